# SPDX-License-Identifier: Apache-2.0

"""Pairs of nearby positions on a skin, found by cell hashing in linear time."""

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats, Indices
from ..base.errors import SpecError

MOST_CANDIDATES = 1 << 22
"""Limit of the pairs whose distance is measured: 64 for each of the 65,536 taxels of the largest
skin; a grid has 20 per taxel. More mean that positions are piled up or the radius is wrong."""
_CELL_BITS = 21
"""Bits of a cell's key per axis: three of them fill an int64. Cells with the same key only cost
time, as distances are checked anyway."""
FACING_AWAY = -1e-3
"""Cosine between normals below which two positions are on opposite sides of a fold: 90°, with room
for the rounding of float32 normals."""


def beside(
    positions_m: NDArray[np.floating], normals: NDArray[np.floating], radius_m: float
) -> tuple[Indices, Indices, Floats]:
    """Pair positions within radius_m of each other whose normals are at most 90° apart.

    positions_m, normals: (t, 3), m and unit vectors. Returns the indices of the first and second
    position of each pair, in both orders, sorted, and their distance, m. The two sides of a thin
    flap are not neighbours, however close.

    Raises SpecError if far more positions lie within the radius than on any skin.
    """
    places_m = positions_m.astype(np.float64)
    found = []
    for first, second in _candidates(np.floor(places_m / radius_m).astype(np.int64), radius_m):
        distance_m, facing = np.zeros(len(first)), np.zeros(len(first))
        for axis in range(3):
            distance_m += (places_m[first, axis] - places_m[second, axis]) ** 2
            facing += normals[first, axis] * normals[second, axis]
        np.sqrt(distance_m, out=distance_m)
        kept = (distance_m <= radius_m) & (facing >= FACING_AWAY) & (first != second)
        found.append((first[kept], second[kept], distance_m[kept]))
    first, second, distance_m = map(np.concatenate, zip(*found, strict=True))
    order = np.lexsort((second, first))
    return first[order], second[order], distance_m[order]


def usual_distance_m(
    positions_m: NDArray[np.floating], normals: NDArray[np.floating]
) -> float | None:
    """Return the median distance to the nearest neighbour, m; None without neighbours."""
    count = len(positions_m)
    extent_m = float(np.linalg.norm(np.ptp(positions_m.astype(np.float64), axis=0)))
    # Start small, so that pairs stay few, and widen until half of the positions have a neighbour.
    radius_m = extent_m / count
    while 0 < radius_m <= 2 * extent_m:
        first, _, distance_m = beside(positions_m, normals, radius_m)
        nearest_m = np.full(count, np.inf)
        np.minimum.at(nearest_m, first, distance_m)
        median_m = float(np.quantile(nearest_m, 0.5, method="lower"))
        if median_m <= radius_m:
            return median_m
        radius_m *= 1.5
    return None


def _candidates(cells: NDArray[np.int64], radius_m: float) -> Iterator[tuple[Indices, Indices]]:
    """Yield pairs of positions in the same cell or in adjacent ones, step by step to these."""
    strides = np.array([1 << (_CELL_BITS * axis) for axis in range(3)])
    keys = cells @ strides
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    steps = np.array(list(product((-1, 0, 1), repeat=3))) @ strides
    wanted = keys + steps[:, None]
    begin = np.searchsorted(ordered, wanted, "left")
    count = np.searchsorted(ordered, wanted, "right") - begin
    if count.sum() > MOST_CANDIDATES:
        raise SpecError(
            f"taxels lie on top of each other: {count.sum() // len(keys)} of them, on average, "
            f"about {radius_m * 1e3:.3g} mm from each other; are positions in mm, is the pitch "
            "right?"
        )
    for begins, counts in zip(begin, count, strict=True):
        first = np.repeat(np.arange(len(keys)), counts)
        within = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
        yield first, order[np.repeat(begins, counts) + within]
