# SPDX-License-Identifier: Apache-2.0

"""Fast correlation equals the matrix product for orders of every kind, within a stated error."""

import threading
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.codes import code_book
from tactile_cdma.code.transform import correlate, spread
from test.support.examples import examples

BLOCKS = [1, 2, 4, 12, 20, 64, 128, 148, 244, 388]  # one dense block
PRODUCTS = [144, 256, 400, 1024, 1040, 4096, 4144, 4160, 16_384, 65_520, 65_536]  # several
LARGE = [676, 1020, 1032, 2040]
"""With a large factor: Paley I over 1019, II over 337 and 257, and products."""
USUAL, BOUND = 2.0**-22, 2.0**-17
"""Error of a correlation over the RMS of its chips: in noise, and in the worst frames, where all
products of a sum are equal and its roundings add up."""


def reference(chips: np.ndarray, order: int, rows: np.ndarray) -> np.ndarray:
    """Some correlations in float64, from the rows themselves."""
    return chips.astype(np.float64) @ code_book(order).rows(rows).T.astype(np.float64) / order


def error(chips: np.ndarray, order: int, rows: np.ndarray) -> float:
    """Largest error of some correlations, over the RMS of the chips of their bit."""
    chips = chips.astype(np.float32)
    rms = np.sqrt(np.square(chips.astype(np.float64)).mean(axis=-1, keepdims=True))
    found = correlate(chips, code_book(order))[..., rows]
    return float(np.max(np.abs(found - reference(chips, order, rows)) / rms))


def some_rows(order: int) -> np.ndarray:
    rng = np.random.default_rng(order)
    return np.unique([0, 1 % order, order - 1, *rng.integers(0, order, 12)])


@pytest.mark.parametrize("order", BLOCKS + PRODUCTS + LARGE)
def test_correlation_is_the_product_with_the_rows(order: int) -> None:
    chips = np.random.default_rng(order).normal(size=(3, order))
    assert error(chips, order, some_rows(order)) < USUAL


@pytest.mark.parametrize("order", BLOCKS + PRODUCTS + LARGE)
def test_correlation_takes_apart_what_spreading_adds_up(order: int) -> None:
    symbols = np.random.default_rng(order).normal(size=(2, order)).astype(np.float32)
    chips = spread(symbols, code_book(order))
    assert np.abs(correlate(chips, code_book(order)) - symbols).max() < 1e-5


@examples(40)
@given(st.sampled_from([20, 312, 1024, 1040, 4160, 65_536]), st.integers(0, 2**32 - 1), st.data())
def test_error_stays_within_the_bound_for_harsh_frames(
    order: int, seed: int, data: st.DataObject
) -> None:
    """A strong code beside others down to 60 dB weaker, an offset of up to 1000 amplitudes."""
    rng = np.random.default_rng(seed)
    symbols = rng.choice([-1.0, 1.0], order) * 10 ** -rng.uniform(0, 3, order)
    symbols[:: data.draw(st.integers(2, 20))] = 0.0
    symbols[0] = data.draw(st.floats(-1000, 1000))
    chips = spread(symbols.astype(np.float32), code_book(order)) * 10 ** rng.uniform(-30, 30)
    assert error(chips, order, some_rows(order)) < BOUND


@pytest.mark.parametrize("order", [16, 20, 312, 1040, 4096, 65_520, 65_536])
@pytest.mark.parametrize("row", [0, -1])
def test_a_lone_node_keeps_its_amplitude(order: int, row: int) -> None:
    """Up to the rails of int16; on row 0 it is an offset."""
    amplitude = np.append(np.random.default_rng(order).uniform(0.1, 1.0, 50), [32_767, -32_768])
    amplitude = amplitude[:, None].astype(np.float32)
    chips = amplitude * code_book(order).rows([row % order]).astype(np.float32)
    found = correlate(chips, code_book(order))
    found[:, row] -= amplitude[:, 0]
    assert (np.abs(found) < BOUND * np.abs(amplitude)).all()


@pytest.mark.parametrize("order", [16, 20, 148, 1024, 1040, 4096, 65_536])
def test_integer_sums_below_2_to_24_are_exact(order: int) -> None:
    rng = np.random.default_rng(order)
    symbols = rng.integers(-1, 2, order) * (2**24 // order - 1)
    chosen = some_rows(order)
    book = code_book(order)
    mirrored = book.rows(chosen).astype(np.int64).T  # columns of the transposed book
    chips = spread(symbols.astype(np.float32), book)
    only = np.zeros(order, dtype=np.int64)
    only[chosen] = symbols[chosen]
    assert np.array_equal(chips, np.rint(chips))
    assert np.array_equal(spread(only.astype(np.float32), book), mirrored @ only[chosen])
    if order & (order - 1) == 0:  # 1/N is exact too
        sums = correlate(symbols.astype(np.float32), book)[chosen].astype(np.float64) * order
        assert np.array_equal(sums, mirrored.T @ symbols)


@pytest.mark.parametrize("order", [20, 1024, 4160, 65_536])
def test_denormal_chips_do_no_harm(order: int) -> None:
    chips = np.full((2, order), 1e-42, dtype=np.float32)
    found = correlate(chips, code_book(order))
    exact = np.where(np.arange(order) == 0, chips[0, 0], np.float32(0))
    assert np.isfinite(found).all()
    assert np.abs(found - exact).max() < order * 2.0**-149


@pytest.mark.parametrize("order", [20, 160, 388, 1040, 676, 16_384])
@pytest.mark.parametrize("shape", [(), (1,), (0,), (7,), (3, 10), (2, 3, 11)])
def test_batches_of_any_shape_give_what_single_vectors_give(
    order: int, shape: tuple[int, ...]
) -> None:
    chips = np.random.default_rng(1).normal(size=(*shape, order)).astype(np.float32)
    found = correlate(chips, code_book(order))
    assert found.shape == chips.shape
    for index in np.ndindex(shape):
        alone = correlate(chips[index], code_book(order))
        assert np.abs(found[index] - alone).max() < USUAL * np.abs(chips).max()


@pytest.mark.parametrize("order", [20, 1040, 676])
def test_any_layout_and_type_of_chips_will_do(order: int) -> None:
    counts = np.random.default_rng(1).integers(-2048, 2048, (order, 12), dtype=np.int16)
    plain = np.ascontiguousarray(counts.T[::2]).astype(np.float32)
    found = correlate(counts.T[::2], code_book(order))  # type: ignore[arg-type]
    assert np.array_equal(found, correlate(plain, code_book(order)))


@pytest.mark.parametrize("order", [20, 388, 1040, 4096])
def test_with_out_nothing_is_allocated(order: int) -> None:
    chips = np.random.default_rng(1).normal(size=(16, order)).astype(np.float32)
    out = np.empty_like(chips)
    expected = correlate(chips, code_book(order))
    tracemalloc.start()
    assert correlate(chips, code_book(order), out=out) is out
    assert tracemalloc.get_traced_memory()[1] < 8192  # views and frames, no data
    tracemalloc.stop()
    assert np.array_equal(out, expected)


def test_threads_do_not_disturb_each_other() -> None:
    books = [code_book(order) for order in (4096, 4160, 4096, 2080)]
    chips = [
        np.random.default_rng(i).normal(size=(10, book.order)).astype(np.float32)
        for i, book in enumerate(books)
    ]
    expected = [correlate(c, book) for c, book in zip(chips, books, strict=True)]
    wrong = []

    def work(i: int) -> None:
        for _ in range(50):
            if not np.array_equal(correlate(chips[i], books[i]), expected[i]):
                wrong.append(i)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(len(books))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_misuse_is_refused_with_a_reason() -> None:
    book, chips = code_book(20), np.zeros((10, 20), dtype=np.float32)
    with pytest.raises(SpecError, match=r"16 chips per bit .* order 20"):
        correlate(chips[:, :16], book)
    for out in (
        np.zeros((10, 20)),
        np.zeros((9, 20), np.float32),
        np.zeros((20, 10), np.float32).T,
    ):
        with pytest.raises(SpecError, match="out must be contiguous float32"):
            correlate(chips, book, out=out)
