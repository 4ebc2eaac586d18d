# SPDX-License-Identifier: Apache-2.0

"""A body of 936 nodes on 13 Picos, whose frames begin together: `make firmware-body`.

    config/big_body.yaml → for each patch: images of its nodes (simavr) → pins → line → the RP2040's
    image → USB → a recording;  all recordings, as they came → one driver process, its body → words

Every Pico has a crystal of its own and is started at another time. The sync line of the one that
drives is wired to the pin by which the others hear. Patches are emulated one after the other, some
at once: nothing but that line joins them, and none of them tells the one that drives anything.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from emulated import EmulationError
from rp2040 import HUB, Bus, EmulatorError
from rp2040_skin import Rp2040Skin
from skin import CRYSTALS, PressedSkin, reference_amplifier, reference_nodes
from tactile_cdma import Body, Frame
from tactile_cdma.base.errors import TactileError
from tactile_cdma.config.body_file import Patch, read_body
from tactile_cdma.config.frame_rate import mcu_of
from tactile_cdma.config.parameters import DRIVES, Value
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.recording.recording_file import Recorder
from thousand import Listener, RandomPresses
from trial import BEFORE_MARK_NS, MOST_WRONG_LSB, press_and_decode

BODY = Path(__file__).resolve().parents[2] / "config" / "big_body.yaml"
FRAMES, QUICK = 250, 50
SETTLING = 6
"""First frames, not counted: nodes start up and measure two periods of the sync line."""
SPARE = 2
"""Last frames, not counted: a body's last round is over when another one begins."""
WAIT_S = 3.0
"""From the begin of a recording to its first frame, s: a body waits 2 s for all patches."""
LATEST_S = 0.06
"""Latest start of a stream, s. Chosen: three frame periods after the first."""
PICO_CRYSTAL = 30e-6
"""Relative error of a Pico's crystal (its data sheet: ±30 ppm)."""
MOST_SKEW_US = 100.0
"""Frames of all patches begin within this, µs: a hundredth of a contact's rise is 0.1 ms."""

Edges = Sequence[tuple[int, bool]]
"""Times of a line's edges, ns, and whether they rise."""


@dataclass(frozen=True, slots=True)
class Plan:
    """A patch to emulate. heard: edges of the line at the pin that hears; begin_s: of START."""

    name: str
    values: Mapping[str, Value]
    recording: Path
    frames: int
    seed: int
    clock_error: float
    begin_s: float
    bus: Bus | None
    heard: Edges = ()


@dataclass(frozen=True, slots=True)
class Emulated:
    """What became of a patch.

    marks_ns: when its frames began, by its digitizer's clock, which is fast by clock_error. truth:
    codes of its sensors' voltages in these frames, (frames, n). edges: of its sync line.
    """

    plan: Plan
    marks_ns: Sequence[int]
    truth: NDArray[np.int64]
    lost_samples: int
    edges: Edges
    cpu_load: float
    bytes_per_s: float


def emulate(plan: Plan) -> Emulated:
    """Run a patch until so many frames have come."""
    config = SkinConfig.of(plan.values)
    spread = replace(CRYSTALS, seed=plan.seed)
    mcu = mcu_of(config.node_kind, config.sync_wire)
    nodes = reference_nodes(config, spread, mcu=mcu, threshold=0, rest=0)
    with ExitStack() as stack:
        recorder = stack.enter_context(
            Recorder(plan.recording, "emulated RP2040", 0, dict(plan.values))
        )
        recorder.write(b"\0", time.monotonic())
        amplifier = reference_amplifier(config)
        skin = stack.enter_context(Rp2040Skin(nodes, amplifier, plan.bus, plan.clock_error))
        skin.hear(plan.heard)
        listener = Listener(skin, recorder, WAIT_S)
        pressed = PressedSkin(config, RandomPresses(plan.seed), skin, listener)
        pressed.run(round(plan.begin_s * 1e9))
        trial = press_and_decode(pressed, config, plan.frames + SPARE, SETTLING)
        marks_ns = list(trial.words)[:-SPARE]
        truth = np.array([pressed.codes(mark_ns - BEFORE_MARK_NS) for mark_ns in marks_ns])
        told = skin.edges_ns, skin.chip.load, plan.recording.stat().st_size / (skin.now_ns * 1e-9)
        return Emulated(plan, marks_ns, truth, trial.lost_samples, *told)


def emulate_all(
    patches: Sequence[Patch], frames: int, seed: int, folder: Path, bus: Bus | None
) -> list[Emulated]:
    """Emulate the patch that drives, then all others, which hear it."""
    rng = np.random.default_rng(seed)
    plans = [
        Plan(
            patch.name,
            {**patch.values, "port": "/dev/null"},
            folder / f"{patch.name}.skin",
            frames,
            seed + number,
            rng.uniform(-PICO_CRYSTAL, PICO_CRYSTAL),
            rng.uniform(0.0, LATEST_S),
            bus,
        )
        for number, patch in enumerate(patches)
    ]
    drives = [plan.values.get("sync", DRIVES) == DRIVES for plan in plans]
    if drives.count(True) != 1:
        raise EmulationError(f"{drives.count(True)} patches drive; one is to be the clock of all")
    clock = plans[drives.index(True)]
    period_s = SkinConfig.of(clock.values).spec.frame_period_s
    longer = math.ceil(LATEST_S / period_s) + SETTLING
    first = emulate(replace(clock, frames=frames + longer))
    others = [replace(plan, heard=first.edges) for plan in plans if plan.name != clock.name]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        return [first, *pool.map(emulate, others)]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Counts of a body.

    frames: in which every patch's words were compared. wrong: words that were missing or more than
    one LSB off. doubtful: words that were called so. skew_us: most by which patches' frames began
    apart. bytes_per_s: of all patches.
    """

    nodes: int
    period_s: float
    frames: int
    wrong: int
    doubtful: int
    lost_samples: int
    skew_us: float
    cpu_load: float
    bytes_per_s: float


def drive(folder: Path, emulated: Sequence[Emulated]) -> dict[str, list[Frame]]:
    """Replay all patches to one driver process and its body; returns the frames of each patch."""
    patches = {
        patch.plan.name: {
            "parameters": {
                **patch.plan.values,
                "port": f"replay://{patch.plan.recording}",
            }
        }
        for patch in emulated
    }
    path = folder / "body.yaml"
    path.write_text(json.dumps({"frame_id": "body", "process": "one", "patches": patches}))
    heard: dict[str, dict[int, Frame]] = {name: {} for name in patches}
    with Body(path) as body:
        for together in body:
            for name, frame in together.patches.items():
                heard[name][frame.sequence] = frame
    return {name: list(frames.values()) for name, frames in heard.items()}


def compare(emulated: Sequence[Emulated], heard: Mapping[str, Sequence[Frame]]) -> Outcome:
    """Compare the driver's words with what the nodes' sensors had, and begins of frames."""
    config = SkinConfig.of(emulated[0].plan.values)
    spec = config.spec
    wrong, doubtful, begins_us = 0, 0, dict[int, list[float]]()
    for patch in emulated:
        frames = np.array([frame.t_device for frame in heard[patch.plan.name]])
        for mark_ns, truth in zip(patch.marks_ns, patch.truth, strict=True):
            middle_s = mark_ns * 1e-9 + spec.chip_s * spec.span_chips / 2
            near = int(np.abs(frames - middle_s).argmin()) if frames.size else 0
            if not frames.size or abs(frames[near] - middle_s) > spec.frame_period_s / 4:
                wrong += truth.size
                continue
            frame = heard[patch.plan.name][near]
            good = frame.active & (np.abs(frame.codes - truth) <= MOST_WRONG_LSB)
            wrong += int(np.sum(~good))
            doubtful += int(np.sum(frame.doubtful))
            begin_s = frames[near] - spec.chip_s * spec.span_chips / 2
            begin_us = begin_s * 1e6 / (1 + patch.plan.clock_error)
            number = round((begin_us * 1e-6 - _first_s(emulated[0])) / spec.frame_period_s)
            begins_us.setdefault(number, []).append(begin_us)
    whole = [begins for begins in begins_us.values() if len(begins) == len(emulated)]
    return Outcome(
        sum(patch.truth.shape[1] for patch in emulated),
        spec.frame_period_s,
        len(whole),
        wrong,
        doubtful,
        sum(patch.lost_samples for patch in emulated),
        max((max(begins) - min(begins) for begins in whole), default=math.inf),
        max(patch.cpu_load for patch in emulated),
        sum(patch.bytes_per_s for patch in emulated),
    )


def _first_s(patch: Emulated) -> float:
    """Return when a patch's first frame began, s on the emulation's axis."""
    return patch.marks_ns[0] * 1e-9 / (1 + patch.plan.clock_error)


def whole_body(
    patches: Sequence[Patch], frames: int, seed: int = 1, bus: Bus | None = HUB
) -> Outcome:
    """Emulate the patches of a body for so many frames, and have one driver read them."""
    with TemporaryDirectory(prefix="body-") as name:
        emulated = emulate_all(patches, frames, seed, Path(name), bus)
        return compare(emulated, drive(Path(name), emulated))


def main() -> int:
    """Print the counts last; exit code 1 on any error."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} frames, not {FRAMES}")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    frames, begin = QUICK if arguments.quick else FRAMES, time.monotonic()
    try:
        patches = read_body(BODY).patches
        found = whole_body(patches, frames, arguments.seed)
    except (EmulationError, EmulatorError, OSError, TactileError) as error:
        print(f"firmware-body: {error}", file=sys.stderr)
        return 1
    print(
        f"doubtful={found.doubtful} usb_kb_s={found.bytes_per_s / 1e3:.0f} "
        f"cpu_load={found.cpu_load:.2f} ({time.monotonic() - begin:.0f} s)"
    )
    print(
        f"patches={len(patches)} nodes={found.nodes} frame_ms={found.period_s * 1e3:g} "
        f"frames={found.frames} wrong={found.wrong} lost_samples={found.lost_samples} "
        f"skew_us={found.skew_us:.1f}"
    )
    too_few = found.frames < frames - SETTLING
    return int(too_few or found.wrong + found.lost_samples > 0 or found.skew_us > MOST_SKEW_US)


if __name__ == "__main__":
    sys.exit(main())
