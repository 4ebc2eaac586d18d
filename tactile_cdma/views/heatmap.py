# SPDX-License-Identifier: Apache-2.0

"""Pressure as a picture: colours and rasters, for the Image topics and the terminal."""

import math

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools, Floats32
from ..places.layout import Layout

_STOPS = (
    (0.00, (6, 8, 30)),
    (0.11, (65, 18, 105)),
    (0.25, (145, 40, 110)),
    (0.39, (215, 70, 65)),
    (0.66, (250, 155, 30)),
    (1.00, (252, 250, 180)),
)
"""A scale from dark to light, (share, RGB), whose luma rises evenly: readable in grey, too."""
NO_READING_RGB = (70, 78, 86)
NO_TAXEL_RGB = (24, 26, 30)
GAMMA = 0.5
"""Exponent of the scale by default: a share p of the top pressure is p^GAMMA up the colours.
Chosen: 2 kPa of 140 is an eighth of the scale away from 0, 100 kPa a sixth from the top."""
MAX_PIXELS = 1 << 20
"""Limit of a heatmap's size, chosen: 3 MB per picture at up to 30 Hz."""
LEAST_LINED_PX = 8
"""Narrower cells have no lines between them; chosen: a line takes an eighth at most."""


_AT, _RGB = zip(*_STOPS, strict=True)
_CHANNELS = [np.interp(np.linspace(0, 1, 256), _AT, channel) for channel in zip(*_RGB, strict=True)]
_STEPS = np.stack(_CHANNELS, axis=1).round()
_PALE = (_STEPS + NO_READING_RGB) / 2
SCALE_RGB = np.vstack([_STEPS, [NO_READING_RGB], _PALE]).astype(np.uint8)
"""(513, 3) uint8: 256 steps of pressure, the colour of taxels without a reading, and 256 steps of
uncertain readings, half as colourful."""
_NO_TAXEL = np.array([NO_TAXEL_RGB], dtype=np.uint8)


def shares(pressure_pa: Floats32, max_pa: float, gamma: float = GAMMA) -> Floats32:
    """Tell how far up the scale 0…max_pa each pressure is, (n,) float32, 0…1; NaN for NaN."""
    share: Floats32 = np.clip(pressure_pa * np.float32(1 / max_pa), 0, 1) ** gamma
    return share


def scale_steps(
    pressure_pa: Floats32, max_pa: float, unsure: Bools | bool = False, gamma: float = GAMMA
) -> NDArray[np.int16]:
    """Find each taxel's row in SCALE_RGB on a fixed scale 0…max_pa, (n,) int16; 256 for NaN.

    unsure: (n,), readings that are uncertain. gamma: see GAMMA.
    """
    with np.errstate(invalid="ignore"):
        step = (shares(pressure_pa, max_pa, gamma) * 255).astype(np.int16)
    step += np.where(unsure, np.int16(257), np.int16(0))
    return np.where(np.isnan(pressure_pa), np.int16(256), step)


def colours(
    pressure_pa: Floats32, max_pa: float, unsure: Bools | bool = False, gamma: float = GAMMA
) -> NDArray[np.uint8]:
    """Colour each taxel, (n, 3) uint8 RGB, see scale_steps; grey for NaN."""
    return SCALE_RGB[scale_steps(pressure_pa, max_pa, unsure, gamma)]


def heatmap(
    pressure_pa: Floats32,
    layout: Layout,
    max_pa: float,
    pixels: int,
    unsure: Bools | bool = False,
    gamma: float = GAMMA,
) -> NDArray[np.uint8]:
    """Draw the unrolled skin, (height, width, 3) uint8 RGB, row 0 on top.

    Cells of LEAST_LINED_PX and more have lines between taxels, in the colour of no taxel.

    pressure_pa: (t,) float32, Pa. pixels: edge of a square of one pitch (with two: of that area),
    reduced if the picture would exceed MAX_PIXELS. unsure, gamma: see scale_steps.
    """
    raster = layout.raster
    per_cell = round(pixels * layout.cell_m / layout.pitch_m)
    per_cell = min(per_cell, math.isqrt(MAX_PIXELS // raster.size))
    stretched = 1.0 if layout.irregular else math.sqrt(layout.aspect)
    wide, tall = (max(1, int(per_cell * share)) for share in (stretched, 1 / stretched))
    cells = np.vstack([colours(pressure_pa, max_pa, unsure, gamma), _NO_TAXEL])[raster]
    lined = wide >= LEAST_LINED_PX and tall >= LEAST_LINED_PX
    beside, beneath = (_ends(raster, axis)[..., None] & lined for axis in (1, 0))
    # Rows last: they are copied whole, six times as fast as pixels.
    rows = [part.repeat(wide, axis=1) for part in (cells, np.where(beneath, _NO_TAXEL, cells))]
    for row, lines in zip(rows, (beside, beside | beneath), strict=True):
        row.reshape(len(raster), -1, wide, 3)[:, :, -1] = np.where(lines, _NO_TAXEL, cells)
    picture = rows[0].repeat(tall, axis=0)
    picture[tall - 1 :: tall] = rows[1]
    return picture


def _ends(raster: NDArray[np.int32], axis: int) -> NDArray[np.bool_]:
    """Tell whether a cell is the last of its taxel along an axis, with another one after it."""
    return np.asarray(np.diff(raster, axis=axis, append=raster.take([-1], axis=axis)) != 0)


def pressure_raster(pressure_pa: Floats32, layout: Layout) -> Floats32:
    """Return the unrolled skin's pressures, (h, w) float32, Pa, one per cell of the raster.

    pressure_pa: (t,) float32, Pa. NaN where there is no taxel, or a taxel without a reading.
    """
    return np.append(pressure_pa, np.float32(np.nan))[layout.raster]
