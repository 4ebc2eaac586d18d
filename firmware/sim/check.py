# SPDX-License-Identifier: Apache-2.0

"""Press the emulated skin and count errors: `make firmware-test`.

    node images (AVR, simavr) → pins → analog line → digitizer → packets → the driver's pipeline

with nodes whose clocks differ by ±2 % and supplies by ±3 %, a moving contact, and every node
transmitting in every frame. The digitizer is the core on a virtual board, then the RP2040's image.
Fast nodes have crystals, ±100 ppm; their edges are compared in test/firmware/test_fast_node.py.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from breadboard import breadboard_line, breadboard_nodes
from emulated import EmulatedNodes, EmulatedSkin, EmulationError
from rp2040 import EmulatorError
from rp2040_skin import Rp2040Skin
from skin import Digitized, PressedSkin, Spread, reference_amplifier, reference_nodes
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.hardware.node_memory import FAST
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
HISTORY_S = 60.0
"""Longer than a trial lasts: the edges of all its frames are compared."""


def on_virtual_board(config: SkinConfig, mcu: str, frames: int) -> tuple[Trial, str]:
    """Try nodes of one kind on the core's virtual board; returns the errors at their pins, too."""
    nodes = reference_nodes(config, mcu=mcu, threshold=0)
    with EmulatedSkin(nodes, reference_amplifier(config), history_s=HISTORY_S) as skin:
        trial = press(skin, skin, config, frames)
        return trial, edges(skin, config, trial.words)


def on_rp2040(config: SkinConfig, frames: int) -> tuple[Trial, str]:
    """Try nodes on the RP2040's image with a USB host; edges relate to its sync pin."""
    nodes = reference_nodes(config, threshold=0)
    with Rp2040Skin(nodes, reference_amplifier(config)) as skin:
        trial = press(skin, skin, config, frames)
        starts = np.array(skin.pulses_ns) + SYNC_LEAD * SYNC_UNIT_US * 1000
        by_pulse = {
            int(starts[np.abs(starts - mark_ns).argmin()]): codes
            for mark_ns, codes in trial.words.items()
        }
        return trial, f"{edges(skin, config, by_pulse)} cpu_load={skin.chip.load:.2f}"


def fast_on_virtual_board(frames: int) -> tuple[Trial, str]:
    """Try 60 nodes with chips of 2 µs on the core's virtual board."""
    config = SkinConfig.of(read_file(THOUSAND) | FAST_SKIN)
    nodes = reference_nodes(config, Spread(clock=100e-6), mcu=FAST, threshold=0)
    with EmulatedSkin(nodes, reference_amplifier(config), history_s=0.1) as skin:
        return press(skin, skin, config, frames), f"nodes={config.spec.nodes}"


def on_breadboard(
    frames: int, config: SkinConfig, ohm: float, bias_ohm: float
) -> tuple[Trial, str]:
    """Try nodes without an amplifier; the last node has 16 MHz and 5 V."""
    line = passive_line(config.spec, input_ohm=ohm, bias_ohm=bias_ohm)
    with (
        breadboard_nodes(config, unos=1) as nodes,
        EmulatedSkin(nodes, breadboard_line(line), history_s=HISTORY_S) as skin,
    ):
        trial = press(skin, skin, config, frames)
        return trial, edges(skin, config, trial.words)


def edges(nodes: EmulatedNodes, config: SkinConfig, words: dict[int, NDArray[np.int32]]) -> str:
    """Return the largest error of an edge, and its largest change from one edge to the next, µs."""
    errors_us = [errors / 1e3 for errors in edge_errors(nodes, config.spec, words)]
    edge_us = max(np.abs(errors).max() for errors in errors_us)
    jitter_us = max(np.abs(np.diff(errors)).max() for errors in errors_us)
    return f"edge_us_max={edge_us:.3f} jitter_us_max={jitter_us:.3f}"


def press(nodes: EmulatedNodes, digitizer: Digitized, config: SkinConfig, frames: int) -> Trial:
    """Try a skin with a contact that moves over it."""
    skin = PressedSkin(config, SCENES["moving"], nodes, digitizer)
    return press_and_decode(skin, config, frames)


def main() -> int:
    """Print a line per trial and the sums last; exit code 1 on any error."""
    config = SkinConfig.of(read_file(PARAMS))
    trials = []
    plan: dict[str, Callable[[], tuple[Trial, str]]] = {
        "16 ATmega328P, core": lambda: on_virtual_board(config, "atmega328p", FRAMES),
        "16 ATtiny85, core": lambda: on_virtual_board(config, "attiny85", FRAMES),
        "60 fast ATmega328P, core": lambda: fast_on_virtual_board(FRAMES),
        "16 ATmega328P, RP2040": lambda: on_rp2040(config, FRAMES),
        "4 passive, one of 16 MHz": lambda: on_breadboard(
            FRAMES, SkinConfig.of(read_file(BREADBOARD)), 22e3, 2200.0
        ),
        "16 passive, one of 16 MHz": lambda: on_breadboard(
            FRAMES, SkinConfig.of(read_file(PARAMS) | SIXTEEN_PASSIVE), 100e3, 2000.0
        ),
    }
    for name, run in plan.items():
        begin = time.monotonic()
        try:
            trial, measured = run()
        except (EmulationError, EmulatorError) as error:
            print(f"firmware-test: {name}: {error}", file=sys.stderr)
            return 1
        trials.append(trial)
        print(
            f"{name}: frames={trial.frames} wrong={trial.wrong} "
            f"silent={trial.silent} lost_samples={trial.lost_samples} {measured} "
            f"({time.monotonic() - begin:.0f} s)",
            flush=True,
        )
    # Every node has to transmit in every frame, so a silent one is wrong, too.
    frames, wrong = sum(t.frames for t in trials), sum(t.wrong + t.silent for t in trials)
    lost_samples = sum(t.lost_samples for t in trials)
    print(f"frames={frames} wrong={wrong} lost_samples={lost_samples}")
    return int(wrong > 0 or lost_samples > 0 or frames < FRAMES * len(plan))


if __name__ == "__main__":
    sys.exit(main())
