# SPDX-License-Identifier: Apache-2.0

"""How deep an object lies in the cover under a force.

An object that moves by s along −n comes s closer to every point of a flat skin, whose normal is n,
so that its force is Σ k·a·max(0, s − h) over points of area a, h below it: a sum of ramps, which is
solved exactly once the heights are sorted. On a curved skin points come closer by a share
of s that depends on both surfaces; there the same sum, with the shares of the step before, is
Newton's method, which finds its kinks, too.
"""

from collections.abc import Sequence

import numpy as np

from ..base.arrays import Floats
from .indenters import Foundation, Indenter

DEEPEST_M = 0.02
"""Farthest that an object is moved, m. Chosen: the cover of a finger is thinner."""
MOST_STEPS, SOUGHT_M = 20, 1e-8
"""Newton's steps on a curved skin end where they are this short, m, or so many; about 5 suffice."""
_LEAST_SHARE = 0.05
"""Least share of the movement by which a point is taken to come closer; chosen."""


def at_force(
    cover: Foundation, thing: Indenter, force_n: float, along: Sequence[float] = (0.0, 0.0, -1.0)
) -> Indenter:
    """The object, moved along a direction until the cover answers with this force along it.

    along: unit vector into the skin. An object that cannot have the force within DEEPEST_M, as it
    lies beside the skin or goes right through its cover, stays where it is.
    """
    way = np.array(along, dtype=np.float64)
    points_m, normals, areas_m2 = cover.near(thing)
    facing = -normals @ way
    flat = bool((facing > 1 - 1e-9).all())
    if not flat:
        points_m, normals, areas_m2 = cover.near(thing, DEEPEST_M)
        facing = -normals @ way
    ahead = facing > _LEAST_SHARE
    points_m, normals, share = points_m[ahead], normals[ahead], facing[ahead]
    weights = areas_m2[ahead] * share * thing.stiffness_pa_per_m
    moved, shift_m, step_m = thing, 0.0, 0.0
    light_m, heavy_m = -DEEPEST_M, DEEPEST_M  # the shift is between these
    before_m: Floats | None = None
    for _ in range(1 if flat else MOST_STEPS):
        height_m, leaves_m = moved.spans_m(points_m, normals)
        if not flat:  # what is behind the skin here may press on it elsewhere
            height_m = np.where(leaves_m > 0, height_m, np.inf)
        if before_m is not None:
            share = _shares(before_m, height_m, step_m, share)
        step_m = _step_m(height_m, share, weights, force_n)
        if step_m > 0:
            light_m = max(light_m, shift_m)
        else:
            heavy_m = min(heavy_m, shift_m)
        if not light_m <= shift_m + step_m <= heavy_m:
            # Beyond the limits; or points have come in from beside, and Newton's step is too long.
            if abs(shift_m + step_m) > DEEPEST_M and (flat or not np.isfinite(step_m)):
                return thing
            step_m = (light_m + heavy_m) / 2 - shift_m
        shift_m += step_m
        before_m = height_m
        moved = thing.moved(shift_m * way)
        if abs(step_m) < SOUGHT_M:
            break
    pressed = height_m < share * step_m
    through = pressed & (leaves_m <= share * step_m)
    return thing if through.any() or DEEPEST_M - abs(shift_m) < SOUGHT_M else moved


def _step_m(height_m: Floats, share: Floats, weights: Floats, force_n: float) -> float:
    """The s at which Σ weights·max(0, share·s − height_m) is the force; ∞ if nothing is ahead."""
    meets_m = height_m / share
    order = np.argsort(meets_m)[: np.count_nonzero(np.isfinite(meets_m))]
    if not len(order):
        return np.inf
    slope = np.cumsum((weights * share)[order])
    offset = np.cumsum((weights * height_m)[order])
    solved_m = (force_n + offset) / slope  # if just the first ones are touched
    begins_next_m = np.append(meets_m[order[1:]], np.inf)
    return float(solved_m[np.argmax(solved_m <= begins_next_m)])


def _shares(before_m: Floats, height_m: Floats, step_m: float, share: Floats) -> Floats:
    """By how much points have come closer in a step, per metre of it; as before where unknown."""
    with np.errstate(invalid="ignore"):
        measured = (before_m - height_m) / step_m
    known = np.isfinite(measured) & (measured > _LEAST_SHARE)
    return np.where(known, measured, share)
