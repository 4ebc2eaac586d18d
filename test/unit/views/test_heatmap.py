# SPDX-License-Identifier: Apache-2.0

"""What eyes can tell apart in the heatmap."""

import numpy as np
import pytest

from tactile_cdma.places.layout import Layout
from tactile_cdma.views.heatmap import (
    NO_READING_RGB,
    NO_TAXEL_RGB,
    SCALE_RGB,
    colours,
    heatmap,
    scale_steps,
)

TOP_PA = 140e3
LUMA = np.array([0.2126, 0.7152, 0.0722])
"""Of red, green and blue, ITU-R BT.709: what a picture in grey keeps."""


def luma(pressure_kpa: list[float], gamma: float | None = None) -> np.ndarray:
    """Of each pressure's colour, as shares of the way from zero's to the top's."""
    pressure_pa = np.array([0.0, TOP_PA / 1e3, *pressure_kpa], np.float32) * np.float32(1e3)
    options = {} if gamma is None else {"gamma": gamma}
    dark, light, *others = colours(pressure_pa, TOP_PA, **options) @ LUMA
    return (np.array(others) - dark) / (light - dark)


def test_light_and_firm_touches_are_told_apart_without_any_setting() -> None:
    two, five, hundred = luma([2.0, 5.0, 100.0])
    assert two >= 0.1
    assert five - two >= 0.05
    assert hundred <= 0.9


@pytest.mark.parametrize("gamma", [0.3, 0.5, 1.0])
def test_luma_is_a_power_of_the_pressure(gamma: float) -> None:
    pressures = [1.0, 2.0, 5.0, 20.0, 70.0, 120.0]
    expected = (np.array(pressures) * 1e3 / TOP_PA) ** gamma
    assert luma(pressures, gamma) == pytest.approx(expected, abs=0.015)


def test_no_pressure_looks_like_no_reading() -> None:
    """Nor do the pale colours of uncertain readings, which keep half of the difference."""
    scale, pale = SCALE_RGB[:256].astype(float), SCALE_RGB[257:].astype(float)
    for colour in (NO_READING_RGB, NO_TAXEL_RGB):
        assert np.linalg.norm(scale - colour, axis=1).min() > 20
    assert np.linalg.norm(pale - NO_READING_RGB, axis=1).min() > 20
    assert scale_steps(np.array([np.nan], np.float32), TOP_PA, gamma=0.1) == 256


def test_lines_are_drawn_between_taxels_and_nowhere_else() -> None:
    grid = Layout.grid(6, 2, 3, 7e-3, 5e-3)
    picture = heatmap(np.full(6, TOP_PA, np.float32), grid, TOP_PA, pixels=32)
    assert picture.shape == (64, 96, 3)
    line = (picture == NO_TAXEL_RGB).all(axis=2)
    assert np.flatnonzero(line.all(axis=1)).tolist() == [31]
    assert np.flatnonzero(line.all(axis=0)).tolist() == [31, 63]
    assert np.count_nonzero(line) == 96 + 2 * 64 - 2
    assert (picture[~line] == SCALE_RGB[255]).all()
    assert not (heatmap(np.zeros(6, np.float32), grid, TOP_PA, 7) == NO_TAXEL_RGB).all(axis=2).any()
