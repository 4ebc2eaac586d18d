# SPDX-License-Identifier: Apache-2.0

"""Pressures and voltages → falling piecewise linear curves: many sensors at once, robustly.

The model is V(P) = b₀ + b₁·P + Σ dⱼ·max(P − kⱼ, 0). Its knees kⱼ are added one at a time, each
where it lowers the sum of |residuals| most: unlike that of squares, this sum is not bent by a few
gross outliers. From there knees and coefficients move together by Gauss–Newton steps (Muggeo,
"Estimating regression models with unknown break-points", Statist. Med. 22, 2003), outliers left
out. So the result is the least squares fit of all points but these.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
LEAST_LEVELS = 3
"""Different loads that every piece needs."""
LEVEL = 0.005
"""Loads that differ by less than this share of the largest are one level."""
OUTLIER = 4.5
"""Points farther off than this many standard deviations are left out."""
KNEE_EVIDENCE = 20.0
"""A knee is one if it lowers the sum of squares by this many variances: chance seldom does."""
_CANDIDATES = 24
_ABSOLUTE_STEPS = 8
_NEWTON_STEPS = 12
_GOOD_SHARE, _GOOD_SIGMAS = 0.7, 1.04
"""So many points are taken to be no outliers; those of a normal distribution lie within 1.04 σ."""
_TRIMS = 5
_RIDGE = 1e-14
_CHUNK = 50_000
"""Points that are fitted at once: as many as keep the arrays within a cache or two."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Curves of n sensors with p pieces, and how they fit m points each.

    corner_pa, corner_v: (n, p + 1), Pa and V: the first corner at 0, the last at the largest load.
    residual_v: (n, m) voltage minus curve, V; NaN where there is no point.
    used: (n, m) bool, points that are no outliers.
    sigma_v: (n,) standard deviation of the points used, V.
    knee_found: (n,) bool, every knee explains more than chance would.
    """

    corner_pa: Floats
    corner_v: Floats
    residual_v: Floats
    used: Mask
    sigma_v: Floats
    knee_found: Mask


def fit_curves(pressure_pa: Floats, voltage_v: Floats, pieces: int, noise_v: float) -> Fit:
    """Fit n sensors at once.

    pressure_pa, voltage_v: (n, m), Pa and V, NaN where a sensor has fewer than m points. Each
    needs LEAST_LEVELS different loads per piece. noise_v: rms that the converter's resolution adds,
    V: no point is an outlier for less. Whether the curves fall is for the caller to check.
    """
    size = max(1, _CHUNK // pressure_pa.shape[1])
    fits = [
        _fit(pressure_pa[i : i + size], voltage_v[i : i + size], pieces, noise_v)
        for i in range(0, len(pressure_pa), size)
    ]
    names = Fit.__dataclass_fields__
    return Fit(**{name: np.concatenate([getattr(fit, name) for fit in fits]) for name in names})


def levels_of(load: Floats) -> Floats:
    """The different loads among (m,), rising: closer than LEVEL of the largest are one."""
    rising: list[float] = np.sort(load).tolist()
    least, levels = LEVEL * rising[-1], rising[:1]
    for value in rising:
        if value - levels[-1] > least:
            levels.append(value)
    return np.array(levels)


def _fit(pressure_pa: Floats, voltage_v: Floats, pieces: int, noise_v: float) -> Fit:
    given = np.isfinite(pressure_pa) & np.isfinite(voltage_v)
    scale_pa = np.max(pressure_pa, axis=1, keepdims=True, where=given, initial=0.0)
    levels = np.full(given.shape, np.nan)
    for row, load, there in zip(levels, pressure_pa / scale_pa, given, strict=True):
        own = levels_of(load[there])
        row[: len(own)] = own
    points = _Points(
        np.where(given, pressure_pa / scale_pa, 0.0), np.where(given, voltage_v, 0.0), given
    )
    n = len(given)
    knees, found = np.empty((n, 0)), np.ones(n, dtype=bool)
    solution = points.settled(knees, np.zeros(n), levels, noise_v)
    for _ in range(1, pieces):
        simpler, (knees, unsure) = knees, points.with_another(knees, levels, noise_v)
        solution = points.settled(knees, unsure, levels, noise_v)
        knees = solution.knees
        gain = points.squares(simpler, solution.used) - points.squares(knees, solution.used)
        sigma_v = np.maximum(points.sigma(solution), noise_v)
        found &= gain > KNEE_EVIDENCE * sigma_v**2
    last = np.max(points.x, axis=1, where=solution.used, initial=0.0)
    corners = np.column_stack((np.zeros(n), knees, last))
    corner_v = np.einsum("nmp,np->nm", _design(corners, knees), solution.beta)
    return Fit(
        corner_pa=corners * scale_pa,
        corner_v=corner_v,
        residual_v=np.where(given, solution.residual, np.nan),
        used=solution.used,
        sigma_v=points.sigma(solution),
        knee_found=found,
    )


@dataclass(frozen=True, eq=False)
class _Solution:
    """Of n sensors. beta: (n, 2 + k) coefficients. cost: (n,) sum of squares, cut at the limit."""

    knees: Floats
    beta: Floats
    residual: Floats
    used: Mask
    cost: Floats


@dataclass(frozen=True, eq=False)
class _Points:
    """Loads x, 0…1, voltages y and where there is a point, (n, m) each."""

    x: Floats
    y: Floats
    given: Mask

    def with_another(self, knees: Floats, levels: Floats, noise_v: float) -> tuple[Floats, Floats]:
        """Knees (n, k) and the one more that lowers the sum of |residuals| most, (n, k + 1).

        Also how far apart the candidates for it are, (n,).
        """
        best_cost, best = np.full(len(self.x), np.inf), np.zeros(len(self.x))
        candidates = _candidates(levels)
        for candidate in candidates:
            trial = np.column_stack((knees, candidate))
            residual = self.residual(trial, self.least_absolute(trial, noise_v))
            cost = np.abs(residual).sum(axis=1, where=self.given)
            best = np.where(cost < best_cost, candidate, best)
            best_cost = np.minimum(cost, best_cost)
        unsure = np.diff(candidates, axis=0).max(axis=0)
        return np.sort(np.column_stack((knees, best)), axis=1), unsure

    def settled(self, knees: Floats, unsure: Floats, levels: Floats, noise_v: float) -> _Solution:
        """The least squares fit near these knees, outliers left out.

        What is an outlier follows from the spread about the start, then from that about what came
        of it. The start's knees are off by up to `unsure`, (n,), which is nobody's fault.
        """
        beta = self.least_absolute(knees, noise_v)
        residual = self.residual(knees, beta)
        slack = unsure * np.abs(beta[:, 2:]).max(axis=1, initial=0.0)
        limit = np.full(len(slack), np.inf)
        for _ in range(_TRIMS):
            # Never wider again: an outlier that bends the curve would let in the next one.
            limit = np.minimum(limit, OUTLIER * self._spread(residual, noise_v) + slack)
            used = self.given & (np.abs(residual) <= limit[:, None])
            solution = self._descend(knees, used, limit, levels)
            knees, residual, slack = solution.knees, solution.residual, np.zeros_like(slack)
        return solution

    def least_absolute(self, knees: Floats, noise_v: float) -> Floats:
        """Coefficients of least sum of |residuals|, by iterated weights, (n, 2 + k)."""
        design, weight = _design(self.x, knees), self.given.astype(float)
        for _ in range(_ABSOLUTE_STEPS):
            beta = _solve(design, self.y, weight)
            residual = self.y - np.einsum("nmp,np->nm", design, beta)
            weight = self.given / np.maximum(np.abs(residual), noise_v)
        return beta

    def residual(self, knees: Floats, beta: Floats) -> Floats:
        """(n, m) V."""
        return np.asarray(self.y - np.einsum("nmp,np->nm", _design(self.x, knees), beta))

    def squares(self, knees: Floats, used: Mask) -> Floats:
        """Least sum of squares with these knees over the points used, (n,) V²."""
        beta = _solve(_design(self.x, knees), self.y, used.astype(float))
        return np.asarray(np.square(self.residual(knees, beta)).sum(axis=1, where=used))

    def sigma(self, solution: _Solution) -> Floats:
        """Standard deviation of the points used, (n,) V."""
        unknowns = solution.beta.shape[1] + solution.knees.shape[1]
        freedom = np.maximum(solution.used.sum(axis=1) - unknowns, 1)
        squares = np.square(solution.residual).sum(axis=1, where=solution.used)
        return np.asarray(np.sqrt(squares / freedom))

    def _spread(self, residual: Floats, noise_v: float) -> Floats:
        """Robust standard deviation, (n,) V, and no less than the converter's.

        Not from the median of |residuals|: more than half of the points may lie on one piece, and
        say nothing of how well the others are met.
        """
        size = np.sort(np.where(self.given, np.abs(residual), np.inf), axis=1)
        place = np.ceil(_GOOD_SHARE * self.given.sum(axis=1)).astype(int) - 1
        return np.asarray(np.maximum(size[np.arange(len(size)), place] / _GOOD_SIGMAS, noise_v))

    def _descend(self, knees: Floats, used: Mask, limit: Floats, levels: Floats) -> _Solution:
        """Gauss–Newton steps in the knees; a step that does not help is halved."""
        best = self._at(knees, used, limit)
        if not knees.shape[1]:
            return best
        low, high = (edge[:, None] for edge in _knee_limits(levels))
        damping = np.ones((len(knees), 1))
        for _ in range(_NEWTON_STEPS):
            step = self._step(best)
            trial = np.sort(np.clip(best.knees + damping * step, low, high), axis=1)
            there = self._at(trial, best.used, limit)
            better = there.cost < best.cost
            best = _choose(better, there, best)
            damping = np.where(better[:, None], 1.0, damping / 2)
        return best

    def _at(self, knees: Floats, used: Mask, limit: Floats) -> _Solution:
        """Coefficients for given knees; points farther off than limit (n,) count as limit.

        used: to begin with.
        """
        design, cut = _design(self.x, knees), limit[:, None]
        for _ in range(2):
            beta = _solve(design, self.y, used.astype(float))
            residual = self.y - np.einsum("nmp,np->nm", design, beta)
            used = self.given & (np.abs(residual) <= cut)
        cost = np.square(np.minimum(np.abs(residual), cut)).sum(axis=1, where=self.given)
        return _Solution(knees, beta, residual, used, cost)

    def _step(self, solution: _Solution) -> Floats:
        """How far the knees are off, to first order: (n, k)."""
        knees = solution.knees
        beyond = -(self.x[:, :, None] > knees[:, None, :]).astype(float)
        design = np.concatenate((_design(self.x, knees), beyond), axis=2)
        full = _solve(design, self.y, solution.used.astype(float))
        count = knees.shape[1]
        bend, jump = full[:, 2 : 2 + count], full[:, 2 + count :]
        flat = np.abs(bend) < 1e-12
        return np.where(flat, 0.0, jump / np.where(flat, 1.0, bend))


def _design(x: Floats, knees: Floats) -> Floats:
    """Columns 1, x, max(x − kⱼ, 0): (n, m, 2 + k)."""
    hinges = np.maximum(x[:, :, None] - knees[:, None, :], 0.0)
    return np.concatenate((np.ones((*x.shape, 1)), x[:, :, None], hinges), axis=2)


def _solve(design: Floats, y: Floats, weight: Floats) -> Floats:
    """Weighted least squares of n sensors: (n, p)."""
    weighted = (design * weight[:, :, None]).transpose(0, 2, 1)
    normal = weighted @ design
    size = np.trace(normal, axis1=1, axis2=2) + np.finfo(float).tiny
    normal += _RIDGE * size[:, None, None] * np.eye(design.shape[2])  # no piece without points
    return np.asarray(np.linalg.solve(normal, weighted @ y[:, :, None])[:, :, 0])


def _knee_limits(levels: Floats) -> tuple[Floats, Floats]:
    """Between these loads a knee has LEAST_LEVELS levels on either side, (n,) each."""
    count = np.isfinite(levels).sum(axis=1)
    last = levels[np.arange(len(levels)), np.maximum(count - LEAST_LEVELS, 0)]
    return levels[:, LEAST_LEVELS - 1], last


def _candidates(levels: Floats) -> Floats:
    """Places for a knee between the limits, (_CANDIDATES, n) rising.

    Evenly by number of levels, not by load: these may be close to each other where the knee is
    expected.
    """
    low, high = _knee_limits(levels)
    count, rows = np.isfinite(levels).sum(axis=1), np.arange(len(levels))
    places = []
    for share in np.linspace(0, 1, _CANDIDATES):
        place = LEAST_LEVELS - 1 + share * np.maximum(count - 2 * LEAST_LEVELS + 1, 0)
        below = np.floor(place).astype(int)
        above = np.minimum(below + 1, count - 1)
        step = levels[rows, above] - levels[rows, below]
        places.append(np.clip(levels[rows, below] + (place - below) * step, low, high))
    return np.array(places)


def _choose(where: Mask, one: _Solution, other: _Solution) -> _Solution:
    """Sensor by sensor, where: (n,)."""
    column = where[:, None]
    return _Solution(
        knees=np.where(column, one.knees, other.knees),
        beta=np.where(column, one.beta, other.beta),
        residual=np.where(column, one.residual, other.residual),
        used=np.where(column, one.used, other.used),
        cost=np.where(where, one.cost, other.cost),
    )
