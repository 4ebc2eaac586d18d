# SPDX-License-Identifier: Apache-2.0

"""Which rows a delay makes alike."""

import numpy as np
import pytest

from tactile_cdma.code.codes import code_book
from tactile_cdma.code.twins import ALIKE, SHIFTS, twins


@pytest.mark.parametrize("order", [1, 2, 4, 8, 16, 20, 24, 40, 48, 72, 104, 128, 144, 312])
def test_twins_are_the_pairs_whose_chips_are_alike(order: int) -> None:
    first, nodes = min(1, order - 1), max(1, order - 3)
    rows = code_book(order).matrix[first : first + nodes].astype(float)
    apart = np.concatenate((rows, np.zeros_like(rows)), axis=1)
    for shift in SHIFTS:
        moved = np.roll(apart, -shift, axis=1)  # the chips that wrap are those of the bit beside
        share = moved[:, :order] @ rows.T / order
        beside = np.roll(np.tile(rows, 2), -shift, axis=1)[:, :order] @ rows.T / order - share
        expected = {
            (i, j): (share[i, j], beside[i, j])
            for i, j in np.argwhere(np.abs(share) > ALIKE).tolist()
            if i != j or share[i, j] < 0
        }
        found = twins(order, first, nodes)
        found = found[found["shift"] == shift]
        assert set(zip(found["sent"].tolist(), found["alike"].tolist(), strict=True)) == set(
            expected
        )
        for pair in found:
            told = pair["share"], pair["wrap"]
            assert told == pytest.approx(expected[int(pair["sent"]), int(pair["alike"])], abs=1e-6)


def test_twins_of_the_largest_book_are_found_at_once() -> None:
    """Which took minutes when all rows were correlated with all others."""
    assert twins(65_536, 1, 65_535).size > 65_536
