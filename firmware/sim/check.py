# SPDX-License-Identifier: Apache-2.0

"""Press the emulated skin and count errors: `make firmware-test`; SYNC=data: sync on the data wire.

SENSORS=4: nodes of four sensors only, on either wire.

    node images (AVR, simavr) → pins → analog line → digitizer → packets → the driver's pipeline

with nodes whose clocks differ by ±2 % and supplies by ±3 %, a moving contact, and every node
transmitting in every frame. The digitizer is the core on a virtual board, then the RP2040's image.
Fast nodes have crystals, ±100 ppm; their edges are compared in test/firmware/test_fast_node.py.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from breadboard import breadboard_line, breadboard_nodes
from emulated import EmulatedNodes, EmulatedSkin, EmulationError
from rp2040 import EmulatorError
from rp2040_skin import Rp2040Skin
from skin import Digitized, PressedSkin, Spread, reference_amplifier, reference_nodes
from tactile_cdma.config.frame_rate import FAST, FOUR, MCUS, TINY_ON_DATA
from tactile_cdma.config.parameters import DATA, OWN, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.hardware.passive import passive_line
from tactile_cdma.sim.scene import SCENES
from tactile_cdma.wire._protocol import SYNC_LEAD, SYNC_UNIT_US
from trial import Trial, edge_errors, press_and_decode

PARAMS = Path(__file__).resolve().parents[2] / "config" / "wired_skin.yaml"
BREADBOARD, THOUSAND = (
    PARAMS.with_name(f"{name}.yaml") for name in ("breadboard", "thousand_skin")
)
FAST_SKIN = {
    "nodes": 60,
    "rows": 6,
    "columns": 10,
    "order": 64,
    "resync_chips": 64,
    "frame_period_ms": 3.2,
    "amplitude_mv": 34.63,
}
"""Fewer of these nodes, of a shorter code."""
SIXTEEN_PASSIVE = {"polarity": 1, "amplitude_mv": 15.3}
FRAMES = 300
"""Per trial. Chosen: seconds of emulation."""
COMPARATOR_V = 1.24
"""Level below which no frame may bring the data wire, V: the bandgap's 1.2 and 40 mV of offset."""
HISTORY_S = 60.0
"""Longer than a trial lasts: the edges of all its frames are compared."""


@dataclass(frozen=True, slots=True)
class Edges:
    """Holds errors of the edges at the nodes' pins, µs: an array per node and frame; and a note."""

    errors_us: Sequence[NDArray[np.float64]] = ()
    note: str = ""

    @property
    def spread_us(self) -> float:
        """Return by how much edges of different nodes and frames are apart."""
        means = [errors.mean() for errors in self.errors_us]
        return float(max(means) - min(means)) if means else 0.0

    @property
    def jitter_us(self) -> float:
        """Return the largest change of the error from one edge to the next."""
        return float(max(np.abs(np.diff(errors)).max() for errors in self.errors_us))

    def __str__(self) -> str:
        if not self.errors_us:
            return self.note
        most = max(np.abs(errors).max() for errors in self.errors_us)
        return f"edge_us_max={most:.3f} jitter_us_max={self.jitter_us:.3f} {self.note}"


Tried = tuple[Trial, Edges]


def on_virtual_board(config: SkinConfig, mcu: str, frames: int) -> Tried:
    """Try nodes of one kind on the core's virtual board."""
    nodes = reference_nodes(config, mcu=mcu, threshold=0)
    with EmulatedSkin(nodes, reference_amplifier(config), history_s=HISTORY_S) as skin:
        trial = press(skin, skin, config, frames)
        return trial, edges(skin, config, trial.words)


def on_rp2040(config: SkinConfig, frames: int, mcu: str = "atmega328p") -> Tried:
    """Try nodes on the RP2040's image with a USB host; edges relate to its sync pin."""
    nodes = reference_nodes(config, mcu=mcu, threshold=0)
    with Rp2040Skin(nodes, reference_amplifier(config)) as skin:
        trial = press(skin, skin, config, frames)
        starts = np.array(skin.pulses_ns) + SYNC_LEAD * SYNC_UNIT_US * 1000
        by_pulse = {
            int(starts[np.abs(starts - mark_ns).argmin()]): codes
            for mark_ns, codes in trial.words.items()
        }
        measured = edges(skin, config, by_pulse)
        return trial, replace(measured, note=f"cpu_load={skin.chip.load:.2f} ")


def fast_on_virtual_board(frames: int) -> Tried:
    """Try 60 nodes with chips of 2 µs on the core's virtual board."""
    config = SkinConfig.of(read_file(THOUSAND) | FAST_SKIN)
    nodes = reference_nodes(config, Spread(clock=100e-6), mcu=FAST, threshold=0)
    with EmulatedSkin(nodes, reference_amplifier(config), history_s=0.1) as skin:
        return press(skin, skin, config, frames), Edges(note=f"nodes={config.spec.nodes} ")


def on_breadboard(frames: int, config: SkinConfig, ohm: float, bias_ohm: float) -> Tried:
    """Try nodes without an amplifier; the last node has 16 MHz and 5 V.

    Raises EmulationError for a frame that comparators on the data wire may take for a pulse.
    """
    line = passive_line(config.spec, input_ohm=ohm, bias_ohm=bias_ohm)
    with (
        breadboard_nodes(config, unos=1) as nodes,
        EmulatedSkin(nodes, breadboard_line(line, config), history_s=HISTORY_S) as skin,
    ):
        trial = press(skin, skin, config, frames)
        if skin.lowest_v < COMPARATOR_V:
            raise EmulationError(
                f"a frame pulls the line to {skin.lowest_v:.2f} V, below {COMPARATOR_V} V, which "
                "nodes may take for a sync pulse: larger input resistors, or sync_wire own"
            )
        return trial, edges(skin, config, trial.words)


def edges(nodes: EmulatedNodes, config: SkinConfig, words: dict[int, NDArray[np.int32]]) -> Edges:
    """Compare the edges at the nodes' pins with those of these words."""
    return Edges([errors / 1e3 for errors in edge_errors(nodes, config.spec, words)])


def press(nodes: EmulatedNodes, digitizer: Digitized, config: SkinConfig, frames: int) -> Trial:
    """Try a skin with a contact that moves over it."""
    skin = PressedSkin(config, SCENES["moving"], nodes, digitizer)
    return press_and_decode(skin, config, frames)


def plan_of(wire: str, sensors: int) -> dict[str, Callable[[], Tried]]:
    """List the trials. On the data wire: of nodes that hear sync pulses there."""
    on_wire = {"sync_wire": wire}
    config = SkinConfig.of(read_file(PARAMS) | on_wire)
    four = SkinConfig.of(read_file(BREADBOARD) | on_wire)
    tiny = TINY_ON_DATA if wire == DATA else "attiny85"
    sixteen = SkinConfig.of(read_file(PARAMS) | SIXTEEN_PASSIVE | on_wire)
    plan: dict[str, Callable[[], Tried]] = {
        "16 ATmega328P, core": lambda: on_virtual_board(config, "atmega328p", FRAMES),
        "16 ATmega328P, RP2040": lambda: on_rp2040(config, FRAMES),
        "4 passive, one of 16 MHz": lambda: on_breadboard(FRAMES, four, 33e3, 2200.0),
        "16 ATtiny85, core": lambda: on_virtual_board(config, tiny, FRAMES),
        "16 passive, one of 16 MHz": lambda: on_breadboard(FRAMES, sixteen, 100e3, 2000.0),
    }
    modules: dict[str, Callable[[], Tried]] = {
        "4 of four sensors, core": lambda: on_virtual_board(config, FOUR, FRAMES),
        "4 of four sensors, RP2040": lambda: on_rp2040(config, FRAMES, FOUR),
    }
    if sensors > 1:
        return modules
    if wire == OWN:
        plan |= {
            "60 fast ATmega328P, core": lambda: fast_on_virtual_board(FRAMES),
        }
    return plan


def main() -> int:
    """Print a line per trial and the sums last; exit code 1 on any error."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sync-wire", choices=(OWN, DATA), default=OWN)
    parser.add_argument("--sensors", type=int, choices=(1, MCUS[FOUR].sensors), default=1)
    given = parser.parse_args()
    wire = given.sync_wire
    trials, spread_us, plan = [], 0.0, plan_of(wire, given.sensors)
    for name, run in plan.items():
        begin = time.monotonic()
        try:
            trial, measured = run()
        except (EmulationError, EmulatorError) as error:
            print(f"firmware-test: {name}: {error}", file=sys.stderr)
            return 1
        trials.append(trial)
        spread_us = max(spread_us, measured.spread_us)
        print(
            f"{name}: frames={trial.frames} wrong={trial.wrong} "
            f"silent={trial.silent} lost_samples={trial.lost_samples} {measured}"
            f"({time.monotonic() - begin:.0f} s)",
            flush=True,
        )
    # Every node has to transmit in every frame, so a silent one is wrong, too.
    frames, wrong = sum(t.frames for t in trials), sum(t.wrong + t.silent for t in trials)
    lost_samples = sum(t.lost_samples for t in trials)
    counts = f"frames={frames} wrong={wrong} lost_samples={lost_samples}"
    on_data = f"sync=data wires=3 {counts} edge_spread_us={spread_us:.2f}"
    print(on_data if wire == DATA else counts)
    return int(wrong > 0 or lost_samples > 0 or frames < FRAMES * len(plan))


if __name__ == "__main__":
    sys.exit(main())
