# SPDX-License-Identifier: Apache-2.0

"""Converts and sums the samples of a frame."""

from collections.abc import Iterable
from functools import reduce
from operator import add
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from . import kernel
from .arrays import Floats, Floats32

F = TypeVar("F", np.float32, np.float64)


def in_order(values: Iterable[float]) -> float:
    """Sum of values, one after the other, as in C; Python's own compensates rounding since 3.12."""
    return reduce(add, values, 0.0)


def dot(some: NDArray[F], others: NDArray[F]) -> float:
    """Sum of products, but not by BLAS: long ones wake its threads, which wait for each other."""
    return float(np.einsum("i,i->", some, others))


def sums(volts: Floats) -> tuple[float, float]:
    """Add up samples (m,): their sum, V, and the sum of their squares, V²."""
    found = kernel.lib.samples_add_wide(kernel.pointer(volts, volts.size), volts.size)
    return found.sum, found.squares


def outside(low_v: float, high_v: float, volts: Floats) -> int:
    """Count the samples (m,) that are not between two levels: at either, or beyond."""
    return int(np.count_nonzero((volts <= low_v) | (volts >= high_v)))


def copy_samples(most_v: float, volts: Floats32, copy: Floats) -> None:
    """Copy samples (m,), V; those that are not within ±most_v become NaN."""
    copy[:] = volts
    copy[~(np.abs(copy) < most_v)] = np.nan
