# SPDX-License-Identifier: Apache-2.0

"""Run the demonstrator, compare every word: `make demo-test`; SYNC=data: its line is pulled low.

The board with its pins joined by resistors at its converter, and with nothing wired, runs in an
emulated RP2040 with a USB host, whose bytes go through the driver's pipeline. What should be heard
follows from the scenes' definition and the nodes' rules of speaking, written down here once more.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from losses import LossyDriver
from rp2040 import EmulatorError, Line, Network, Rp2040
from tactile_cdma.config.parameters import DATA, OWN, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.wire._protocol import Scene
from tactile_cdma.wire.messages import Command
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from trial import Marks

ROOT = Path(__file__).resolve().parents[2]
IMAGE = ROOT / "firmware" / "build" / "rp2040" / "demo.bin"
PARAMS = ROOT / "config" / "demo_skin.yaml"
NODES = 16
RESISTORS = Network((100e3,) * NODES)
PULLED = replace(RESISTORS, pull_ohms=50.0, told=True)
"""With a BSS138 and 47 Ω (firmware/README.md), ohm; its pins are watched."""
SECONDS = 10.0
"""Time of the demonstrator, s: more than one round of its scenes."""
READY_S = 0.05
"""Time by which the host has configured the device, s."""
STEP_S = 0.02
REST, HEARTBEAT, THRESHOLD = 1015, 78, 1
"""Settings in the nodes' memories: LSB, frames, LSB."""
X, Y = np.arange(NODES) % 4, np.arange(NODES) // 4
LOSE_EVERY, MOST_BLIND = 23, 5
"""Frames, one of which is lost to a second driver; after it, most with a value in doubt: the host
looks only every two frames."""
Codes = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Press:
    """Is a touch of the demonstrator's table. x, y: taxels; x_speed: taxels/frame; depth: LSB."""

    x: float
    y: float
    x_speed: float
    depth: int
    frames: int

    def codes(self, frame: int) -> Codes:
        """Return what the nodes measure, (16,); depth rises in 32 frames, and falls in as many."""
        deepest = self.depth * min(frame, self.frames - frame, 32) // 32
        squares = (X - self.x - self.x_speed * frame) ** 2 + (Y - self.y) ** 2
        fallen: Codes = np.floor(deepest * np.maximum(1 - squares / 2, 0)).astype(np.int64)
        return REST - fallen


TABLE = {
    Scene.REST: Press(0, 0, 0, 0, 234),
    Scene.PRESS: Press(1.5, 1.5, 0, 300, 234),
    Scene.SLIDE: Press(-0.5, 500 / 256, 4 / 256, 400, 256),
}


def all_scenes(frame: int) -> Codes:
    """Return the codes of frame `frame` of the table's scenes, one after another."""
    frame %= sum(press.frames for press in TABLE.values())
    for press in TABLE.values():
        if frame < press.frames:
            return press.codes(frame)
        frame -= press.frames
    raise AssertionError


class Nodes:
    """Tells when nodes speak: while a code is off its rest, or off what was sent, and in turn."""

    def __init__(self) -> None:
        self.last = np.full(NODES, REST)
        self._turn = np.arange(NODES) * HEARTBEAT // NODES

    def speak(self, frame: int, codes: Codes, asked: bool = False) -> NDArray[np.bool_]:
        """Tell who speaks, (16,). asked: all are to."""
        speaks: NDArray[np.bool_] = (np.abs(codes - REST) > THRESHOLD) | (
            np.abs(codes - self.last) > THRESHOLD
        )
        speaks |= asked | (self._turn == frame % HEARTBEAT)
        self.last[speaks] = codes[speaks]
        return speaks


@dataclass(frozen=True, slots=True)
class Heard:
    """Holds what the driver made of the stream.

    codes, active: (16,) by the frame's number since START. lossy: a driver that lost frames.
    sync_faults: pulses that were late, or that the line did not follow.
    """

    codes: dict[int, NDArray[np.int32]]
    active: dict[int, NDArray[np.bool_]]
    lost_samples: int
    digitizer_id: bytes
    lossy: LossyDriver | None = None
    sync_faults: int = 0


def listen(
    line: Line | Network,
    seconds: float = SECONDS,
    script: dict[float, list[Command]] | None = None,
    lose_every: int = 0,
    wire: str = OWN,
    **watched: Any,
) -> Heard:
    """Run the image and decode as the driver does.

    script: commands, by the time at which they are sent, s. lose_every: so many frames one is lost
    to a second driver, which asks all nodes to speak. wire: of the sync pulses. watched: on_sync,
    on_pin of Rp2040.
    """
    config = SkinConfig.of(read_file(PARAMS) | {"sync_wire": wire})
    pipeline, parser, marks = Pipeline(config), PacketParser(), Marks(config)
    writer, left = PacketWriter(), dict(script or {})
    session, frames = Session(config), list[TactileFrame]()
    lossy = LossyDriver(config, session, lose_every) if lose_every else None
    with Rp2040(IMAGE, line, **watched) as chip:
        chip.plug_usb()
        chip.run(READY_S)
        chip.write_usb(session.open())
        while chip.now < seconds:
            for due_s in [due_s for due_s in left if due_s <= chip.now]:
                chip.write_usb(b"".join(map(writer.encode, left.pop(due_s))))
            chip.run(chip.now + STEP_S)
            data = chip.read_usb()
            for packet in parser.feed(data):
                marks.take(packet)
            frames += pipeline.feed(data, chip.now)
            if lossy and (request := lossy.feed(data, chip.now)):
                chip.write_usb(request)
    if lossy:
        lossy.compare(frames)
    period_ns = config.spec.frame_period_s * 1e9
    numbers = [round((marks.nearest(frame) - marks.marks_ns[0]) / period_ns) for frame in frames]
    assert pipeline.digitizer.info is not None
    return Heard(
        {number: frame.words.codes for number, frame in zip(numbers, frames, strict=True)},
        {number: frame.words.active for number, frame in zip(numbers, frames, strict=True)},
        pipeline.counters.lost_samples,
        pipeline.digitizer.info.digitizer_id,
        lossy,
        pipeline.digitizer.status.sync_faults if pipeline.digitizer.status else 0,
    )


def count_words(heard: Heard, truth: Callable[[int], Codes]) -> tuple[int, int]:
    """Count words that were right; and those that were wrong, missing or made up.

    Frames in which all speak are those in which all were asked to.
    """
    nodes, right, wrong = Nodes(), 0, 0
    for number in range(max(heard.codes) + 1):
        codes = truth(number)
        active = heard.active.get(number, np.zeros(NODES, bool))
        speaks = nodes.speak(number, codes, bool(active.all()))
        good = (active == speaks) & (~speaks | (heard.codes.get(number) == codes))
        right, wrong = right + int(np.sum(good & speaks)), wrong + int(np.sum(~good))
    return right, wrong


@dataclass(slots=True)
class FrameStarts:
    """Notes when the pins' first edges of a frame come after its sync pulse, ns."""

    after_ns: list[float] = field(default_factory=list)
    _pulse_ns: float | None = None

    def sync(self, t_ns: float, rises: bool) -> None:
        """Take an edge of the sync pin."""
        if rises:
            self._pulse_ns = t_ns

    def pin(self, t_ns: float, pin: int, level: int) -> None:
        """Take a change of a node's pin."""
        if self._pulse_ns is not None and level < 2:
            self.after_ns.append(t_ns - self._pulse_ns)
            self._pulse_ns = None

    @property
    def spread_us(self) -> float:
        """Return by how much they differ from frame to frame."""
        return (max(self.after_ns) - min(self.after_ns)) / 1e3


def floating(times_ns: NDArray[np.float64]) -> NDArray[np.uint16]:
    """Return the counts of a pin that nothing is connected to: hum."""
    return (600 + 400 * np.sin(times_ns * 1e-9 * 2 * np.pi * 50)).astype(np.uint16)


def main() -> int:
    """Print a line per mode and the sums last; exit code 1 on any error."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--sync-wire", choices=(OWN, DATA), default=OWN)
    given = parser.parse_args()
    seconds, wire = given.seconds, given.sync_wire
    frames = wrong = lost = blind = 0
    modes: dict[str, Line | Network] = {
        "summed pins": RESISTORS,
        "a skin without a wire": floating,
    }
    starts = FrameStarts()
    watched: dict[str, Any] = {}
    if wire == DATA:  # without a wire there is none to pull
        modes, watched = {"pulled line": PULLED}, {"on_sync": starts.sync, "on_pin": starts.pin}
    for name, line in modes.items():
        begin = time.monotonic()
        try:
            heard = listen(line, seconds, lose_every=LOSE_EVERY, wire=wire, **watched)
        except EmulatorError as error:
            print(f"demo-test: {name}: {error}", file=sys.stderr)
            return 1
        right, false = count_words(heard, all_scenes)
        frames, wrong = frames + len(heard.codes), wrong + false
        lost += heard.lost_samples
        lossy = heard.lossy
        assert lossy is not None
        wrong += lossy.wrong + lossy.unflagged
        blind = max(blind, lossy.most_blind)
        print(
            f"{name}: frames={len(heard.codes)} words={right} wrong={false} "
            f"lost_samples={heard.lost_samples} lost_on_purpose={lossy.lost} "
            f"blind_frames={lossy.most_blind} ({time.monotonic() - begin:.0f} s)",
            flush=True,
        )
    counts = f"frames={frames} wrong={wrong} lost_samples={lost}"
    if wire == DATA:
        print(f"sync=data wires=3 {counts} edge_spread_us={starts.spread_us:.2f}")
    else:
        print(f"nodes={NODES} {counts} blind_frames={blind}")
    few = frames < len(modes) * 70 * (seconds - 1)
    return int(wrong + lost > 0 or not 0 < blind <= MOST_BLIND or few)


if __name__ == "__main__":
    sys.exit(main())
