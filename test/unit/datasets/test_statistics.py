# SPDX-License-Identifier: Apache-2.0

"""Statistics kept row by row are those of the whole, wherever the values lie."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.datasets.lerobot.writer import Statistics

NAMES = ("min", "max", "mean", "std")


@given(
    st.lists(st.lists(st.floats(-1e5, 1e5) | st.just(np.nan), min_size=3, max_size=3), min_size=1),
    st.sampled_from([0.0, 101_325.0, 1e12]),
    st.booleans(),
)
def test_they_are_those_of_the_finite_values(
    rows: list[list[float]], far: float, pooled: bool
) -> None:
    """Truth is numpy's, of the values before they were moved far away."""
    table = np.array(rows)
    statistics = Statistics((3,), (0,) if pooled else ())
    for row in table:
        statistics.add(row + far, valid=np.ones(3, dtype=bool))
    found = statistics.content()
    for element in range(3):
        column = table if pooled else table[:, element]
        if known := column[np.isfinite(column)].tolist():
            expected = [np.min(known), np.max(known), np.mean(known)]
            moved = [found[name][element] - far for name in NAMES[:3]]
            assert moved == pytest.approx(expected, abs=1e-6 + far * 1e-14)
            assert found["std"][element] == pytest.approx(np.std(known), abs=1e-2, rel=1e-6)
        else:
            assert [found[name][element] for name in NAMES] == [0, 0, 0, 0]
    assert statistics.not_finite == np.count_nonzero(np.isnan(table))
