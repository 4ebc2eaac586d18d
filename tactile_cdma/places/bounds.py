# SPDX-License-Identifier: Apache-2.0

"""What objects are bounded by, round or flat, and where lines cross that.

By functions of the array API standard: lines may be those of many objects. kernel/cover.c does the
same in C.
"""

from collections.abc import Sequence
from functools import reduce
from operator import add
from typing import Any, NamedTuple

PARALLEL = 1e-9
"""Part of a direction below which a line is parallel to a plane, or to a cylinder. Chosen far below
what 32 bits resolve."""
HUGE = 1e20
"""What a line that misses is off by is multiplied by this; chosen: in 32 bits nothing overflows."""
FAR_M = 1e6
"""Lines that would meet an object beyond that miss it, m. Chosen: a thousand times MOST_M."""
Spans = tuple[Any, Any]
"""Where lines enter and leave an object, each (m,), m along the line: +∞ and −∞, or beyond FAR_M
either way, where they miss. A choice between arrays takes ten times as long as a product."""
Axis = tuple[Any, Any]
"""Along one axis of an object: lines' points, (m,), m, and parts of their unit directions, (m,), or
(1,) where all are the same; for many objects (e, m), by the array API standard."""


class Bound(NamedTuple):
    """The points p for which |weights·(p − (0, 0, middle_m))| ≤ size.

    An ellipsoid; with one weight of 0 an endless cylinder, with two the space between two planes.
    weights: of the object's axes, not all 0. size: m times a weight.
    """

    weights: tuple[float, float, float]
    size: float
    middle_m: float = 0.0

    @property
    def reach_m(self) -> float:
        """Tell how far its points are from the origin at most, on the axes that it bounds, m."""
        return self.size / min(filter(None, self.weights)) + abs(self.middle_m)

    def spans(self, axes: Sequence[Axis], xp: Any) -> Spans:
        """Cross this with lines, as Indenter.spans does."""
        used = [each for each in zip(axes, self.weights, strict=True) if each[1] != 0]
        if len(used) == 1:
            ((axis, weight),) = used
            return _slab(self.size / weight, axis, xp)
        if self.middle_m:
            *beside, ((place_m, direction), weight) = used
            used = [*beside, ((place_m - self.middle_m, direction), weight)]
        scaled = [(p * w, n * w) if w != 1 else (p, n) for (p, n), w in used]
        return _round(self.size, scaled, xp)


def _round(radius_m: float, axes: Sequence[Axis], xp: Any) -> Spans:
    """Cross a ball about the origin, or an endless cylinder about the axis that is not summed.

    Lines are inside where a·s² + 2·b·s + c ≤ 0: |p + s·n|² ≤ R², with n shorter than 1 along a
    cylinder's axis. Those parallel to it are inside nearly for ever, or never.
    """
    c = reduce(add, [p * p for p, _ in axes]) - radius_m**2
    # A direction that is 0 everywhere, a float, takes no time.
    crossed = [(p, n) for p, n in axes if not (isinstance(n, float) and n == 0)]
    nothing = xp.zeros_like(c[..., :1])
    a = reduce(add, [n * n for _, n in crossed], nothing)
    b = reduce(add, [p * n for p, n in crossed], nothing)
    along = a < PARALLEL**2
    a_safe = xp.where(along, 1.0, a)
    square = b * b - a_safe * c
    half_m = xp.sqrt(xp.maximum(square, nothing)) * xp.where(along, HUGE, 1 / a_safe)
    half_m = half_m + xp.minimum(square, nothing) * HUGE  # far below 0 beside it
    middle_m = b * (-1 / a_safe)
    return middle_m - half_m, middle_m + half_m


def _slab(half_m: float, axis: Axis, xp: Any) -> Spans:
    """Cross the space between two planes at ±half_m on one axis."""
    place_m, direction = axis
    direction = xp.zeros_like(place_m[..., :1]) + direction
    along = abs(direction) < PARALLEL
    safe = xp.where(along, PARALLEL, direction)
    reach_m = half_m / abs(safe)
    reach_m = xp.where(along, reach_m * (1 + 1e-6), reach_m)  # lines within a face are inside
    middle_m = place_m * (-1 / safe)
    return middle_m - reach_m, middle_m + reach_m


def within_all(spans: Sequence[Spans], xp: Any) -> Spans:
    """Tell where lines are inside of all of some convex objects."""
    if len(spans) == 1:
        return spans[0]
    all_enter_m, all_leave_m = zip(*spans, strict=True)
    enters_m, leaves_m = reduce(xp.maximum, all_enter_m), reduce(xp.minimum, all_leave_m)
    beside_m = xp.maximum(enters_m - leaves_m, xp.zeros_like(enters_m[..., :1])) * HUGE
    return enters_m + beside_m, leaves_m - beside_m
