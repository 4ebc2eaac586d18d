# SPDX-License-Identifier: Apache-2.0

"""The scene of all rivals: a ball that lies on a fixed plate with 4 × 4 taxels.

Standard library only: rivals run in environments of their own, each with nothing but its simulator.
"""

import json
import os
import statistics
import time
from collections.abc import Callable

RADIUS_M, MASS_KG = 0.02, 0.2
PLATE_M, THICK_M = 0.028, 0.01
"""Edge and thickness of the plate, whose upper face is at z = 0."""
SIDE, PITCH_M = 4, 0.007
PLACE_M = 0.002, 0.001
"""Where the ball lies on the plate, x and y: not in the middle of the taxels about it."""
STIFFNESS_PA_PER_M = 1e7
"""Stiffness of the plate's cover, that of the simulator's objects by default."""
STEP_S, SETTLED_STEPS = 0.002, 500
QUICK = os.environ.get("QUICK", "") not in ("", "0")
ENVS = 64
CALLS = 20 if QUICK else 200
ROUNDS = 3 if QUICK else 9


def cost_us(function: Callable[[], object], envs: int) -> float:
    """Return the CPU time of a call per environment, µs: the median of some rounds."""
    took_s = []
    for _ in range(ROUNDS):
        begun_s = time.process_time()
        for _ in range(CALLS):
            function()
        took_s.append((time.process_time() - begun_s) / CALLS / envs)
    return statistics.median(took_s) * 1e6


def tell(version: str, envs: int, step_us: float, frame_us: float, forces_n: list[float]) -> None:
    """Print what was found, for the benchmark. step_us: without reading; 0: there are no physics.

    frame_us: with reading. forces_n: on every taxel.
    """
    found = {"version": version, "envs": envs, "step_us": step_us, "frame_us": frame_us}
    print(json.dumps({**found, "forces_n": forces_n}))
