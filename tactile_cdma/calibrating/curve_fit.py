# SPDX-License-Identifier: Apache-2.0

"""Robust fit of continuous piecewise linear curves, for the sensors of a whole skin at once.

The model is V(P) = b₀ + b₁·P + Σ dⱼ·max(P − kⱼ, 0). Its knees kⱼ are added one at a time, each
where it lowers the sum of |residuals| most: unlike that of squares, this sum is not bent by a few
gross outliers. From there knees and coefficients move together by Gauss–Newton steps (Muggeo,
"Estimating regression models with unknown break-points", Statist. Med. 22, 2003), outliers left
out. So the result is the least squares fit of all points but these.

scipy.optimize.least_squares with a Cauchy loss and three starts took 84 ms per node, this 2.5; with
4 outliers among 40 points it put 6 of 100 curves off by more than an LSB, this none of 480.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..base.arrays import Bools, Floats
from ..readings.calibration import Curves, PressureCurve

LEAST_LEVELS = 3
"""Different loads that every piece needs: two give its line, one more tells how well it fits."""
LEVEL = 0.005
"""Loads closer than this share of the largest count as one; chosen: a reference's own noise."""
OUTLIER = 4.5
"""Residual beyond which a point is an outlier, σ: seven of a million normal ones are."""
KNEE_EVIDENCE = 20.0
"""Drop of the sum of squares, σ², that proves a knee: noise makes it in 5e-5 (χ², 2 degrees)."""
EXPONENTS, MOST_END = (0.2, 20.0), 9.0
"""Limits of a power law: exponent; |ln(V/(supply − V))| at the largest load. Chosen: sensors
have 0.4 to 2 or so; beyond, corners are closer to each other than a calibration file tells."""
_CANDIDATES = 24
"""Places tried for a knee; chosen, like the next: with them test_skin_fit.py finds its curves."""
_ABSOLUTE_STEPS, _NEWTON_STEPS, _TRIMS = 8, 12, 5
"""Iterations of the weights of least |residuals|, of the knees, and of the limit of outliers."""
_GOOD_SHARE, _GOOD_SIGMAS = 0.7, 1.04
"""Share of the points taken to be no outliers; of a normal distribution it lies within 1.04 σ."""
_RIDGE = 1e-14
"""Relative to the trace of the normal matrix: keeps it regular where a piece has no points."""


@dataclass(frozen=True, eq=False)
class CurveFit:
    """Curves of n sensors with p pieces, and how they fit m points each.

    corner_pa, corner_v: (n, p + 1), Pa and V: the first corner at 0, the last at the largest load.
    residual_v: (n, m) voltage minus curve, V; NaN where there is no point.
    used: (n, m) bool, points that are no outliers.
    sigma_v: (n,) standard deviation of the points used, V.
    knee_found: (n,) bool, every knee explains more than chance would; or there is a power law.
    """

    corner_pa: Floats
    corner_v: Floats
    residual_v: Floats
    used: Bools
    sigma_v: Floats
    knee_found: Bools

    def sensor(self, index: int, points: int) -> CurveFit:
        """Return the fit of one sensor to its first points, without the axis n."""
        row = CurveFit(**{name: values[index] for name, values in vars(self).items()})
        return replace(row, residual_v=row.residual_v[:points], used=row.used[:points])


def fit_curves(pressure_pa: Floats, voltage_v: Floats, pieces: int, noise_v: float) -> CurveFit:
    """Fit n sensors at once; a few thousand points at a time are fastest.

    pressure_pa, voltage_v: (n, m), Pa and V, NaN where a sensor has fewer than m points. Each
    needs LEAST_LEVELS different loads per piece. noise_v: rms that the converter's resolution adds,
    V: no point is an outlier for less. Whether the curves are monotone is for the caller to check.
    """
    given = np.isfinite(pressure_pa) & np.isfinite(voltage_v)
    scale_pa = np.max(pressure_pa, axis=1, keepdims=True, where=given, initial=0.0)
    load = np.where(given, pressure_pa / scale_pa, 0.0)
    places = np.array([_places(row[there]) for row, there in zip(load, given, strict=True)]).T
    points = _Points(load, np.where(given, voltage_v, 0.0), given, places, noise_v)
    knees, found = np.empty((len(given), 0)), np.ones(len(given), dtype=bool)
    knees, used = points.settle(knees, 0.0)
    for _ in range(1, pieces):
        simpler, spacing = knees, np.diff(places, axis=0).max(axis=0)
        knees, used = points.settle(points.with_another(knees), spacing)
        gain = points.squares(simpler, used) - points.squares(knees, used)
        found &= gain > KNEE_EVIDENCE * np.maximum(points.variance(knees, used), noise_v**2)
    last = np.max(load, axis=1, where=used, initial=0.0)
    corners = np.column_stack((np.zeros(len(given)), knees, last))
    beta, residual = points.solve(knees, used)
    return CurveFit(
        corner_pa=corners * scale_pa,
        corner_v=(_design(corners, knees) @ beta[:, :, None])[:, :, 0],
        residual_v=np.where(given, residual, np.nan),
        used=used,
        sigma_v=np.sqrt(points.variance(knees, used)),
        knee_found=found,
    )


def fit_power_laws(
    pressure_pa: Floats, voltage_v: Floats, supply_v: float, noise_v: float
) -> CurveFit:
    """Fit as fit_curves, but force sensing resistors in a divider: PressureCurve.power_law.

    There ln(V/(supply − V)) is a line over ln(P), with the exponent as its slope, − where V falls.
    Its squares are weighted by how far V moves with it, squared, which makes them those of V.
    """
    x = np.log(np.maximum(pressure_pa, np.finfo(float).tiny))
    given = np.isfinite(voltage_v) & (pressure_pa > 0)
    volts = np.clip(np.where(given, voltage_v, supply_v / 2), 1e-6, supply_v - 1e-6)
    x, y = np.where(given, x, 0.0), np.log(volts / (supply_v - volts))
    design, fitted_v = np.concatenate((np.ones((*x.shape, 1)), x[:, :, None]), axis=2), volts
    used, trust = given, given.astype(float)
    for step in range(_ABSOLUTE_STEPS + _TRIMS):
        slope_v = fitted_v * (supply_v - fitted_v) / supply_v
        beta, off = _solve(design, y, trust * slope_v**2)
        fitted_v = supply_v / (1 + np.exp(np.minimum(off - y, 50.0)))
        residual_v = np.where(given, volts - fitted_v, 0.0)
        size_v = np.maximum(np.abs(residual_v), noise_v)
        trust = given / size_v
        if step >= _ABSOLUTE_STEPS - 1:
            used = given & (size_v <= OUTLIER * _spread(residual_v, given, noise_v)[:, None])
            trust = used.astype(float)
    slope, range_pa = beta[:, 1], np.nanmax(pressure_pa, axis=1)
    end = beta[:, 0] + slope * np.log(range_pa)
    exponent, shown_end = np.clip(np.abs(slope), *EXPONENTS), np.clip(end, -MOST_END, MOST_END)
    half_pa = range_pa * np.exp(-shown_end / np.copysign(exponent, slope))
    curves = [
        PressureCurve.power_law(half, power, largest, supply_v, rises)
        for half, power, largest, rises in zip(half_pa, exponent, range_pa, slope > 0, strict=True)
    ]
    freedom = np.maximum(used.sum(axis=1) - 2, 1)
    return CurveFit(
        corner_pa=np.array([curve.pressure_pa for curve in curves]),
        corner_v=np.array([curve.voltage_v for curve in curves]),
        residual_v=voltage_v - Curves.of(curves).voltage(pressure_pa.T).T,
        used=used,
        sigma_v=np.sqrt(np.square(residual_v).sum(axis=1, where=used) / freedom),
        knee_found=(exponent == np.abs(slope)) & (shown_end == end),
    )


def levels_of(load: Floats) -> Floats:
    """Return the different loads among (m,), rising: closer than LEVEL of the largest are one."""
    rising: list[float] = np.sort(load).tolist()
    least, levels = LEVEL * rising[-1], rising[:1]
    for value in rising:
        if value - levels[-1] > least:
            levels.append(value)
    return np.array(levels)


@dataclass(frozen=True, eq=False)
class _Points:
    """m points of n sensors: loads x, 0…1, voltages y, and where there is a point, (n, m) each.

    places: (_CANDIDATES, n) rising, where a knee may lie.
    """

    x: Floats
    y: Floats
    given: Bools
    places: Floats
    noise_v: float

    def solve(self, knees: Floats, weight: Floats | Bools) -> tuple[Floats, Floats]:
        """Solve weighted least squares for knees (n, k).

        Returns coefficients (n, 2 + k) and residuals (n, m), V.
        """
        return _solve(_design(self.x, knees), self.y, weight)

    def squares(self, knees: Floats, used: Bools) -> Floats:
        """Return the least sum of squares over the points used, (n,) V²."""
        return np.asarray(np.square(self.solve(knees, used)[1]).sum(axis=1, where=used))

    def variance(self, knees: Floats, used: Bools) -> Floats:
        """Return the variance of the points used about the fit, (n,) V²."""
        freedom = used.sum(axis=1) - 2 - 2 * knees.shape[1]
        return np.asarray(self.squares(knees, used) / np.maximum(freedom, 1))

    def with_another(self, knees: Floats) -> Floats:
        """Add to knees (n, k) the one that lowers the sum of |residuals| most: (n, k + 1)."""
        trials = [np.column_stack((knees, place)) for place in self.places]
        costs = [np.abs(self._least_absolute(t)[1]).sum(axis=1, where=self.given) for t in trials]
        best = np.argmin(costs, axis=0)
        return np.sort(np.array(trials)[best, np.arange(len(best))], axis=1)

    def settle(self, knees: Floats, spacing: Floats | float) -> tuple[Floats, Bools]:
        """Find the knees of the least squares fit near these, and the points that are no outliers.

        What is an outlier follows first from the spread about the start, whose knees are off by up
        to spacing, (n,); then from the spread about the fit.
        """
        beta, residual = self._least_absolute(knees)
        slack_v = spacing * np.abs(beta[:, 2:]).max(axis=1, initial=0.0)
        limit_v = np.full(len(knees), np.inf)
        for _ in range(_TRIMS):
            # Never wider again: an outlier that bends the curve would let in the next one.
            spread_v = _spread(residual, self.given, self.noise_v)
            limit_v = np.minimum(limit_v, OUTLIER * spread_v + slack_v)
            used = self.given & (np.abs(residual) <= limit_v[:, None])
            knees = self._descend(knees, used)
            residual, slack_v = self.solve(knees, used)[1], np.zeros_like(slack_v)
        return knees, used

    def _least_absolute(self, knees: Floats) -> tuple[Floats, Floats]:
        """Solve as solve, but for the least sum of |residuals|, by iterated weights."""
        design, weight = _design(self.x, knees), self.given.astype(float)
        for _ in range(_ABSOLUTE_STEPS):
            beta, residual = _solve(design, self.y, weight)
            weight = self.given / np.maximum(np.abs(residual), self.noise_v)
        return beta, residual

    def _descend(self, knees: Floats, used: Bools) -> Floats:
        """Take Gauss–Newton steps in the knees; a step that does not help is halved."""
        cost = self.squares(knees, used)
        low, high = self.places[0][:, None], self.places[-1][:, None]
        damping = np.ones_like(cost)
        for _ in range(_NEWTON_STEPS if knees.size else 0):
            # How far the knees are off, to first order, (n, k).
            beyond = -(self.x[:, :, None] > knees[:, None, :]).astype(float)
            design = np.concatenate((_design(self.x, knees), beyond), axis=2)
            bend, jump = np.split(_solve(design, self.y, used)[0][:, 2:], 2, axis=1)
            off = np.divide(jump, bend, out=np.zeros_like(jump), where=np.abs(bend) >= 1e-12)
            trial = np.sort(np.clip(knees + damping[:, None] * off, low, high), axis=1)
            trial_cost = self.squares(trial, used)
            better = trial_cost < cost
            knees = np.where(better[:, None], trial, knees)
            cost = np.minimum(cost, trial_cost)
            damping = np.where(better, 1.0, damping / 2)
        return knees


def _spread(residual_v: Floats, given: Bools, noise_v: float) -> Floats:
    """Estimate the standard deviation of residuals (n, m), (n,) V, no less than the converter's.

    Not from the median of |residuals|: more than half of the points may lie on one piece, and say
    nothing of how well the others are met.
    """
    size = np.sort(np.where(given, np.abs(residual_v), np.inf), axis=1)
    place = np.ceil(_GOOD_SHARE * given.sum(axis=1)).astype(int) - 1
    good = np.take_along_axis(size, place[:, None], axis=1)[:, 0]
    return np.asarray(np.maximum(good / _GOOD_SIGMAS, noise_v))


def _design(x: Floats, knees: Floats) -> Floats:
    """Return columns 1, x, max(x − kⱼ, 0): (n, m, 2 + k)."""
    hinges = np.maximum(x[:, :, None] - knees[:, None, :], 0.0)
    return np.concatenate((np.ones((*x.shape, 1)), x[:, :, None], hinges), axis=2)


def _solve(design: Floats, y: Floats, weight: Floats | Bools) -> tuple[Floats, Floats]:
    """Solve weighted least squares of n sensors: coefficients (n, p) and residuals (n, m)."""
    weighted = (design * weight[:, :, None]).transpose(0, 2, 1)
    normal = weighted @ design
    size = np.trace(normal, axis1=1, axis2=2) + np.finfo(float).tiny
    normal += _RIDGE * size[:, None, None] * np.eye(design.shape[2])
    beta = np.linalg.solve(normal, weighted @ y[:, :, None])
    return np.asarray(beta[:, :, 0]), np.asarray(y - (design @ beta)[:, :, 0])


def _places(load: Floats) -> Floats:
    """Return where a sensor's knee may lie, rising, LEAST_LEVELS levels on either side of each.

    Evenly by number of levels, not by load: loads may be dense where the knee is expected.
    """
    levels = levels_of(load)
    inner = levels[LEAST_LEVELS - 1 : max(len(levels) - LEAST_LEVELS + 1, LEAST_LEVELS)]
    return np.interp(np.linspace(0, len(inner) - 1, _CANDIDATES), np.arange(len(inner)), inner)
