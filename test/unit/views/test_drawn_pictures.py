# SPDX-License-Identifier: Apache-2.0

"""Pictures of the readings: point clouds and rasters, colours that eyes tell apart, curves."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_shapes import sphere
from tactile_cdma.places.poses import Pose
from tactile_cdma.views.heatmap import (
    BODY_POINT,
    NO_READING_RGB,
    NO_TAXEL_RGB,
    POINT,
    SCALE_RGB,
    Cloud,
    colours,
    heatmap,
    pressure_raster,
    scale_steps,
)
from tactile_cdma.views.live import History

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


def patch(number: int = 0, pose: Pose = HERE) -> Cloud:
    return Cloud(pose.apply(FLAT.positions_m.astype(float)), pose.rotate(FLAT.normals), number)


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
    points = patch(5).points(pressure_pa, 140e3)
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
    pose = Pose.of_rpy(xyz, rpy)
    points = patch(0, pose).points(np.ones(12, dtype=np.float32), 1.0)
    places = FLAT.positions_m.astype(float) @ pose.rotation.T + xyz
    np.testing.assert_allclose(columns(points, "x", "y", "z"), places, atol=1e-5)
    normals = columns(points, "normal_x", "normal_y", "normal_z")
    np.testing.assert_allclose(normals, np.tile(pose.rotation[:, 2], (12, 1)), atol=1e-6)


def test_a_quarter_turn_by_hand() -> None:
    """The patch is flat: its normal becomes the body's x, and its row of 4 columns runs down."""
    pose = Pose.of_rpy((0.1, 0.0, 0.3), (0.0, math.pi / 2, 0.0))
    points = patch(0, pose).points(np.ones(12, dtype=np.float32), 1.0)
    np.testing.assert_allclose(points["x"], 0.1, atol=1e-7)
    np.testing.assert_allclose(points["z"][:4] - 0.3, [0.0105, 0.0035, -0.0035, -0.0105], atol=1e-6)
    np.testing.assert_allclose(points["normal_x"], 1.0, atol=1e-7)


TOP_PA = 140e3
LUMA = np.array([0.2126, 0.7152, 0.0722])
"""Of red, green and blue, ITU-R BT.709: what a picture in grey keeps."""


def luma(pressure_kpa: list[float], gamma: float | None = None) -> np.ndarray:
    """Of each pressure's colour, as shares of the way from zero's to the top's."""
    pressure_pa = np.array([0.0, TOP_PA / 1e3, *pressure_kpa], np.float32) * np.float32(1e3)
    options = {} if gamma is None else {"gamma": gamma}
    dark, light, *others = colours(pressure_pa, TOP_PA, **options) @ LUMA
    return (np.array(others) - dark) / (light - dark)


def test_light_and_firm_touches_are_told_apart_without_any_setting() -> None:
    two, five, hundred = luma([2.0, 5.0, 100.0])
    assert two >= 0.1
    assert five - two >= 0.05
    assert hundred <= 0.9


@pytest.mark.parametrize("gamma", [0.3, 0.5, 1.0])
def test_luma_is_a_power_of_the_pressure(gamma: float) -> None:
    pressures = [1.0, 2.0, 5.0, 20.0, 70.0, 120.0]
    expected = (np.array(pressures) * 1e3 / TOP_PA) ** gamma
    assert luma(pressures, gamma) == pytest.approx(expected, abs=0.015)


def test_no_pressure_looks_like_no_reading() -> None:
    """Nor do the pale colours of uncertain readings, which keep half of the difference."""
    scale, pale = SCALE_RGB[:256].astype(float), SCALE_RGB[257:].astype(float)
    for colour in (NO_READING_RGB, NO_TAXEL_RGB):
        assert np.linalg.norm(scale - colour, axis=1).min() > 20
    assert np.linalg.norm(pale - NO_READING_RGB, axis=1).min() > 20
    assert scale_steps(np.array([np.nan], np.float32), TOP_PA, gamma=0.1) == 256


def test_lines_are_drawn_between_taxels_and_nowhere_else() -> None:
    grid = Layout.grid(6, 2, 3, 7e-3, 5e-3)
    picture = heatmap(np.full(6, TOP_PA, np.float32), grid, TOP_PA, pixels=32)
    assert picture.shape == (64, 96, 3)
    line = (picture == NO_TAXEL_RGB).all(axis=2)
    assert np.flatnonzero(line.all(axis=1)).tolist() == [31]
    assert np.flatnonzero(line.all(axis=0)).tolist() == [31, 63]
    assert np.count_nonzero(line) == 96 + 2 * 64 - 2
    assert (picture[~line] == SCALE_RGB[255]).all()
    assert not (heatmap(np.zeros(6, np.float32), grid, TOP_PA, 7) == NO_TAXEL_RGB).all(axis=2).any()


def test_bins_keep_the_greatest_of_their_time_and_forget_what_is_old() -> None:
    history = History(span_s=4.0)
    for now_s, value in ((0.0, 99.0), (6.5, 1.0), (7.1, 5.0), (7.2, 2.0), (9.9, 3.0)):
        history.add(now_s, value)
    history.add(10.0, float("nan"))
    np.testing.assert_array_equal(history.bins(10.0, 4), [1.0, 5.0, np.nan, 3.0])
    np.testing.assert_array_equal(history.bins(12.0, 4), [np.nan, 3.0, np.nan, np.nan])


def test_a_history_of_nothing_is_unknown() -> None:
    history = History(span_s=1.0)
    assert np.isnan(history.bins(5.0, 3)).all()
    assert np.isnan(history.latest)
    history.add(4.0, 7.0)
    assert history.latest == 7.0
    history.add(5.5, float("nan"))
    assert np.isnan(history.latest), "not the last that was known"
    assert np.isnan(history.bins(5.5, 3)).all()


def test_colours_rise_with_pressure_on_a_fixed_scale() -> None:
    pressure = np.array([-1, 0, 30e3, 70e3, 140e3, 1e9], np.float32)
    light = colours(pressure, 140e3).astype(int).sum(axis=1)
    assert light[0] == light[1]
    assert light[4] == light[5]
    assert (np.diff(light[1:5]) > 0).all()
    assert tuple(colours(np.array([np.nan], np.float32), 1.0)[0]) == NO_READING_RGB
    pale = colours(pressure, 140e3, unsure=np.ones(len(pressure), bool)).astype(int)
    middle = (colours(pressure, 140e3) + np.array(NO_READING_RGB)) / 2
    assert np.abs(pale - middle).max() <= 1
    assert tuple(colours(np.array([np.nan], np.float32), 1.0, unsure=True)[0]) == NO_READING_RGB


def test_heatmap_puts_taxel_row_zero_on_top() -> None:
    pressure = np.zeros(6, np.float32)
    pressure[5] = 1e5
    picture = heatmap(pressure, Layout.grid(6, 2, 3, 7e-3, 5e-3), 1e5, pixels=8)
    assert picture.shape == (16, 24, 3)
    assert picture[15, 23].sum() > picture[0, 0].sum()
    assert (picture[8:, 16:] == picture[15, 23]).all()
    large = Layout.grid(4096, 64, 64, 7e-3, 5e-3)
    assert heatmap(np.zeros(4096, np.float32), large, 1e5, pixels=256).size <= 3 << 20
