# SPDX-License-Identifier: Apache-2.0

"""The skin's surface as triangles: a square for every taxel, in the plane that touches it there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .layout import Layout

CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, -1), (1, 1), (-1, 1))
"""Of a taxel's two triangles, in half edges right and up; anticlockwise, seen from outside."""


def taxel_squares(layout: Layout) -> NDArray[np.float32]:
    """Two triangles per taxel, (t, 6, 3) float32, corners in m, anticlockwise seen from outside.

    A square has its taxel's area. So they meet on a plane; on a cylinder they touch it, and on a
    sphere, where cells are narrower one way, they overlap a little the other way.
    """
    right, up = tangents(layout.normals)
    half_m = np.sqrt(layout.areas_m2.astype(np.float64))[:, None, None] / 2
    x, y = np.array(CORNERS, dtype=np.float64).T[:, None, :, None]
    corners_m = half_m * (x * right[:, None] + y * up[:, None])
    return np.asarray(layout.positions_m[:, None] + corners_m, dtype=np.float32)


def tangents(normals: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Right and up on the surface, (t, 3) float64 both, unit vectors; right × up is the normal.

    normals: (t, 3), unit vectors. They are x and y, turned with z the shortest way to the normal:
    the rows and columns of regular skins. Straight down it is turned about y, as on a cylinder.
    """
    x, y, z = normals.T.astype(np.float64)
    slope = np.hypot(x, y)
    upright = slope == 0
    along = np.where(upright, 1.0, slope)  # no division by 0
    # Which way a normal leans, and what a unit vector that way gains by the turn.
    lean_x, lean_y = np.where(upright, 1.0, x) / along, y / along
    gain = np.stack([(z - 1) * lean_x, (z - 1) * lean_y, -slope], axis=1)
    return [1, 0, 0] + lean_x[:, None] * gain, [0, 1, 0] + lean_y[:, None] * gain
