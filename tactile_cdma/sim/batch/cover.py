# SPDX-License-Identifier: Apache-2.0

"""Objects pressed into many equal skins at once: the elastic cover of sim/indenters.py, batched."""

from itertools import accumulate, chain
from typing import Any

import numpy as np

from ...base import kernel
from ...base.arrays import Floats
from ...base.errors import ParameterError
from ...config.python_arguments import instance
from ...places.bounds import FAR_M, PARALLEL, Axis, Spans
from ...places.layout import Layout
from ..indenters import Bounded, Foundation, Sphere
from .standard import Array, array_api, axes_of, described, floating, is_array

POWER_STEPS, STEPS = 2, 5
"""Steps by which the depth under a force is sought, the first ones by a power. Chosen: with 4 some
of 100,000 tilted objects at 10⁻⁴ to 100 N were not exact yet, with 5 none."""


class BatchCover:
    """The elastic cover of e equal skins of t taxels; docs/simulation.md has an example.

    The kernel takes arrays of numpy, and of torch on a processor; functions of the array API
    standard take those that torch differentiates, and all others.
    areas_m2: (t,) float64, m².
    """

    def __init__(self, layout: Layout) -> None:
        places = instance("layout", layout, Layout).positions_m, layout.normals, layout.areas_m2
        self._foundation = cover = Foundation(*places, layout.aspect)
        self.areas_m2 = cover.areas_m2
        self._per_taxel = cover.points_m.shape[1]
        self._points_m = cover.points_m.reshape(-1, 3)
        normals = cover.normals.repeat(self._per_taxel, axis=0)
        self._normals = normals[:1] if cover.is_flat else normals
        self._point_m2 = (self.areas_m2 / self._per_taxel).repeat(self._per_taxel)

    def pressure_pa(
        self,
        thing: Bounded,
        position_m: Array,
        orientation_xyzw: Array | None = None,
        force_n: Array | None = None,
    ) -> Array:
        """Return the mean pressure on every taxel under one object in each environment, (e, t), Pa.

        thing: its shape, size and stiffness, not its pose. position_m: (e, 3), m, and
        orientation_xyzw: (e, 4), quaternions, None: not turned, in the skin's frame. force_n: (e,),
        N: each object is moved along the normal of the skin, which has to be flat, from wherever it
        is until the cover answers with this force; with none where it is beside the skin. NaN where
        one of these is, or a force is negative. Raises ParameterError for other shapes or objects.
        """
        if not isinstance(thing, Bounded):
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
        if force_n is not None and not self._foundation.is_flat:
            raise ParameterError("objects are pressed with a force on flat skins only")
        given = position_m, orientation_xyzw, force_n
        if not all(each is None or _is_in_memory(each) for each in given):
            return self._pressure_pa(thing, *given)
        turned, forces_n = (
            None if each is None else np.asarray(each, np.float64)
            for each in (orientation_xyzw, force_n)
        )
        place_m: Floats = np.asarray(position_m, np.float64)
        found_pa = pressed_pa(self._foundation, thing, place_m, turned, forces_n)
        xp = array_api().array_namespace(position_m)
        return xp.asarray(found_pa.astype(np.asarray(position_m).dtype, copy=False))

    def _pressure_pa(self, thing: Bounded, place_m: Array, turned: Any, force_n: Any) -> Array:
        api = array_api()
        xp, where = api.array_namespace(place_m), api.device(place_m)

        def here(array: Any) -> Array:
            return xp.asarray(array, dtype=place_m.dtype, device=where)

        doubt = 0 * xp.sum(place_m, axis=-1)  # NaN where something is
        if turned is not None:
            doubt = doubt + 0 / xp.sum(turned * turned, axis=-1)
        if isinstance(thing, Sphere):
            turned = None  # looks the same from everywhere
        enters_m, leaves_m = self._spans(thing, place_m, turned, xp, here)
        nothing = here(np.zeros((1, 1)))
        if force_n is None:
            depth_m = xp.where(leaves_m > 0, xp.maximum(-enters_m, nothing), nothing)
        else:
            doubt = doubt + xp.where(force_n >= 0, 0 * force_n, np.nan)  # a skin does not pull
            volume_m3 = force_n / thing.stiffness_pa_per_m
            shift_m = self._shift_m(enters_m, volume_m3, xp, here)[:, None]
            depth_m = xp.maximum(shift_m - enters_m, nothing)
        mean = here(np.full(self._per_taxel, thing.stiffness_pa_per_m / self._per_taxel))
        pressure_pa = xp.reshape(depth_m, (-1, self._per_taxel)) @ mean
        return xp.reshape(pressure_pa, (depth_m.shape[0], -1)) + doubt[:, None]

    def _spans(
        self, thing: Bounded, position_m: Array, turned: Array | None, xp: Any, here: Any
    ) -> Spans:
        """Tell where the normals at all points enter and leave the objects, (e, m) each."""
        # Coordinates along the object's axes, each (e, m): R.T @ (point − position).
        points_m, normals = here(self._points_m), here(self._normals)
        axes = axes_of(turned, xp) if turned is not None else None

        def along(axis: int) -> Axis:
            if axes is None:
                return points_m[None, :, axis] - position_m[:, axis, None], normals[None, :, axis]
            row = axes[axis]  # (e, 3)
            offset_m = xp.sum(row * position_m, axis=-1)[:, None]
            return row @ points_m.T - offset_m, row @ normals.T

        return thing.spans(tuple(map(along, range(3))), xp)

    def _shift_m(self, enters_m: Array, volume_m3: Array, xp: Any, here: Any) -> Array:
        """Tell how far to shift objects, (e,), m, so that they displace these volumes, (e,), m³.

        The volume is Σ aᵢ·max(s − eᵢ, 0), convex in s and 0 up to the least of the eᵢ. Near that it
        goes by a power of the depth, which a step by the power that it has here finds; Newton's
        steps end it, as they come from above, where each of its straight pieces is met exactly.
        """
        point_m2, nothing = here(self._point_m2), xp.zeros_like(volume_m3)
        begin_m = xp.min(enters_m, axis=-1)
        is_hit = (begin_m < FAR_M) & (volume_m3 > 0)
        spare = xp.astype(~is_hit, volume_m3.dtype)  # keeps what has no depth among numbers
        begin_m = xp.where(is_hit, begin_m, nothing)
        volume_m3 = xp.where(is_hit, volume_m3, nothing + 1)
        shift_m = begin_m + volume_m3 ** (1 / 3)
        for turn in range(STEPS):
            depth_m = xp.maximum(shift_m[:, None] - enters_m, nothing[:, None])
            area_m2 = xp.astype(depth_m > 0, point_m2.dtype) @ point_m2 + spare
            pressed_m3 = depth_m @ point_m2 + spare
            if turn < POWER_STEPS:
                deep_m = shift_m - begin_m
                share = pressed_m3 / (area_m2 * deep_m)  # the inverse of the power
                shift_m = begin_m + deep_m * (volume_m3 / pressed_m3) ** share
            else:
                shift_m = shift_m + (volume_m3 - pressed_m3) / area_m2
        return xp.where(is_hit, shift_m, nothing - np.inf)


def _is_in_memory(array: Array) -> bool:
    """Tell whether it is an array of numpy, or one of torch that is no more than numbers."""
    api = array_api()
    if api.is_torch_array(array):
        return array.device.type == "cpu" and not array.requires_grad
    return bool(api.is_numpy_array(array))


def pressed_pa(
    cover: Foundation, thing: Bounded, at_m: Floats, turned: Floats | None, force_n: Floats | None
) -> Floats:
    """Have the kernel (kernel/cover.h) find BatchCover.pressure_pa, (e, t) float64, Pa."""
    envs, (taxels, points, _) = len(at_m), cover.points_m.shape
    assert points <= kernel.lib.COVER_POINTS
    offsets_m = cover.points_m - cover.positions_m[:, None]
    skin = kernel.struct(
        "cover_skin",
        taxels=taxels,
        points=points,
        centres_m=np.ascontiguousarray(cover.positions_m),
        normals=np.ascontiguousarray(cover.normals),
        offsets_m=np.ascontiguousarray(offsets_m.swapaxes(1, 2)),
        corners_m=cover.corners_m,
        point_m2=cover.areas_m2 / points,
    )
    bounds = list(chain.from_iterable(thing.parts))
    given = kernel.struct(
        "cover_object",
        parts=len(thing.parts),
        ends=np.array(list(accumulate(map(len, thing.parts))), np.int32),
        weights=np.array([bound.weights for bound in bounds], np.float64),
        sizes=np.array([bound.size for bound in bounds], np.float64),
        middles=np.array([bound.middle_m for bound in bounds], np.float64),
        reach_m=thing.reach_m,
        parallel=PARALLEL,
        stiffness_pa_per_m=thing.stiffness_pa_per_m,
    )
    axes = np.tile(np.eye(3), (envs, 1, 1))
    if turned is not None:
        with np.errstate(invalid="ignore"):  # one of length 0 is no orientation: NaN
            axes = np.stack(axes_of(turned, np), axis=1)
    found_pa = np.empty((envs, taxels))
    kernel.lib.cover_press(
        skin.at,
        given.at,
        envs,
        kernel.pointer(np.ascontiguousarray(at_m), envs, 3),
        kernel.pointer(axes, envs, 3, 3),
        kernel.ffi.NULL if force_n is None else kernel.pointer(np.ascontiguousarray(force_n), envs),
        kernel.pointer(np.empty(taxels * (points + 3)), taxels * (points + 3), written=True),
        kernel.pointer(found_pa, envs, taxels, written=True),
    )
    return found_pa
