# SPDX-License-Identifier: Apache-2.0

"""The points of a body: those of its patches, moved into one frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..places.poses import Pose
from .cloud import POINT, in_one_piece, packed_colours, selected

BODY_POINT = np.dtype([*POINT.descr, ("patch", "<u4")])
"""A point of one skin, and which patch it is of."""


class PatchCloud:
    """The points of one patch in the body's frame; what does not change is worked out once."""

    def __init__(
        self, positions_m: NDArray[np.float32], normals: NDArray[np.float32], patch: int
    ) -> None:
        """Taxels (t, 3) in the patch's frame, m, with unit vectors (t, 3) out of the skin."""
        self._positions_m = positions_m.astype(np.float64)
        self._normals = normals.astype(np.float64)
        self._points = np.zeros(len(positions_m), dtype=BODY_POINT)
        self._points["taxel"] = np.arange(len(positions_m))
        self._points["patch"] = patch
        self._pose: Pose | None = None

    def __len__(self) -> int:
        return len(self._points)

    def points(
        self, pressure_pa: NDArray[np.float32], max_pa: float, pose: Pose
    ) -> NDArray[np.void]:
        """(m,) BODY_POINT, the taxels with a reading.

        pressure_pa: (t,) float32, Pa, NaN without a reading. max_pa: end of the colour scale.
        pose: of the patch's frame in the body's.
        """
        self._place(pose)
        self._points["pressure"] = pressure_pa
        self._points["rgb"] = packed_colours(pressure_pa, max_pa)
        return selected(self._points, np.isfinite(pressure_pa))

    def _place(self, pose: Pose) -> None:
        """Have the points where the patch is now."""
        if self._pose and _same(pose, self._pose):
            return
        self._pose = pose
        places, normals = pose.apply(self._positions_m), pose.rotate(self._normals)
        for axis, letter in enumerate("xyz"):
            self._points[letter] = places[:, axis]
            self._points[f"normal_{letter}"] = normals[:, axis]


def together(clouds: Sequence[NDArray[np.void]]) -> NDArray[np.void]:
    """(m,) BODY_POINT, those of one patch after the other."""
    nothing = np.zeros(0, dtype=BODY_POINT)
    return np.concatenate([in_one_piece(c) for c in (nothing, *clouds)]).view(BODY_POINT)


def _same(one: Pose, other: Pose) -> bool:
    return np.array_equal(one.translation_m, other.translation_m) and np.array_equal(
        one.rotation, other.rotation
    )
