# SPDX-License-Identifier: Apache-2.0

"""Taxel positions on regular surfaces: rows and columns on a plane, a cylinder or a sphere.

The frame is the patch's: its origin is the centre of the skin, where z points out of the surface.
Seen from outside, columns run to the right (+x) and rows down (−y), as in a picture. As the radius
grows, a curved patch becomes the flat one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats, Floats32
from ..base.errors import SpecError

OVERLAP = 0.25
"""Tolerance of positions, in pitches; chosen: two taxels this close are an error in the file, and a
cylinder whose columns exceed its circumference by no more than this was rounded."""
Pitch: TypeAlias = float | tuple[float, float]
"""Distance of neighbouring taxels, m: from column to column and from row to row, if they differ."""
_QUADRATURE = 6
"""Gauss–Legendre points per edge of a cell, for its area: exact to float32 on a hemisphere."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Taxel positions on a surface, t of them.

    flat_m: (t, 2) float32, positions on the unrolled surface, m.
    positions_m: (t, 3) float32, centres in the frame of the patch, m.
    normals: (t, 3) float32, unit vectors out of the surface.
    areas_m2: (t,) float32, share of the surface, m²: force is pressure times this area.
    """

    flat_m: Floats32
    positions_m: Floats32
    normals: Floats32
    areas_m2: Floats32

    @classmethod
    def of(cls, *arrays: Floats) -> Surface:
        """Make places of arrays in the order of the fields, of any float type."""
        return cls(*(np.array(values, dtype=np.float32) for values in arrays))


def across_and_down(pitch_m: Pitch) -> tuple[float, float]:
    """Return the distance from column to column, and from row to row, m."""
    return pitch_m if isinstance(pitch_m, tuple) else (pitch_m, pitch_m)


def pitch_of(pitch_mm: Pitch) -> Pitch:
    """Return the pitch in m."""
    across_mm, down_mm = across_and_down(pitch_mm)
    return (across_mm * 1e-3, down_mm * 1e-3) if isinstance(pitch_mm, tuple) else pitch_mm * 1e-3


def is_same(pitch: Pitch, other: Pitch) -> bool:
    """Tell whether two pitches, or other numbers, agree to a thousandth."""
    pairs = zip(across_and_down(pitch), across_and_down(other), strict=True)
    return all(math.isclose(one, another, rel_tol=1e-3) for one, another in pairs)


def shown_mm(pitch_mm: Pitch) -> str:
    """Show the pitch as it is written in files and URLs."""
    return f"[{pitch_mm[0]:g}, {pitch_mm[1]:g}]" if isinstance(pitch_mm, tuple) else f"{pitch_mm:g}"


def plane(rows: int, columns: int, pitch_m: Pitch) -> Surface:
    """Lay a flat grid, row-major, about its centre."""
    flat_m = _grid(rows, columns, pitch_m)
    normals = np.broadcast_to([0.0, 0.0, 1.0], (len(flat_m), 3))
    areas_m2 = np.full(len(flat_m), math.prod(across_and_down(pitch_m)))
    return Surface.of(flat_m, np.pad(flat_m, ((0, 0), (0, 1))), normals, areas_m2)


def cylinder(rows: int, columns: int, pitch_m: Pitch, radius_m: float) -> Surface:
    """Bend a grid around an axis parallel to y at z = −radius: columns go around it, rows along it.

    Distances along the surface are preserved: neighbouring columns are an angle pitch/radius apart.
    Raises SpecError where the columns go round more than once.
    """
    round_m, (across_m, down_m) = 2 * math.pi * radius_m, across_and_down(pitch_m)
    if columns * across_m > round_m + OVERLAP * across_m:
        raise SpecError(
            f"{columns} columns of {across_m * 1e3:g} mm take {columns * across_m * 1e3:g} mm, but "
            f"a cylinder of radius {radius_m * 1e3:g} mm is {round_m * 1e3:.1f} mm round: they go "
            "round more than once"
        )
    flat_m = _grid(rows, columns, pitch_m)
    angle = flat_m[:, 0] / radius_m
    normals = np.stack([np.sin(angle), np.zeros(len(angle)), np.cos(angle)], axis=1)
    positions_m = radius_m * (normals - [0.0, 0.0, 1.0])
    positions_m[:, 1] = flat_m[:, 1]
    return Surface.of(flat_m, positions_m, normals, np.full(len(flat_m), across_m * down_m))


def sphere(rows: int, columns: int, pitch_m: Pitch, radius_m: float) -> Surface:
    """Lay a grid on a ball: distances and directions from its middle are kept.

    That is the azimuthal equidistant projection (Snyder, Map Projections, USGS 1395, ch. 25);
    across these directions places draw together, by sin(c)/c at the angle c from the middle.
    Raises SpecError where a taxel would lie beyond the hemisphere.
    """
    flat_m = _grid(rows, columns, pitch_m)
    reach_m = float(np.hypot(*flat_m[0]))
    if reach_m > math.pi / 2 * radius_m:
        raise SpecError(
            f"the corner taxels are {reach_m * 1e3:.1f} mm from the middle, but the hemisphere of "
            f"radius {radius_m * 1e3:g} mm ends at {math.pi / 2 * radius_m * 1e3:.1f} mm: a sheet "
            "does not fit farther round"
        )
    angle = np.hypot(flat_m[:, 0], flat_m[:, 1]) / radius_m
    across = flat_m * (np.sinc(angle / np.pi) / radius_m)[:, None]
    normals = np.column_stack([across, np.cos(angle)])
    positions_m = radius_m * (normals - [0.0, 0.0, 1.0])
    return Surface.of(flat_m, positions_m, normals, _sphere_areas_m2(flat_m, pitch_m, radius_m))


def seen_from_outside(positions_m: NDArray[np.floating], normals: NDArray[np.floating]) -> Floats:
    """Project positions along the mean normal, (t, 2), m; along z where the normals cancel out.

    x points to the right as closely as the direction of view allows.
    """
    out = normals.mean(axis=0)
    if np.linalg.norm(out) < 1e-3:
        out = np.array([0.0, 0.0, 1.0])
    out /= np.linalg.norm(out)
    right = np.cross([0.0, 1.0, 0.0], out)
    if np.linalg.norm(right) < 1e-3:  # seen along y, x is still to the right
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    return np.asarray(positions_m @ np.stack([right, np.cross(out, right)], axis=1))


def tangents(normals: Floats | Floats32) -> tuple[Floats, Floats]:
    """Return right and up on the surface, (t, 3) float64 each, unit; right × up is the normal.

    normals: (t, 3), unit vectors. Right and up are x and y, rotated as z is the shortest way to the
    normal, about y if that is straight down: the directions of rows and columns on regular skins.
    """
    x, y, z = normals.T.astype(np.float64)
    slope = np.hypot(x, y)
    upright = slope == 0
    along = np.where(upright, 1.0, slope)  # no division by 0
    # The direction in which a normal leans, and how the rotation changes the unit vector there.
    lean_x, lean_y = np.where(upright, 1.0, x) / along, y / along
    gain = np.stack([(z - 1) * lean_x, (z - 1) * lean_y, -slope], axis=1)
    return [1, 0, 0] + lean_x[:, None] * gain, [0, 1, 0] + lean_y[:, None] * gain


def _grid(rows: int, columns: int, pitch_m: Pitch) -> Floats:
    """Return the row-major positions of a flat grid about its centre, (rows · columns, 2), m."""
    y, x = np.mgrid[:rows, :columns].astype(np.float64)
    centred = np.stack([x.ravel() - (columns - 1) / 2, (rows - 1) / 2 - y.ravel()], axis=1)
    return np.asarray(centred * across_and_down(pitch_m))


def _sphere_areas_m2(flat_m: Floats, pitch_m: Pitch, radius_m: float) -> Floats:
    """Return areas on the sphere of cells around flat positions: the integral of sin(c)/c."""
    at, weight = np.polynomial.legendre.leggauss(_QUADRATURE)
    half_m = np.array(across_and_down(pitch_m))[:, None, None] / 2
    x, y = flat_m.T[:, :, None] + at * half_m  # (t, _QUADRATURE) each
    angle = np.hypot(x[:, :, None], y[:, None, :]) / radius_m
    areas = np.einsum("txy,x,y->t", np.sinc(angle / np.pi), weight, weight)
    return np.asarray(areas * half_m.prod())
