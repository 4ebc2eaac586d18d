# SPDX-License-Identifier: Apache-2.0

"""Correlation with all rows of a code book at once, and its inverse, spreading.

A book is a Kronecker product A ⊗ B ⊗ …, so correlating means multiplying each axis of the chips,
seen as an array of shape (a, b, …), by its own small matrix: O(N·(a + b + …)) instead of O(N²).
Each stage multiplies the slowest axis and leaves it as the fastest one, which costs no copy, as
BLAS reads transposed matrices; after the last stage the axes are back in order. Small factors are
merged to blocks that suit BLAS.

The compiled kernel (kernel/transform.h) does the same with fewer operations.
"""

from __future__ import annotations

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

_LARGEST_BLOCK = 128
"""Order to which factors are merged: few stages, none much larger than it needs. Chosen."""
_BLAS_PRODUCTS = 1 << 18
"""Multiplications in one BLAS call. OpenBLAS spreads longer ones over its threads, which then wait
for each other: milliseconds, on a machine that has anything else to do."""
_LEAST_ROWS = 32
"""Rows of a product below which packing the block's matrix for BLAS dominates its time. Measured
when it was introduced."""
_CHUNK = MAX_ORDER
"""Values that pass through all stages together: one scratch buffer of 256 kB serves any batch, and
intermediate results stay in the cache."""


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


class _Dense:
    """A stage for BLAS: matrix (order, order) applied from the right.

    One product is split into many, of some rows and columns each; see _BLAS_PRODUCTS.
    """

    def __init__(self, matrix: Floats32, rest: int) -> None:
        """rest: product of the other blocks' orders."""
        order = len(matrix)
        self.matrix, self.rest = matrix, rest
        rows = max(d for d in range(1, min(rest, _most_rows(order)) + 1) if rest % d == 0)
        self._from = (-1, order, rest // rows, rows)
        self._to = (-1, rest // rows, rows, order)

    def apply(self, values: Floats32, result: Floats32) -> None:
        """(c, order·rest) to (c, rest·order)."""
        if self.rest > 1:
            values = values.reshape(self._from).transpose(0, 2, 3, 1)
            result = result.reshape(self._to)
        rows, order = values.shape[-2:]
        columns = _BLAS_PRODUCTS // (rows * order)
        if columns >= order:
            np.matmul(values, self.matrix, out=result)
            return
        for start in range(0, order, columns):
            part = slice(start, start + columns)
            np.matmul(values, self.matrix[:, part], out=result[..., part])


class _Scratch(threading.local):
    """A buffer for intermediate results; each thread has its own."""

    def __init__(self) -> None:
        self.values = np.empty(_CHUNK, dtype=np.float32)


_scratch = _Scratch()


@dataclass(frozen=True)
class _Stages:
    """The product as stages in numpy. most: vectors that go through them together."""

    order: int
    stages: tuple[_Dense, ...]
    most: int

    def multiply(self, source: Floats32, out: Floats32, /) -> None:
        """As Transform."""
        source, result = source.reshape(-1, self.order), out.reshape(-1, self.order)
        count = len(source)
        parts = -(-count // self.most)
        for part in range(parts):  # of about equal size
            chosen = slice(part * count // parts, (part + 1) * count // parts)
            values, to_scratch = source[chosen], len(self.stages) % 2 == 0
            for stage in self.stages:  # by turns, so that the last one writes the result
                goal = _scratch.values[: values.size] if to_scratch else result[chosen]
                stage.apply(values, goal)
                values, to_scratch = goal, not to_scratch


@lru_cache(maxsize=64)
def transform_of(plan: tuple[int, ...], spreading: bool = False) -> Transform:
    """The product with a code book of this plan, scaled by 1/N unless spreading."""
    if kernel.compiled is not None:
        return compiled_transform(plan, spreading)
    return numpy_transform(plan, spreading)


def compiled_transform(plan: tuple[int, ...], spreading: bool, lanes: int = 0) -> Transform:
    """That of the kernel. lanes: 1, 4 or 8; 0 for what the processor has."""
    assert kernel.compiled is not None
    orders = [order for order in plan if order > 2]
    factors = [CodeBook((order,)).matrix for order in orders]
    signs = [(matrix.T if spreading else matrix).astype(np.int8).ravel() for matrix in factors]
    transform: Transform = kernel.compiled.Transform(
        plan.count(2),
        np.array(orders, np.uintc),
        np.concatenate([np.zeros(0, np.int8), *signs]),
        1.0 if spreading else 1.0 / math.prod(plan),
        lanes,
    )
    return transform


def numpy_transform(plan: tuple[int, ...], spreading: bool) -> Transform:
    """That of numpy; the first stage of those that correlate scales."""
    order = math.prod(plan)
    stages: list[_Dense] = []
    for group in _blocks(plan):
        block = math.prod(group)
        scale = 1.0 if spreading or stages else 1.0 / order
        matrix = CodeBook(group).matrix if spreading else CodeBook(group).matrix.T
        stages.append(_Dense((matrix * scale).astype(np.float32, order="C"), order // block))
    most = _most_rows(order) if len(stages) == 1 else _CHUNK // order
    return _Stages(order, tuple(stages), most)


def _most_rows(order: int) -> int:
    """Rows of one BLAS product with a block; products of few large rows are split by columns."""
    return max(_BLAS_PRODUCTS // order**2, _LEAST_ROWS)


def _blocks(plan: tuple[int, ...]) -> list[tuple[int, ...]]:
    """The plan's factors, merged with their neighbours to blocks of up to _LARGEST_BLOCK."""
    blocks: list[tuple[int, ...]] = []
    for factor in plan:
        if blocks and math.prod(blocks[-1]) * factor <= _LARGEST_BLOCK:
            blocks[-1] += (factor,)
        else:
            blocks.append((factor,))
    return blocks
