# SPDX-License-Identifier: Apache-2.0

"""The layout of a skin patch: taxel positions, the node behind each taxel, and neighbours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..base.arrays import Floats, Floats32, Indices, Int32s
from ..base.errors import SpecError
from .adjacency import around, cells, connected, on_grid, polygon_areas_m2, table, usual_distance_m
from .layout_shapes import Pitch, Surface, across_and_down, plane, seen_from_outside, tangents

COVER_PITCHES = 0.75
"""Radius of a listed taxel in pictures, in pitches: above √½, so that squares leave no gaps."""
MAX_CELLS = 1 << 18
"""Most cells in an irregular skin's raster: 4, of half a pitch, for each of 65,535 taxels."""
CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, -1), (1, 1), (-1, 1))
"""Corners of a taxel's two triangles, in half edges right and up; anticlockwise from outside."""
MOST_SQUARES = 256
"""Taxels up to which markers have squares, 240 bytes each; chosen: ~/points takes a sixth."""


@dataclass(frozen=True, eq=False)
class Layout(Surface):
    """The taxels of one skin patch, t of them, in the order of all published arrays.

    name: shown to people. rows, columns: t = rows · columns, row-major; of an irregular skin, where
    they do not describe positions, one row. nodes: (t,) int32, 1-based number of the node behind
    each taxel; 0: none. masked: those out of service. unplaced: those on the wire behind no taxel.
    pitch_m: typical distance between neighbouring taxels, m: where there are two, their geometric
    mean. aspect: distance from column to column over that from row to row.
    """

    name: str
    rows: int
    columns: int
    nodes: Int32s
    pitch_m: float
    masked: tuple[int, ...] = ()
    unplaced: tuple[int, ...] = ()
    irregular: bool = False
    aspect: float = 1.0

    @classmethod
    def grid(cls, nodes: int, rows: int, columns: int, pitch_m: Pitch, taxel_m: float) -> Layout:
        """Make a flat grid of nodes 1…n, row-major, about the centre of the skin.

        Node 1 is row 0, column 0; x grows with columns, y falls with rows. Where rows or columns
        are 0 they are chosen, as square as a full grid allows. taxel_m: edge of a taxel's sensing
        area, m.
        Raises SpecError where rows × columns is not the number of nodes, or taxels overlap.
        """
        if not rows and not columns:
            rows = next(r for r in range(math.isqrt(nodes), 0, -1) if nodes % r == 0)
        rows = rows or max(1, nodes // columns)
        columns = columns or max(1, nodes // rows)
        if rows * columns != nodes:
            raise SpecError(
                f"a grid of {rows} rows × {columns} columns has {rows * columns} places for "
                f"{nodes} nodes; set rows and columns so that they multiply to nodes"
            )
        across_m, down_m = across_and_down(pitch_m)
        if taxel_m > min(across_m, down_m):
            raise SpecError(
                f"taxels of {taxel_m * 1e3:g} mm overlap at a pitch of "
                f"{min(across_m, down_m) * 1e3:g} mm"
            )
        return cls(
            **vars(plane(rows, columns, pitch_m)),
            name=f"grid of {rows} × {columns}",
            rows=rows,
            columns=columns,
            nodes=np.arange(1, nodes + 1, dtype=np.int32),
            pitch_m=math.sqrt(across_m * down_m),
            aspect=across_m / down_m,
        )

    @classmethod
    def seen(cls, name: str, size: tuple[int, int], nodes: Int32s, *at: Floats32) -> Layout:
        """Make a layout of places alone: an irregular skin, of one row, is as seen from outside.

        size: rows, columns. at: positions_m, normals, areas_m2.
        """
        positions_m, normals, areas_m2 = at
        irregular = size[0] == 1 and size[1] > 1
        pitch_m = usual_distance_m(positions_m, normals) if irregular else None
        across_m, down_m = (_usual_step_m(positions_m, normals, size, axis) for axis in (1, 0))
        two = min(across_m, down_m) > 0 and not irregular
        flat_m = seen_from_outside(positions_m, normals).astype(np.float32)
        return cls(
            **vars(Surface(flat_m, *at)),
            name=name,
            rows=size[0],
            columns=size[1],
            nodes=nodes,
            pitch_m=pitch_m or float(np.sqrt(np.median(areas_m2))),
            irregular=irregular,
            aspect=across_m / down_m if two else 1.0,
        )

    def __len__(self) -> int:
        return len(self.nodes)

    def __repr__(self) -> str:
        return f"Layout({self.name!r}, {len(self)} taxels)"

    @property
    def pitches_m(self) -> tuple[float, float]:
        """Return the distance of two columns, and of two rows, m; equal on most skins."""
        return self.pitch_m * math.sqrt(self.aspect), self.pitch_m / math.sqrt(self.aspect)

    def said(self) -> dict[str, Pitch]:
        """Tell what the parameters of these names would be: rows, columns, pitch_mm."""
        across_mm, down_mm = (1e3 * pitch_m for pitch_m in self.pitches_m)
        pitch_mm = across_mm if self.aspect == 1 else (across_mm, down_mm)
        return {"rows": self.rows, "columns": self.columns, "pitch_mm": pitch_mm}

    def is_alike(self, other: Layout) -> bool:
        """Tell whether the same taxels with the same nodes are at the same places."""
        return len(self) == len(other) and all(
            np.allclose(getattr(self, name), getattr(other, name), rtol=1e-3, atol=1e-9)
            for name in ("positions_m", "normals", "areas_m2", "nodes")
        )

    @property
    def edges_m(self) -> Floats:
        """Return each taxel's width and height, (t, 2), m: its area, in the shape of its cells."""
        shape = [math.sqrt(self.aspect), 1 / math.sqrt(self.aspect)]
        return np.sqrt(self.areas_m2.astype(np.float64))[:, None] * shape

    @property
    def wired(self) -> int:
        """Number of nodes on the wire: the highest node number in the layout."""
        return max((int(self.nodes.max()), *self.unplaced))

    @cached_property
    def middle(self) -> int:
        """Find the taxel nearest to the middle of all."""
        from_middle_m = self.positions_m - self.positions_m.mean(axis=0)
        return int(np.linalg.norm(from_middle_m, axis=1).argmin())

    @cached_property
    def source(self) -> Indices | None:
        """Return the index of each taxel's node in arrays of all nodes, (t,); −1: no node.

        None if taxel i has node i + 1 and every node has a taxel: arrays need no reordering.
        """
        index = self.nodes.astype(np.intp) - 1
        in_order = np.array_equal(index, np.arange(len(index))) and not self.unplaced
        return None if in_order else index

    def of_nodes(self, values: Floats32) -> Floats32:
        """Order values of the nodes, (n,), by taxel, (t,); 0 for a taxel without a node."""
        if self.source is None:
            return values
        return np.where(self.source < 0, np.float32(0), values[self.source])

    @cached_property
    def neighbours(self) -> Int32s:
        """Return the neighbours of each taxel, (t, m) int32, padded with its own index.

        On a grid they are the eight around it, and what a sleeve brings near; else see
        adjacency.around. None face away from each other, and none is without a node.
        """
        placed = np.flatnonzero(self.nodes)
        surface = self.positions_m[placed], self.normals[placed]
        if self.irregular:
            first, second = around(*surface, self.pitch_m)
        else:
            first, second = on_grid(*surface, self.pitches_m, placed, self.columns)
        return table(placed[first], placed[second], len(self))

    @cached_property
    def pieces(self) -> Indices:
        """Return which piece of the skin each taxel with a node is of, (t,), from 0; −1: no node.

        Neighbours, and their neighbours, are one piece.
        """
        placed = np.flatnonzero(self.nodes)
        pieces = np.full(len(self), -1, dtype=np.intp)
        pieces[placed] = connected(placed, self.neighbours.T)
        return pieces

    @cached_property
    def outlines_m(self) -> list[Floats]:
        """Return each taxel's corners (c, 2), m from its centre, right and up, turning left.

        A rectangle on a grid, a Voronoi cell on an irregular skin; of the taxel's area.
        """
        if not self.irregular:
            square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
            return list(square * self.edges_m[:, None])
        outlines = cells(self.positions_m, self.normals, self.neighbours, self.pitch_m)
        scale = np.sqrt(self.areas_m2 / polygon_areas_m2(outlines))
        return [outline * share for outline, share in zip(outlines, scale, strict=True)]

    @property
    def squares_m(self) -> Floats32:
        """Return two triangles per taxel, (t, 6, 3), corners in m, anticlockwise seen from outside.

        Each has its taxel's area and the shape of its cell. Neighbouring ones meet on a plane, are
        tangent to a cylinder, and overlap slightly one way on a sphere, whose cells are narrower.
        """
        right, up = tangents(self.normals)
        x, y = (self.edges_m[:, None] / 2 * CORNERS).transpose(2, 0, 1)[..., None]
        corners_m = x * right[:, None] + y * up[:, None]
        return np.asarray(self.positions_m[:, None] + corners_m, dtype=np.float32)

    @cached_property
    def raster(self) -> Int32s:
        """Return the taxel in each cell of a picture of the unrolled skin, (h, w) int32; −1: none.

        Seen from outside, with the greatest y in the top row. The cells of a grid are its taxels
        with a node; those of an irregular skin are cell_m wide and hold the nearest taxel.
        """
        if not self.irregular:
            taxels = np.where(self.nodes > 0, np.arange(len(self)), -1)
            return taxels.astype(np.int32).reshape(self.rows, self.columns)
        down_m = self.flat_m * np.array([1, -1], dtype=np.float32)
        place = (down_m - down_m.min(axis=0) + self.pitch_m / 2) / self.cell_m
        width, height = self._cells(self.cell_m)
        reach = COVER_PITCHES * self.pitch_m / self.cell_m
        steps = np.arange(-math.ceil(reach), math.ceil(reach) + 1)
        offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        cells = np.floor(place).astype(np.int64)[:, None] + offsets
        distance = np.linalg.norm(cells + 0.5 - place[:, None], axis=2)
        own = (offsets == 0).all(axis=1)
        inside = ((cells >= 0) & (cells < [width, height])).all(axis=2)
        taxel, offset = np.nonzero(inside & ((distance <= reach) | own))
        # The nearest taxel of a cell is written last and stays.
        order = np.argsort(-distance[taxel, offset], kind="stable")
        x, y = cells[taxel, offset][order].T
        raster = np.full((height, width), -1, dtype=np.int32)
        raster[y, x] = taxel[order]
        return raster

    @cached_property
    def cell_m(self) -> float:
        """Return the edge length of a cell of the raster, m: the pitch of a grid.

        On an irregular skin half the pitch, doubled until there are at most MAX_CELLS cells.
        """
        if not self.irregular:
            return self.pitch_m
        cell_m = self.pitch_m / 2
        while math.prod(self._cells(cell_m)) > MAX_CELLS:
            cell_m *= 2
        return cell_m

    def _cells(self, cell_m: float) -> tuple[int, int]:
        """Return width and height of an irregular skin and a border of half a pitch, in cells."""
        extent_m = np.ptp(self.flat_m.astype(np.float64), axis=0) + self.pitch_m
        # Rounding of float32 positions must not add a cell.
        width, height = np.ceil(extent_m / cell_m - 0.01).astype(int).tolist()
        return max(1, width), max(1, height)


def _usual_step_m(
    positions_m: Floats32, normals: Floats32, size: tuple[int, int], axis: int
) -> float:
    """Median distance of neighbours in rows (axis 1) or columns along the surface, m; 0: none."""
    if size[axis] < 2:
        return 0.0
    apart_m = np.linalg.norm(np.diff(positions_m.reshape(*size, 3), axis=axis), axis=2)
    ends = normals.reshape(*size, 3)
    turned = np.linalg.norm(np.diff(ends, axis=axis), axis=2) / 2  # the sine of half the angle
    arc = np.arcsin(np.minimum(turned, 1.0)) / np.maximum(turned, 1e-9)
    return float(np.median(apart_m * np.where(turned > 1e-6, arc, 1.0)))
