"""Correlation with all rows of a code book at once, and its inverse, spreading."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .codes import CodeBook, code_book

_BLOCK = 64
"""Kronecker factors are merged up to this order: dense products of that size suit BLAS best."""


def correlate(chips: NDArray[np.float32], book: CodeBook) -> NDArray[np.float32]:
    """Amplitude of every code row in every bit.

    chips: (…, N) float32, V. Returns (…, N) float32, V: entry r is ±a for an active node on
    row r, 0 for silence. Liu et al. eq. 3, scaled by 1/N. The Kronecker factors of the book are
    applied one after the other, O(N·Σ factor) instead of O(N²).
    """
    blocks = tuple(block.T for block in _blocks(book.order))
    return _multiply(chips, blocks) * np.float32(1.0 / book.order)


def spread(symbols: NDArray[np.float32], book: CodeBook) -> NDArray[np.float32]:
    """The sum of all code rows, each times its symbol: (…, N) float32 to chips (…, N) float32.

    What correlate takes apart: correlate(spread(x)) == x.
    """
    return _multiply(symbols, _blocks(book.order))


def _multiply(
    vectors: NDArray[np.float32], blocks: tuple[NDArray[np.float32], ...]
) -> NDArray[np.float32]:
    """Row vectors (…, N) times the Kronecker product of the blocks."""
    shape = vectors.shape
    values: NDArray[np.float32] = np.ascontiguousarray(vectors, dtype=np.float32)
    count = values.size // shape[-1]
    for block in reversed(blocks):
        # Transform the fastest axis and rotate it to the front; after all blocks the axes are
        # back in order.
        transformed = values.reshape(-1, len(block)) @ block
        values = transformed.reshape(count, -1, len(block)).swapaxes(1, 2)
    return values.reshape(shape)


@lru_cache(maxsize=32)
def _blocks(order: int) -> tuple[NDArray[np.float32], ...]:
    """The factors of a book merged into few float32 blocks."""
    merged: list[NDArray[np.int8]] = []
    for factor in code_book(order).factors:
        if merged and len(merged[-1]) * len(factor) <= _BLOCK:
            merged[-1] = np.kron(merged[-1], factor)
        else:
            merged.append(factor)
    return tuple(block.astype(np.float32) for block in merged)
