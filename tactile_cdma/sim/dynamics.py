# SPDX-License-Identifier: Apache-2.0

"""Lag and hysteresis of simulated sensors.

A pressure P first passes a first-order lag, slow while it rises and quick while it falls, then
hysteresis, a Prandtl–Ishlinskii operator on the logarithmic axis l = ln(1 + P/SCALE_PA):

    v = (1 − Σ wⱼ)·l + Σ wⱼ·pⱼ,   pⱼ ← max(l, min(l + widthⱼ, pⱼ)),   apparent P = SCALE_PA·(eᵛ − 1)

A play pⱼ follows while the pressure rises; after a turn it rests until the pressure has fallen by
widthⱼ. So rising loads read as the static curve says, falling ones read more, loops grow with the
load, and almost nothing remains at zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.arrays import Floats

SCALE_PA = 2e3
"""Pressure above which loops are proportional to the load, Pa; chosen: far below the loads for
which the paper gives loops."""


@dataclass(frozen=True, slots=True)
class Dynamics:
    """Lag and hysteresis common to all sensors of a skin.

    rise_s, fall_s: time constants of the lag, s, above 0.
    widths: widths of the plays on the logarithmic axis. weights: their shares, of less than 1 in
    all.
    """

    rise_s: float
    fall_s: float
    widths: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()


class Hysteresis:
    """A Prandtl–Ishlinskii operator for n sensors; it starts as if pressures had only risen."""

    def __init__(self, dynamics: Dynamics, sensors: int) -> None:
        self._widths = np.array(dynamics.widths)[:, None]
        self._weights = np.array(dynamics.weights)
        self._plays = np.zeros((len(self._weights), sensors))

    def update(self, pressure_pa: Floats) -> Floats:
        """Apparent pressures (n,), Pa, for pressures (n,), Pa, ≥ 0; whatever the time.

        Repeating or subdividing a step changes nothing.
        """
        level = np.log1p(pressure_pa / SCALE_PA)
        self._plays = np.maximum(level, np.minimum(level + self._widths, self._plays))
        value = (1 - self._weights.sum()) * level + self._weights @ self._plays
        return np.asarray(SCALE_PA * np.expm1(value))


class Lag:
    """A first-order lag of n sensors, with separate time constants for rise and fall."""

    def __init__(self, dynamics: Dynamics) -> None:
        self._rise_s, self._fall_s = dynamics.rise_s, dynamics.fall_s
        self._delayed_pa: Floats | None = None

    def update(self, pressure_pa: Floats, passed_s: float) -> Floats:
        """Lagged pressures (n,), Pa, after these pressures (n,), Pa, were applied for passed_s.

        The first pressures count as applied since ever.
        """
        if self._delayed_pa is None:
            self._delayed_pa = np.array(pressure_pa, dtype=np.float64)
        missing_pa = pressure_pa - self._delayed_pa
        constant_s = np.where(missing_pa > 0, self._rise_s, self._fall_s)
        self._delayed_pa = self._delayed_pa - missing_pa * np.expm1(-passed_s / constant_s)
        return self._delayed_pa
