"""Where the taxels are: their places on the skin, the nodes behind them, who is beside whom."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .errors import SpecError


@dataclass(frozen=True, eq=False)
class Layout:
    """The taxels of one skin patch, t of them, in the order of all arrays that are published.

    name: of the layout; shown to people. rows, columns: t = rows · columns, row-major; an
        irregular skin is one row.
    positions_m: (t, 3) float32, centres, m, in the frame of the patch.
    normals: (t, 3) float32, unit vectors out of the surface.
    areas_m2: (t,) float32, the share of the surface that each taxel stands for, m²: force is
        pressure times this area.
    flat_m: (t, 2) float32, the places on the unrolled surface, m.
    nodes: (t,) int32, 1-based number of the node behind each taxel; 0: none.
    pitch_m: usual distance of neighbouring taxels, m.
    masked: nodes that are out of service.
    """

    name: str
    rows: int
    columns: int
    positions_m: NDArray[np.float32]
    normals: NDArray[np.float32]
    areas_m2: NDArray[np.float32]
    flat_m: NDArray[np.float32]
    nodes: NDArray[np.int32]
    pitch_m: float
    masked: tuple[int, ...] = ()

    @classmethod
    def grid(cls, nodes: int, rows: int, columns: int, pitch_m: float, taxel_m: float) -> Layout:
        """A flat grid for n nodes, row-major, about the centre of the skin.

        Node 1 is row 0, column 0; x grows with columns, y with rows. 0 rows or columns are chosen,
        as square as a full grid allows. taxel_m: edge of a taxel's sensing area, m.
        Raises SpecError where rows × columns is not the number of nodes.
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
        if taxel_m > pitch_m:
            raise SpecError(
                f"taxels of {taxel_m * 1e3:g} mm overlap at a pitch of {pitch_m * 1e3:g} mm"
            )
        flat_m = grid_places(rows, columns, pitch_m)
        return cls(
            name=f"grid of {rows} × {columns}",
            rows=rows,
            columns=columns,
            positions_m=np.pad(flat_m, ((0, 0), (0, 1))),
            normals=np.tile(np.array([0, 0, 1], dtype=np.float32), (nodes, 1)),
            areas_m2=np.full(nodes, pitch_m**2, dtype=np.float32),
            flat_m=flat_m,
            nodes=np.arange(1, nodes + 1, dtype=np.int32),
            pitch_m=pitch_m,
        )

    def __len__(self) -> int:
        return len(self.nodes)

    @cached_property
    def source(self) -> NDArray[np.intp] | None:
        """(t,) index of each taxel's node in arrays of all nodes; −1: no node.

        None where taxel i has node i + 1 throughout, so that nothing has to be moved.
        """
        index = self.nodes.astype(np.intp) - 1
        return None if np.array_equal(index, np.arange(len(index))) else index

    @cached_property
    def neighbours(self) -> NDArray[np.int32]:
        """(t, m) int32, the taxels within 1.5 pitches of each one, padded with its own index."""
        close = [
            np.flatnonzero(
                (np.linalg.norm(self.positions_m - place, axis=1) < 1.5 * self.pitch_m)
                & (self.nodes > 0)
                & (number > 0)
            )
            for place, number in zip(self.positions_m, self.nodes, strict=True)
        ]
        table = np.arange(len(self), dtype=np.int32)[:, None].repeat(max(map(len, close)), axis=1)
        for own, taxels in enumerate(close):
            table[own, : len(taxels)] = taxels
        return table


def grid_places(rows: int, columns: int, pitch_m: float) -> NDArray[np.float32]:
    """Row-major places of a flat grid about its centre, (rows · columns, 2) float32, m."""
    y, x = np.mgrid[:rows, :columns].astype(np.float64)
    centred = np.stack([x.ravel() - (columns - 1) / 2, y.ravel() - (rows - 1) / 2], axis=1)
    return (centred * pitch_m).astype(np.float32)
