# SPDX-License-Identifier: Apache-2.0

"""Rotation and translation between frames."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.places.poses import Pose

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
def test_what_is_no_pose_is_refused(
    xyz_m: tuple[float, ...], xyzw: tuple[float, ...], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        Pose.of_quaternion(xyz_m, xyzw)
