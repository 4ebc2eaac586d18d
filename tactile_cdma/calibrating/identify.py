# SPDX-License-Identifier: Apache-2.0

"""Lag and hysteresis of a skin's sensors, from loading cycles with a known pressure.

The static pressures that the sensors show are, on the logarithmic axis of `dynamics`, linear in the
weights of the plays once the lag is given. So for many time constants at once the plays follow the
known pressure, non-negative least squares give their weights, and the time constants that leave
least are refined. Where the clock of the known pressure is only known roughly, what is left of its
offset is one more unknown, linear for small ones. The last third of the record takes no part: on it
the result has to prove itself, through the very compensation that will run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.errors import CalibrationError
from ..readings.dynamics import Compensator, Dynamics, Lag, Plays

Floats = NDArray[np.float64]
WIDTHS = (0.03, 0.06, 0.1, 0.15, 0.22, 0.32, 0.45, 0.65, 0.9, 1.3)
"""Of the plays: from a few per cent of the load to more than half of it."""
MOST_WEIGHT = 0.75
"""All plays together; more would quadruple noise where pressures turn."""
LEAST_POINTS, LEAST_CYCLES = 200, 3
LEAST_LOAD_PA = 5e3
LEAST_REMOVED = 0.1
"""Share of the error that must go; chance takes a few per cent of any."""
MOST_LEFT = 0.2
"""Share of the largest load that may be left of the error: less than of any sensor worth it."""
SCALE_PA = 2e3
_RISES_S, _FALLS_S = (2e-3, 3.0), (2e-3, 1.0)
_TRIES = 16
_SHRINK = (1.0, 0.15, 0.03)
_REPEATS = 3
"""Of each of these steps, where the clock is to be found, too."""
_SWEEPS = 300
_PROBE_S = 0.1
"""A lag that the loads must be quick enough to show."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """The m frames of n nodes that were not fitted.

    t_s: (m,) s. reference_pa: (m,) known pressure, Pa. static_pa, compensated_pa: (m, n), Pa, NaN
    where a node has no reading.
    """

    t_s: Floats
    reference_pa: Floats
    static_pa: NDArray[np.floating]
    compensated_pa: NDArray[np.floating]

    @property
    def before_pa(self) -> float:
        """Rms error of the static pressures of the middle one of the nodes, Pa."""
        return self._error_pa(self.static_pa)

    @property
    def after_pa(self) -> float:
        """The same with compensation."""
        return self._error_pa(self.compensated_pa)

    @property
    def removed(self) -> float:
        """Share of the error that compensation removes."""
        return 1.0 - self.after_pa / self.before_pa

    def _error_pa(self, pressure_pa: NDArray[np.floating]) -> float:
        return float(np.nanmedian(_rms(pressure_pa - self.reference_pa[:, None])))


@dataclass(frozen=True, eq=False)
class Identified:
    """Dynamics, and what their compensation makes of cycles that they were not fitted to.

    cycles: loads and releases in the record. late_s: so much too late was the reference, s.
    """

    dynamics: Dynamics
    cycles: int
    late_s: float
    held_out: HeldOut


def identify(
    t_s: Floats,
    reference_pa: Floats,
    pressure_pa: NDArray[np.floating],
    uncertain_s: float = 0.0,
) -> Identified:
    """The dynamics that all sensors of a skin share.

    t_s: (m,) rising, s. reference_pa: (m,) the known pressure on all taxels, Pa. pressure_pa:
    (m, n) what the static curves make of the voltages of n nodes, Pa; NaN where there is none.
    uncertain_s: by how much the reference may be too late or too early as a whole, s.

    Raises CalibrationError, with the reason, where the record cannot tell.
    """
    _check(t_s, reference_pa, pressure_pa)
    cycles = _cycles(reference_pa)
    if cycles < LEAST_CYCLES:
        raise CalibrationError(
            f"the loads rise and fall {cycles} times; dynamics take {LEAST_CYCLES} cycles or more"
        )
    heard = np.isfinite(pressure_pa).any(axis=1)
    t_s, reference_pa, pressure_pa = t_s[heard], reference_pa[heard], pressure_pa[heard]
    fit = _Fit(t_s, reference_pa, np.nanmedian(pressure_pa, axis=1), uncertain_s)
    dynamics = _search(fit)
    last = slice(fit.fitted, None)
    compensated_pa = _compensated(dynamics, t_s, pressure_pa)
    held_out = HeldOut(t_s[last], fit.reference_pa[last], pressure_pa[last], compensated_pa[last])
    if not held_out.after_pa < (1 - LEAST_REMOVED) * held_out.before_pa:
        raise CalibrationError(
            "what the first cycles taught makes the last ones hardly better: "
            f"{held_out.before_pa:.0f} Pa rms before, {held_out.after_pa:.0f} Pa after; do the "
            "curves and the reference belong together?"
        )
    if held_out.after_pa > MOST_LEFT * held_out.reference_pa.max():
        raise CalibrationError(
            f"{held_out.after_pa:.0f} Pa rms stay of loads up to {held_out.reference_pa.max():.0f} "
            "Pa: do the capture, the reference and the curves belong together?"
        )
    return Identified(dynamics, cycles, fit.late_s, held_out)


@dataclass(frozen=True, eq=False)
class _Solution:
    """What fits best for k pairs of time constants.

    (k, j) weights of the plays; (k,) so much later still is the reference, s; (k,) what all that
    leaves unexplained, Pa rms.
    """

    weights: Floats
    late_s: Floats
    left_pa: Floats


class _Fit:
    """Weights of the plays for given time constants, many at once."""

    def __init__(
        self, t_s: Floats, reference_pa: Floats, measured_pa: Floats, uncertain_s: float
    ) -> None:
        self.fitted = len(t_s) * 2 // 3
        self.reference_pa, self.late_s = reference_pa, 0.0
        self.uncertain_s = uncertain_s
        self._t_s, self._given_pa = t_s, reference_pa
        self._passed_s = np.diff(t_s, prepend=t_s[0])
        # On the logarithmic axis errors count by what they are in Pa.
        self._relevance = (SCALE_PA + measured_pa)[: self.fitted, None]
        self._measured = np.log1p(measured_pa[: self.fitted, None] / SCALE_PA)

    def delayed(self, rise_s: Floats, fall_s: Floats) -> Floats:
        """(m', k) the known pressure behind lags of k pairs of time constants."""
        lag = Lag(rise_s, fall_s)
        course = zip(self.reference_pa[: self.fitted], self._passed_s.tolist(), strict=False)
        return np.array([lag.update(np.full(len(rise_s), p), passed) for p, passed in course])

    def solve(self, rise_s: Floats, fall_s: Floats) -> _Solution:
        """What explains the fitted part best, for k pairs of time constants."""
        levels = np.log1p(self.delayed(rise_s, fall_s) / SCALE_PA)
        plays = Plays(np.array(WIDTHS), len(rise_s), np.float64)
        behind = np.array([plays.follow(level) - level for level in levels])  # (m', j, k)
        if self.uncertain_s:
            ahead = np.gradient(levels, self._t_s[: self.fitted], axis=0)[:, None]
            behind = np.concatenate((behind, ahead, -ahead), axis=1)
        behind *= self._relevance[:, :, None]
        wanted = (self._measured - levels) * self._relevance
        columns = behind.transpose(2, 1, 0)
        found = _non_negative(
            columns @ columns.transpose(0, 2, 1),
            np.einsum("kjm,mk->kj", columns, wanted),
        )
        weights = found[:, : len(WIDTHS)]
        weights *= MOST_WEIGHT / np.maximum(weights.sum(axis=1, keepdims=True), MOST_WEIGHT)
        left_pa = _rms(wanted - np.einsum("kjm,kj->mk", columns, found))
        late_s = found[:, len(WIDTHS) :] @ [1, -1] if self.uncertain_s else np.zeros(len(found))
        return _Solution(weights, late_s, left_pa)

    def shift(self, late_s: float) -> None:
        """The reference was so much later still than it should have been."""
        most_s = self.uncertain_s
        self.late_s = min(max(self.late_s + late_s, -most_s), most_s)
        self.reference_pa = np.interp(self._t_s + self.late_s, self._t_s, self._given_pa)


def _search(fit: _Fit) -> Dynamics:
    """The time constants, and the weights with them, that leave least; the reference is shifted."""
    rise_s, fall_s = (math.sqrt(low * high) for low, high in (_RISES_S, _FALLS_S))
    # An offset of the clocks that is not yet right makes the time constants wrong by as much.
    for shrink in np.repeat(_SHRINK, _REPEATS if fit.uncertain_s else 1):
        rise_s = _best(fit, _around(rise_s, _RISES_S, shrink), np.array([fall_s]))[0]
        falls_s = _around(fall_s, _FALLS_S, shrink)
        # What both lags have in common looks much like an offset of the clocks.
        rises_s = rise_s + falls_s - fall_s if fit.uncertain_s else np.array([rise_s])
        rise_s, fall_s = _best(fit, np.clip(rises_s, *_RISES_S), falls_s)
        if fit.uncertain_s:
            fit.shift(float(fit.solve(np.array([rise_s]), np.array([fall_s])).late_s[0]))
    if abs(fit.late_s) >= fit.uncertain_s > 0:
        raise CalibrationError(
            f"the clocks differ by {fit.uncertain_s:g} s or more from the offset that was found by "
            "matching the loads: give --offset"
        )
    found = fit.solve(np.array([rise_s]), np.array([fall_s]))
    probe = fit.delayed(np.array([1e-6, _PROBE_S]), np.array([1e-6, 1e-6]))
    shown_pa = float(_rms(probe[:, 1] - probe[:, 0]))
    if shown_pa < found.left_pa[0]:
        raise CalibrationError(
            f"a lag of {_PROBE_S:g} s would change the readings by {shown_pa:.0f} Pa rms, but "
            f"{found.left_pa[0]:.0f} Pa stay unexplained anyway: the loads change too slowly to "
            "tell, or capture and reference do not belong together"
        )
    return Dynamics(
        rise_s=float(rise_s),
        fall_s=float(fall_s),
        widths=WIDTHS,
        weights=tuple(found.weights[0].tolist()),
        scale_pa=SCALE_PA,
    )


def _around(centre_s: float, limits_s: tuple[float, float], share: float) -> Floats:
    """Time constants about one, evenly on a logarithmic axis, over a share of the whole range."""
    reach = (limits_s[1] / limits_s[0]) ** (share / 2)
    return np.clip(np.geomspace(centre_s / reach, centre_s * reach, _TRIES), *limits_s)


def _best(fit: _Fit, rise_s: Floats, fall_s: Floats) -> tuple[float, float]:
    """The pair that leaves least, of pairs given along one axis."""
    rise_s, fall_s = np.broadcast_arrays(rise_s, fall_s)
    best = np.argmin(fit.solve(rise_s, fall_s).left_pa)
    return float(rise_s[best]), float(fall_s[best])


def _non_negative(gram: Floats, right: Floats) -> Floats:
    """Minima of wᵀ·G·w/2 − rᵀ·w with w ≥ 0, (k, j), one weight after another, over and over.

    gram: (k, j, j), positive semidefinite; right: (k, j).
    """
    weights = np.zeros_like(right)
    for _ in range(_SWEEPS):
        for j in range(right.shape[1]):
            own = gram[:, j, j]
            pull = right[:, j] - (gram[:, j] * weights).sum(axis=1) + own * weights[:, j]
            free = np.divide(pull, own, out=np.zeros_like(pull), where=own > 0)
            weights[:, j] = np.maximum(free, 0.0)
    return weights


def _compensated(
    dynamics: Dynamics, t_s: Floats, pressure_pa: NDArray[np.floating]
) -> NDArray[np.float32]:
    nodes = pressure_pa.shape[1]
    highest_pa = 2 * float(np.nanmax(pressure_pa))  # out of the way: it is not to help
    compensator = Compensator(dynamics, np.full(nodes, highest_pa))
    everywhere = np.ones(nodes, dtype=bool)
    rows = pressure_pa.astype(np.float32)
    return np.array(
        [compensator.update(row, everywhere, t) for row, t in zip(rows, t_s.tolist(), strict=True)]
    )


def _check(t_s: Floats, reference_pa: Floats, pressure_pa: NDArray[np.floating]) -> None:
    points = len(t_s)
    if reference_pa.shape != (points,) or pressure_pa.ndim != 2 or len(pressure_pa) != points:
        raise CalibrationError(
            f"{points} times, {reference_pa.shape} reference pressures and {pressure_pa.shape} "
            "readings: there must be one of each, and one reading per node, for every frame"
        )
    if points < LEAST_POINTS:
        raise CalibrationError(f"{points} frames; dynamics take {LEAST_POINTS} or more")
    if not (np.isfinite(t_s).all() and np.all(np.diff(t_s) > 0)):
        raise CalibrationError("times must rise from frame to frame")
    if not np.isfinite(reference_pa).all():
        raise CalibrationError("the reference pressure is not known for every frame")
    if np.isfinite(pressure_pa).any(axis=1).mean() < 0.5:
        raise CalibrationError("in more than half of the frames no node has a reading")
    if (highest_pa := reference_pa.max()) < LEAST_LOAD_PA:
        raise CalibrationError(
            f"the loads reach {highest_pa:.0f} Pa; dynamics take {LEAST_LOAD_PA:.0f} Pa or more. "
            "Is the reference in Pa?"
        )
    if np.ptp(reference_pa) < 0.1 * highest_pa:
        raise CalibrationError("the reference pressure hardly changes; dynamics take cycles")
    if (lowest_pa := reference_pa.min()) < -0.05 * highest_pa:
        raise CalibrationError(f"the reference pressure falls to {lowest_pa:.0f} Pa, below zero")


def _cycles(reference_pa: Floats) -> int:
    """How often the load rises well above its middle after it was well below."""
    low, high = np.quantile(reference_pa, (0.02, 0.98))
    share = (reference_pa - low) / (high - low)
    pressed = share[(share < 0.4) | (share > 0.6)] > 0.5
    return int(np.count_nonzero(pressed[1:] & ~pressed[:-1]))


def _rms(values: NDArray[np.floating]) -> Floats:
    """Down the columns, without what is missing; NaN where all is."""
    known = np.isfinite(values)
    squares = np.where(known, np.square(values, dtype=np.float64), 0.0).sum(axis=0)
    counts = np.maximum(known.sum(axis=0), 1)
    return np.asarray(np.where(known.any(axis=0), np.sqrt(squares / counts), np.nan))
