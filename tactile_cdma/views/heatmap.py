# SPDX-License-Identifier: Apache-2.0

"""Pressure as a picture: colours and rasters, shared by the Image topic and the terminal."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..places.layout import Layout

_STOPS = (
    (0.00, (6, 8, 30)),
    (0.20, (65, 18, 105)),
    (0.40, (145, 40, 110)),
    (0.60, (215, 70, 65)),
    (0.80, (250, 155, 30)),
    (1.00, (252, 250, 180)),
)
"""A dark-to-light scale whose brightness rises evenly, so it also reads in grey."""
NO_READING_RGB = (70, 78, 86)
NO_TAXEL_RGB = (24, 26, 30)
MAX_PIXELS = 1 << 20


def _scale() -> NDArray[np.uint8]:
    at = np.linspace(0, 1, 256)
    places = [place for place, _ in _STOPS]
    channels = [np.interp(at, places, [rgb[c] for _, rgb in _STOPS]) for c in range(3)]
    table = np.stack(channels, axis=1).round().astype(np.uint8)
    return np.vstack([table, np.array([NO_READING_RGB], dtype=np.uint8)])


SCALE_RGB = _scale()
"""(257, 3) uint8: 256 steps of pressure, and what has no reading."""
_NO_TAXEL = np.array([NO_TAXEL_RGB], dtype=np.uint8)


def scale_steps(pressure_pa: NDArray[np.float32], max_pa: float) -> NDArray[np.int16]:
    """(n,) int16, each taxel's row of SCALE_RGB on a fixed scale 0…max_pa; the last where NaN."""
    with np.errstate(invalid="ignore"):
        step = np.clip(pressure_pa * (255 / max_pa), 0, 255).astype(np.int16)
    return np.where(np.isnan(pressure_pa), np.int16(256), step)


def colours(pressure_pa: NDArray[np.float32], max_pa: float) -> NDArray[np.uint8]:
    """One colour per taxel, (n, 3) uint8 RGB, on a fixed scale 0…max_pa; grey where NaN."""
    return SCALE_RGB[scale_steps(pressure_pa, max_pa)]


def heatmap(
    pressure_pa: NDArray[np.float32], layout: Layout, max_pa: float, pixels: int
) -> NDArray[np.uint8]:
    """The unrolled skin as a picture, (height, width, 3) uint8 RGB, row 0 on top.

    pressure_pa: (t,) float32, Pa. pixels: edge length of a square of one pitch; less is drawn
    where the picture would pass MAX_PIXELS.
    """
    raster = layout.raster
    pixels_per_cell = round(pixels * layout.cell_m / layout.pitch_m)
    edge = max(1, min(pixels_per_cell, math.isqrt(MAX_PIXELS // raster.size)))
    paint = np.vstack([colours(pressure_pa, max_pa), _NO_TAXEL])
    # Rows last: these are copied whole, six times as fast as pixels.
    return paint[raster].repeat(edge, axis=1).repeat(edge, axis=0)


def pressure_raster(pressure_pa: NDArray[np.float32], layout: Layout) -> NDArray[np.float32]:
    """The unrolled skin's pressures, (h, w) float32, Pa, one per cell of the layout's raster.

    pressure_pa: (t,) float32, Pa. NaN where there is no taxel, or a taxel without a reading.
    """
    return np.append(pressure_pa, np.float32(np.nan))[layout.raster]
