# SPDX-License-Identifier: Apache-2.0

"""Objects pressed into a skin, and the pressure that its elastic cover answers with.

The cover is a Winkler foundation: every point of the surface is a spring of its own, along its
normal, so that pressure = stiffness · depth; docs/simulation.md has what that leaves out.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, ClassVar, Self

import numpy as np

from ..base.arrays import Bools, Floats, Floats32
from ..base.errors import ParameterError
from ..places.layout_shapes import tangents
from ..places.poses import Pose

STIFFNESS_PA_PER_M = 1e7
"""Default stiffness, Pa/m: 10 kPa per mm, a soft cover some millimetres thick. Chosen."""
MOST_PA_PER_M, MOST_M = 1e12, 1e3
"""Greatest stiffness, Pa/m; size and distance, m. Chosen beyond every object; nothing overflows."""
EDGE_POINTS = 6
"""Points per edge of a taxel over which its pressure is averaged. Chosen: the edge of a box is
placed to a twelfth of a taxel's edge, or better."""
_STEEP, _MAP_STEPS = 0.2, 3
"""Least slope of a line to a height map's plane, and how often the place where it meets the map is
looked up; chosen: lines are steep, and the faces of objects that touch a skin are not."""
Spans = tuple[Floats, Floats]
"""Where lines enter and leave an object, each (m,), m along the line: +∞ and −∞ where they miss."""


@dataclass(frozen=True, kw_only=True)
class Indenter(ABC):
    """A rigid object pressed into a skin; poses are in the skin's frame.

    position_m: of its origin, m. orientation_xyzw: quaternion, as in ROS messages.
    stiffness_pa_per_m: pressure per depth, Pa/m, of cover and object together.
    Raises ParameterError for values that are no pose, size or stiffness.
    """

    LENGTHS: ClassVar[dict[str, int]] = {}
    """Fields that are lengths, m, each with the number of its values."""

    position_m: Sequence[float]
    orientation_xyzw: Sequence[float] = (0.0, 0.0, 0.0, 1.0)
    stiffness_pa_per_m: float = STIFFNESS_PA_PER_M

    def __post_init__(self) -> None:
        kind = type(self).__name__
        _positive(f"stiffness_pa_per_m of {kind}", self.stiffness_pa_per_m, MOST_PA_PER_M)
        for name, count in self.LENGTHS.items():
            lengths_m = np.ravel(getattr(self, name))
            if len(lengths_m) != count:
                raise ParameterError(
                    f"{name} of {kind} has {len(lengths_m)} values; it must have {count}"
                )
            for length_m in lengths_m.tolist():
                _positive(f"{name} of {kind}", length_m, MOST_M)
        if len(self.position_m) != 3 or len(self.orientation_xyzw) != 4:
            raise ParameterError(f"{kind}: a position has 3 values, an orientation has 4")
        try:
            _ = self.pose
        except ValueError as error:
            raise ParameterError(f"{kind}: {error}") from None
        if max(map(abs, self.position_m)) > MOST_M:
            raise ParameterError(
                f"position_m of {kind} is {tuple(self.position_m)}; it must be within {MOST_M:g} m"
            )

    @cached_property
    def pose(self) -> Pose:
        """The object's own frame in the skin's."""
        return Pose.of_quaternion(self.position_m, self.orientation_xyzw)

    def moved(self, by_m: Floats) -> Self:
        """The same object elsewhere, (3,), m; not checked again."""
        thing = copy(self)
        pose = Pose(self.pose.rotation, self.pose.translation_m + by_m)
        vars(thing).update(position_m=tuple(pose.translation_m.tolist()), pose=pose)
        return thing

    def spans_m(self, points_m: Floats, normals: Floats) -> Spans:
        """Where lines along the normals of a surface enter and leave it, as heights above there.

        points_m, normals: (m, 3), in the skin's frame.
        """
        own = self.pose.inverse
        return self._spans(own.apply(points_m), own.rotate(normals))

    def depth_m(self, points_m: Floats, normals: Floats) -> Floats:
        """How far the object reaches below points of a surface, along the normals there.

        points_m, normals: (m, 3), in the skin's frame. Returns (m,), m. 0 where the object is
        beside the normal's line, above the surface, or wholly behind it.
        """
        enters_m, leaves_m = self.spans_m(points_m, normals)
        return np.where(leaves_m > 0, np.maximum(-enters_m, 0.0), 0.0)

    def may_touch(self, points_m: Floats, normals: Floats, around_m: Floats) -> Bools:
        """Whether it may reach below a surface (m, 3) within around_m (m,), m, of each point."""
        from_it_m = points_m - self.pose.translation_m
        along_m = _dot(from_it_m, normals)
        beside_m2 = _dot(from_it_m, from_it_m) - np.square(along_m)
        return np.asarray(beside_m2 <= np.square(self._reach_m + around_m))

    @property
    @abstractmethod
    def _reach_m(self) -> float:
        """No line touches the object that passes its origin at a greater distance, m."""

    @abstractmethod
    def _spans(self, points_m: Floats, directions: Floats) -> Spans:
        """Where lines pass through the object. Both (m, 3), in its own frame; unit directions."""


@dataclass(frozen=True, kw_only=True)
class Sphere(Indenter):
    """A ball about its origin."""

    LENGTHS: ClassVar = {"radius_m": 1}

    radius_m: float

    @property
    def _reach_m(self) -> float:
        return self.radius_m

    def _spans(self, points_m: Floats, directions: Floats) -> Spans:
        return _round_spans(points_m, directions, self.radius_m)


@dataclass(frozen=True, kw_only=True)
class Cylinder(Indenter):
    """A cylinder about its own z axis, its origin in the middle."""

    LENGTHS: ClassVar = {"radius_m": 1, "length_m": 1}

    radius_m: float
    length_m: float

    @property
    def _reach_m(self) -> float:
        return math.hypot(self.radius_m, self.length_m / 2)

    def _spans(self, points_m: Floats, directions: Floats) -> Spans:
        return within_all(
            _round_spans(points_m[:, :2], directions[:, :2], self.radius_m),
            slab_spans(points_m[:, 2], directions[:, 2], self.length_m / 2),
        )


@dataclass(frozen=True, kw_only=True)
class Box(Indenter):
    """A cuboid with edges along its own axes, its origin in the middle. size_m: x, y, z, m."""

    LENGTHS: ClassVar = {"size_m": 3}

    size_m: Sequence[float]

    @property
    def _reach_m(self) -> float:
        return math.hypot(*self.size_m) / 2

    def _spans(self, points_m: Floats, directions: Floats) -> Spans:
        return within_all(*map(slab_spans, points_m.T, directions.T, np.array(self.size_m) / 2))


@dataclass(frozen=True, kw_only=True)
class Capsule(Indenter):
    """A cylinder about its own z axis with half a ball on either end, its origin in the middle.

    length_m: between the balls' middles, m.
    """

    LENGTHS: ClassVar = {"radius_m": 1, "length_m": 1}

    radius_m: float
    length_m: float

    @property
    def _reach_m(self) -> float:
        return self.radius_m + self.length_m / 2

    def _spans(self, points_m: Floats, directions: Floats) -> Spans:
        half_m, radius_m = self.length_m / 2, self.radius_m
        middle = within_all(
            _round_spans(points_m[:, :2], directions[:, :2], radius_m),
            slab_spans(points_m[:, 2], directions[:, 2], half_m),
        )
        ends = (
            _round_spans(points_m - [0, 0, z_m], directions, radius_m) for z_m in (-half_m, half_m)
        )
        all_enter_m, all_leave_m = zip(middle, *ends, strict=True)
        return np.min(all_enter_m, axis=0), np.max(all_leave_m, axis=0)


@dataclass(frozen=True, kw_only=True)
class Ellipsoid(Indenter):
    """An ellipsoid about its origin. size_m: its diameters along its own x, y and z, m."""

    LENGTHS: ClassVar = {"size_m": 3}

    size_m: Sequence[float]

    @property
    def _reach_m(self) -> float:
        return max(self.size_m) / 2

    def _spans(self, points_m: Floats, directions: Floats) -> Spans:
        axes_m = np.array(self.size_m) / 2
        return _round_spans(points_m / axes_m, directions / axes_m, 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class HeightMap(Indenter):
    """The lower face of any object, as heights above its own plane z = 0; solid above it.

    heights_m: (r, c), m, of the points of a grid about the origin, whose columns are along x and
    rows along y, cell_m apart; NaN where there is no object. Lines are taken to be steep to that
    plane: turn it to where the object is pressed.
    """

    LENGTHS: ClassVar = {"cell_m": 1}

    heights_m: Floats
    cell_m: float

    @property
    def _reach_m(self) -> float:
        rows, columns = self.heights_m.shape
        farthest_m = max(np.nanmax(np.abs(self.heights_m), initial=0.0), 0.0)
        return math.hypot(rows * self.cell_m / 2, columns * self.cell_m / 2, farthest_m)

    def _spans(self, points_m: Floats, directions: Floats) -> Spans:
        rows, columns = self.heights_m.shape
        rise = np.maximum(directions[:, 2], _STEEP)
        enters_m = np.zeros(len(points_m))
        for _ in range(_MAP_STEPS):
            at_m = points_m + enters_m[:, None] * directions
            column = at_m[:, 0] / self.cell_m + (columns - 1) / 2
            row = at_m[:, 1] / self.cell_m + (rows - 1) / 2
            height_m = _between(self.heights_m, row, column)
            enters_m = np.where(np.isfinite(height_m), (height_m - points_m[:, 2]) / rise, 0.0)
        hits = np.isfinite(height_m) & (directions[:, 2] > 0)
        return np.where(hits, enters_m, np.inf), np.where(hits, np.inf, -np.inf)


class Foundation:
    """The elastic cover of t taxels: rectangles of the taxels' areas, tangential to the skin.

    areas_m2: (t,), m². points_m: (t, p, 3), m, the points of every taxel.
    """

    def __init__(
        self,
        positions_m: Floats | Floats32,
        normals: Floats | Floats32,
        areas_m2: Floats | Floats32,
        aspect: float = 1.0,
    ) -> None:
        """positions_m, normals: (t, 3), m, in the skin's frame. aspect: width over height."""
        self._positions_m = positions_m.astype(np.float64)
        self._normals = normals.astype(np.float64)
        self.areas_m2 = areas_m2.astype(np.float64)
        edge_m = np.sqrt(self.areas_m2)[:, None, None]
        wide_m, tall_m = edge_m * math.sqrt(aspect), edge_m / math.sqrt(aspect)
        self._corners_m = np.hypot(wide_m, tall_m).ravel() / 2  # how far they are from the centres
        right, up = tangents(self._normals)
        steps = (np.arange(EDGE_POINTS) + 0.5) / EDGE_POINTS - 0.5
        x, y = (part.ravel()[:, None] for part in np.meshgrid(steps, steps))
        offsets_m = wide_m * x * right[:, None] + tall_m * y * up[:, None]
        self.points_m = self._positions_m[:, None] + offsets_m
        per_taxel = self.points_m.shape[1]
        self._point_normals = self._normals[:, None].repeat(per_taxel, axis=1)
        self._point_m2 = (self.areas_m2 / per_taxel)[:, None].repeat(per_taxel, axis=1)

    def near(self, indenter: Indenter, moves_m: float = 0.0) -> tuple[Floats, Floats, Floats]:
        """The points that an object may reach, their normals (both (m, 3)) and areas (m,), m².

        moves_m: as far as it moves sideways of the normals, m.
        """
        near = self._near(indenter, moves_m)
        points_m, normals = self.points_m[near], self._point_normals[near]
        return points_m.reshape(-1, 3), normals.reshape(-1, 3), self._point_m2[near].ravel()

    def pressure_pa(self, indenters: Sequence[Indenter]) -> Floats:
        """Mean pressure on every taxel, (t,), Pa; where several objects meet, the greatest."""
        pressure_pa = np.zeros(self.points_m.shape[:2])
        for indenter in indenters:
            near = self._near(indenter)
            points_m, normals = self.points_m[near], self._point_normals[near]
            depth_m = indenter.depth_m(points_m.reshape(-1, 3), normals.reshape(-1, 3))
            depth_m = depth_m.reshape(points_m.shape[:2])
            pressed_pa = indenter.stiffness_pa_per_m * depth_m
            pressure_pa[near] = np.maximum(pressure_pa[near], pressed_pa)
        return np.asarray(pressure_pa.mean(axis=1))

    def _near(self, indenter: Indenter, moves_m: float = 0.0) -> Bools | slice:
        """Which taxels it may touch; a slice of all is quicker to take than a mask."""
        around_m = self._corners_m + moves_m
        near = indenter.may_touch(self._positions_m, self._normals, around_m)
        return slice(None) if near.all() else near


def _round_spans(points_m: Floats, directions: Floats, radius_m: float) -> Spans:
    """Of a ball (3 coordinates) or an endless cylinder (2) about the origin."""
    return round_spans(
        _dot(directions, directions),
        _dot(points_m, directions),
        _dot(points_m, points_m) - radius_m**2,
    )


def _dot(one: Floats, other: Floats) -> Floats:
    """(m,) of (m, d); einsum takes a fifth of the time of a sum along a short axis."""
    return np.asarray(np.einsum("md,md->m", one, other))


def round_spans(a: Any, b: Any, c: Any, xp: Any = np) -> Spans:
    """Where a·s² + 2·b·s + c ≤ 0: |p + s·n|² ≤ R², with n shorter than 1 along a cylinder's axis.

    xp: the arrays' namespace, by the array API standard.
    """
    along = a < 1e-18  # parallel to the cylinder: inside for ever, or never
    square = b * b - a * c
    root = xp.sqrt(xp.clip(square, 0.0, None))
    a_safe = xp.where(along, 1.0, a)
    hits = xp.where(along, c, -square) <= 0
    enters_m = xp.where(along, -np.inf, (-b - root) / a_safe)
    leaves_m = xp.where(along, np.inf, (-b + root) / a_safe)
    return xp.where(hits, enters_m, np.inf), xp.where(hits, leaves_m, -np.inf)


def slab_spans(place_m: Any, direction: Any, half_m: float, xp: Any = np) -> Spans:
    """Between two planes at ±half_m on one axis. place_m, direction: (m,), along that axis."""
    along = direction == 0
    safe = xp.where(along, 1.0, direction)
    one, other = (-half_m - place_m) / safe, (half_m - place_m) / safe
    inside = abs(place_m) <= half_m
    enters_m = xp.where(along, np.inf, xp.minimum(one, other))
    leaves_m = xp.where(along, -np.inf, xp.maximum(one, other))
    enters_m = xp.where(along & inside, -np.inf, enters_m)
    leaves_m = xp.where(along & inside, np.inf, leaves_m)
    return enters_m, leaves_m


def within_all(*spans: Spans, xp: Any = np) -> Spans:
    """Where lines are inside of all of some convex objects."""
    all_enter_m, all_leave_m = zip(*spans, strict=True)
    enters_m, leaves_m = reduce(xp.maximum, all_enter_m), reduce(xp.minimum, all_leave_m)
    hits = enters_m <= leaves_m
    return xp.where(hits, enters_m, np.inf), xp.where(hits, leaves_m, -np.inf)


def _between(grid: Floats, row: Floats, column: Floats) -> Floats:
    """Values of a grid between its points, linear both ways; NaN outside, and beside a NaN."""
    top = np.clip(np.floor(row), 0, len(grid) - 2).astype(np.intp)
    left = np.clip(np.floor(column), 0, grid.shape[1] - 2).astype(np.intp)
    down, right = row - top, column - left
    above = grid[top, left] * (1 - right) + grid[top, left + 1] * right
    below = grid[top + 1, left] * (1 - right) + grid[top + 1, left + 1] * right
    inside = (abs(down - 0.5) <= 0.5) & (abs(right - 0.5) <= 0.5)
    return np.where(inside, above * (1 - down) + below * down, np.nan)


def _positive(name: str, value: float, most: float) -> None:
    if not 0 < value <= most:
        raise ParameterError(f"{name} is {value}; it must be above 0, and {most:g} at most")
