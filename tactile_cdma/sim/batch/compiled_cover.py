# SPDX-License-Identifier: Apache-2.0

"""Binds the kernel's cover (kernel/cover.h): objects in arrays of numpy → pressures."""

from __future__ import annotations

from itertools import accumulate, chain

import numpy as np

from ...base import kernel
from ...base.arrays import Floats
from ...places.bounds import PARALLEL
from ..indenters import Bounded, Foundation
from .standard import axes_of


def pressed_pa(
    cover: Foundation,
    thing: Bounded,
    position_m: Floats,
    orientation_xyzw: Floats | None,
    force_n: Floats | None,
) -> Floats:
    """Return what BatchCover.pressure_pa does, (e, t) float64, Pa, of checked arrays of float64."""
    envs, (taxels, points, _) = len(position_m), cover.points_m.shape
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
    if orientation_xyzw is not None:
        with np.errstate(invalid="ignore"):  # one of length 0 is no orientation: NaN
            axes = np.stack(axes_of(orientation_xyzw, np), axis=1)
    found_pa = np.empty((envs, taxels))
    kernel.lib.cover_press(
        skin.at,
        given.at,
        envs,
        kernel.pointer(np.ascontiguousarray(position_m), envs, 3),
        kernel.pointer(axes, envs, 3, 3),
        kernel.ffi.NULL if force_n is None else kernel.pointer(np.ascontiguousarray(force_n), envs),
        kernel.pointer(np.empty(taxels * (points + 3)), taxels * (points + 3), written=True),
        kernel.pointer(found_pa, envs, taxels, written=True),
    )
    return found_pa
