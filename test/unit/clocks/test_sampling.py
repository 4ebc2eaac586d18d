# SPDX-License-Identifier: Apache-2.0

"""Code rows as the digitizer sees them: instants and running sums."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.clocks.sampling import RunningSum, row_samples
from tactile_cdma.code.codes import code_book

ROWS = code_book(12).matrix
clocks = st.tuples(st.floats(-1.0, 3.0), st.floats(0.98, 1.02))


def finely(row: np.ndarray, begin: float, chip: float, instants: np.ndarray) -> np.ndarray:
    """The row's level at instants, nominal chips."""
    index = np.floor((instants - begin) / chip).astype(int)
    inside = (index >= 0) & (index < row.size)
    return np.where(inside, row[np.where(inside, index, 0)], 0)


@given(clocks, st.sampled_from([2.0, 3.0, 4.5]), st.integers(0, 11))
def test_instants_show_the_chip_that_they_fall_into(clock, per_chip: float, number: int) -> None:
    begin, chip = clock
    middles = (np.arange(40) + 0.5) / per_chip
    expected = finely(ROWS[number], begin, chip, middles)
    sharp = np.abs((middles - begin) / chip % 1 - 0.5) < 0.499
    seen = row_samples(ROWS[number][None], np.array([begin]), np.array([chip]), 0, 40, per_chip)
    assert np.allclose(seen[0][sharp], expected[sharp], atol=1e-5)


def test_any_window_shows_the_same() -> None:
    begin, chip = np.linspace(0, 2, 12), np.linspace(0.98, 1.02, 12)
    whole = row_samples(ROWS, begin, chip, 0, 60, 4.0)
    part = row_samples(ROWS, begin, chip, 17, 31, 4.0)
    assert np.array_equal(whole[:, 17:31], part)


@given(clocks, st.integers(0, 11))
def test_running_sums_correlate_with_a_row(clock, number: int) -> None:
    """The inner product with the row's samples, by two sums per chip."""
    begin, chip = clock
    per_chip, row = 3.0, ROWS[number]
    line = np.random.default_rng(0).normal(size=60)
    sums = RunningSum(line, per_chip)
    total, count = sums.until(begin + chip * np.arange(13))
    waveform = row_samples(row[None], np.array([begin]), np.array([chip]), 0, 60, per_chip)[0]
    assert np.diff(total) @ row == pytest.approx(waveform @ line, abs=1e-4)
    assert count[-1] - count[0] == pytest.approx(
        row_samples(
            np.ones((1, 12), np.int8), np.array([begin]), np.array([chip]), 0, 60, per_chip
        ).sum(),
        abs=1e-3,
    )
