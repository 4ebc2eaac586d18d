# SPDX-License-Identifier: Apache-2.0

"""The point cloud and the raster hold the skin's readings at their positions."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_shapes import sphere
from tactile_cdma.views.cloud import Cloud
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
pressures = arrays(
    np.float32, COUNT, elements=st.floats(-1e4, 3e5, width=32) | st.just(float("nan"))
)


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
        found = np.stack([points[letter] for letter in letters], axis=1)
        assert np.array_equal(found, values[taxels])
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
