# SPDX-License-Identifier: Apache-2.0

"""The skin's surface as triangles: a rectangle for every taxel, in its tangent plane."""

import numpy as np

from ..base.arrays import Floats32
from .layout import Layout
from .layout_shapes import tangents

CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, -1), (1, 1), (-1, 1))
"""Corners of a taxel's two triangles, in half edges right and up; anticlockwise from outside."""

MOST_SQUARES = 256
"""Taxels up to which markers have squares, 240 bytes each; chosen: larger skins have ~/points,
which take a sixth of that."""


def taxel_squares(layout: Layout) -> Floats32:
    """Two triangles per taxel, (t, 6, 3) float32, corners in m, anticlockwise seen from outside.

    Each has its taxel's area and the shape of its cell. On a plane neighbouring ones meet; on a
    cylinder they are tangent to it; on a sphere, whose cells are narrower one way, they overlap
    slightly the other way.
    """
    right, up = tangents(layout.normals)
    x, y = (layout.edges_m[:, None] / 2 * CORNERS).transpose(2, 0, 1)[..., None]
    corners_m = x * right[:, None] + y * up[:, None]
    return np.asarray(layout.positions_m[:, None] + corners_m, dtype=np.float32)
