"""Presses the emulated skin and counts what goes wrong: `make firmware-test`.

    node images (AVR, simavr) → pins → analog line → digitizer → packets → the driver's pipeline

with nodes whose clocks and supplies differ; the digitizer is the portable core on a virtual board,
then the RP2040's image.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from emulated import EmulatedSkin, EmulationError
from skin import PressedSkin, reference_amplifier, reference_nodes
from trial import Trial, edge_errors, press_and_decode

from tactile_cdma.parameters import SkinConfig, read_file
from tactile_cdma.sim.scene import SCENES

PARAMS = Path(__file__).resolve().parents[2] / "config" / "wired_skin.yaml"
FRAMES = 300
SETTLED = 8
"""Frames after START in which nodes may still measure the period of the sync edges."""


def main() -> int:
    """Print a line per trial and the sums last; the exit code tells whether all was right."""
    config = SkinConfig.of(read_file(PARAMS))
    trials: list[Trial] = []
    try:
        for name, trial in TRIALS.items():
            begin = time.monotonic()
            trials.append(trial(config))
            print(f"{name}: {summary(trials[-1])} ({time.monotonic() - begin:.0f} s)", flush=True)
    except EmulationError as error:
        print(f"firmware-test: {error}", file=sys.stderr)
        return 1
    wrong, lost = sum(t.wrong for t in trials), sum(t.lost_samples for t in trials)
    frames = sum(t.frames for t in trials)
    print(f"frames={frames} wrong={wrong} lost_samples={lost}")
    return int(bool(wrong or lost) or frames < len(trials) * FRAMES)
