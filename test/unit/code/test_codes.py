# SPDX-License-Identifier: Apache-2.0

"""Hadamard code books: orthogonality, coverage of orders, row signs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.codes import (
    MAX_ORDER,
    SMALL_FACTOR,
    code_book,
    default_order,
    is_feasible,
    row_signs,
    smallest_order,
)

MULTIPLES = range(4, 1001, 4)
FEASIBLE = [order for order in MULTIPLES if is_feasible(order)]


@pytest.mark.parametrize(
    "order", [1, 2, *[n for n in FEASIBLE if n <= 260], 336, 340, 344, 500, 676, 972]
)
def test_rows_are_orthogonal_and_row_zero_is_all_ones(order: int) -> None:
    matrix = code_book(order).matrix.astype(np.float32)
    assert np.array_equal(np.abs(matrix), np.ones((order, order)))
    assert np.array_equal(matrix @ matrix.T, order * np.eye(order))
    assert (matrix[0] == 1).all()


def test_constructions_cover_what_they_are_known_to_cover() -> None:
    assert len(FEASIBLE) == 195
    assert {28, 36, 52, 244, 344} <= set(FEASIBLE)  # Paley over 27, 17, 25, 243 and 343
    assert not {92, 116, 156, 188, 668} & set(FEASIBLE)
    assert max(smallest_order(n) - n for n in range(4, 1001)) == 11


@given(st.sampled_from([1, 2, 12, 20, 48, 144, 1024, 1040]), st.data())
def test_single_rows_equal_rows_of_the_matrix(order: int, data: st.DataObject) -> None:
    rows = data.draw(st.lists(st.integers(0, order - 1), max_size=5))
    assert np.array_equal(code_book(order).rows(rows), code_book(order).matrix[rows])


@pytest.mark.parametrize("order", [1020, 4160, 16_416, 65_536])
def test_rows_of_long_codes_are_orthogonal(order: int) -> None:
    """Paley I over 1019, and products; whole, up to 4 GB."""
    chosen = np.unique([0, 1, order - 1, *np.random.default_rng(order).integers(0, order, 20)])
    rows = code_book(order).rows(chosen).astype(np.float64)
    assert np.array_equal(rows @ rows.T, order * np.eye(len(chosen)))


ROWS = st.one_of(st.integers(1, 700), st.integers(1, MAX_ORDER))


@given(ROWS)
def test_the_default_order_is_short_and_cheap(rows: int) -> None:
    smallest, order = smallest_order(rows), default_order(rows)
    assert smallest <= order <= 1.02 * smallest
    assert is_feasible(order)
    if order != smallest:
        assert max(code_book(smallest).plan) > SMALL_FACTOR >= max(code_book(order).plan)


NEIGHBOURS = [(92, ("88", "96")), (3, ("2", "4")), (668, ("664", "672"))]


@pytest.mark.parametrize(("order", "named"), NEIGHBOURS)
def test_infeasible_orders_name_their_neighbours(order: int, named: tuple[str, str]) -> None:
    with pytest.raises(SpecError) as caught:
        code_book(order)
    assert all(f" {number}" in str(caught.value) for number in (order, *named))


@pytest.mark.parametrize("order", [0, -4, 65_540])
def test_orders_out_of_range_are_refused(order: int) -> None:
    with pytest.raises(SpecError, match="65536"):
        code_book(order)


def test_rows_out_of_range_are_refused() -> None:
    with pytest.raises(SpecError, match="0 to 15"):
        code_book(16).rows([16])


def test_signs_are_fixed_balanced_and_per_row() -> None:
    rows = np.arange(4096)
    signs = row_signs(rows, 1)
    assert set(np.unique(signs)) == {-1, 1}
    assert abs(int(signs.sum())) < 4 * 64  # 4 standard deviations of fair coins
    assert np.array_equal(row_signs(rows[100:200], 1), signs[100:200])
    assert abs(int(signs @ row_signs(rows, 2).astype(int))) < 4 * 64
    assert (row_signs(rows, None) == 1).all()


def test_random_signs_lower_the_crest_of_equal_words() -> None:
    book, rows = code_book(256), np.arange(256)
    natural = np.abs(book.matrix.sum(axis=0, dtype=int)).max()
    scrambled = np.abs(row_signs(rows, 1).astype(int) @ book.matrix).max()
    assert natural == 256
    assert scrambled < 6 * 16  # 6·√n
