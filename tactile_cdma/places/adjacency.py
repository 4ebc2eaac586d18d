# SPDX-License-Identifier: Apache-2.0

"""Finds what lies nearby: neighbours, the pieces that they make, the cells that divide the skin.

On an irregular skin neighbours are those of a Gabriel graph (Gabriel & Sokal, A new statistical
approach to geographic variation analysis, 1969): the ball between two of them holds no third one.
A part of the Delaunay triangulation, it takes closed sleeves and fingertips without a plane.
"""

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools, Floats, Indices, Int32s, Int64s
from ..base.errors import SpecError
from .layout_shapes import tangents

NEIGHBOUR_PITCHES = 1.5
"""Largest distance between neighbours' centres on a grid, in pitches: between √2 (the diagonal) and
2, so that a taxel has its eight neighbours."""
REACH_PITCHES = 3.0
"""Farthest that neighbours on an irregular skin are looked for, in pitches. Chosen: the nearest
taxel is a pitch away, so columns and rows may differ by a factor of 2.8."""
_BALL = 0.85
"""Radius of the ball that must be empty, over half the distance of two neighbours. Chosen below 1,
so that both diagonals of a rectangle count, though its corners are a little off; the third taxel of
a row, and what is beyond it, never do down to 0.38."""
_LONG = 1.5
"""Neighbours are no farther from each other than this times the median distance of either one's.
Chosen as NEIGHBOUR_PITCHES, so that no neighbour is found across a missing taxel."""
_GAP, _BESIDE = np.radians(135), np.radians(20)
"""A taxel with a wider angle between neighbours is at the border; what is mirrored this close to a
neighbour adds nothing. Chosen: inside, neighbours of a Gabriel graph leave 90° on average."""
MOST_COMPARED = 1 << 27
"""Most pairs times the most neighbours of one taxel. Chosen: 65,536 taxels have 51 million."""
_AT_ONCE = 1 << 20
"""Pairs of candidates that are compared at once: 24 MB."""
Points = NDArray[np.floating]


def on_grid(
    positions_m: Points,
    normals: Points,
    pitches_m: tuple[float, float],
    places: Indices,
    columns: int,
) -> tuple[Indices, Indices]:
    """Pair each taxel with its neighbours on a grid: first and second taxel, both orders, sorted.

    positions_m, normals: (t, 3), m and unit vectors. pitches_m: from column to column, row to row.
    places: (t,) of each taxel on the whole grid, row by row, rising. Neighbours are those around a
    place, and those that a closed sleeve or a fold brings as near as that.
    """
    first, second, _ = beside(positions_m, normals, NEIGHBOUR_PITCHES * max(pitches_m))
    row, column = np.divmod(places, columns)
    if pitches_m[0] != pitches_m[1]:
        apart_m = (positions_m[second] - positions_m[first]).astype(np.float64)
        offset = [np.einsum("pi,pi->p", apart_m, way[first]) for way in tangents(normals)]
        near = np.hypot(offset[0] / pitches_m[0], offset[1] / pitches_m[1]) <= NEIGHBOUR_PITCHES
        # Right and up need not be those of rows and columns, so that others of a row seem near.
        near &= np.abs(column[first] - column[second]) > 2
        near = _both_ways(near, first, second)  # they differ from taxel to taxel on a ball
        first, second = first[near], second[near]
    on_it = np.column_stack([row, column, np.zeros_like(row)]).astype(np.float64)
    one, other, _ = beside(on_it, normals, NEIGHBOUR_PITCHES)
    pairs = np.concatenate([first * len(places) + second, one * len(places) + other])
    return np.divmod(np.unique(pairs), len(places))


def around(positions_m: Points, normals: Points, pitch_m: float) -> tuple[Indices, Indices]:
    """Pair each taxel of an irregular skin with its neighbours. pitch_m: usual distance of two."""
    first, second, distance_m = beside(positions_m, normals, REACH_PITCHES * pitch_m)
    empty = _between_is_empty(positions_m.astype(np.float64), first, second, distance_m)
    empty = _both_ways(empty, first, second)  # the third one may face away from one of them
    first, second, distance_m = first[empty], second[empty], distance_m[empty]
    most_m = _LONG * _median_of(first, distance_m, len(positions_m))
    near = distance_m <= np.minimum(most_m[first], most_m[second])
    return first[near], second[near]


def table(first: Indices, second: Indices, count: int) -> Int32s:
    """List the seconds of each first, (count, m) int32, padded with its index. Pairs: sorted."""
    counts = np.bincount(first, minlength=count)
    column = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
    result = np.arange(count, dtype=np.int32)[:, None].repeat(counts.max(initial=1), axis=1)
    result[first, column] = second
    return result


def connected(taxels: Indices, beside: NDArray[np.signedinteger]) -> Indices:
    """Label the connected components of some taxels: (k,), 0…c − 1 in the order of first taxels.

    taxels: (k,) int, rising. beside: (m, t) int, the neighbours of each taxel, padded with itself.

    Trees of taxels merge along the links between them: in each round every root whose tree touches
    lower ones is attached to the lowest, then the trees are flattened. (A form of Shiloach &
    Vishkin, An O(log n) parallel connectivity algorithm, 1982. scipy's connected_components would
    do it too, but the core does without scipy.)
    """
    count = len(taxels)
    own = np.arange(count + 1)  # the last entry stands for all other taxels
    among = np.full(beside.shape[1], count)
    among[taxels] = own[:-1]
    near = among[beside.take(taxels, axis=1)]
    root, lowest = own, _lowest(own, near)
    while True:
        above = root.copy()
        np.minimum.at(above, root[:-1], lowest)
        while (root != above).any():
            root, above = above, above[above]
        lowest = _lowest(root, near)
        if not (lowest < root[:-1]).any():
            return np.asarray(((root == own).cumsum() - 1)[root[:-1]])


def _lowest(root: Indices, near: Indices) -> Indices:
    # numpy finds the minimum of int32 30 times as fast as of int64.
    return np.asarray(root.astype(np.int32)[near].min(axis=0).astype(np.intp))


def _between_is_empty(
    places_m: Floats, first: Indices, second: Indices, distance_m: Floats
) -> Bools:
    """Tell whether the ball between two taxels holds none of those near the first one, (p,)."""
    most = int(np.bincount(first, minlength=1).max())
    if len(first) * most > MOST_COMPARED:
        raise SpecError(
            f"{most} taxels lie within {REACH_PITCHES:g} pitches of one: are positions in mm, is "
            "the pitch right?"
        )
    near, empty = table(first, second, len(places_m)), np.ones(len(first), dtype=bool)
    step = max(1, _AT_ONCE // near.shape[1])
    for begin in range(0, len(first), step):
        pair = slice(begin, begin + step)
        one, other, third = first[pair], second[pair], near[first[pair]]
        middle_m = (places_m[one] + places_m[other]) / 2
        off_m = np.linalg.norm(places_m[third] - middle_m[:, None], axis=2)
        inside = off_m < _BALL / 2 * distance_m[pair, None]
        inside &= (third != one[:, None]) & (third != other[:, None])
        empty[pair] = ~inside.any(axis=1)
    return empty


def _both_ways(holds: Bools, first: Indices, second: Indices) -> Bools:
    """Tell whether something holds of a pair in both orders, (p,)."""
    return holds & holds[np.lexsort((first, second))]


def _median_of(group: Indices, values: Floats, groups: int) -> Floats:
    """Return the upper median of each group's values, (groups,); ∞ where there are none."""
    order = np.lexsort((values, group))
    counts = np.bincount(group, minlength=groups)
    middle = np.cumsum(counts) - counts + counts // 2
    medians = np.full(groups, np.inf)
    some = counts > 0
    medians[some] = values[order][middle[some]]
    return medians


def cells(positions_m: Points, normals: Points, neighbours: Int32s, pitch_m: float) -> list[Floats]:
    """Return the Voronoi cells: corners (c, 2), m, right and up of the taxel, turning left.

    neighbours: (t, m), padded with the taxel itself. Cells are cut in the tangent plane. At the
    border, where neighbours leave a gap of more than _GAP, a cell reaches as far out as it does on
    the other side; along a lone row, a pitch's half.
    """
    ways = np.stack(tangents(normals), axis=1)  # (t, 2, 3)
    first, second, _ = beside(positions_m, normals, REACH_PITCHES * pitch_m)
    begins = np.searchsorted(first, np.arange(len(positions_m) + 1))
    result = []
    for taxel, row in enumerate(neighbours):
        others = second[begins[taxel] : begins[taxel + 1]]
        apart_m = positions_m[others].astype(np.float64) - positions_m[taxel]
        flat_m = apart_m @ ways[taxel].T
        length_m = np.maximum(np.linalg.norm(flat_m, axis=1), 1e-12)
        flat_m *= (np.linalg.norm(apart_m, axis=1) / length_m)[:, None]
        beyond_m = _beyond(flat_m[np.isin(others, row)], pitch_m)
        result.append(_cell(np.vstack([flat_m, beyond_m])))
    return result


def polygon_areas_m2(polygons: list[Floats]) -> Floats:
    """Return the areas of polygons that turn left, (t,), m²."""
    sides = ((p, np.roll(p, -1, axis=0)) for p in polygons)  # by the shoelace formula
    return np.array([(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum() / 2 for p, q in sides])


def _beyond(flat_m: Floats, pitch_m: float) -> Floats:
    """Return places (g, 2) of taxels that would lie beyond the border, seen from one at (0, 0)."""
    ghosts = [np.empty((0, 2)) if len(flat_m) else np.array([[pitch_m, 0.0]])]
    mirrored = np.arctan2(-flat_m[:, 1], -flat_m[:, 0])
    for begin, gap in _gaps(flat_m):
        inside = (mirrored - begin) % (2 * np.pi)
        ghosts.append(-flat_m[(inside > _BESIDE) & (inside < gap - _BESIDE)])
    for begin, gap in _gaps(np.vstack([flat_m, *ghosts])):
        parts = max(1, round(gap / (np.pi / 2)) - 1)
        way = begin + gap * (np.arange(parts) + 1) / (parts + 1)
        ghosts.append(pitch_m * np.column_stack([np.cos(way), np.sin(way)]))
    return np.vstack(ghosts)


def _gaps(flat_m: Floats) -> list[tuple[float, float]]:
    """Find where angles of more than _GAP between directions begin, and how wide they are, rad."""
    turned = np.sort(np.arctan2(flat_m[:, 1], flat_m[:, 0]))
    width = np.diff(turned, append=turned[:1] + 2 * np.pi)
    return list(zip(turned[width > _GAP].tolist(), width[width > _GAP].tolist(), strict=True))


def _cell(flat_m: Floats) -> Floats:
    """Return corners (c, 2) of the points nearer to (0, 0) than to any of these (k, 2) places."""
    # A line n·p = h for each: it is an edge between the lines that cut it first on either side.
    far_m = np.linalg.norm(flat_m, axis=1)
    normal, height_m = flat_m / far_m[:, None], far_m / 2
    along = np.column_stack([-normal[:, 1], normal[:, 0]])
    rate = along @ normal.T  # (edge, other)
    room_m = height_m - height_m[:, None] * (normal @ normal.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        meets_m = room_m / rate
    parallel = np.abs(rate) < 1e-9
    low_m = np.where(parallel | (rate > 0), -np.inf, meets_m).max(axis=1)
    high_m = np.where(parallel | (rate < 0), np.inf, meets_m).min(axis=1)
    beyond = (parallel & (room_m < -1e-15)).any(axis=1)
    edge = np.flatnonzero(~beyond & (high_m - low_m > 1e-9 * far_m.min()))
    # Two places in the same direction have the same line: it counts once.
    _, once = np.unique(np.round(flat_m[edge] / far_m.min(), 6), axis=0, return_index=True)
    edge = edge[once]
    edge = edge[np.argsort(np.arctan2(normal[edge, 1], normal[edge, 0]))]
    return np.asarray(height_m[edge, None] * normal[edge] + high_m[edge, None] * along[edge])


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
    positions_m: Points, normals: Points, radius_m: float
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


def usual_distance_m(positions_m: Points, normals: Points) -> float | None:
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


def _candidates(cells: Int64s, radius_m: float) -> Iterator[tuple[Indices, Indices]]:
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
