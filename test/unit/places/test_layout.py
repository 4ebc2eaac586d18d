# SPDX-License-Identifier: Apache-2.0

"""Geometry of layouts: surfaces, neighbours, rasters, squares that are drawn; poses of frames."""

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import SpecError
from tactile_cdma.places.adjacency import cells, polygon_areas_m2, usual_distance_m
from tactile_cdma.places.layout import MAX_CELLS, Layout
from tactile_cdma.places.layout_shapes import Surface, cylinder, plane, sphere, tangents
from tactile_cdma.places.poses import Pose
from tactile_cdma.views.heatmap import NO_TAXEL_RGB, heatmap
from test.support.examples import examples

PITCH_M = 7e-3
SURFACES = {
    "plane": plane(5, 8, PITCH_M),
    "cylinder": cylinder(5, 8, PITCH_M, 20e-3),
    "sphere": sphere(5, 8, PITCH_M, 25e-3),
}
SLEEVE = cylinder(3, 12, PITCH_M, 12 * PITCH_M / (2 * math.pi))


def on(surface: Surface, rows: int = 5, columns: int = 8, **changes: Any) -> Layout:
    nodes = np.arange(1, rows * columns + 1, dtype=np.int32)
    wiring = {"name": "skin", "nodes": nodes, "pitch_m": PITCH_M, **changes}
    return Layout(**vars(surface), rows=rows, columns=columns, **wiring)


def irregular(places_m: np.ndarray, pitch_m: float = PITCH_M) -> Layout:
    """Taxels anywhere on a plane; places_m: (t, 2)."""
    count = len(places_m)
    positions_m, normals = np.pad(places_m, ((0, 0), (0, 1))), np.tile([0, 0, 1], (count, 1))
    surface = Surface.of(places_m, positions_m, normals, np.full(count, pitch_m**2))
    return on(surface, 1, count, pitch_m=pitch_m, irregular=True)


def pairs(layout: Layout) -> set[tuple[int, int]]:
    rows = enumerate(layout.neighbours.tolist())
    return {(taxel, other) for taxel, row in rows for other in row if other != taxel}


def eight_around(rows: int, columns: int) -> set[tuple[int, int]]:
    """Pairs of a grid's places that touch, also at a corner."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    step = np.maximum(abs(row[:, None] - row), abs(column[:, None] - column))
    return set(map(tuple, np.argwhere(step == 1).tolist()))


def gabriel_pairs(layout: Layout, ball: float) -> set[tuple[int, int]]:
    """Pairs of facing taxels whose ball, times `ball`, holds none that faces both."""
    places, taxels = layout.positions_m.astype(float), np.flatnonzero(layout.nodes).tolist()
    face = layout.normals @ layout.normals.T > -1e-3
    found = set()
    for a, b in itertools.permutations(taxels, 2):
        middle, radius = (places[a] + places[b]) / 2, math.dist(places[a], places[b]) / 2
        inside = np.linalg.norm(places[taxels] - middle, axis=1) < ball * radius
        inside &= face[a][taxels] & face[b][taxels] & ~np.isin(taxels, [a, b])
        if face[a, b] and not inside.any():
            found.add((a, b))
    return found


@pytest.mark.parametrize("name", SURFACES)
def test_normals_are_unit_vectors_along_the_gradient(name: str) -> None:
    surface = SURFACES[name]
    assert np.allclose(np.linalg.norm(surface.normals, axis=1), 1, atol=1e-6)
    if name == "plane":
        assert (surface.normals == [0, 0, 1]).all()
        return
    radius_m = {"cylinder": 20e-3, "sphere": 25e-3}[name]
    from_centre = surface.positions_m + np.array([0, 0, radius_m])
    if name == "cylinder":
        from_centre[:, 1] = 0  # the axis is along y
    assert np.allclose(np.linalg.norm(from_centre, axis=1), radius_m, rtol=1e-6)
    assert np.allclose(from_centre / radius_m, surface.normals, atol=1e-6)


def test_bent_surfaces_keep_their_distances() -> None:
    places = SURFACES["cylinder"].positions_m.reshape(5, 8, 3).astype(float)
    around = np.linalg.norm(np.diff(places, axis=1), axis=2)
    assert np.allclose(around, 2 * 20e-3 * math.sin(PITCH_M / 20e-3 / 2), rtol=1e-5)
    assert np.allclose(np.diff(places, axis=0), [0, -PITCH_M, 0], atol=1e-9)
    surface, radius_m = SURFACES["sphere"], 25e-3
    angle = np.arccos(np.clip(surface.normals[:, 2].astype(float), -1, 1))
    assert np.allclose(angle * radius_m, np.linalg.norm(surface.flat_m, axis=1), atol=1e-7)
    across, flat = surface.positions_m[:, :2].astype(float), surface.flat_m.astype(float)
    assert np.allclose(across[:, 0] * flat[:, 1], across[:, 1] * flat[:, 0], atol=1e-9)
    assert ((across * flat).sum(axis=1) > 0).all()


def test_areas_add_up_to_that_of_the_surface() -> None:
    flat_m2 = 40 * PITCH_M**2
    assert SURFACES["plane"].areas_m2.sum() == pytest.approx(flat_m2)
    assert SURFACES["cylinder"].areas_m2.sum() == pytest.approx(flat_m2)
    # Integral over all directions of the spherical cap up to the rectangle's edge.
    radius_m, half = 25e-3, np.array([8, 5]) * PITCH_M / 2
    turn = (np.arange(200_000) + 0.5) * 2 * np.pi / 200_000
    edge = np.min(half / np.abs(np.stack([np.cos(turn), np.sin(turn)], axis=1)), axis=1)
    cap_m2 = radius_m**2 * 2 * np.pi * np.mean(1 - np.cos(edge / radius_m))
    assert SURFACES["sphere"].areas_m2.sum() == pytest.approx(cap_m2, rel=1e-5)
    assert SURFACES["sphere"].areas_m2.min() < SURFACES["sphere"].areas_m2.max() < PITCH_M**2


@pytest.mark.parametrize(("nodes", "shape"), [(16, (4, 4)), (12, (3, 4)), (7, (1, 7)), (1, (1, 1))])
def test_grids_are_as_square_as_they_can_be(nodes: int, shape: tuple[int, int]) -> None:
    grid = Layout.grid(nodes, 0, 0, 7e-3, 5.5e-3)
    assert (grid.rows, grid.columns) == shape


def test_taxels_that_overlap_are_refused() -> None:
    with pytest.raises(SpecError, match="overlap"):
        Layout.grid(16, 4, 4, 5e-3, 7e-3)


@pytest.mark.parametrize("name", SURFACES)
def test_neighbours_on_gridded_surfaces_are_the_eight_around(name: str) -> None:
    layout = on(SURFACES[name])
    assert pairs(layout) == eight_around(5, 8)
    assert layout.neighbours.shape == (40, 8)
    assert layout.neighbours.dtype == np.int32


def test_a_sleeve_closes_and_a_thin_finger_keeps_its_sides_apart() -> None:
    sleeve = on(SLEEVE, 3, 12)
    assert {len(set(row)) for row in sleeve.neighbours[12:24].tolist()} == {8}
    assert (0, 11) in pairs(sleeve)
    finger = on(cylinder(1, 4, PITCH_M, 4 * PITCH_M / (2 * math.pi)), 1, 4)
    assert pairs(finger) == {(a, b) for a in range(4) for b in range(4) if (a - b) % 4 in (1, 3)}


def test_places_without_a_node_and_lone_taxels_have_no_neighbours() -> None:
    layout = on(SURFACES["plane"])
    nodes = layout.nodes.copy()
    nodes[9] = 0
    holed = replace(layout, nodes=nodes)
    assert (holed.neighbours[9] == 9).all()
    assert pairs(holed) == {(a, b) for a, b in pairs(layout) if 9 not in (a, b)}
    assert irregular(np.zeros((1, 2))).neighbours.tolist() == [[0]]


@pytest.mark.parametrize("shape", ["grid", "list"])
def test_columns_may_be_farther_apart_than_rows(shape: str) -> None:
    """6.0 × 3.6 mm: within 1.5 of the shorter pitch are no columns, of the longer one two rows."""
    grid = Layout.grid(24, 6, 4, (6e-3, 3.6e-3), 3e-3)
    layout = grid if shape == "grid" else irregular(grid.flat_m, 3.6e-3)
    assert pairs(layout) == eight_around(6, 4)
    assert np.allclose(polygon_areas_m2(layout.outlines_m), layout.areas_m2)
    assert np.allclose(grid.areas_m2, 21.6e-6)
    assert np.allclose(grid.pitches_m, (6e-3, 3.6e-3))
    bent = cylinder(6, 4, (6e-3, 3.6e-3), 15e-3)
    assert pairs(replace(grid, **vars(bent))) == pairs(grid)
    picture = heatmap(np.zeros(24, np.float32), grid, 1e5, pixels=64)
    assert picture.shape[1] / picture.shape[0] == pytest.approx(4 * 6.0 / (6 * 3.6), rel=0.02)


@examples(40)
@given(st.integers(0, 2**32 - 1), st.integers(4, 40), st.floats(1.5, 5), st.booleans())
def test_nobody_is_between_neighbours(seed: int, count: int, spread: float, is_bent: bool) -> None:
    rng = np.random.default_rng(seed)
    places = rng.uniform(-spread, spread, (count, 3)) * PITCH_M
    normals = np.tile([0.0, 0.0, 1.0], (count, 1))
    if is_bent:
        normals = rng.normal(size=(count, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    places[:, 2] *= is_bent
    layout = replace(
        irregular(places[:, :2]),
        positions_m=places.astype(np.float32),
        normals=normals.astype(np.float32),
        nodes=rng.permutation(count).astype(np.int32),  # one of them is 0
    )
    found = pairs(layout)
    assert found == {(b, a) for a, b in found}, "who is beside me has me beside him"
    assert all(math.dist(*layout.positions_m[[a, b]]) <= 3.001 * PITCH_M for a, b in found)
    if not is_bent:
        assert found <= gabriel_pairs(layout, 0.84)
        length = {pair: math.dist(*layout.positions_m[[*pair]]) for pair in found}
        shortest = min(length.values(), default=0.0)
        for pair in gabriel_pairs(layout, 1.0):
            assert pair in found or math.dist(*layout.positions_m[[*pair]]) > shortest


def test_cells_of_a_list_are_those_of_voronoi() -> None:
    """Inside as scipy finds them; at the border of a grid, and along a lone row, whole ones."""
    from scipy.spatial import ConvexHull, Voronoi  # slow to load, and needed here only

    rng = np.random.default_rng(3)
    places = np.stack(np.meshgrid(np.arange(9.0), np.arange(8.0)), axis=-1).reshape(-1, 2)
    inside = ((places > 1) & (places < [7, 6])).all(axis=1)
    layout = irregular((places + rng.uniform(-0.25, 0.25, places.shape)) * PITCH_M)
    surface = layout.positions_m, layout.normals, layout.neighbours
    found_m2 = polygon_areas_m2(cells(*surface, PITCH_M))
    diagram = Voronoi(layout.flat_m.astype(float))
    for taxel in np.flatnonzero(inside):
        corners = diagram.vertices[diagram.regions[diagram.point_region[taxel]]]
        assert found_m2[taxel] == pytest.approx(ConvexHull(corners).volume, rel=1e-5)
    row = irregular(places[:9] * PITCH_M)
    assert np.allclose(polygon_areas_m2(row.outlines_m), PITCH_M**2)


def test_pieces_of_a_skin_are_counted() -> None:
    places = np.array([[0, 0], [1, 0], [0, 1], [4, 0], [5, 0], [5, 1], [9, 9]]) * PITCH_M
    assert irregular(places).pieces.tolist() == [0, 0, 0, 1, 1, 1, 2]


@examples(40)
@given(st.integers(0, 2**32 - 1), st.integers(2, 60))
def test_the_usual_distance_is_the_median_of_the_nearest(seed: int, count: int) -> None:
    places = np.random.default_rng(seed).normal(size=(count, 3))
    distance = np.linalg.norm(places[:, None] - places, axis=2) + np.diag([np.inf] * count)
    nearest = np.sort(distance.min(axis=1))
    upwards = np.tile([0.0, 0.0, 1.0], (count, 1))
    assert usual_distance_m(places, upwards) == pytest.approx(nearest[(count - 1) // 2])


def test_a_list_that_is_a_grid_is_drawn_as_that_grid() -> None:
    grid = Layout.grid(40, 5, 8, PITCH_M, PITCH_M)
    same = irregular(grid.flat_m)
    assert np.array_equal(grid.raster, np.arange(40).reshape(5, 8))
    assert np.array_equal(same.raster, grid.raster.repeat(2, axis=0).repeat(2, axis=1))
    pressure = np.linspace(0, 1e5, 40).astype(np.float32)
    for pixels in (6, 32):  # without and with lines between taxels
        expected = heatmap(pressure, grid, 1e5, pixels)
        assert np.array_equal(heatmap(pressure, same, 1e5, pixels), expected)


@pytest.mark.parametrize("name", [*SURFACES, "list"])
def test_pictures_show_the_skin_as_it_looks_from_outside(name: str) -> None:
    """With normals towards the viewer x is to the right and y up: no mirror image."""
    layout = irregular(SURFACES["plane"].flat_m) if name == "list" else on(SURFACES[name])
    right, up = layout.positions_m[:, 0].argmax(), layout.positions_m[:, 1].argmax()
    assert np.argwhere(layout.raster == right)[:, 1].max() == layout.raster.shape[1] - 1
    assert np.argwhere(layout.raster == up)[:, 0].min() == 0
    assert (layout.normals[:, 2] > 0).all()


@examples(40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.floats(1, 10))
def test_cells_of_a_raster_show_the_nearest_taxel(seed: int, count: int, spread: float) -> None:
    layout = irregular(np.random.default_rng(seed).uniform(-spread, spread, (count, 2)) * PITCH_M)
    height, width = layout.raster.shape
    y, x = np.mgrid[:height, :width] + 0.5
    left, top = layout.flat_m.min(axis=0)[0], layout.flat_m.max(axis=0)[1]
    right_m, down_m = (axis * layout.cell_m - PITCH_M / 2 for axis in (x, y))
    cells = np.stack([left + right_m, top - down_m], axis=-1)
    distance = np.linalg.norm(cells[:, :, None] - layout.flat_m, axis=3)
    shown = layout.raster >= 0
    chosen = np.take_along_axis(distance, np.maximum(layout.raster, 0)[..., None], axis=2)[..., 0]
    assert np.allclose(chosen[shown], distance.min(axis=2)[shown], atol=1e-8)
    assert (distance.min(axis=2)[~shown] > 0.7 * PITCH_M).all()


def test_rasters_of_scattered_skins_are_bounded_and_show_every_taxel() -> None:
    far = irregular(np.array([[0, 0], [1, 0], [3000, 4000]]) * PITCH_M)
    assert far.raster.size <= MAX_CELLS
    assert far.raster.max() == 2
    picture = heatmap(np.zeros(3, np.float32), far, 1e5, pixels=256)
    assert picture.size <= 3 << 20
    assert tuple(picture[0, 0]) == tuple(picture[-1, -1]) == NO_TAXEL_RGB


def triangles(squares: np.ndarray) -> np.ndarray:
    """(t, 2, 3): twice the area of each triangle along its normal, m²."""
    corners = squares.astype(np.float64).reshape(-1, 2, 3, 3)
    first, second = corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
    return np.cross(first, second)


@pytest.mark.parametrize("surface", SURFACES.values(), ids=SURFACES)
def test_two_triangles_have_the_area_of_their_taxel_and_look_outwards(surface: Surface) -> None:
    twice = triangles(on(surface).squares_m)
    assert np.allclose(
        twice.sum(axis=1) / 2, surface.normals * surface.areas_m2[:, None], atol=1e-10
    )
    areas = np.linalg.norm(twice, axis=2) / 2
    assert np.allclose(areas, surface.areas_m2[:, None] / 2, rtol=1e-4)


@pytest.mark.parametrize("surface", SURFACES.values(), ids=SURFACES)
def test_squares_lie_about_their_taxel_in_the_tangent_plane(surface: Surface) -> None:
    squares = on(surface).squares_m
    arms = squares - surface.positions_m[:, None]
    assert np.allclose((arms * surface.normals[:, None]).sum(axis=2), 0, atol=1e-8)
    half_diagonals = np.sqrt(surface.areas_m2 / 2)[:, None]
    assert np.allclose(np.linalg.norm(arms, axis=2), half_diagonals, rtol=1e-4)
    assert np.allclose(arms.sum(axis=1), 0, atol=1e-8), "its triangles share a diagonal, no more"


def test_squares_cover_planes_and_stand_along_rows_and_columns() -> None:
    corners = np.unique(on(SURFACES["plane"]).squares_m[..., :2].round(7), axis=None)
    lines = {round(float(x), 4) for x in corners}
    edges = {round((i - n / 2) * PITCH_M, 4) for n in (5, 8) for i in range(n + 1)}
    assert lines == edges
    skin = on(SLEEVE, 3, 12)
    right, up = tangents(skin.normals)
    assert np.allclose(up, [0, 1, 0], atol=1e-6)
    places = skin.positions_m.reshape(3, 12, 3).astype(float)
    chords = np.roll(places, -1, axis=1) - np.roll(places, 1, axis=1)  # along the columns
    chords /= np.linalg.norm(chords, axis=2, keepdims=True)
    assert np.allclose(right.reshape(3, 12, 3), chords, atol=1e-5)


unit = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)
almost_down = st.tuples(st.floats(-1e-6, 1e-6), st.floats(-1e-6, 1e-6), st.just(-1.0))


@given(unit | almost_down)
def test_tangents_and_any_normal_are_right_handed(direction: tuple[float, float, float]) -> None:
    normal = (np.array(direction) / np.linalg.norm(direction)).astype(np.float32)
    [right], [up] = tangents(normal[None])
    frame = np.stack([right, up, normal])
    assert np.allclose(frame @ frame.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(frame) == pytest.approx(1)


angles = st.floats(-7, 7)
triples = st.tuples(angles, angles, angles)
poses = st.builds(Pose.of_rpy, triples, triples)


@pytest.mark.parametrize(
    ("rpy", "x_goes_to", "y_goes_to"),
    [
        ((math.pi / 2, 0, 0), (1, 0, 0), (0, 0, 1)),
        ((0, math.pi / 2, 0), (0, 0, -1), (0, 1, 0)),
        ((0, 0, math.pi / 2), (0, 1, 0), (-1, 0, 0)),
        # Fixed axes: the yaw rotates what the roll has rotated.
        ((math.pi / 2, 0, math.pi / 2), (0, 1, 0), (0, 0, 1)),
    ],
)
def test_angles_are_those_of_urdf(
    rpy: tuple[float, ...], x_goes_to: tuple[int, ...], y_goes_to: tuple[int, ...]
) -> None:
    pose = Pose.of_rpy((0, 0, 0), rpy)
    assert np.allclose(pose.rotate(np.eye(3)[:2]), [x_goes_to, y_goes_to])


@given(poses)
def test_rotations_are_proper_and_survive_the_way_through_a_quaternion(pose: Pose) -> None:
    assert np.allclose(pose.rotation @ pose.rotation.T, np.eye(3))
    assert np.linalg.det(pose.rotation) == pytest.approx(1)
    quaternion = pose.quaternion
    assert np.linalg.norm(quaternion) == pytest.approx(1)
    assert quaternion[3] >= 0
    again = Pose.of_quaternion(pose.translation_m.tolist(), quaternion.tolist())
    assert np.allclose(again.rotation, pose.rotation, atol=1e-12)


@given(st.tuples(angles, angles, angles, angles).filter(lambda q: math.hypot(*q) > 1e-3))
def test_quaternions_turn_as_hamilton_says(xyzw: tuple[float, ...]) -> None:
    """Against v' = v + 2·w·(u × v) + 2·u × (u × v)."""
    x, y, z, w = np.array(xyzw) / math.hypot(*xyzw)
    axis, vector = np.array([x, y, z]), np.array([0.3, -1.0, 2.0])
    once = np.cross(axis, vector)
    expected = vector + 2 * w * once + 2 * np.cross(axis, once)
    assert np.allclose(Pose.of_quaternion((0, 0, 0), xyzw).rotate(vector), expected)


@given(poses, poses)
def test_poses_chain_and_invert(one: Pose, other: Pose) -> None:
    points = np.random.default_rng(1).normal(size=(5, 3))
    assert np.allclose((one @ other).apply(points), one.apply(other.apply(points)))
    assert np.allclose((one @ one.inverse).apply(points), points)
    assert np.allclose(one.inverse.apply(one.apply(points)), points)
    turned = one.apply(points) - one.apply(np.zeros(3))
    assert np.allclose(one.rotate(points), turned)


@pytest.mark.parametrize(
    ("xyz_m", "xyzw", "said"),
    [
        ((0, 0, 0), (0, 0, 0, 0), "not a rotation"),
        ((0, 0, 0), (math.nan, 0, 0, 1), "not a rotation"),
        ((0, 0, 0), (0, math.inf, 0, 1), "not a rotation"),
        ((math.nan, 0, 0), (0, 0, 0, 1), "not a translation"),
        ((0, 0, -math.inf), (0, 0, 0, 1), "not a translation"),
    ],
)
def test_no_pose_is_refused(xyz_m: tuple[float, ...], xyzw: tuple[float, ...], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Pose.of_quaternion(xyz_m, xyzw)
