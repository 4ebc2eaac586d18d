# SPDX-License-Identifier: Apache-2.0

"""How deep an object lies in the cover under a force.

An object that moves by s along −n comes s closer to every point of a flat skin, whose normal is n,
so that its force is Σ k·a·max(0, s − h) over points of area a, h below it: a sum of ramps, which is
solved exactly once the heights are sorted. On a curved skin points come closer by a share
of s that depends on both surfaces; there the same sum, with the shares of the step before, is
Newton's method, which finds its kinks, too.
"""

import math
from collections.abc import Sequence

import numpy as np

from ..base.arrays import Floats
from ..base.errors import ParameterError
from ..config.python_arguments import argument, instance
from ..places.bounds import Spans
from .indenters import Foundation, Indenter, Near

DEEPEST_M = 0.02
"""Farthest that an object is moved, m. Chosen: the cover of a finger is thinner."""
MOST_STEPS, SOUGHT_M = 20, 1e-8
"""Newton's steps on a curved skin end where they are this short, m, or so many; about 5 suffice."""
_LIMIT_M = 1e-4
"""A shift this close to DEEPEST_M has found no end, m; chosen: where eight halvings come."""
Press = tuple[Indenter, float, Sequence[float]]
"""An object, its force, N, and the direction in which it is moved, as at_force takes them."""
_LEAST_SHARE = 0.05
"""Least share of the movement by which a point is taken to come closer; chosen."""


def at_force(
    cover: Foundation, thing: Indenter, force_n: float, along: Sequence[float] = (0.0, 0.0, -1.0)
) -> Indenter:
    """Return the object, moved along a direction until the cover answers with this force along it.

    along: unit vector into the skin. An object that cannot have the force within DEEPEST_M, as it
    lies beside the skin or goes right through its cover, stays where it is.
    """
    way = _checked(cover, thing, force_n, along)
    near = cover.near(thing)
    if _is_along(near, way):
        shift_m = _flat_shift_m(thing, near, thing.spans_m(near.points_m, near.normals), force_n)
        return thing.moved(shift_m * way) if shift_m else thing
    _, points_m, normals, areas_m2 = cover.near(thing, DEEPEST_M)
    normals = np.broadcast_to(normals, points_m.shape)
    facing = -normals @ way
    ahead = facing > _LEAST_SHARE
    points_m, normals, share = points_m[ahead], normals[ahead], facing[ahead]
    weights = areas_m2[ahead] * share * thing.stiffness_pa_per_m
    moved, shift_m, step_m = thing, 0.0, 0.0
    light_m, heavy_m = -DEEPEST_M, DEEPEST_M  # the shift is between these
    before_m: Floats | None = None
    for _ in range(MOST_STEPS):
        height_m, leaves_m = moved.spans_m(points_m, normals)
        # What is behind the skin here may press on it elsewhere.
        height_m = np.where(leaves_m > 0, height_m, np.inf)
        if before_m is not None:
            share = _shares(before_m, height_m, step_m, share)
        step_m = _step_m(height_m / share, weights * share, force_n)
        if step_m > 0:
            light_m = max(light_m, shift_m)
        else:
            heavy_m = min(heavy_m, shift_m)
        if not light_m <= shift_m + step_m <= heavy_m:
            # Beyond the limits; or points have come in from beside, and Newton's step is too long.
            if not np.isfinite(step_m):
                return thing
            step_m = (light_m + heavy_m) / 2 - shift_m
        shift_m += step_m
        before_m = height_m
        moved = thing.moved(shift_m * way)
        if abs(step_m) < SOUGHT_M:
            break
    if DEEPEST_M - abs(shift_m) < _LIMIT_M or _goes_through(height_m, leaves_m, share * step_m):
        return thing
    return moved


def pressed_pa(cover: Foundation, presses: Sequence[Press]) -> Floats:
    """Return the mean pressure on every taxel, (t,), Pa, of objects that are moved as by at_force.

    As Foundation.pressure_pa of these, in half the time where the skin is flat.
    """
    pressed = []
    for thing, force_n, along in presses:
        way = _checked(cover, thing, force_n, along)
        near = cover.near(thing)
        if is_along := _is_along(near, way):
            moved = thing
        else:
            moved = at_force(cover, thing, force_n, along)
            near = cover.near(moved)
        spans_m = moved.spans_m(near.points_m, near.normals)
        shift_m = _flat_shift_m(thing, near, spans_m, force_n) if is_along else 0.0
        depth_m = np.where(spans_m[1] > shift_m, np.maximum(shift_m - spans_m[0], 0.0), 0.0)
        pressed.append((near, thing.stiffness_pa_per_m * depth_m))
    return cover.mean_pa(pressed)


def _checked(cover: Foundation, thing: Indenter, force_n: float, along: Sequence[float]) -> Floats:
    """Check the arguments; returns the direction, (3,)."""
    instance("cover", cover, Foundation)
    instance("thing", thing, Indenter)
    argument("force_n", force_n, 0.0, (0.0, math.inf), "N")
    way = argument("along", along, (0.0, 0.0, 0.0))
    if not abs(math.hypot(*way) - 1) < 1e-6:
        raise ParameterError(f"along is {way}; it must be of length 1")
    return np.array(way)


def _is_along(near: Near, way: Floats) -> bool:
    """Tell whether an object that moves this way comes as much closer to all points."""
    return bool((near.normals @ way < 1e-9 - 1).all())


def _flat_shift_m(thing: Indenter, near: Near, spans_m: Spans, force_n: float) -> float:
    """Tell how far an object moves against all normals, m; 0 where it cannot have the force."""
    shift_m = _step_m(spans_m[0], near.areas_m2 * thing.stiffness_pa_per_m, force_n)
    beyond = not abs(shift_m) <= DEEPEST_M or _goes_through(*spans_m, shift_m)
    return 0.0 if beyond else shift_m


def _goes_through(height_m: Floats, leaves_m: Floats, step_m: Floats | float) -> bool:
    """Tell whether the cover has passed through the object where a step presses on it."""
    return bool(((height_m < step_m) & (leaves_m <= step_m)).any())


def _step_m(meets_m: Floats, stiffness_n_per_m: Floats, force_n: float) -> float:
    """Return the s at which Σ stiffness·max(0, s − meets_m) is the force; ∞ if nothing is ahead."""
    order = np.argsort(meets_m)
    meets_m, slope = meets_m[order], stiffness_n_per_m[order]
    # The sum is the greatest of those of the first ones alone, so that s is their least solution.
    solved_m = (force_n + np.cumsum(slope * meets_m)) / np.cumsum(slope)
    return float(solved_m.min(initial=np.inf))


def _shares(before_m: Floats, height_m: Floats, step_m: float, share: Floats) -> Floats:
    """Tell how much closer points came in a step, per metre of it; as before where unknown."""
    with np.errstate(invalid="ignore"):
        measured = (before_m - height_m) / step_m
    known = np.isfinite(measured) & (measured > _LEAST_SHARE)
    return np.where(known, measured, share)
