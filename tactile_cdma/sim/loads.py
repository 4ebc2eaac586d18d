# SPDX-License-Identifier: Apache-2.0

"""Scenes for calibration: known loads, the same on all taxels."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .scene import Scene, SkinGeometry

_RISING_KPA = (*range(0, 60, 5), *range(60, 141, 10))
STEPS_KPA = (*_RISING_KPA, *_RISING_KPA[-2:0:-1])
"""The staircase of "steps", kPa: up to the end of the range and down again, repeatedly."""
DWELL_S = 2.0
"""Duration of each of these loads, s: the paper's sensor settles in 0.74 s."""
TURNS_KPA = (0, 140, 20, 90, 0, 55, 10, 120, 40, 75, 0, 110, 60, 140, 0, 40)
"""The loads between which "cycles" swings, kPa, repeatedly."""
TURN_S = 2.0
"""Duration of each swing, s."""


def steps(t_s: float, skin: SkinGeometry) -> NDArray[np.float64]:
    """The loads STEPS_KPA one after the other, DWELL_S each."""
    return _everywhere(skin, STEPS_KPA[int(t_s / DWELL_S) % len(STEPS_KPA)])


def cycles(t_s: float, skin: SkinGeometry) -> NDArray[np.float64]:
    """Half a cosine in TURN_S from each load of TURNS_KPA to the next."""
    turn, share = divmod(t_s / TURN_S, 1.0)
    begin, end = _SWINGS[int(turn) % len(_SWINGS)]
    return _everywhere(skin, begin + (end - begin) * (0.5 - 0.5 * math.cos(math.pi * share)))


LOADS: dict[str, Scene] = {"steps": steps, "cycles": cycles}

_SWINGS = tuple(pairwise((*TURNS_KPA, TURNS_KPA[0])))


def _everywhere(skin: SkinGeometry, load_kpa: float) -> NDArray[np.float64]:
    return np.full(len(skin.positions_m), load_kpa * 1e3)
