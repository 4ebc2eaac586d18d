# SPDX-License-Identifier: Apache-2.0

"""Lag and hysteresis of the sensors: a model of both, and their compensation.

A pressure P first passes a first-order lag, slow while it rises and quick while it falls, then
hysteresis, a Prandtl–Ishlinskii operator on the logarithmic axis l = ln(1 + P/scale):

    v = (1 − Σ wⱼ)·l + Σ wⱼ·pⱼ,   pⱼ ← max(l, min(l + widthⱼ, pⱼ)),   apparent P = scale·(eᵛ − 1)

A play pⱼ follows while the pressure rises; after a turn it rests until the pressure has fallen by
widthⱼ. So rising loads read as the static curve says, falling ones read more, loops grow with the
load, and almost nothing remains at zero. The inverse is exact and an operator of the same kind.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..base.arrays import Bools, Floats, Floats32
from ..base.errors import SpecError, check_limits

LEAST_SHARE = 0.1
"""Smallest share of the pressure, on the logarithmic axis, that may follow every turn at once;
chosen: the inverse amplifies noise by up to 1/share."""
LIMITS = {
    "rise_s": (1e-6, 60.0),
    "fall_s": (1e-6, 60.0),
    "scale_pa": (1.0, 1e6),
    "most_gain": (1.0, 20.0),
}
"""Limits of the scalar fields of Dynamics."""
MOST_WIDTH = 20.0
"""Limit of a play's width on the logarithmic axis: a load of e²⁰ times the scale."""
_OPEN_PA, _OPEN_SHARE = 150.0, 0.01
"""The lead starts once a rise exceeds _OPEN_PA + _OPEN_SHARE · pressure, Pa: with the paper's
sensor 1.5 LSB of 98 Pa near zero, and 1.2…2.8 LSB of 546 Pa in the second stage."""
_CLOSED_PA = 5.0
"""It ends when less than this is left of the rise, Pa; chosen: 1/20 LSB of the first stage."""


@dataclass(frozen=True, slots=True)
class Dynamics:
    """Lag and hysteresis common to all sensors of a skin.

    rise_s, fall_s: time constants of the lag, s.
    scale_pa: pressure above which loops are proportional to the load, Pa.
    widths: rising; widths of the plays on the logarithmic axis. weights: their shares.
    most_gain: upper bound of the noise gain of undoing the lag, 1…20.

    Raises SpecError for values outside LIMITS, or that cannot be undone.
    """

    rise_s: float
    fall_s: float
    widths: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()
    scale_pa: float = 2e3
    most_gain: float = 4.0

    def __post_init__(self) -> None:
        for name, (low, high) in LIMITS.items():
            check_limits(f"dynamics: {name}", getattr(self, name), low, high)
        if len(self.widths) != len(self.weights):
            raise SpecError(
                f"dynamics: {len(self.widths)} widths but {len(self.weights)} weights; every play "
                "has one of each"
            )
        edges = (0.0, *self.widths, MOST_WIDTH)
        if not all(low < high for low, high in pairwise(edges)):
            raise SpecError(
                f"dynamics: widths must rise from above 0 to below {MOST_WIDTH:g}, got "
                f"{self.widths}"
            )
        if not all(weight >= 0 for weight in self.weights):
            raise SpecError(f"dynamics: weights must not be negative, got {self.weights}")
        if not self.share >= LEAST_SHARE:
            raise SpecError(
                f"dynamics: weights add up to {sum(self.weights):g}; above {1 - LEAST_SHARE:g} "
                "hysteresis cannot be undone"
            )

    @property
    def share(self) -> float:
        """The share without play: the part of a pressure that follows every turn at once."""
        return 1.0 - sum(self.weights)

    @property
    def noise_gain(self) -> float:
        """Upper bound of compensation's gain of white noise on a pressure, rms to rms.

        It holds while the lead is on; otherwise the gain is at most 1/share. The peak of a small
        disturbance of any shape grows by (2·most_gain − 1)·(2/share − 1) at most, as plays and the
        lead's filter never move by more than their input.
        """
        return self.most_gain / self.share


class Plays:
    """The plays of n sensors.

    positions: (j, n), on the logarithmic axis.
    """

    def __init__(self, widths: NDArray[Any], sensors: int, dtype: DTypeLike) -> None:
        """widths: (j,), rising."""
        self._widths = np.asarray(widths, dtype=dtype)[:, None]
        self.positions = np.zeros((len(widths), sensors), dtype=dtype)
        self._upper = np.empty_like(self.positions)

    def follow(self, level: NDArray[Any]) -> NDArray[Any]:
        """Positions after the levels (n,); repeating or subdividing a step changes nothing."""
        np.add(level, self._widths, out=self._upper)
        np.minimum(self._upper, self.positions, out=self.positions)
        np.maximum(level, self.positions, out=self.positions)
        return self.positions


class Hysteresis:
    """A Prandtl–Ishlinskii operator for n sensors; it starts as if pressures had only risen."""

    def __init__(
        self, dynamics: Dynamics, sensors: int, dtype: DTypeLike = np.float64, inverse: bool = False
    ) -> None:
        """inverse: undo the sensors' hysteresis; the weights of this operator are negative.

        K. Kuhnen, "Modeling, identification and compensation of complex hysteretic
        nonlinearities: a modified Prandtl–Ishlinskii approach", Eur. J. Control 9 (2003), 407–418.
        """
        widths, weights = np.array(dynamics.widths), np.array(dynamics.weights)
        if inverse:
            slopes = dynamics.share + np.append(0.0, np.cumsum(weights))  # of a loop, turn by turn
            widths = np.cumsum(slopes[:-1] * np.diff(widths, prepend=0.0))
            weights = np.diff(1.0 / slopes)
        self._plays = Plays(widths, sensors, dtype)
        self._weights = np.asarray(weights, dtype=dtype)
        kind = self._weights.dtype.type
        self._share, self._scale_pa = kind(1.0 - np.sum(weights)), kind(dynamics.scale_pa)

    def update(self, pressure_pa: NDArray[Any]) -> NDArray[Any]:
        """Output pressures (n,), Pa, ≥ 0, for input pressures (n,), Pa, ≥ 0; whatever the time."""
        level = np.log(1 + pressure_pa / self._scale_pa)
        value = self._share * level + self._weights @ self._plays.follow(level)
        np.maximum(value, 0, out=value)  # an inverse that missed an earlier load could go below
        return np.asarray(self._scale_pa * (np.exp(value) - 1))

    def forget(self, sensors: Bools) -> None:
        """Restart the sensors of a mask (n,) as if their pressures had only risen."""
        self._plays.positions[:, sensors] = 0


class Lag:
    """A first-order lag of n sensors, with separate time constants for rise and fall."""

    def __init__(self, rise_s: float | Floats, fall_s: float | Floats) -> None:
        """rise_s, fall_s: time constants, s, above 0; of all sensors, or (n,)."""
        self._rise_s, self._fall_s = rise_s, fall_s
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


class Compensator:
    """Compensates lag and hysteresis of n sensors, as far as their noise allows.

    Hysteresis is undone by its exact inverse. The lag of a falling pressure is short and remains;
    that of a rising one is undone by a lead, low-pass filtered with rise_s/most_gain to limit the
    noise. For frames at an even rate the result is the true pressure through this filter alone.
    The lead starts once a pressure has risen by more than quantisation explains and ends when it
    falls, so a resting sensor does not flicker.

    The result lies within 0…range for any input, and white noise grows at most by
    dynamics.noise_gain. Where the lead starts or ends the result jumps.
    """

    def __init__(self, dynamics: Dynamics, range_pa: NDArray[Any]) -> None:
        """range_pa: (n,), highest pressures, Pa."""
        sensors = len(range_pa)
        self._range_pa = range_pa.astype(np.float32)
        self._hysteresis = Hysteresis(dynamics, sensors, np.float32, inverse=True)
        self._rise_s, self._most_gain = dynamics.rise_s, dynamics.most_gain
        self._followed_pa = np.full(sensors, np.inf, dtype=np.float32)  # the filter's state
        self._rising = np.zeros(sensors, dtype=bool)
        self._settled = False
        self._last_s = math.inf

    def update(self, pressure_pa: Floats32, valid: Bools, t_s: float) -> Floats32:
        """True pressures (n,) float32, Pa, from static ones (n,) float32, Pa, at t_s (s).

        valid: (n,) bool. Sensors without a finite reading give NaN and start over afterwards; all
        sensors start over when time goes back.
        """
        passed_s, self._last_s = t_s - self._last_s, t_s
        if not passed_s >= 0:
            self._forget(np.ones(len(valid), dtype=bool))
            passed_s = 0.0
        valid = valid & np.isfinite(pressure_pa)
        everywhere = bool(valid.all())
        if not everywhere:
            pressure_pa = np.where(valid, pressure_pa, np.float32(0))
        delayed_pa = self._hysteresis.update(np.clip(pressure_pa, 0, self._range_pa))
        result = self._lead(delayed_pa, passed_s)
        if not everywhere:
            self._forget(~valid)
            result[~valid] = np.nan
        return result

    def try_hold(self, t_s: float) -> bool:
        """Keep the last result for the same pressures at t_s (s), if an update would give it.

        Returns whether it stands; if so, this counts as an update.
        """
        if self._settled and t_s >= self._last_s:
            self._last_s = t_s
            return True
        return False

    def _lead(self, delayed_pa: Floats32, passed_s: float) -> Floats32:
        """Pressures before the lag. Masks are used as factors, which is quicker than selecting."""
        followed_pa, rising = self._followed_pa, self._rising
        np.minimum(followed_pa, delayed_pa, out=followed_pa)
        ahead_pa = delayed_pa - followed_pa
        near = ahead_pa <= _CLOSED_PA
        rising |= ahead_pa > _OPEN_SHARE * delayed_pa + _OPEN_PA
        rising &= ~near
        self._settled = bool(near.all())
        if self._settled:  # nothing moves, so frames may be skipped
            return np.minimum(delayed_pa, self._range_pa)
        # Shares of a step that the filter and the lead follow within passed_s.
        share = _approached(self._rise_s / self._most_gain, passed_s)
        answer = _approached(self._rise_s, passed_s)
        gain = share / answer if answer > 0 else self._most_gain
        result: Floats32 = (np.float32(gain) - 1) * ahead_pa
        result *= rising
        result += delayed_pa
        ahead_pa *= np.float32(share)
        followed_pa += ahead_pa
        np.minimum(result, self._range_pa, out=result)
        return result

    def _forget(self, sensors: Bools) -> None:
        self._hysteresis.forget(sensors)
        self._followed_pa[sensors] = np.inf
        self._rising[sensors] = False


def _approached(time_constant_s: float, passed_s: float) -> float:
    """Share of a step that a first-order lag has followed after passed_s."""
    return -math.expm1(-passed_s / time_constant_s)
