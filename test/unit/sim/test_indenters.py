# SPDX-License-Identifier: Apache-2.0

"""Objects pressed into a skin: closed forms, and volumes counted by points.

On a flat Winkler foundation the force is stiffness × the volume below the surface. The count knows
of shapes only whether a point is inside.
"""

import itertools
import math
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_shapes import Surface, cylinder, plane
from tactile_cdma.places.poses import Pose
from tactile_cdma.sim.indenters import (
    Box,
    Cylinder,
    Foundation,
    Indenter,
    Sphere,
    at_force,
    pressed_pa,
)

PITCH_M, K = 2e-3, 2e7
LAYOUT = Layout.grid(32 * 32, 32, 32, PITCH_M, PITCH_M)  # 64 × 64 mm
COVER = Foundation(LAYOUT.positions_m, LAYOUT.normals, LAYOUT.areas_m2)
MIDDLE = slice(480, 560)
SMALL = Foundation(LAYOUT.positions_m[MIDDLE], LAYOUT.normals[MIDDLE], LAYOUT.areas_m2[MIDDLE])
LYING = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))  # its z axis along −y
Points = NDArray[np.float64]


def force_n(*objects: Indenter) -> float:
    return float(COVER.pressure_pa(objects) @ LAYOUT.areas_m2)


@pytest.mark.parametrize("depth_m", [2e-4, 1e-3, 8e-3])
@pytest.mark.parametrize("place_m", [(0.0, 0.0), (3.3e-3, -1.7e-3)])
def test_sphere(depth_m: float, place_m: tuple[float, float]) -> None:
    radius_m = 0.02
    ball = Sphere(
        radius_m=radius_m, position_m=(*place_m, radius_m - depth_m), stiffness_pa_per_m=K
    )
    cap_m3 = math.pi * depth_m**2 * (3 * radius_m - depth_m) / 3
    assert force_n(ball) == pytest.approx(K * cap_m3, rel=0.02)
    if depth_m < 0.05 * radius_m:  # the parabola of a shallow contact
        assert force_n(ball) == pytest.approx(math.pi * K * radius_m * depth_m**2, rel=0.03)
    assert COVER.pressure_pa([ball]).max() <= K * depth_m


def test_cylinder_lying_and_standing() -> None:
    radius_m, length_m, depth_m = 0.02, 0.03, 2e-3
    common = {"radius_m": radius_m, "length_m": length_m, "stiffness_pa_per_m": K}
    lying = Cylinder(position_m=(0, 0, radius_m - depth_m), orientation_xyzw=LYING, **common)
    segment_m2 = radius_m**2 * math.acos(1 - depth_m / radius_m) - (radius_m - depth_m) * math.sqrt(
        2 * radius_m * depth_m - depth_m**2
    )
    assert force_n(lying) == pytest.approx(K * length_m * segment_m2, rel=0.01)
    standing = Cylinder(position_m=(0, 0, length_m / 2 - depth_m), **common)
    assert force_n(standing) == pytest.approx(K * math.pi * radius_m**2 * depth_m, rel=0.01)


def test_box_presses_by_area_times_depth() -> None:
    box = Box(size_m=(0.016, 0.012, 0.01), position_m=(0, 0, 4e-3), stiffness_pa_per_m=K)
    pressure_pa = COVER.pressure_pa([box])
    assert pressure_pa.max() == pytest.approx(K * 1e-3)
    assert force_n(box) == pytest.approx(K * 1e-3 * 0.016 * 0.012, rel=1e-6)
    covered = np.all(np.abs(LAYOUT.positions_m[:, :2]) < [0.008, 0.006], axis=1)
    assert np.array_equal(pressure_pa > 0, covered)


def test_half_a_taxel_has_half_the_pressure() -> None:
    # From x = 0, an edge between taxels, to the middle of the next.
    box = Box(size_m=(1e-3, 0.02, 0.01), position_m=(0.5e-3, 0, 4e-3), stiffness_pa_per_m=K)
    pressure_pa = COVER.pressure_pa([box]).reshape(32, 32)[15]
    assert pressure_pa[16] == pytest.approx(K * 1e-3 / 2)
    assert np.count_nonzero(pressure_pa) == 1


SHAPES: dict[str, tuple[Callable[..., Indenter], Callable[[Points], NDArray[np.bool_]]]] = {
    "sphere": (partial(Sphere, radius_m=0.01), lambda p: np.linalg.norm(p, axis=1) < 0.01),
    "cylinder": (
        partial(Cylinder, radius_m=0.008, length_m=0.02),
        lambda p: (np.hypot(p[:, 0], p[:, 1]) < 0.008) & (np.abs(p[:, 2]) < 0.01),
    ),
    "box": (
        partial(Box, size_m=(0.02, 0.012, 0.016)),
        lambda p: (np.abs(p) < [0.01, 0.006, 0.008]).all(axis=1),
    ),
}
"""Of each shape how it is made, and whether points, (m, 3) in its own frame, m, are inside."""


@pytest.mark.parametrize("shape", SHAPES)
def test_force_is_stiffness_times_the_volume_below_the_surface(shape: str) -> None:
    """In poses at random, 4 mm deep; the volume is counted at points under the skin."""
    make, contains = SHAPES[shape]
    rng = np.random.default_rng(7)
    extent_m, depth_m = 0.05, 4e-3
    around_m = rng.uniform(-0.025, 0.025, (200_000, 3))
    below_m = around_m * [1, 1, 0.5 * depth_m / 0.025] - [0, 0, depth_m / 2]
    for _ in range(2):
        turned = [*rng.normal(0, 1.0, 3), 1.0]
        own = Pose.of_quaternion((0, 0, 0), turned).inverse
        lowest_m = around_m[contains(own.apply(around_m)), 2].min()
        place_m = (1e-3, -2e-3, -lowest_m - depth_m)
        volume_m3 = contains(own.apply(below_m - place_m)).mean() * extent_m**2 * depth_m
        thing = make(position_m=place_m, orientation_xyzw=turned, stiffness_pa_per_m=K)
        assert volume_m3 > 1e-8
        assert force_n(thing) == pytest.approx(K * volume_m3, rel=0.03)


def test_a_curved_skin_is_pressed_along_its_normals() -> None:
    surface = cylinder(24, 24, PITCH_M, 0.04)  # around y, its axis at z = −40 mm
    cover = Foundation(surface.positions_m, surface.normals, surface.areas_m2)
    # A pipe of the same axis and 1 mm less radius would touch everywhere; a ball about the axis
    # touches along the middle row, where it is deepest.
    around = Cylinder(
        radius_m=0.039,
        length_m=1.0,
        position_m=(0, 0, -0.04),
        orientation_xyzw=LYING,
        stiffness_pa_per_m=K,
    )
    assert not cover.pressure_pa([around]).any(), "wholly behind the skin"
    ball = Sphere(radius_m=0.01, position_m=(0, 0, 0.009), stiffness_pa_per_m=K)
    flat_n, curved_n = force_n(ball), float(cover.pressure_pa([ball]) @ surface.areas_m2)
    # Two bodies touch as one of the mean curvature does: 1/R and 1/R + 1/40 mm.
    assert curved_n / flat_n == pytest.approx(math.sqrt(1 / (1 + 0.01 / 0.04)), rel=0.03)


def test_objects_do_not_add_up_where_they_overlap() -> None:
    ball = Sphere(radius_m=0.01, position_m=(0, 0, 0.009), stiffness_pa_per_m=K)
    apart = Sphere(radius_m=0.01, position_m=(0.02, 0, 0.009), stiffness_pa_per_m=K)
    assert force_n(ball, ball) == force_n(ball)
    assert force_n(ball, apart) == pytest.approx(2 * force_n(ball), rel=0.02)
    assert force_n() == 0


@given(st.tuples(*[st.floats(-0.05, 0.05)] * 3), st.sampled_from([*SHAPES]))
def test_nothing_pulls_and_what_is_away_does_not_touch(
    place_m: tuple[float, float, float], shape: str
) -> None:
    pressure_pa = SMALL.pressure_pa([SHAPES[shape][0](position_m=place_m)])
    assert np.isfinite(pressure_pa).all()
    assert pressure_pa.min() >= 0
    if place_m[2] > 0.025:
        assert not pressure_pa.any()


@pytest.mark.parametrize("shape", SHAPES)
def test_what_reaches_below_a_surface_may_touch_what_is_around(shape: str) -> None:
    """Taxels whose centres are as far from what is pressed as their corners may be."""
    rng, pressed = np.random.default_rng(1), 0
    up = np.broadcast_to([0.0, 0.0, 1.0], (200, 3))
    for _ in range(500):
        turn = rng.normal(size=4)
        object_ = SHAPES[shape][0](
            position_m=rng.uniform(-0.02, 0.02, 3), orientation_xyzw=turn / np.linalg.norm(turn)
        )
        points_m, centres_m = np.zeros((2, 200, 3))
        points_m[:, :2] = rng.uniform(-0.06, 0.06, (200, 2))
        centres_m[:, :2] = points_m[:, :2] + rng.uniform(-3e-3, 3e-3, (200, 2))
        beside_m = np.linalg.norm(centres_m - points_m, axis=1)
        reached = object_.depth_m(points_m, up) > 0
        pressed += np.count_nonzero(reached)
        may_touch = object_.may_touch(centres_m, up, beside_m * (1 + 1e-9))
        assert may_touch[reached].all()
        assert not may_touch.all()
    assert pressed > 500


def objects(seed: int) -> list[Indenter]:
    rng = np.random.default_rng(seed)
    turned = rng.normal(size=4).tolist()
    common = {"position_m": (*rng.uniform(-8e-3, 8e-3, 2), 0.02), "stiffness_pa_per_m": K}
    edge_m, long_m = rng.uniform(0.012, 0.02), rng.uniform(0.02, 0.03)
    return [
        Sphere(radius_m=edge_m, **common),
        Cylinder(radius_m=edge_m, length_m=long_m, orientation_xyzw=turned, **common),
        Box(size_m=(edge_m, long_m, 0.02), orientation_xyzw=turned, **common),
    ]


@pytest.mark.parametrize(
    ("surface", "most_n", "within"),
    [(plane(12, 12, 4e-3), 0.3, 1e-6), (cylinder(12, 8, 4e-3, 0.015), 0.3, 0.05)],
    ids=["flat", "curved"],  # there points come in from beside, one by one
)
def test_an_object_lies_where_the_cover_has_the_force(
    surface: Surface, most_n: float, within: float
) -> None:
    cover = Foundation(surface.positions_m, surface.normals, surface.areas_m2)
    slanted = np.array([0.3 * bool(np.ptp(surface.normals[:, 0])), 0.0, -1.0])
    way = slanted / np.linalg.norm(slanted)
    facing_m2 = surface.areas_m2 * np.maximum(-surface.normals @ way, 0)
    for thing, share in itertools.product(itertools.chain(*map(objects, range(20))), (0.3, 1.0)):
        lies = at_force(cover, thing, share * most_n, way.tolist())
        moved_m = np.subtract(lies.position_m, thing.position_m)
        assert np.allclose(moved_m, moved_m @ way * way, atol=1e-9)
        force_n = float(cover.pressure_pa([lies]) @ facing_m2)
        assert force_n == pytest.approx(share * most_n, rel=within)
        pressure_pa = pressed_pa(cover, [(thing, share * most_n, way.tolist())])
        assert pressure_pa == pytest.approx(cover.pressure_pa([lies]), rel=1e-6, abs=1e-3)


def test_a_curved_skin_takes_a_few_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Newton's steps with measured shares; with those of the start there are more."""
    calls, spans_m = [], Sphere.spans_m
    monkeypatch.setattr(Sphere, "spans_m", lambda *given: calls.append(1) or spans_m(*given))
    surface = cylinder(6, 8, 5e-3, 0.012)
    cover = Foundation(surface.positions_m, surface.normals, surface.areas_m2)
    for place_m, along in ((0.0, 0.001, 0.02), (0, 0, -1)), ((0.025, 0.001, 0.0), (-0.8, 0, -0.6)):
        calls.clear()
        at_force(cover, Sphere(radius_m=0.02, position_m=place_m), 5.0, along)
        assert 2 < len(calls) <= 6


def test_what_cannot_have_the_force_stays_where_it_is() -> None:
    beside = Sphere(radius_m=5e-3, position_m=(0.06, 0, 4e-3))
    small = Sphere(radius_m=1e-3, position_m=(0, 0, 0))
    far = Sphere(radius_m=5e-3, position_m=(0, 0, 0.04))
    for thing in (beside, small, far):
        assert at_force(COVER, thing, 5.0) is thing
        presses = [(thing, 5.0, (0.0, 0.0, -1.0))]
        assert np.array_equal(pressed_pa(COVER, presses), COVER.pressure_pa([thing]))
    bent = cylinder(12, 8, 4e-3, 0.015)  # across it the ball never meets enough of the cover
    cover, normal = Foundation(bent.positions_m, bent.normals, bent.areas_m2), bent.normals[21]
    way = np.array([0.5, 0, 0]) - normal
    ball = Sphere(radius_m=8e-3, position_m=(bent.positions_m[21] + 8e-3 * normal).tolist())
    assert at_force(cover, ball, 8.0, (way / np.linalg.norm(way)).tolist()) is ball


def test_an_object_stays_where_it_was_made_whatever_becomes_of_the_list() -> None:
    place_m, turned, size_m = [0.0, 0.0, 0.0], np.array([0.0, 0.0, 0.0, 1.0]), [0.01, 0.01, 0.01]
    thing = Box(size_m=size_m, position_m=place_m, orientation_xyzw=turned)
    place_m[2], turned[0], size_m[0] = 0.5, 1.0, 9.0
    assert thing == Box(size_m=(0.01,) * 3, position_m=(0, 0, 0))
    assert hash(thing) == hash(thing.placed(thing.pose))
