# SPDX-License-Identifier: Apache-2.0

"""Tells viewers about a patch: the names of its topics, and its layout from ~/info."""

import numpy as np

from tactile_cdma.msg import TactileSkinInfo

from ...base.arrays import Floats32
from ...config.body_file import NODE_NAME as NODE_NAME  # viewers take it from here
from ...places.layout import Layout
from ...places.layout_shapes import seen_from_outside
from ...places.proximity import usual_distance_m
from ..common.convert import places_of

ARRAY_TOPIC = "tactile"
OLD_S = 1.0
"""Time without a frame, s, after which the last one no longer counts as a reading; chosen."""


def full_name(patch: str) -> str:
    """Complete the name of a driver: left_palm and /left_palm/skin are the same patch."""
    name = patch.strip("/")
    return f"/{name}" if name == NODE_NAME or "/" in patch else f"/{name}/{NODE_NAME}"


def layout_of(info: TactileSkinInfo) -> Layout:
    """Return the layout that a driver has published.

    It has no positions on the unrolled skin: an irregular skin is drawn as seen from outside.
    Raises MessageError where its fields contradict each other.
    """
    positions_m, normals, areas_m2 = (place.astype(np.float32) for place in places_of(info))
    irregular = info.height == 1 and info.width > 1
    pitch_m = usual_distance_m(positions_m, normals) if irregular else None
    size = info.height, info.width
    across_m, down_m = (_usual_step_m(positions_m, normals, size, axis) for axis in (1, 0))
    two = min(across_m, down_m) > 0 and not irregular
    return Layout(
        name=info.header.frame_id,
        rows=info.height,
        columns=info.width,
        positions_m=positions_m,
        normals=normals,
        areas_m2=areas_m2,
        flat_m=seen_from_outside(positions_m, normals).astype(np.float32),
        nodes=np.array(info.node, dtype=np.int32),
        pitch_m=pitch_m or float(np.sqrt(np.median(areas_m2))),
        irregular=irregular,
        aspect=across_m / down_m if two else 1.0,
    )


def _usual_step_m(
    positions_m: Floats32, normals: Floats32, size: tuple[int, int], axis: int
) -> float:
    """Median distance of neighbours in rows (axis 1) or columns along the surface, m; 0: none."""
    if size[axis] < 2:
        return 0.0
    apart_m = np.linalg.norm(np.diff(positions_m.reshape(*size, 3), axis=axis), axis=2)
    ends = normals.reshape(*size, 3)
    turned = np.linalg.norm(np.diff(ends, axis=axis), axis=2) / 2  # the sine of half the angle
    arc = np.arcsin(np.minimum(turned, 1.0)) / np.maximum(turned, 1e-9)
    return float(np.median(apart_m * np.where(turned > 1e-6, arc, 1.0)))
