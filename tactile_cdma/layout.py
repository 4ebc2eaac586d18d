"""Where the taxels are: their places on the skin and in a picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import SpecError


@dataclass(frozen=True, slots=True)
class GridLayout:
    """A flat grid, row-major: node 1 is row 0, column 0; x grows with columns, y with rows.

    pitch_m: distance of neighbouring taxels, m. taxel_m: edge of a taxel's sensing area, m.
    """

    rows: int
    columns: int
    pitch_m: float
    taxel_m: float

    @classmethod
    def of(cls, nodes: int, rows: int, columns: int, pitch_m: float, taxel_m: float) -> GridLayout:
        """A grid for n nodes; 0 rows or columns are chosen, as square as a full grid allows.

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
        return cls(rows, columns, pitch_m, taxel_m)

    @property
    def positions_m(self) -> NDArray[np.float32]:
        """Centre of every taxel, (n, 3) float32, m, about the centre of the skin."""
        y, x = np.mgrid[: self.rows, : self.columns].astype(np.float32)
        centred = [x.ravel() - (self.columns - 1) / 2, y.ravel() - (self.rows - 1) / 2]
        return np.stack([*centred, np.zeros(x.size)], axis=1).astype(np.float32) * np.float32(
            self.pitch_m
        )

    @property
    def area_m2(self) -> float:
        """Sensing area of one taxel, m²."""
        return self.taxel_m**2
