# SPDX-License-Identifier: Apache-2.0

"""Correlation with all rows of a code book at once, and its inverse, spreading.

A book is a Kronecker product A ⊗ B ⊗ …, so correlating means multiplying each axis of the chips,
seen as an array of shape (a, b, …), by its own small matrix: O(N·(a + b + …)) instead of O(N²).
Each stage multiplies the slowest axis and leaves it as the fastest one, without a copy, as BLAS
reads transposed matrices; at last the axes are in order again. Small factors are merged for BLAS.

The compiled kernel (kernel/transform.h) does the same with fewer operations.
"""

import math
import threading
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

from ..base import kernel
from ..base.arrays import Floats32
from ..base.errors import SpecError
from .codes import MAX_ORDER, CodeBook
from .frame import FrameSpec

_LARGEST_BLOCK = 128
"""Order to which factors are merged: few stages, none much larger than it needs. Chosen."""
_BLAS_PRODUCTS = 1 << 18
"""Multiplications in one BLAS call. OpenBLAS spreads longer ones over its threads, which then wait
for each other: milliseconds, on a machine that has anything else to do."""


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


class Transform(Protocol):
    """Product with a code book, prepared once."""

    def multiply(self, source: Floats32, out: Floats32, /) -> None:
        """Multiply vectors (…, N), into contiguous memory of the same size."""


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


class _Scratch(threading.local):
    """Memory for intermediate results; each thread has its own."""

    def __init__(self) -> None:
        self.values = np.empty(MAX_ORDER, dtype=np.float32)


_scratch = _Scratch()


@dataclass(frozen=True)
class _Blocks:
    """The product in numpy. matrices: of the blocks, applied from the right."""

    order: int
    matrices: list[Floats32]

    def multiply(self, source: Floats32, out: Floats32, /) -> None:
        """As Transform."""
        vectors, results = source.reshape(-1, self.order), out.reshape(-1, self.order)
        most, last = MAX_ORDER // self.order, len(self.matrices) - 1
        for start in range(0, len(vectors), most):
            values, result = vectors[start : start + most], results[start : start + most]
            spare = _scratch.values[: values.size].reshape(values.shape)
            for i, matrix in enumerate(self.matrices):  # by turns, so that the last is in result
                goal = spare if (last - i) % 2 else result
                self._apply(matrix, values, goal)
                values = goal

    def _apply(self, matrix: Floats32, values: Floats32, goal: Floats32) -> None:
        """Multiply the slowest axis of vectors (c, N), and leave it as the fastest one of goal."""
        count, block = len(values), len(matrix)
        turned = values.reshape(count, block, -1).transpose(0, 2, 1)
        goal, columns = goal.reshape(count, -1, block), _BLAS_PRODUCTS // self.order
        for start in range(0, block, columns):
            part = slice(start, start + columns)
            np.matmul(turned, matrix[:, part], out=goal[..., part])


@lru_cache(maxsize=64)
def transform_of(plan: tuple[int, ...], spreading: bool = False) -> Transform:
    """The product with a code book of this plan, scaled by 1/N unless spreading."""
    if kernel.compiled is not None:
        return CompiledTransform(plan, spreading)
    return numpy_transform(plan, spreading)


class CompiledTransform(kernel.Held):
    """Multiplies in the kernel (kernel/transform.h); scaled by 1/N unless spreading."""

    def __init__(self, plan: tuple[int, ...], spreading: bool, lanes: int = 0) -> None:
        """lanes: 1, 4 or 8; 0 for what the processor has. Raises ValueError for others."""
        orders = [order for order in plan if order > 2]
        factors = [CodeBook((order,)).matrix for order in orders]
        signs = [np.array(m.T if spreading else m, np.int8, order="C") for m in factors]
        matrices = [kernel.pointer(m, order, order) for m, order in zip(signs, orders, strict=True)]
        self.order = math.prod(plan)
        scale = 1.0 if spreading else 1.0 / self.order
        library = kernel.compiled
        made = library.transform_new(plan.count(2), len(orders), orders, matrices, scale, lanes)
        super().__init__(made, library.transform_free)

    def multiply(self, source: Floats32, out: Floats32, /) -> None:
        """As Transform. Raises ValueError where out is not of source's shape, or a part of it."""
        count, left = divmod(source.size, self.order)
        if left:
            raise ValueError(f"{source.size} values are no vectors of order {self.order}")
        if source is not out and np.may_share_memory(source, out):
            raise ValueError("source and out overlap")
        values = kernel.pointer(source, *source.shape)
        result = kernel.pointer(out, *source.shape, written=True)
        kernel.compiled.transform_multiply(self.at, values, result, count)


def numpy_transform(plan: tuple[int, ...], spreading: bool) -> Transform:
    """That of numpy; the first block of those that correlate scales."""
    books = [CodeBook(block).matrix for block in _blocks(plan)]
    matrices = [(book if spreading else book.T).astype(np.float32, order="C") for book in books]
    order = math.prod(plan)
    if not spreading:
        matrices[0] *= np.float32(1.0 / order)
    return _Blocks(order, matrices)


def _blocks(plan: tuple[int, ...]) -> list[tuple[int, ...]]:
    """The plan's factors, merged with their neighbours to blocks of up to _LARGEST_BLOCK."""
    blocks: list[tuple[int, ...]] = []
    for factor in plan:
        if blocks and math.prod(blocks[-1]) * factor <= _LARGEST_BLOCK:
            blocks[-1] += (factor,)
        else:
            blocks.append((factor,))
    return blocks
