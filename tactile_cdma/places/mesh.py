# SPDX-License-Identifier: Apache-2.0

"""The skin's surface as triangles: a square for every taxel, in its tangent plane."""

import numpy as np

from ..base.arrays import Floats, Floats32
from .layout import Layout

CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, -1), (1, 1), (-1, 1))
"""Corners of a taxel's two triangles, in half edges right and up; anticlockwise from outside."""

MOST_SQUARES = 256
"""Taxels up to which markers have squares, 240 bytes each; chosen: larger skins have ~/points,
which take a sixth of that."""


def taxel_squares(layout: Layout) -> Floats32:
    """Two triangles per taxel, (t, 6, 3) float32, corners in m, anticlockwise seen from outside.

    Each square has its taxel's area. On a plane neighbouring squares meet; on a cylinder they are
    tangent to it; on a sphere, whose cells are narrower one way, they overlap slightly the other
    way.
    """
    right, up = tangents(layout.normals)
    half_m = np.sqrt(layout.areas_m2.astype(np.float64))[:, None, None] / 2
    x, y = np.array(CORNERS, dtype=np.float64).T[:, None, :, None]
    corners_m = half_m * (x * right[:, None] + y * up[:, None])
    return np.asarray(layout.positions_m[:, None] + corners_m, dtype=np.float32)


def tangents(normals: Floats | Floats32) -> tuple[Floats, Floats]:
    """Right and up on the surface, (t, 3) float64 each, unit vectors; right × up is the normal.

    normals: (t, 3), unit vectors. Right and up are x and y, rotated as z is the shortest way to the
    normal: the directions of rows and columns on regular skins. For a normal straight down the
    rotation is about y, as on a cylinder.
    """
    x, y, z = normals.T.astype(np.float64)
    slope = np.hypot(x, y)
    upright = slope == 0
    along = np.where(upright, 1.0, slope)  # no division by 0
    # The direction in which a normal leans, and how the rotation changes the unit vector there.
    lean_x, lean_y = np.where(upright, 1.0, x) / along, y / along
    gain = np.stack([(z - 1) * lean_x, (z - 1) * lean_y, -slope], axis=1)
    return [1, 0, 0] + lean_x[:, None] * gain, [0, 1, 0] + lean_y[:, None] * gain
