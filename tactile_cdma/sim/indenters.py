# SPDX-License-Identifier: Apache-2.0

"""Objects pressed into a skin, how deep by a force, and the pressure that its cover answers with.

The cover is a Winkler foundation: every point of the surface is a spring of its own, along its
normal, so that pressure = stiffness · depth; docs/simulation.md has what that leaves out.

An object that moves by s along −n comes s closer to every point of a flat skin, whose normal is n,
so that its force is Σ k·a·max(0, s − h) over points of area a, h below it: a sum of ramps, which is
solved exactly once the heights are sorted. On a curved skin points come closer by a share
of s that depends on both surfaces; there the same sum, with the shares of the step before, is
Newton's method, which finds its kinks, too.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, fields
from functools import cached_property, reduce
from typing import Any, NamedTuple, Self

import numpy as np

from ..base.arrays import Bools, Floats, Floats32
from ..base.errors import ParameterError
from ..config.python_arguments import argument, array_of, instance
from ..places.bounds import FAR_M, Axis, Bound, Spans, within_all
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
DEEPEST_M = 0.02
"""Farthest that an object is moved, m. Chosen: the cover of a finger is thinner."""
MOST_STEPS, SOUGHT_M = 20, 1e-8
"""Newton's steps on a curved skin end where they are this short, m, or so many; about 5 suffice."""
_LIMIT_M = 1e-4
"""A shift this close to DEEPEST_M has found no end, m; chosen: where eight halvings come."""
_LEAST_SHARE = 0.05
"""Least share of the movement by which a point is taken to come closer; chosen."""
LENGTH, LENGTHS = {"lengths": 1}, {"lengths": 3}
"""Metadata of objects' fields that are lengths, m, above 0: how many."""


@dataclass(frozen=True, kw_only=True)
class Indenter(ABC):
    """A rigid object pressed into a skin; poses are in the skin's frame.

    position_m: of its origin, m. orientation_xyzw: quaternion, as in ROS messages.
    stiffness_pa_per_m: pressure per depth, Pa/m, of cover and object together.
    Raises ParameterError for values that are no pose, size or stiffness.
    """

    position_m: Sequence[float]
    orientation_xyzw: Sequence[float] = (0.0, 0.0, 0.0, 1.0)
    stiffness_pa_per_m: float = STIFFNESS_PA_PER_M

    def __post_init__(self) -> None:
        kind = type(self).__name__
        amounts = [("stiffness_pa_per_m", 1, MOST_PA_PER_M, "Pa/m")]
        sizes = {each.name: each.metadata["lengths"] for each in fields(self) if each.metadata}
        amounts += [(name, count, MOST_M, "m") for name, count in sizes.items()]
        for name, count, most, unit in amounts:
            like = 0.0 if count == 1 else (0.0,) * count
            if not np.all(found := self._checked(name, like, (0.0, most), unit)):
                raise ParameterError(f"{name} of {kind} is {found}; it must be above 0")
        self._checked("position_m", (0.0,) * 3, (-MOST_M, MOST_M), "m")
        self._checked("orientation_xyzw", (0.0,) * 4)
        try:
            _ = self.pose
        except ValueError as error:
            raise ParameterError(f"{kind}: {error}") from None

    def _checked(self, name: str, like: float | tuple[float, ...], *about: Any) -> Any:
        """Copy a value that is right: the program may go on changing its list."""
        value = argument(f"{name} of {type(self).__name__}", getattr(self, name), like, *about)
        object.__setattr__(self, name, value)
        return value

    @cached_property
    def pose(self) -> Pose:
        """Return the object's own frame in the skin's."""
        return Pose.of_quaternion(self.position_m, self.orientation_xyzw)

    def moved(self, by_m: Floats) -> Self:
        """Copy the object to another place, by_m away, (3,), m; not checked again."""
        thing, pose = copy(self), Pose(self.pose.rotation, self.pose.translation_m + by_m)
        vars(thing).update(position_m=tuple(pose.translation_m.tolist()), pose=pose)
        return thing

    def placed(self, pose: Pose) -> Self:
        """Copy the object in another pose; not checked again."""
        thing, turned = copy(self), tuple(pose.quaternion.tolist())
        place_m = tuple(pose.translation_m.tolist())
        vars(thing).update(position_m=place_m, orientation_xyzw=turned, pose=pose)
        return thing

    def spans_m(self, points_m: Floats, normals: Floats) -> Spans:
        """Find where lines along a surface's normals enter and leave it, as heights above there.

        points_m, normals: (m, 3), in the skin's frame; normals (1, 3) where all are the same.
        """
        own = self.pose.inverse
        places_m = own.rotation @ points_m.T + own.translation_m[:, None]
        axes = tuple(zip(places_m, own.rotation @ normals.T, strict=True))
        enters_m, leaves_m = self.spans(axes)
        hits = enters_m < FAR_M
        return np.where(hits, enters_m, np.inf), np.where(hits, leaves_m, -np.inf)

    def depth_m(self, points_m: Floats, normals: Floats) -> Floats:
        """Tell how far the object reaches below points of a surface, along the normals there.

        points_m, normals: (m, 3), in the skin's frame. Returns (m,), m. 0 where the object is
        beside the normal's line, above the surface, or wholly behind it.
        """
        enters_m, leaves_m = self.spans_m(points_m, normals)
        return np.where(leaves_m > 0, np.maximum(-enters_m, 0.0), 0.0)

    def may_touch(self, points_m: Floats, normals: Floats, around_m: Floats) -> Bools:
        """Tell whether it may reach below points (m, 3) of a surface within around_m (m,), m."""
        from_it_m = points_m - self.pose.translation_m
        along_m = _dot(from_it_m, normals)
        beside_m2 = _dot(from_it_m, from_it_m) - np.square(along_m)
        return np.asarray(beside_m2 <= np.square(self.reach_m + around_m))

    @property
    @abstractmethod
    def reach_m(self) -> float:
        """No line touches the object that passes its origin at a greater distance, m."""

    @abstractmethod
    def spans(self, axes: Sequence[Axis], xp: Any = np) -> Spans:
        """Cross the object with lines. axes: along its own x, y and z; xp: their namespace.

        Those of many objects alike may be asked for at once, except of height maps.
        """


class Bounded(Indenter):
    """An object that is the union of some parts, each the space within all of its bounds."""

    @property
    @abstractmethod
    def parts(self) -> Sequence[Sequence[Bound]]:
        """Return the bounds of each part, on its own axes."""

    @property
    def reach_m(self) -> float:
        # The bounds of a part are on different axes, and together on all three.
        return max(math.hypot(*(bound.reach_m for bound in part)) for part in self.parts)

    def spans(self, axes: Sequence[Axis], xp: Any = np) -> Spans:
        each = [within_all([bound.spans(axes, xp) for bound in part], xp) for part in self.parts]
        all_enter_m, all_leave_m = zip(*each, strict=True)
        return reduce(xp.minimum, all_enter_m), reduce(xp.maximum, all_leave_m)


@dataclass(frozen=True, kw_only=True)
class Sphere(Bounded):
    """A ball about its origin."""

    radius_m: float = field(metadata=LENGTH)

    @property
    def parts(self) -> Sequence[Sequence[Bound]]:
        return ((Bound((1, 1, 1), self.radius_m),),)


@dataclass(frozen=True, kw_only=True)
class Cylinder(Bounded):
    """A cylinder about its own z axis, its origin in the middle."""

    radius_m: float = field(metadata=LENGTH)
    length_m: float = field(metadata=LENGTH)

    @property
    def parts(self) -> Sequence[Sequence[Bound]]:
        return (_pipe(self.radius_m, self.length_m),)


@dataclass(frozen=True, kw_only=True)
class Box(Bounded):
    """A cuboid with edges along its own axes, its origin in the middle. size_m: x, y, z, m."""

    size_m: Sequence[float] = field(metadata=LENGTHS)

    @property
    def parts(self) -> Sequence[Sequence[Bound]]:
        x_m, y_m, z_m = (size_m / 2 for size_m in self.size_m)
        return ((Bound((1, 0, 0), x_m), Bound((0, 1, 0), y_m), Bound((0, 0, 1), z_m)),)


@dataclass(frozen=True, kw_only=True)
class Capsule(Bounded):
    """A cylinder about its own z axis with half a ball on either end, its origin in the middle.

    length_m: between the balls' middles, m.
    """

    radius_m: float = field(metadata=LENGTH)
    length_m: float = field(metadata=LENGTH)

    @property
    def parts(self) -> Sequence[Sequence[Bound]]:
        ends_m = -self.length_m / 2, self.length_m / 2
        balls = ((Bound((1, 1, 1), self.radius_m, end_m),) for end_m in ends_m)
        return _pipe(self.radius_m, self.length_m), *balls


@dataclass(frozen=True, kw_only=True)
class Ellipsoid(Bounded):
    """An ellipsoid about its origin. size_m: its diameters along its own x, y and z, m."""

    size_m: Sequence[float] = field(metadata=LENGTHS)

    @property
    def parts(self) -> Sequence[Sequence[Bound]]:
        x, y, z = (2 / size_m for size_m in self.size_m)
        return ((Bound((x, y, z), 1),),)


@dataclass(frozen=True, kw_only=True, eq=False)
class HeightMap(Indenter):
    """The lower face of any object, as heights above its own plane z = 0; solid above it.

    heights_m: (r, c), m, of the points of a grid about the origin, whose columns are along x and
    rows along y, cell_m apart; NaN where there is no object. Lines are taken to be steep to that
    plane: turn it to where the object is pressed.
    """

    heights_m: Floats
    cell_m: float = field(metadata=LENGTH)

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(array_of("heights_m", self.heights_m, ("rows", "columns")).shape) < 2:
            raise ParameterError(f"heights_m is {self.heights_m.shape}; it must be 2 × 2 or more")
        if np.isinf(self.heights_m).any():
            raise ParameterError("heights_m has infinite ones; NaN stands where there is no object")

    @property
    def reach_m(self) -> float:
        rows, columns = self.heights_m.shape
        farthest_m = max(np.nanmax(np.abs(self.heights_m), initial=0.0), 0.0)
        return math.hypot(rows * self.cell_m / 2, columns * self.cell_m / 2, farthest_m)

    def spans(self, axes: Sequence[Axis], xp: Any = np) -> Spans:
        (x_m, to_x), (y_m, to_y), (z_m, to_z) = axes
        rows, columns = self.heights_m.shape
        rise = np.maximum(to_z, _STEEP)
        enters_m = np.zeros_like(z_m)
        for _ in range(_MAP_STEPS):
            column = (x_m + enters_m * to_x) / self.cell_m + (columns - 1) / 2
            row = (y_m + enters_m * to_y) / self.cell_m + (rows - 1) / 2
            height_m = _between(self.heights_m, row, column)
            enters_m = np.where(np.isfinite(height_m), (height_m - z_m) / rise, 0.0)
        hits = np.isfinite(height_m) & (to_z > 0)
        return np.where(hits, enters_m, np.inf), np.where(hits, np.inf, -np.inf)


class Foundation:
    """The elastic cover of t taxels: rectangles of the taxels' areas, tangential to the skin.

    positions_m, normals: (t, 3), m. areas_m2: (t,), m². points_m: (t, p, 3), m, the points of every
    taxel; corners_m: (t,), m, how far from its middle they are at most.
    """

    def __init__(
        self,
        positions_m: Floats | Floats32,
        normals: Floats | Floats32,
        areas_m2: Floats | Floats32,
        aspect: float = 1.0,
    ) -> None:
        """positions_m, normals: (t, 3), m, in the skin's frame. aspect: width over height."""
        taxels = len(array_of("positions_m", positions_m, ("taxels", 3)))
        self.positions_m = positions_m.astype(np.float64)
        self.normals = array_of("normals", normals, (taxels, 3)).astype(np.float64)
        self.areas_m2 = array_of("areas_m2", areas_m2, (taxels,)).astype(np.float64)
        aspect = argument("aspect", aspect, 1.0, (1e-3, 1e3))
        sizes = np.linalg.norm(self.normals, axis=1)
        if not (np.isfinite(self.positions_m).all() and np.isclose(sizes, 1, atol=1e-3).all()):
            raise ParameterError("positions_m must be finite, and normals of length 1")
        if not ((self.areas_m2 > 0) & (self.areas_m2 <= MOST_M**2)).all():
            raise ParameterError("areas_m2 must be above 0 m², and at most 1e6 m²")
        edge_m = np.sqrt(self.areas_m2)[:, None, None]
        wide_m, tall_m = edge_m * math.sqrt(aspect), edge_m / math.sqrt(aspect)
        self.corners_m = np.hypot(wide_m, tall_m).ravel() / 2
        right, up = tangents(self.normals)
        steps = (np.arange(EDGE_POINTS) + 0.5) / EDGE_POINTS - 0.5
        x, y = (part.ravel()[:, None] for part in np.meshgrid(steps, steps))
        offsets_m = wide_m * x * right[:, None] + tall_m * y * up[:, None]
        self.points_m = self.positions_m[:, None] + offsets_m
        per_taxel = self.points_m.shape[1]
        self._point_m2 = (self.areas_m2 / per_taxel)[:, None].repeat(per_taxel, axis=1)
        self.is_flat = bool((self.normals == self.normals[0]).all())

    def near(self, indenter: Indenter, moves_m: float = 0.0) -> "Near":
        """Find what an object may reach that moves up to moves_m, m, sideways of the normals."""
        around_m = self.corners_m + moves_m
        mask = indenter.may_touch(self.positions_m, self.normals, around_m)
        taxels = slice(None) if mask.all() else mask  # a slice is quicker to take
        points_m, normals = self.points_m[taxels], self.normals[:1]
        if not self.is_flat:
            normals = self.normals[taxels].repeat(points_m.shape[1], axis=0)
        return Near(taxels, points_m.reshape(-1, 3), normals, self._point_m2[taxels].ravel())

    def pressure_pa(self, indenters: Sequence[Indenter]) -> Floats:
        """Average over every taxel, (t,), Pa; where several objects meet, the greatest counts."""
        pressed = []
        for indenter in instance("indenters", indenters, Sequence):
            instance("an indenter", indenter, Indenter)
            near = self.near(indenter)
            depth_m = indenter.depth_m(near.points_m, near.normals)
            pressed.append((near, indenter.stiffness_pa_per_m * depth_m))
        return self.mean_pa(pressed)

    def mean_pa(self, pressed: Sequence[tuple["Near", Floats]]) -> Floats:
        """Average over every taxel what presses on the points near each object, (m,), Pa."""
        pressure_pa = np.zeros(self.points_m.shape[:2])
        for near, point_pa in pressed:
            so_far_pa = pressure_pa[near.taxels]
            pressure_pa[near.taxels] = np.maximum(so_far_pa, point_pa.reshape(so_far_pa.shape))
        return np.asarray(pressure_pa.mean(axis=1))


class Near(NamedTuple):
    """Holds what an object may reach of a cover.

    taxels: a mask, (t,), or all. points_m: (m, 3), m, of these taxels, one after the other.
    normals: (m, 3) there; (1, 3) if the skin is flat. areas_m2: (m,), m², of the points.
    """

    taxels: Bools | slice
    points_m: Floats
    normals: Floats
    areas_m2: Floats


def _dot(one: Floats, other: Floats) -> Floats:
    """Multiply row by row, (m,) of (m, d); einsum takes a fifth of the time of a sum."""
    return np.asarray(np.einsum("md,md->m", one, other))


def _pipe(radius_m: float, length_m: float) -> Sequence[Bound]:
    return Bound((1, 1, 0), radius_m), Bound((0, 0, 1), length_m / 2)


def _between(grid: Floats, row: Floats, column: Floats) -> Floats:
    """Interpolate a grid between its points, linear both ways; NaN outside, and beside a NaN."""
    top = np.clip(np.floor(row), 0, len(grid) - 2).astype(np.intp)
    left = np.clip(np.floor(column), 0, grid.shape[1] - 2).astype(np.intp)
    down, right = row - top, column - left
    above = grid[top, left] * (1 - right) + grid[top, left + 1] * right
    below = grid[top + 1, left] * (1 - right) + grid[top + 1, left + 1] * right
    inside = (abs(down - 0.5) <= 0.5) & (abs(right - 0.5) <= 0.5)
    return np.where(inside, above * (1 - down) + below * down, np.nan)


Press = tuple[Indenter, float, Sequence[float]]
"""An object, its force, N, and the direction in which it is moved, as at_force takes them."""


def at_force(
    cover: Foundation, thing: Indenter, force_n: float, along: Sequence[float] = (0.0, 0.0, -1.0)
) -> Indenter:
    """Return the object, moved along a direction until the cover answers with this force along it.

    along: unit vector into the skin. An object that cannot have the force within DEEPEST_M, as it
    lies beside the skin or goes right through its cover, stays where it is.
    """
    way = _checked(cover, thing, force_n, along)
    near = cover.near(thing)
    if _is_along(near, way):
        shift_m = _flat_shift_m(thing, near, thing.spans_m(near.points_m, near.normals), force_n)
        return thing.moved(shift_m * way) if shift_m else thing
    _, points_m, normals, areas_m2 = cover.near(thing, DEEPEST_M)
    normals = np.broadcast_to(normals, points_m.shape)
    facing = -normals @ way
    ahead = facing > _LEAST_SHARE
    points_m, normals, share = points_m[ahead], normals[ahead], facing[ahead]
    weights = areas_m2[ahead] * share * thing.stiffness_pa_per_m
    moved, shift_m, step_m = thing, 0.0, 0.0
    light_m, heavy_m = -DEEPEST_M, DEEPEST_M  # the shift is between these
    before_m: Floats | None = None
    for _ in range(MOST_STEPS):
        height_m, leaves_m = moved.spans_m(points_m, normals)
        # What is behind the skin here may press on it elsewhere.
        height_m = np.where(leaves_m > 0, height_m, np.inf)
        if before_m is not None:
            with np.errstate(invalid="ignore"):  # how much closer points came, per metre
                came = (before_m - height_m) / step_m
            share = np.where(np.isfinite(came) & (came > _LEAST_SHARE), came, share)
        step_m = _step_m(height_m / share, weights * share, force_n)
        if step_m > 0:
            light_m = max(light_m, shift_m)
        else:
            heavy_m = min(heavy_m, shift_m)
        if not light_m <= shift_m + step_m <= heavy_m:
            # Beyond the limits; or points have come in from beside, and Newton's step is too long.
            if not np.isfinite(step_m):
                return thing
            step_m = (light_m + heavy_m) / 2 - shift_m
        shift_m += step_m
        before_m = height_m
        moved = thing.moved(shift_m * way)
        if abs(step_m) < SOUGHT_M:
            break
    if DEEPEST_M - abs(shift_m) < _LIMIT_M or _goes_through(height_m, leaves_m, share * step_m):
        return thing
    return moved


def pressed_pa(cover: Foundation, presses: Sequence[Press]) -> Floats:
    """Return the mean pressure on every taxel, (t,), Pa, of objects that are moved as by at_force.

    As Foundation.pressure_pa of these, in half the time where the skin is flat.
    """
    pressed = []
    for thing, force_n, along in presses:
        way = _checked(cover, thing, force_n, along)
        near = cover.near(thing)
        if is_along := _is_along(near, way):
            moved = thing
        else:
            moved = at_force(cover, thing, force_n, along)
            near = cover.near(moved)
        spans_m = moved.spans_m(near.points_m, near.normals)
        shift_m = _flat_shift_m(thing, near, spans_m, force_n) if is_along else 0.0
        depth_m = np.where(spans_m[1] > shift_m, np.maximum(shift_m - spans_m[0], 0.0), 0.0)
        pressed.append((near, thing.stiffness_pa_per_m * depth_m))
    return cover.mean_pa(pressed)


def _checked(cover: Foundation, thing: Indenter, force_n: float, along: Sequence[float]) -> Floats:
    """Check the arguments; returns the direction, (3,)."""
    instance("cover", cover, Foundation)
    instance("thing", thing, Indenter)
    argument("force_n", force_n, 0.0, (0.0, math.inf), "N")
    way = argument("along", along, (0.0, 0.0, 0.0))
    if not abs(math.hypot(*way) - 1) < 1e-6:
        raise ParameterError(f"along is {way}; it must be of length 1")
    return np.array(way)


def _is_along(near: Near, way: Floats) -> bool:
    """Tell whether an object that moves this way comes as much closer to all points."""
    return bool((near.normals @ way < 1e-9 - 1).all())


def _flat_shift_m(thing: Indenter, near: Near, spans_m: Spans, force_n: float) -> float:
    """Tell how far an object moves against all normals, m; 0 where it cannot have the force."""
    shift_m = _step_m(spans_m[0], near.areas_m2 * thing.stiffness_pa_per_m, force_n)
    beyond = not abs(shift_m) <= DEEPEST_M or _goes_through(*spans_m, shift_m)
    return 0.0 if beyond else shift_m


def _goes_through(height_m: Floats, leaves_m: Floats, step_m: Floats | float) -> bool:
    """Tell whether the cover has passed through the object where a step presses on it."""
    return bool(((height_m < step_m) & (leaves_m <= step_m)).any())


def _step_m(meets_m: Floats, stiffness_n_per_m: Floats, force_n: float) -> float:
    """Return the s at which Σ stiffness·max(0, s − meets_m) is the force; ∞ if nothing is ahead."""
    order = np.argsort(meets_m)
    meets_m, slope = meets_m[order], stiffness_n_per_m[order]
    # The sum is the greatest of those of the first ones alone, so that s is their least solution.
    solved_m = (force_n + np.cumsum(slope * meets_m)) / np.cumsum(slope)
    return float(solved_m.min(initial=np.inf))
