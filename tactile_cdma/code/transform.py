# SPDX-License-Identifier: Apache-2.0

"""Correlation with all rows of a code book at once, and its inverse, spreading.

A book is a Kronecker product A ⊗ B ⊗ …, so correlating means multiplying each axis of the chips,
seen as an array of shape (a, b, …), by its own small matrix: O(N·(a + b + …)) instead of O(N²). The
compiled kernel does it (kernel/transform.h).
"""

import math
from functools import lru_cache

import numpy as np

from ..base import kernel
from ..base.arrays import Floats32
from ..base.errors import SpecError
from .codes import CodeBook
from .frame import FrameSpec


def correlate(chips: Floats32, book: CodeBook, out: Floats32 | None = None) -> Floats32:
    """Amplitude of every code row in every bit.

    chips: (…, N) float32, V. Returns (…, N) float32, V: entry r is ±a for an active node on
    row r, 0 for silence. Liu et al. eq. 3, scaled by 1/N. In noise the error is below 2⁻²² of the
    chips' RMS, in the worst case (a lone node or an offset) 2⁻¹⁷.
    out: takes the result instead of a new array; contiguous, and no part of chips.
    Raises SpecError where chips or out do not fit the book.
    """
    return _multiply(chips, book.order, transform_of(book.plan), out)


def spread(symbols: Floats32, book: CodeBook) -> Floats32:
    """The sum of all code rows, each times its symbol: (…, N) float32 to chips (…, N) float32.

    What correlate takes apart: correlate(spread(x)) == x. Errors as there.
    """
    return _multiply(symbols, book.order, transform_of(book.plan, spreading=True))


def rows_of(chips: Floats32, spec: FrameSpec) -> Floats32:
    """Correlation of every row with every bit's chips: (…, k, N) float32, V, of such chips.

    Of sparse codes (…, k, 2^m); what other rows hold is in each of them, as noise.
    """
    if spec.flips is not None:
        chips = np.multiply(chips, spec.flips, dtype=np.float32)
    if not spec.sparse:
        return correlate(chips, spec.book)
    scattered = np.zeros((*chips.shape[:-1], spec.row_count), np.float32)
    flat = scattered.reshape(-1, spec.line_bits * spec.row_count)
    flat[:, spec.code_places] = chips.reshape(-1, spec.chips)
    flat *= np.float32(spec.row_count / spec.order)
    return np.ascontiguousarray(correlate(scattered, spec.book)[..., spec.code_numbers])


def chips_of(rows: Floats32, spec: FrameSpec) -> Floats32:
    """The chips in which every row has this level: the inverse, but for sparse codes."""
    if not spec.sparse:
        chips = spread(rows, spec.book)
    else:
        codes = np.empty_like(rows)
        codes[..., spec.code_numbers] = rows
        chips = spread(codes, spec.book).reshape(-1, spec.line_bits * spec.row_count)
        chips = chips[:, spec.code_places].reshape(*rows.shape[:-1], spec.order)
    return chips if spec.flips is None else chips * spec.flips


class Transform(kernel.Held):
    """Multiplies in the kernel (kernel/transform.h); scaled by 1/N unless spreading."""

    def __init__(self, plan: tuple[int, ...], spreading: bool, lanes: int = 0) -> None:
        """lanes: 1, 4 or 8; 0 for what the processor has. Raises ValueError for others."""
        orders = [order for order in plan if order > 2]
        factors = [CodeBook((order,)).matrix for order in orders]
        signs = [np.array(m.T if spreading else m, np.int8, order="C") for m in factors]
        matrices = [kernel.pointer(m, order, order) for m, order in zip(signs, orders, strict=True)]
        self.order = math.prod(plan)
        scale = 1.0 if spreading else 1.0 / self.order
        library = kernel.lib
        made = library.transform_new(plan.count(2), len(orders), orders, matrices, scale, lanes)
        super().__init__(made, library.transform_free)

    def multiply(self, source: Floats32, out: Floats32, /) -> None:
        """Multiply vectors (…, N). Raises ValueError where out has another shape, or is a part."""
        count, left = divmod(source.size, self.order)
        if left:
            raise ValueError(f"{source.size} values are no vectors of order {self.order}")
        if source is not out and np.may_share_memory(source, out):
            raise ValueError("source and out overlap")
        values = kernel.pointer(source, *source.shape)
        result = kernel.pointer(out, *source.shape, written=True)
        kernel.lib.transform_multiply(self.at, values, result, count)


@lru_cache(maxsize=64)
def transform_of(plan: tuple[int, ...], spreading: bool = False) -> Transform:
    """The product with a code book of this plan, scaled by 1/N unless spreading."""
    return Transform(plan, spreading)


def _multiply(
    vectors: Floats32, order: int, transform: Transform, out: Floats32 | None = None
) -> Floats32:
    """The product of vectors (…, N), in out or a new array."""
    values = np.ascontiguousarray(vectors, dtype=np.float32)
    if values.shape[-1] != order:
        raise SpecError(f"{values.shape[-1]} chips per bit do not fit a code book of order {order}")
    if out is None:
        out = np.empty(values.shape, np.float32)
    elif out.shape != values.shape or out.dtype != np.float32 or not out.flags.c_contiguous:
        raise SpecError(f"out must be contiguous float32 of shape {values.shape}")
    transform.multiply(values, out)
    return out
