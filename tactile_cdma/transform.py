"""Correlation with all rows of a code book at once, and its inverse, spreading.

A book is a Kronecker product A ⊗ B ⊗ …, so correlating means multiplying each axis of the chips,
seen as an array of shape (a, b, …), by its own small matrix: O(N·(a + b + …)) instead of O(N²).
Each stage multiplies the slowest axis and leaves it as the fastest one, which costs no copy, as
BLAS reads transposed matrices; after the last stage the axes are back in order. Small factors are
merged to blocks that suit BLAS; large Paley factors are multiplied by FFT.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from .codes import LARGE_FACTOR, MAX_ORDER, CodeBook
from .errors import SpecError
from .paley import Paley, paley

_BLAS_PRODUCTS = 1 << 18
"""Multiplications in one BLAS call. OpenBLAS spreads longer ones over its threads, which then wait
for each other: milliseconds, on a machine that has anything else to do."""
_CHUNK = MAX_ORDER
"""Values that pass through all stages together: one small scratch buffer does for any batch, and
what is between two stages stays in the cache."""
_STAGE_COST, _CALL_COST = 20, 16_000
"""What a stage costs per value, and per call, beside the order of its block, in multiplications
(measured for words of 10 bits)."""


def correlate(
    chips: NDArray[np.float32], book: CodeBook, out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Amplitude of every code row in every bit.

    chips: (…, N) float32, V. Returns (…, N) float32, V: entry r is ±a for an active node on
    row r, 0 for silence. Liu et al. eq. 3, scaled by 1/N.
    out: takes the result instead of a new array; contiguous, and no part of chips.
    Raises SpecError where chips or out do not fit the book.
    """
    result = _multiply(chips, _transform(book.plan), out)
    if not _is_power_of_two(book.order):  # else the first block holds the scale, unrounded
        result *= np.float32(1.0 / book.order)
    return result


def spread(
    symbols: NDArray[np.float32], book: CodeBook, out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """The sum of all code rows, each times its symbol: (…, N) float32 to chips (…, N) float32.

    What correlate takes apart: correlate(spread(x)) == x. out and errors as there.
    """
    return _multiply(symbols, _transform(book.plan, spreading=True), out)


@dataclass(frozen=True)
class _Dense:
    """A stage for BLAS: matrix (order, order), to be applied from the right."""

    matrix: NDArray[np.float32]

    @property
    def order(self) -> int:
        return len(self.matrix)

    def apply(self, values: NDArray[np.float32], result: NDArray[np.float32]) -> None:
        """(c, order, rest) to (c, rest, order), in products of at most _BLAS_PRODUCTS."""
        count, order, rest = values.shape
        if rest == 1:
            np.matmul(values[:, :, 0], self.matrix, out=result[:, 0, :])
            return
        rows = _largest_divisor(rest, _BLAS_PRODUCTS // order**2)
        np.matmul(
            values.reshape(count, order, rest // rows, rows).transpose(0, 2, 3, 1),
            self.matrix,
            out=result.reshape(count, rest // rows, rows, order),
        )


@dataclass(frozen=True)
class _Fourier:
    """A stage that is a large Paley factor."""

    factor: Paley
    transposed: bool

    @property
    def order(self) -> int:
        return self.factor.order

    def apply(self, values: NDArray[np.float32], result: NDArray[np.float32]) -> None:
        """(c, order, rest) to (c, rest, order)."""
        result[...] = self.factor.multiply(values.swapaxes(1, 2), self.transposed)


@dataclass(frozen=True)
class _Transform:
    """Product with a code book, as stages. most: vectors that go through them together."""

    order: int
    stages: tuple[_Dense | _Fourier, ...]
    most: int


class _Scratch(threading.local):
    """A buffer for what is between two stages; each thread has its own."""

    def __init__(self) -> None:
        self.values = np.empty(_CHUNK, dtype=np.float32)


_scratch = _Scratch()


def _multiply(
    vectors: NDArray[np.float32], transform: _Transform, out: NDArray[np.float32] | None
) -> NDArray[np.float32]:
    """All stages, one after the other, on vectors (…, N)."""
    order = transform.order
    values = np.ascontiguousarray(vectors, dtype=np.float32)
    if values.shape[-1] != order:
        raise SpecError(f"{values.shape[-1]} chips per bit do not fit a code book of order {order}")
    if out is None:
        out = np.empty_like(values)
    elif out.shape != values.shape or out.dtype != np.float32 or not out.flags.c_contiguous:
        raise SpecError(f"out must be contiguous float32 of shape {values.shape}")
    source, result = values.reshape(-1, order), out.reshape(-1, order)
    parts = -(-len(source) // transform.most)
    for part in range(parts):  # of about equal size
        chosen = slice(part * len(source) // parts, (part + 1) * len(source) // parts)
        _pass(source[chosen], result[chosen], transform.stages)
    return out


def _pass(
    values: NDArray[np.float32],
    result: NDArray[np.float32],
    stages: tuple[_Dense | _Fourier, ...],
) -> None:
    """Multiply every axis of vectors (c, N), the slowest first."""
    count, order = values.shape
    for following, stage in zip(range(len(stages) - 1, -1, -1), stages, strict=True):
        # By turns, so that the last stage writes the result.
        goal = _scratch.values[: values.size] if following % 2 else result
        rest = order // stage.order
        stage.apply(
            values.reshape(count, stage.order, rest), goal.reshape(count, rest, stage.order)
        )
        values = goal


@lru_cache(maxsize=64)
def _transform(plan: tuple[int, ...], spreading: bool = False) -> _Transform:
    """The stages of a code book of this plan."""
    order = math.prod(plan)
    stages = [_stage(group, spreading) for group in _groups(plan)]
    if not spreading and _is_power_of_two(order):
        assert isinstance(stages[0], _Dense), "a power of two has no large factor"
        stages[0] = _Dense(stages[0].matrix * np.float32(1.0 / order))
    most = _BLAS_PRODUCTS // order**2 if stages[0].order == order else _CHUNK // order
    return _Transform(order, tuple(stages), max(most, 1))


def _stage(group: tuple[int, ...], spreading: bool) -> _Dense | _Fourier:
    """The stage for the product of some factors."""
    order = math.prod(group)
    if order > LARGE_FACTOR:
        factor = paley(order)
        assert factor is not None, "all other factors are small"
        return _Fourier(factor, transposed=spreading)
    matrix = CodeBook(group).matrix.astype(np.float32)
    return _Dense(matrix if spreading else np.ascontiguousarray(matrix.T))


def _groups(plan: tuple[int, ...]) -> tuple[tuple[int, ...], ...]:
    """The plan's factors merged to the blocks that cost least, none above LARGE_FACTOR."""
    per_stage = _STAGE_COST + _CALL_COST / math.prod(plan)
    best: list[tuple[float, tuple[tuple[int, ...], ...]]] = [(0.0, ())]  # for plan[:i]
    for end in range(1, len(plan) + 1):
        ways = []
        for start in range(end):
            group = plan[start:end]
            order = math.prod(group)
            if order <= LARGE_FACTOR or len(group) == 1:
                cost, groups = best[start]
                ways.append((cost + order + per_stage, (*groups, group)))
        best.append(min(ways))
    return best[-1][1]


@cache
def _largest_divisor(number: int, limit: int) -> int:
    return max(d for d in range(1, limit + 1) if number % d == 0)


def _is_power_of_two(order: int) -> bool:
    return order & (order - 1) == 0
