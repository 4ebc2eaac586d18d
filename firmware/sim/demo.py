# SPDX-License-Identifier: Apache-2.0

"""Run the demonstrator's image and compare every word: `make demo-test`.

Its pins, joined by resistors at its converter, and the same board with nothing wired, are run in an
emulated RP2040 with a USB host, through the driver's pipeline. What should be heard follows from the
scenes' definition and the nodes' rules of speaking, both written down here once more.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rp2040 import EmulatorError, Line, Network, Rp2040
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.driver.session import Session
from tactile_cdma.wire._protocol import Scene
from tactile_cdma.wire.messages import Command, RollCall, Touch
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from trial import Marks

ROOT = Path(__file__).resolve().parents[2]
IMAGE = ROOT / "firmware" / "build" / "rp2040" / "demo.bin"
PARAMS = ROOT / "config" / "demo_skin.yaml"
NODES = 16
RESISTORS = Network((100e3,) * NODES)
SECONDS = 10.0
"""Of the demonstrator's time: more than one round of its scenes."""
STEP_S = 0.02
REST, HEARTBEAT, THRESHOLD = 1015, 78, 1
"""In the nodes' memories: LSB, frames, LSB."""
X, Y = np.arange(NODES) % 4, np.arange(NODES) // 4
Codes = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Press:
    """A touch of the demonstrator's table. x, y: taxels; x_speed: taxels per frame; depth: LSB."""

    x: float
    y: float
    x_speed: float
    depth: int
    frames: int

    def codes(self, frame: int) -> Codes:
        """(16,) what the nodes measure; the depth rises in 32 frames, and falls in as many."""
        deepest = self.depth * min(frame, self.frames - frame, 32) // 32
        squares = (X - self.x - self.x_speed * frame) ** 2 + (Y - self.y) ** 2
        return REST - np.floor(deepest * np.maximum(1 - squares / 2, 0)).astype(np.int64)


TABLE = {
    Scene.REST: Press(0, 0, 0, 0, 234),
    Scene.PRESS: Press(1.5, 1.5, 0, 300, 234),
    Scene.SLIDE: Press(-0.5, 500 / 256, 4 / 256, 400, 256),
}


def all_scenes(frame: int) -> Codes:
    """The codes of frame `frame` of the table's scenes, one after another."""
    frame %= sum(press.frames for press in TABLE.values())
    for press in TABLE.values():
        if frame < press.frames:
            return press.codes(frame)
        frame -= press.frames
    raise AssertionError


class Nodes:
    """When nodes speak: while their code is off its rest or off what was sent last, and in turn."""

    def __init__(self) -> None:
        self.last = np.full(NODES, REST)
        self._turn = np.arange(NODES) * HEARTBEAT // NODES

    def speak(self, frame: int, codes: Codes, called: int | None = None) -> NDArray[np.bool_]:
        """(16,) who speaks. called: the only one who may, in a roll call."""
        speaks = (np.abs(codes - REST) > THRESHOLD) | (np.abs(codes - self.last) > THRESHOLD)
        speaks |= self._turn == frame % HEARTBEAT
        if called is not None:
            speaks = np.arange(NODES) == called
        self.last[speaks] = codes[speaks]
        return speaks


@dataclass(frozen=True, slots=True)
class Heard:
    """What the driver made of the stream. codes, active: by the frame's number since START, (16,)."""

    codes: dict[int, NDArray[np.int32]]
    active: dict[int, NDArray[np.bool_]]
    lost_samples: int
    info_id: bytes


def listen(
    line: Line | Network,
    seconds: float = SECONDS,
    commands: Callable[[float], list[Command]] = lambda now_s: [],
    values: dict[str, object] | None = None,
    on_chip: Callable[[Rp2040], None] = lambda chip: None,
) -> Heard:
    """Run the image and decode. commands: to be sent at a time, asked for after every step.

    values: parameters that differ from demo_skin.yaml. on_chip: called once the stream runs.
    """
    config = SkinConfig.of(read_file(PARAMS) | (values or {}))
    pipeline, parser, marks = Pipeline(config, background=False), PacketParser(), Marks(config)
    writer, heard = PacketWriter(), Heard({}, {}, 0, b"")
    frames = []
    with Rp2040(IMAGE, line) as chip:
        chip.plug_usb()
        chip.run(0.05)
        chip.write_usb(Session(config).open())
        on_chip(chip)
        while chip.now < seconds:
            chip.run(chip.now + STEP_S)
            data = chip.read_usb()
            for packet in parser.feed(data):
                marks.take(packet)
            frames += pipeline.feed(data, chip.now)
            for command in commands(chip.now):
                chip.write_usb(writer.encode(command))
    first_ns, period_ns = marks.marks_ns[0], config.spec.frame_period_s * 1e9
    for frame in frames:
        number = round((marks.nearest(frame) - first_ns) / period_ns)
        heard.codes[number] = frame.words.codes
        heard.active[number] = frame.words.active
    assert pipeline.digitizer.info is not None
    return Heard(
        heard.codes,
        heard.active,
        pipeline.counters.lost_samples,
        pipeline.digitizer.info.digitizer_id,
    )


def count_wrong(heard: Heard, truth: Callable[[int], Codes]) -> tuple[int, int]:
    """Words of the table's scenes: right ones; and wrong, missing or made up ones."""
    nodes, right, wrong = Nodes(), 0, 0
    for number in range(max(heard.codes) + 1):
        codes = truth(number)
        speaks = nodes.speak(number, codes)
        if number not in heard.codes:
            wrong += int(speaks.sum())
            continue
        active = heard.active[number]
        same = active == speaks
        same &= ~speaks | (heard.codes[number] == codes)
        wrong += int(np.sum(~same))
        right += int(np.sum(same & speaks))
    return right, wrong


def floating(times_ns: NDArray[np.float64]) -> NDArray[np.uint16]:
    """The counts of a pin that nothing is connected to: hum."""
    return (600 + 400 * np.sin(times_ns * 1e-9 * 2 * np.pi * 50)).astype(np.uint16)


def main() -> int:
    """Print a line per mode and the sums last; exit code 1 on any error."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=SECONDS)
    seconds = parser.parse_args().seconds
    frames = wrong = lost = 0
    for name, line in {"summed pins": RESISTORS, "a skin without a wire": floating}.items():
        begin = time.monotonic()
        try:
            heard = listen(line, seconds)
        except EmulatorError as error:
            print(f"demo-test: {name}: {error}", file=sys.stderr)
            return 1
        right, false = count_wrong(heard, all_scenes)
        frames, wrong = frames + len(heard.codes), wrong + false
        lost += heard.lost_samples
        print(
            f"{name}: frames={len(heard.codes)} words={right} wrong={false} "
            f"lost_samples={heard.lost_samples} ({time.monotonic() - begin:.0f} s)",
            flush=True,
        )
    print(f"nodes={NODES} frames={frames} wrong={wrong} lost_samples={lost}")
    return int(wrong + lost > 0 or frames < 2 * 70 * (seconds - 1))


if __name__ == "__main__":
    sys.exit(main())
