# SPDX-License-Identifier: Apache-2.0

"""The skin's surface as triangles: a rectangle for every taxel, in its tangent plane."""

import numpy as np

from ..base.arrays import Floats32
from .layout import Layout
from .layout_shapes import tangents

CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, -1), (1, 1), (-1, 1))
"""Corners of a taxel's two triangles, in half edges right and up; anticlockwise from outside."""

MOST_SQUARES = 256
"""Taxels up to which markers have squares, 240 bytes each; chosen: ~/points takes a sixth."""


def taxel_squares(layout: Layout) -> Floats32:
    """Two triangles per taxel, (t, 6, 3) float32, corners in m, anticlockwise seen from outside.

    Each has its taxel's area and the shape of its cell. Neighbouring ones meet on a plane, are
    tangent to a cylinder, and overlap slightly one way on a sphere, whose cells are narrower.
    """
    right, up = tangents(layout.normals)
    x, y = (layout.edges_m[:, None] / 2 * CORNERS).transpose(2, 0, 1)[..., None]
    corners_m = x * right[:, None] + y * up[:, None]
    return np.asarray(layout.positions_m[:, None] + corners_m, dtype=np.float32)
