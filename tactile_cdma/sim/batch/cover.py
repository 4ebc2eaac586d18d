# SPDX-License-Identifier: Apache-2.0

"""Objects pressed into many equal skins at once: the elastic cover of sim/indenters.py, batched."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...base.arrays import Floats
from ...base.errors import ParameterError
from ...config.python_arguments import instance
from ...places.layout import Layout
from ..indenters import Axis, Foundation, HeightMap, Indenter, Spans
from .standard import Array, array_api, described, floating, is_array

POWER_STEPS, STEPS = 2, 8
"""Steps by which the depth under a force is sought, the first ones by a power. Chosen: with 6 two
of 24,000 tilted objects at 10⁻⁴ to 100 N were not exact yet, with 8 none."""
AT_ONCE = 1 << 15
"""Points × environments that numpy takes at once. Chosen: they stay in a core's cache, which makes
1,000 environments twice as fast or more."""


class BatchCover:
    """The elastic cover of e equal skins of t taxels; docs/simulation.md has an example.

    areas_m2: (t,) float64, m².
    """

    def __init__(self, layout: Layout) -> None:
        places = instance("layout", layout, Layout).positions_m, layout.normals, layout.areas_m2
        cover = Foundation(*places, layout.aspect)
        self.areas_m2, self._is_flat = cover.areas_m2, cover.is_flat
        self._per_taxel = cover.points_m.shape[1]
        self._points_m = cover.points_m.reshape(-1, 3)
        self._normals = layout.normals.astype(np.float64).repeat(self._per_taxel, axis=0)
        self._point_m2 = (self.areas_m2 / self._per_taxel).repeat(self._per_taxel)

    def pressure_pa(
        self,
        thing: Indenter,
        position_m: Array,
        orientation_xyzw: Array | None = None,
        force_n: Array | None = None,
    ) -> Array:
        """Return the mean pressure on every taxel under one object in each environment, (e, t), Pa.

        thing: its shape, size and stiffness, not its pose; no HeightMap. position_m: (e, 3), m, and
        orientation_xyzw: (e, 4), quaternions, None: not turned, in the skin's frame. force_n: (e,),
        N: each object is moved along the normal of the skin, which has to be flat, from wherever it
        is until the cover answers with this force; with none where it is beside the skin. NaN where
        one of these is, or a force is negative. Raises ParameterError for other shapes or objects.
        """
        if not isinstance(thing, Indenter) or isinstance(thing, HeightMap):
            raise ParameterError(f"BatchCover knows no {type(thing).__name__}")
        floating("position_m", position_m)
        count = position_m.shape[:1]
        for name, array, rest in (
            ("position_m", position_m, (3,)),
            ("orientation_xyzw", orientation_xyzw, (4,)),
            ("force_n", force_n, ()),
        ):
            if array is None:
                continue
            if not is_array(array, (*count, *rest)) or 0 in array.shape:
                raise ParameterError(f"{name} is {described(array)}; it must be {('e', *rest)}")
            floating(name, array)
        given, envs = (position_m, orientation_xyzw, force_n), position_m.shape[0]
        few = max(1, AT_ONCE // len(self._points_m))
        if envs <= few or not array_api().is_numpy_array(position_m):
            return self._pressure_pa(thing, *given)
        parts = (slice(begin, begin + few) for begin in range(0, envs, few))
        return np.concatenate(
            [
                self._pressure_pa(thing, *(each if each is None else each[part] for each in given))
                for part in parts
            ]
        )

    def _pressure_pa(
        self,
        thing: Indenter,
        position_m: Array,
        orientation_xyzw: Array | None,
        force_n: Array | None,
    ) -> Array:
        api = array_api()
        xp, where = api.array_namespace(position_m), api.device(position_m)

        def here(array: Any) -> Array:
            return xp.asarray(array, dtype=position_m.dtype, device=where)

        doubt = 0 * xp.sum(position_m, axis=-1)  # NaN where something is
        if orientation_xyzw is not None:
            doubt = doubt + 0 / xp.sum(orientation_xyzw * orientation_xyzw, axis=-1)
        enters_m, leaves_m = self._spans(thing, position_m, orientation_xyzw, xp, here)
        if force_n is None:
            depth_m = xp.where((leaves_m > 0) & (enters_m < 0), -enters_m, 0.0)
        else:
            if not self._is_flat:
                raise ParameterError("objects are pressed with a force on flat skins only")
            doubt = doubt + xp.where(force_n >= 0, 0 * force_n, np.nan)  # a skin does not pull
            volume_m3 = force_n / thing.stiffness_pa_per_m
            shift_m = self._shift_m(enters_m, volume_m3, xp, here)[:, None]
            depth_m = xp.where(enters_m < shift_m, shift_m - enters_m, 0.0)
        by_taxel = xp.reshape(depth_m, (depth_m.shape[0], -1, self._per_taxel))
        return thing.stiffness_pa_per_m * xp.mean(by_taxel, axis=-1) + doubt[:, None]

    def _spans(
        self, thing: Indenter, position_m: Array, turned: Array | None, xp: Any, here: Any
    ) -> Spans:
        """Tell where the normals at all points enter and leave the objects, (e, m) each."""
        points_m, normals = self._points_m, self._normals
        # Coordinates along the object's axes, each (e, m): R.T @ (point − position).
        axes = _axes(turned, xp) if turned is not None else None

        def along(axis: int) -> Axis:
            if axes is None:  # what is the same at all points is taken once
                place_m, normal = _once(points_m[:, axis]), _once(normals[:, axis])
                return here(place_m)[None, :] - position_m[:, axis, None], here(normal)[None, :]
            row = axes[axis]  # (e, 3)
            offset_m = xp.sum(row * position_m, axis=-1)[:, None]
            return row @ here(points_m.T) - offset_m, row @ here(_once(normals).T)

        return thing.spans(tuple(map(along, range(3))), xp)

    def _shift_m(self, enters_m: Array, volume_m3: Array, xp: Any, here: Any) -> Array:
        """Tell how far to shift objects, (e,), m, so that they displace these volumes, (e,), m³.

        The volume is Σ aᵢ·max(s − eᵢ, 0), convex in s and 0 up to the least of the eᵢ. Near that it
        goes by a power of the depth, which a step by the power that it has here finds; Newton's
        steps end it, as they come from above, where each of its straight pieces is met exactly.
        """
        point_m2, nothing = here(self._point_m2), xp.zeros_like(volume_m3)
        begin_m = xp.min(enters_m, axis=-1)
        is_hit = (begin_m < np.inf) & (volume_m3 > 0)
        begin_m = xp.where(is_hit, begin_m, nothing)
        volume_m3 = xp.where(is_hit, volume_m3, nothing + 1)
        enters_m = xp.where(is_hit[:, None], enters_m, nothing[:, None])
        is_there = enters_m < np.inf
        place_m = xp.where(is_there, enters_m, nothing[:, None])
        area_m2 = xp.astype(is_there, enters_m.dtype) @ point_m2
        shift_m = (volume_m3 + place_m @ point_m2) / area_m2
        for turn in range(STEPS):
            depth_m = xp.maximum(shift_m[:, None] - enters_m, nothing[:, None])
            area_m2 = xp.astype(depth_m > 0, enters_m.dtype) @ point_m2
            pressed_m3 = depth_m @ point_m2
            if turn < POWER_STEPS:
                deep_m = shift_m - begin_m
                share = pressed_m3 / (area_m2 * deep_m)  # the inverse of the power
                shift_m = begin_m + deep_m * (volume_m3 / pressed_m3) ** share
            else:
                shift_m = shift_m + (volume_m3 - pressed_m3) / area_m2
        return xp.where(is_hit, shift_m, nothing - np.inf)


def _once(values: Floats) -> Floats:
    """Return the first of values that are all the same, else all; (m, …)."""
    return values[:1] if (values == values[0]).all() else values


def _axes(quaternion: Array, xp: Any) -> tuple[Array, Array, Array]:
    """Turn orientations (e, 4), x, y, z, w of any length, to the objects' axes, (e, 3) each."""
    q = quaternion / xp.sqrt(xp.sum(quaternion * quaternion, axis=-1, keepdims=True))
    x, y, z, w = (q[:, i] for i in range(4))
    return (
        xp.stack((1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)), axis=-1),
        xp.stack((2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)), axis=-1),
        xp.stack((2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)), axis=-1),
    )
