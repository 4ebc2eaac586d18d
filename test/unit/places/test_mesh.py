# SPDX-License-Identifier: Apache-2.0

"""Squares of taxels on the skin: areas, normals, positions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_shapes import Surface, cylinder, plane, sphere, tangents
from tactile_cdma.places.mesh import taxel_squares

PITCH_M = 7e-3
ROWS, COLUMNS = 6, 9
SURFACES = {
    "plane": plane(ROWS, COLUMNS, PITCH_M),
    "sleeve": cylinder(ROWS, COLUMNS, PITCH_M, COLUMNS * PITCH_M / (2 * np.pi)),
    "sphere": sphere(ROWS, COLUMNS, PITCH_M, 25e-3),
}
shapes = pytest.mark.parametrize("surface", SURFACES.values(), ids=SURFACES)


def layout(surface: Surface) -> Layout:
    numbers = np.arange(1, ROWS * COLUMNS + 1, dtype=np.int32)
    wiring = {"name": "skin", "nodes": numbers, "pitch_m": PITCH_M}
    return Layout(**vars(surface), rows=ROWS, columns=COLUMNS, **wiring)


def triangles(squares: np.ndarray) -> np.ndarray:
    """(t, 2, 3): twice the area of each triangle along its normal, m²."""
    corners = squares.astype(np.float64).reshape(-1, 2, 3, 3)
    first, second = corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
    return np.cross(first, second)


@shapes
def test_two_triangles_have_the_area_of_their_taxel_and_look_outwards(surface: Surface) -> None:
    twice = triangles(taxel_squares(layout(surface)))
    assert np.allclose(
        twice.sum(axis=1) / 2, surface.normals * surface.areas_m2[:, None], atol=1e-10
    )
    areas = np.linalg.norm(twice, axis=2) / 2
    assert np.allclose(areas, surface.areas_m2[:, None] / 2, rtol=1e-4)


@shapes
def test_squares_lie_about_their_taxel_in_the_tangent_plane(surface: Surface) -> None:
    squares = taxel_squares(layout(surface))
    arms = squares - surface.positions_m[:, None]
    assert np.allclose((arms * surface.normals[:, None]).sum(axis=2), 0, atol=1e-8)
    half_diagonals = np.sqrt(surface.areas_m2 / 2)[:, None]
    assert np.allclose(np.linalg.norm(arms, axis=2), half_diagonals, rtol=1e-4)


def test_squares_of_a_plane_cover_it_without_a_gap() -> None:
    corners = np.unique(taxel_squares(layout(SURFACES["plane"]))[..., :2].round(7), axis=None)
    lines = {round(float(x), 4) for x in corners}
    edges = {round((i - n / 2) * PITCH_M, 4) for n in (ROWS, COLUMNS) for i in range(n + 1)}
    assert lines == edges


def test_squares_stand_along_rows_and_columns_of_a_sleeve() -> None:
    skin = layout(SURFACES["sleeve"])
    right, up = tangents(skin.normals)
    assert np.allclose(up, [0, 1, 0], atol=1e-6)
    places = skin.positions_m.reshape(ROWS, COLUMNS, 3).astype(float)
    chords = np.roll(places, -1, axis=1) - np.roll(places, 1, axis=1)  # along the columns
    chords /= np.linalg.norm(chords, axis=2, keepdims=True)
    assert np.allclose(right.reshape(ROWS, COLUMNS, 3), chords, atol=1e-5)


unit = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)
almost_down = st.tuples(st.floats(-1e-6, 1e-6), st.floats(-1e-6, 1e-6), st.just(-1.0))


@given(unit | almost_down)
def test_tangents_and_normal_are_right_handed_wherever_the_normal_points(
    direction: tuple[float, float, float],
) -> None:
    normal = (np.array(direction) / np.linalg.norm(direction)).astype(np.float32)
    [right], [up] = tangents(normal[None])
    frame = np.stack([right, up, normal])
    assert np.allclose(frame @ frame.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(frame) == pytest.approx(1)
