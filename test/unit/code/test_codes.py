# SPDX-License-Identifier: Apache-2.0

"""Hadamard code books and the frames made of them: derived quantities, refusals, the encoder."""

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
from tactile_cdma.code.encode import line_chips, word_bits
from tactile_cdma.code.frame import FrameSpec

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


SCRAMBLED = {"scramble": True}
SPARSE = {"codes": "sparse", "nodes": 100, "order": 32, "frame_period_s": 1.0}


def test_defaults_keep_row_zero_free_and_fit_the_papers_period() -> None:
    spec = FrameSpec()
    assert (spec.nodes, spec.order, spec.chips) == (16, 20, 200)
    assert 0 not in spec.rows
    assert spec.frame_s == pytest.approx(10e-3)
    assert set(spec.rows) | set(range(20)[spec.spare_rows]) | {0} == set(range(20))


def test_the_papers_book_is_selectable() -> None:
    spec = FrameSpec(order=16, first_row=0, sign_seed=None)
    assert spec.frame_s == pytest.approx(8e-3)
    assert list(spec.rows) == list(range(16))
    assert (spec.signs == 1).all()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"order": 16}, "16 nodes from row 1 on need 17 code rows.*use order 20"),
        ({"nodes": 20, "order": 16, "first_row": 0}, "use order 20"),
        ({"order": 92}, "nearest feasible orders are 88 and 96"),
        ({"chip_s": 100e-6}, "lasts 20 ms, longer than its period of 12.8 ms: .* to 21 or more"),
        ({"drive": "unipolar", "first_row": 0, "order": 16}, "cannot use code row 0"),
        ({"drive": "tripolar"}, "'tripolar'.*'bipolar' or 'unipolar'"),
        ({"polarity": 0}, "polarity is 0"),
        ({"bits": 7}, "bits is 7; it must lie within 8…16"),
        ({"bits": 17}, "8…16"),
        ({"nodes": 0}, "nodes is 0"),
        ({"chip_s": float("nan")}, "chip_s is nan"),
        ({"amplitude_v": -0.3}, "amplitude_v is -0.3"),
        ({"sign_seed": 2**32}, "sign_seed"),
        ({"resync_chips": 32}, "resync_chips is 32 and guard_chips 0"),
        ({"guard_chips": 1}, "resync_chips is 0 and guard_chips 1"),
        (SCRAMBLED | {"nodes": 1, "order": 2, "first_row": 0}, "order is 2: rows of fewer than 4"),
        (SCRAMBLED | {"drive": "unipolar"}, "would show in all rows"),
        (SCRAMBLED | {"sign_seed": None}, "from sign_seed"),
        (SPARSE | {"drive": "unipolar"}, "unipolar drive cannot be: .* set drive to bipolar"),
        (SPARSE | {"first_row": 0}, "set first_row to 1"),
        (SPARSE | {"order": 7}, "8 to 4096 chips"),
        (SPARSE | {"order": 5000}, "8 to 4096 chips"),
        (SPARSE | {"sign_seed": None}, "sign_seed"),
        (SPARSE | {"nodes": 65_536}, "65535 at most"),
    ],
)
def test_impossible_combinations_are_refused_with_the_reason(fields: dict, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        FrameSpec(**fields)


@given(st.integers(8, 16), st.data())
def test_bits_are_most_significant_first(bits: int, data: st.DataObject) -> None:
    codes = data.draw(st.lists(st.integers(0, 2**bits - 1), min_size=1, max_size=8))
    for code, row in zip(codes, word_bits(codes, bits), strict=True):
        assert "".join(map(str, row)) == format(code, f"0{bits}b")


@pytest.mark.parametrize("code", [-1, 1024])
def test_codes_that_do_not_fit_are_refused(code: int) -> None:
    with pytest.raises(SpecError, match=rf"code {code} does not fit 10 bits"):
        word_bits([0, code], 10)


@given(
    st.integers(1, 300),
    st.sampled_from(["bipolar", "unipolar"]),
    st.sampled_from([1, -1]),
    st.integers(0, 1000),
)
def test_chips_follow_the_definition_for_any_number_of_nodes(
    nodes: int, drive: str, polarity: int, seed: int
) -> None:
    spec = FrameSpec(nodes=nodes, chip_s=1e-6, drive=drive, polarity=polarity, sign_seed=seed)
    rng = np.random.default_rng(seed)
    codes, active = rng.integers(0, 1024, nodes), rng.random(nodes) < 0.7
    own = spec.signs[:, None] * spec.book.rows(spec.rows).astype(float)  # (n, N), of ±1
    bits = 2 * word_bits(codes, 10).astype(int) - 1  # (n, k), of ±1
    total = bits[active].T @ own[active]  # (k, N): of all who speak
    expected = polarity * 0.3 * (total if drive == "bipolar" else (total + active.sum()) / 2)
    assert np.allclose(line_chips(spec, codes, active), expected, atol=1e-5 * nodes)
