# SPDX-License-Identifier: Apache-2.0

"""Sensor models that the compensation does not assume, beside the one that it does.

All but "creep" read a load that rises slowly as their static curve says. Pressures may change
between two frames, which compensation cannot see.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.readings.dynamics import Hysteresis, Lag
from tactile_cdma.sim.sensor import PAPER_DYNAMICS

Floats = NDArray[np.float64]
Distortion = Callable[[Floats, float], Floats]
"""(true pressures (n,), Pa, their duration, s) → apparent pressures (n,), Pa."""

HIGHEST_PA = 140e3
_PARTS = 2
"""Steps from one frame to the next."""


class Paper:
    """Lag and Prandtl–Ishlinskii plays, as the compensation assumes."""

    def __init__(self, sensors: int) -> None:
        self._lag = Lag(PAPER_DYNAMICS.rise_s, PAPER_DYNAMICS.fall_s)
        self._hysteresis = Hysteresis(PAPER_DYNAMICS, sensors)

    def __call__(self, pressure_pa: Floats, passed_s: float) -> Floats:
        return self._hysteresis.update(self._lag.update(pressure_pa, passed_s))


class Relays:
    """The same lag, then a classical Preisach operator, whose loops are others at every load.

    I. D. Mayergoyz, "Mathematical Models of Hysteresis and Their Applications" (2003), chapter 1.
    """

    LEVELS = 100
    SHARE = 0.2
    """Share of the reading that relays make; the rest follows at once."""

    def __init__(self, sensors: int) -> None:
        self._lag = Lag(PAPER_DYNAMICS.rise_s, PAPER_DYNAMICS.fall_s)
        levels_pa = (np.arange(self.LEVELS) + 0.5) * HIGHEST_PA / self.LEVELS
        up, down = np.tril_indices(self.LEVELS)
        self._up_pa, self._down_pa = levels_pa[up, None], levels_pa[down, None]
        # Most relays are narrow, and wide ones belong to high loads.
        weights = np.exp(-4 * (1 - levels_pa[down] / levels_pa[up])) * np.sqrt(levels_pa[up])
        self._weights_pa = self.SHARE * HIGHEST_PA * weights / weights.sum()
        self._on = np.zeros((len(up), sensors), dtype=bool)
        self._ends_pa = np.arange(self.LEVELS + 1) * HIGHEST_PA / self.LEVELS
        risen_pa = np.append(0.0, np.cumsum(np.bincount(up, self._weights_pa)))
        self._shown_pa = (1 - self.SHARE) * self._ends_pa + risen_pa

    def __call__(self, pressure_pa: Floats, passed_s: float) -> Floats:
        pressure_pa = self._lag.update(pressure_pa, passed_s)
        self._on |= pressure_pa >= self._up_pa
        self._on &= pressure_pa > self._down_pa
        shown_pa = (1 - self.SHARE) * pressure_pa + self._weights_pa @ self._on
        return np.asarray(np.interp(shown_pa, self._shown_pa, self._ends_pa))


class Creep:
    """A generalised Kelvin–Voigt solid: shares of a load show at once, in 0.15 s, and in 4 s."""

    TIMES_S = np.array([0.15, 4.0])[:, None]
    SHARES = np.array([0.25, 0.1])[:, None]

    def __init__(self, sensors: int) -> None:
        self._crept_pa = np.zeros((len(self.TIMES_S), sensors))

    def __call__(self, pressure_pa: Floats, passed_s: float) -> Floats:
        missing_pa = self.SHARES * pressure_pa - self._crept_pa
        self._crept_pa -= missing_pa * np.expm1(-passed_s / self.TIMES_S)
        return np.asarray((1 - self.SHARES.sum()) * pressure_pa + self._crept_pa.sum(axis=0))


class Quick:
    """Neither lag nor loops: nothing to compensate."""

    def __init__(self, sensors: int) -> None:
        pass

    def __call__(self, pressure_pa: Floats, passed_s: float) -> Floats:
        return pressure_pa


KINDS: dict[str, Callable[[int], Distortion]] = {
    "the paper's": Paper,
    "relays": Relays,
    "creep": Creep,
    "quick": Quick,
}


def apparent(kind: Callable[[int], Distortion], loads_pa: Floats, period_s: float) -> Floats:
    """Apparent pressure at every frame, (m, n) Pa, under loads (m, n), Pa, linear in between."""
    sensors, before_pa, shown = kind(loads_pa.shape[1]), loads_pa[0], []
    for load_pa in loads_pa:
        for part in range(1, _PARTS + 1):
            shown_pa = sensors(before_pa + (load_pa - before_pa) * part / _PARTS, period_s / _PARTS)
        before_pa = load_pa
        shown.append(shown_pa)
    return np.array(shown)
