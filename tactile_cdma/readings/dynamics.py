# SPDX-License-Identifier: Apache-2.0

"""Lag and hysteresis of a sensor: what they do to a pressure, and how they are undone.

A pressure P first meets a lag of first order, slow while it rises and quick while it falls, then
hysteresis, a Prandtl–Ishlinskii operator on the logarithmic axis l = ln(1 + P/scale):

    v = (1 − Σ wⱼ)·l + Σ wⱼ·pⱼ,   pⱼ ← max(l, min(l + widthⱼ, pⱼ)),   apparent P = scale·(eᵛ − 1)

A play pⱼ goes along while the pressure rises, and rests after a turn until the pressure has come
back by widthⱼ. So rising loads read what the static curve says, falling ones more, loops grow with
the load, and next to nothing remains at zero. The operator has an exact inverse of its own kind.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..base.errors import SpecError

LEAST_SHARE = 0.1
"""Share of the pressure, on the logarithmic axis, that follows every turn at once."""
LIMITS = {
    "rise_s": (1e-6, 60.0),
    "fall_s": (1e-6, 60.0),
    "scale_pa": (1.0, 1e6),
    "most_gain": (1.0, 20.0),
}
"""Least and most of the single values of Dynamics."""
_OPEN_PA, _OPEN_SHARE = 150.0, 0.01
"""A rise is undone once it exceeds this, 1.5 LSB of the paper's sensor in both of its stages."""
_CLOSED_PA = 5.0
"""And until this is left of it, a small part of an LSB."""


@dataclass(frozen=True, slots=True)
class Dynamics:
    """Lag and hysteresis that the sensors of a skin have in common.

    rise_s, fall_s: time constants of the lag, s.
    scale_pa: pressure above which loops are in proportion to the load, Pa.
    widths: rising; how far plays stay behind, on the logarithmic axis. weights: their shares.
    most_gain: bound of what undoing the lag makes of noise, 1…20.

    Raises SpecError for values that no sensor has, or that cannot be undone.
    """

    rise_s: float
    fall_s: float
    widths: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()
    scale_pa: float = 2e3
    most_gain: float = 4.0

    def __post_init__(self) -> None:
        for name, (low, high) in LIMITS.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise SpecError(
                    f"dynamics: {name} is {value:g}; it must lie within {low:g}…{high:g}"
                )
        if len(self.widths) != len(self.weights):
            raise SpecError(
                f"dynamics: {len(self.widths)} widths but {len(self.weights)} weights; every play "
                "has one of each"
            )
        edges = (0.0, *self.widths, 20.0)
        if not all(low < high for low, high in pairwise(edges)):
            raise SpecError(
                f"dynamics: widths must rise from above 0 to below 20, got {self.widths}"
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
        """What the plays leave: the part of a pressure that follows every turn at once."""
        return 1.0 - sum(self.weights)

    @property
    def noise_gain(self) -> float:
        """Bound of what compensation makes of white noise on a pressure, rms to rms.

        It holds while the lead is on; without it noise grows by 1/share. Peaks of a small
        disturbance of any course grow by (2·most_gain − 1)·(2/share − 1) at most: plays, and what
        the lead follows, never move by more than what moves them.
        """
        return self.most_gain / self.share


class Plays:
    """The plays of n sensors.

    positions: (j, n), where they are, on the logarithmic axis.
    """

    def __init__(self, widths: NDArray[Any], sensors: int, dtype: DTypeLike) -> None:
        """widths: (j,), rising."""
        self._widths = np.asarray(widths, dtype=dtype)[:, None]
        self.positions = np.zeros((len(widths), sensors), dtype=dtype)
        self._upper = np.empty_like(self.positions)

    def follow(self, level: NDArray[Any]) -> NDArray[Any]:
        """Where plays are after the level (n,); a level may also come twice, or in two steps."""
        np.add(level, self._widths, out=self._upper)
        np.minimum(self._upper, self.positions, out=self.positions)
        np.maximum(level, self.positions, out=self.positions)
        return self.positions


class Hysteresis:
    """A Prandtl–Ishlinskii operator for n sensors, from pressures that only rose so far."""

    def __init__(
        self,
        widths: NDArray[Any],
        weights: NDArray[Any],
        scale_pa: float,
        sensors: int,
        dtype: DTypeLike = np.float64,
    ) -> None:
        """widths, weights: (j,), of the plays."""
        self._plays = Plays(widths, sensors, dtype)
        self._weights = np.asarray(weights, dtype=dtype)
        kind = self._weights.dtype.type
        self._share, self._scale_pa = kind(1.0 - np.sum(weights)), kind(scale_pa)

    @classmethod
    def of(cls, dynamics: Dynamics, sensors: int, dtype: DTypeLike = np.float64) -> Hysteresis:
        """What the sensors do."""
        widths, weights = np.array(dynamics.widths), np.array(dynamics.weights)
        return cls(widths, weights, dynamics.scale_pa, sensors, dtype)

    @classmethod
    def undoing(cls, dynamics: Dynamics, sensors: int, dtype: DTypeLike = np.float64) -> Hysteresis:
        """The inverse of what they do; weights are negative.

        K. Kuhnen, "Modeling, identification and compensation of complex hysteretic
        nonlinearities: a modified Prandtl–Ishlinskii approach", Eur. J. Control 9 (2003), 407–418.
        """
        widths, weights = np.array(dynamics.widths), np.array(dynamics.weights)
        slopes = dynamics.share + np.append(0.0, np.cumsum(weights))  # along a loop, turn by turn
        steps = np.diff(widths, prepend=0.0)
        return cls(
            np.cumsum(slopes[:-1] * steps),
            np.diff(1.0 / slopes),
            dynamics.scale_pa,
            sensors,
            dtype,
        )

    def update(self, pressure_pa: NDArray[Any]) -> NDArray[Any]:
        """(n,) Pa to (n,) Pa, both 0 or more; how much time has passed does not matter."""
        level = np.log(1 + pressure_pa / self._scale_pa)
        value = self._share * level + self._weights @ self._plays.follow(level)
        np.maximum(value, 0, out=value)  # an inverse may not know of an earlier load
        return np.asarray(self._scale_pa * (np.exp(value) - 1))

    def forget(self, sensors: NDArray[np.bool_]) -> None:
        """Some sensors (n,) begin anew: their pressures only rose so far."""
        self._plays.positions[:, sensors] = 0


class Lag:
    """A lag of first order of n sensors, not the same for rising and falling pressures."""

    def __init__(self, rise_s: NDArray[Any], fall_s: NDArray[Any]) -> None:
        """rise_s, fall_s: (n,) time constants, s, above 0."""
        self._rise_s, self._fall_s = rise_s, fall_s
        self._delayed_pa: NDArray[np.float64] | None = None

    @classmethod
    def of(cls, dynamics: Dynamics) -> Lag:
        """The same for all sensors."""
        return cls(np.array([dynamics.rise_s]), np.array([dynamics.fall_s]))

    def update(self, pressure_pa: NDArray[np.float64], passed_s: float) -> NDArray[np.float64]:
        """Delayed pressures (n,), Pa, of sensors that had these (n,) for the last passed_s.

        The first pressures have been there for ever.
        """
        if self._delayed_pa is None:
            self._delayed_pa = np.array(pressure_pa, dtype=np.float64)
        missing_pa = pressure_pa - self._delayed_pa
        constant_s = np.where(missing_pa > 0, self._rise_s, self._fall_s)
        self._delayed_pa = self._delayed_pa - missing_pa * np.expm1(-passed_s / constant_s)
        return self._delayed_pa


class Compensator:
    """Undoes lag and hysteresis of n sensors, as far as their noise allows.

    Hysteresis by its exact inverse. The lag of a falling pressure is left alone, it is short; that
    of a rising one is undone by a lead, which would make noise of everything were it not filtered
    with rise_s/most_gain. For frames at an even pace the result is then the true pressure through
    this filter alone. The lead sets in once a pressure has risen by more than the last digit and
    ends when it falls, so a resting sensor does not flicker.

    The result lies within 0…range whatever comes in, and white noise grows at most by
    dynamics.noise_gain. Where the lead sets in or ends the result jumps.
    """

    def __init__(self, dynamics: Dynamics, range_pa: NDArray[Any]) -> None:
        """range_pa: (n,), highest pressures."""
        sensors = len(range_pa)
        self._range_pa = range_pa.astype(np.float32)
        self._hysteresis = Hysteresis.undoing(dynamics, sensors, np.float32)
        self._rise_s, self._most_gain = dynamics.rise_s, dynamics.most_gain
        self._followed_pa = np.full(sensors, np.inf, dtype=np.float32)  # the filter's state
        self._rising = np.zeros(sensors, dtype=bool)
        self._settled = False
        self._last_s = math.inf

    def update(
        self, pressure_pa: NDArray[np.float32], valid: NDArray[np.bool_], t_s: float
    ) -> NDArray[np.float32]:
        """True pressures (n,) float32, Pa, from static ones (n,) float32, Pa, at t_s (s).

        valid: (n,) bool. Sensors without a finite reading give NaN and begin anew afterwards; all
        do when time goes back.
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

    def steady(self, t_s: float) -> bool:
        """Whether the same pressures at t_s (s) give the result of the last update.

        If so, that counts as an update.
        """
        if self._settled and t_s >= self._last_s:
            self._last_s = t_s
            return True
        return False

    def _lead(self, delayed_pa: NDArray[np.float32], passed_s: float) -> NDArray[np.float32]:
        """What the lag had before it. Masks are factors here: choosing takes longer."""
        followed_pa, rising = self._followed_pa, self._rising
        np.minimum(followed_pa, delayed_pa, out=followed_pa)
        ahead_pa = delayed_pa - followed_pa
        near = ahead_pa <= _CLOSED_PA
        rising |= ahead_pa > _OPEN_SHARE * delayed_pa + _OPEN_PA
        rising &= ~near
        self._settled = bool(near.all())
        if self._settled:  # nothing moves any more, so that frames may be skipped
            return np.minimum(delayed_pa, self._range_pa)
        share, gain = self._filter(passed_s)
        result: NDArray[np.float32] = (gain - 1) * ahead_pa
        result *= rising
        result += delayed_pa
        ahead_pa *= share
        followed_pa += ahead_pa
        np.minimum(result, self._range_pa, out=result)
        return result

    def _filter(self, passed_s: float) -> tuple[np.float32, np.float32]:
        """Shares of a step that the filter, and the lead, make of it at once."""
        share = _approached(self._rise_s / self._most_gain, passed_s)
        answer = _approached(self._rise_s, passed_s)
        return np.float32(share), np.float32(share / answer if answer > 0 else self._most_gain)

    def _forget(self, sensors: NDArray[np.bool_]) -> None:
        self._hysteresis.forget(sensors)
        self._followed_pa[sensors] = np.inf
        self._rising[sensors] = False


def _approached(time_constant_s: float, passed_s: float) -> float:
    """Share of a step that a lag of first order has made after some time."""
    return -math.expm1(-passed_s / time_constant_s)
