# SPDX-License-Identifier: Apache-2.0

"""Point clouds, also in a body's frame, and rasters hold the skin's readings at their positions."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_shapes import sphere
from tactile_cdma.places.poses import Pose
from tactile_cdma.views.cloud import BODY_POINT, POINT, Cloud
from tactile_cdma.views.heatmap import SCALE_RGB, colours, heatmap, pressure_raster, scale_steps

ROWS, COLUMNS, PITCH_M, MAX_PA = 3, 4, 7e-3, 140e3
COUNT = ROWS * COLUMNS
NODES = np.array([1, 2, 0, 3, 4, 5, 6, 7, 8, 9, 10, 11], dtype=np.int32)  # one place without
BALL = Layout(
    **vars(sphere(ROWS, COLUMNS, PITCH_M, 25e-3)),
    name="ball",
    rows=ROWS,
    columns=COLUMNS,
    nodes=NODES,
    pitch_m=PITCH_M,
)
FLAT = Layout.grid(12, 3, 4, PITCH_M, 5e-3)
HERE = Pose.of_rpy((0, 0, 0), (0, 0, 0))
triples = st.tuples(*[st.floats(-4, 4)] * 3)
pressures = arrays(
    np.float32, COUNT, elements=st.floats(-1e4, 3e5, width=32) | st.just(float("nan"))
)


def patch(number: int = 0) -> Cloud:
    return Cloud(FLAT.positions_m, FLAT.normals, number)


def columns(points: np.ndarray, *names: str) -> np.ndarray:
    return np.stack([points[name] for name in names], axis=1)


@given(pressures)
def test_points_are_the_taxels_with_a_reading_and_have_the_colours_of_the_heatmap(
    pressure_pa: np.ndarray,
) -> None:
    points = Cloud(BALL.positions_m, BALL.normals).points(pressure_pa, MAX_PA)
    taxels = points["taxel"]
    assert taxels.tolist() == np.flatnonzero(~np.isnan(pressure_pa)).tolist()
    assert np.array_equal(points["pressure"], pressure_pa[taxels])
    for letters, values in (
        (("x", "y", "z"), BALL.positions_m),
        (("normal_x", "normal_y", "normal_z"), BALL.normals),
    ):
        assert np.array_equal(columns(points, *letters), values[taxels])
    red_green_blue = np.stack([points["rgb"] >> shift & 255 for shift in (16, 8, 0)], axis=1)
    assert np.array_equal(red_green_blue, colours(pressure_pa, MAX_PA)[taxels])
    assert (points["rgb"] < 1 << 24).all()


def test_clouds_stay_as_they_are_when_the_next_is_made() -> None:
    cloud = Cloud(BALL.positions_m, BALL.normals)
    first = cloud.points(np.full(COUNT, 1e3, dtype=np.float32), MAX_PA)
    kept = first.copy()
    cloud.points(np.full(COUNT, 9e4, dtype=np.float32), MAX_PA)
    assert np.array_equal(first, kept)


@given(pressures)
def test_rasters_agree_with_the_heatmap_pixel_by_pixel(pressure_pa: np.ndarray) -> None:
    raster = pressure_raster(pressure_pa, BALL)
    picture = heatmap(pressure_pa, BALL, MAX_PA, pixels=1)
    assert raster.dtype == np.float32
    placed = BALL.raster >= 0
    assert np.isnan(raster[~placed]).all()
    assert not placed.all()
    assert np.array_equal(raster[placed], pressure_pa[BALL.raster[placed]], equal_nan=True)
    assert np.array_equal(colours(raster[placed], MAX_PA), picture[placed])


@given(st.lists(st.floats(-1e5, 1e6, width=32), min_size=2))
def test_more_pressure_is_never_a_lower_step(values: list[float]) -> None:
    steps = scale_steps(np.sort(np.array(values, dtype=np.float32)), MAX_PA)
    assert (np.diff(steps) >= 0).all()
    assert steps.min() >= 0
    assert steps.max() < len(SCALE_RGB) - 1


def test_points_are_those_of_the_patch_and_say_whose_they_are() -> None:
    pressure_pa = np.linspace(-1e3, 2e5, 12, dtype=np.float32)
    pressure_pa[[3, 7]] = np.nan
    points = patch(5).points(pressure_pa, 140e3, HERE)
    alone = Cloud(FLAT.positions_m, FLAT.normals).points(pressure_pa, 140e3)
    assert points.dtype == BODY_POINT
    assert POINT.names is not None
    for name in POINT.names:
        np.testing.assert_array_equal(points[name], alone[name])
    assert (points["patch"] == 5).all()
    assert points["taxel"].tolist() == [0, 1, 2, 4, 5, 6, 8, 9, 10, 11]


@given(triples, triples)
def test_places_move_and_normals_only_turn(
    xyz: tuple[float, float, float], rpy: tuple[float, float, float]
) -> None:
    pose, flat = Pose.of_rpy(xyz, rpy), patch()
    pressure_pa = np.ones(12, dtype=np.float32)
    flat.points(pressure_pa, 1.0, HERE)  # it has been elsewhere
    points = flat.points(pressure_pa, 1.0, pose)
    places = FLAT.positions_m.astype(float) @ pose.rotation.T + xyz
    np.testing.assert_allclose(columns(points, "x", "y", "z"), places, atol=1e-5)
    normals = columns(points, "normal_x", "normal_y", "normal_z")
    np.testing.assert_allclose(normals, np.tile(pose.rotation[:, 2], (12, 1)), atol=1e-6)


def test_a_quarter_turn_by_hand() -> None:
    """The patch is flat: its normal becomes the body's x, and its row of 4 columns runs down."""
    pose = Pose.of_rpy((0.1, 0.0, 0.3), (0.0, math.pi / 2, 0.0))
    points = patch().points(np.ones(12, dtype=np.float32), 1.0, pose)
    np.testing.assert_allclose(points["x"], 0.1, atol=1e-7)
    np.testing.assert_allclose(points["z"][:4] - 0.3, [0.0105, 0.0035, -0.0035, -0.0105], atol=1e-6)
    np.testing.assert_allclose(points["normal_x"], 1.0, atol=1e-7)
