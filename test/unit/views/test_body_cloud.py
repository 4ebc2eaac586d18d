# SPDX-License-Identifier: Apache-2.0

"""A patch's points in the body's frame."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.places.layout import Layout
from tactile_cdma.places.poses import Pose
from tactile_cdma.views.cloud import BODY_POINT, POINT, Cloud

triples = st.tuples(*[st.floats(-4, 4)] * 3)
LAYOUT = Layout.grid(12, 3, 4, 7e-3, 5e-3)
HERE = Pose.of_rpy((0, 0, 0), (0, 0, 0))


def cloud(patch: int = 0) -> Cloud:
    return Cloud(LAYOUT.positions_m, LAYOUT.normals, patch)


def columns(points: np.ndarray, *names: str) -> np.ndarray:
    return np.stack([points[name] for name in names], axis=1)


def test_points_are_those_of_the_patch_and_say_whose_they_are() -> None:
    pressure_pa = np.linspace(-1e3, 2e5, 12, dtype=np.float32)
    pressure_pa[[3, 7]] = np.nan
    points = cloud(patch=5).points(pressure_pa, 140e3, HERE)
    alone = Cloud(LAYOUT.positions_m, LAYOUT.normals).points(pressure_pa, 140e3)
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
    pose, flat = Pose.of_rpy(xyz, rpy), cloud()
    pressure_pa = np.ones(12, dtype=np.float32)
    flat.points(pressure_pa, 1.0, HERE)  # it has been elsewhere
    points = flat.points(pressure_pa, 1.0, pose)
    places = LAYOUT.positions_m.astype(float) @ pose.rotation.T + xyz
    np.testing.assert_allclose(columns(points, "x", "y", "z"), places, atol=1e-5)
    normals = columns(points, "normal_x", "normal_y", "normal_z")
    np.testing.assert_allclose(normals, np.tile(pose.rotation[:, 2], (12, 1)), atol=1e-6)


def test_a_quarter_turn_by_hand() -> None:
    """The patch is flat: its normal becomes the body's x, and its row of 4 columns runs down."""
    pose = Pose.of_rpy((0.1, 0.0, 0.3), (0.0, math.pi / 2, 0.0))
    points = cloud().points(np.ones(12, dtype=np.float32), 1.0, pose)
    np.testing.assert_allclose(points["x"], 0.1, atol=1e-7)
    np.testing.assert_allclose(points["z"][:4] - 0.3, [0.0105, 0.0035, -0.0035, -0.0105], atol=1e-6)
    np.testing.assert_allclose(points["normal_x"], 1.0, atol=1e-7)


def test_points_of_a_body_name_their_patch() -> None:
    one, other = np.full(12, 1e3, dtype=np.float32), np.full(12, 2e3, dtype=np.float32)
    other[0] = np.nan
    for patch, pressure_pa, count in ((0, one, 12), (1, other, 11)):
        points = cloud(patch).points(pressure_pa, 140e3, HERE)
        assert points.dtype == BODY_POINT
        assert points["patch"].tolist() == [patch] * count
        assert points["pressure"].tolist() == [1e3 * (patch + 1)] * count
