# SPDX-License-Identifier: Apache-2.0

"""The skin as a cloud of points: position, normal, pressure and colour in an array of records."""

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats32
from .heatmap import GAMMA, SCALE_RGB, scale_steps

_FLOATS = ("x", "y", "z", "normal_x", "normal_y", "normal_z", "pressure")
POINT = np.dtype([*((name, "<f4") for name in _FLOATS), ("rgb", "<u4"), ("taxel", "<u4")])
"""One point: position (m), unit normal out of the skin, pressure (Pa), colour 0x00RRGGBB, index of
the taxel."""
BODY_POINT = np.dtype([*POINT.descr, ("patch", "<u4")])
"""A point of a body: that of a skin and the index of its patch."""
_PACKED_RGB = SCALE_RGB.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], dtype=np.uint32)
"""(513,) uint32 0x00RRGGBB, the colours of SCALE_RGB."""
Places = NDArray[np.floating]


class Cloud:
    """The points of one skin, alone or as a patch of a body."""

    def __init__(self, positions_m: Places, normals: Places, patch: int | None = None) -> None:
        """positions_m, normals: (t, 3), m and unit vectors. patch: its index in a body."""
        self._points = np.zeros(len(positions_m), dtype=POINT if patch is None else BODY_POINT)
        self._points["taxel"] = np.arange(len(positions_m))
        if patch is not None:
            self._points["patch"] = patch
        for axis, letter in enumerate("xyz"):
            self._points[letter] = positions_m[:, axis]
            self._points[f"normal_{letter}"] = normals[:, axis]

    def points(
        self, pressure_pa: Floats32, max_pa: float, gamma: float = GAMMA
    ) -> NDArray[np.void]:
        """Make (m,) POINT or, of a patch, BODY_POINT: the taxels with a reading.

        pressure_pa: (t,) float32, Pa, NaN: no reading. max_pa, Pa, gamma: of the colour scale.
        """
        self._points["pressure"] = pressure_pa
        self._points["rgb"] = _PACKED_RGB[scale_steps(pressure_pa, max_pa, gamma=gamma)]
        # Records without fields are copied 15 times as fast.
        plain = self._points.view(np.dtype((np.void, self._points.itemsize)))
        return plain[np.isfinite(pressure_pa)].view(self._points.dtype)
