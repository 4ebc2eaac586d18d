# SPDX-License-Identifier: Apache-2.0

"""Sums over the samples of a frame, compiled or in numpy."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from . import kernel
from .arrays import Floats, Floats32

F = TypeVar("F", np.float32, np.float64)


def dot(some: NDArray[F], others: NDArray[F]) -> float:
    """Sum of products, but not by BLAS: long ones wake its threads, which wait for each other."""
    return float(np.einsum("i,i->", some, others))


def numpy_sums(volts: Floats) -> tuple[float, float]:
    """Sum, V, and sum of squares, V², of samples (m,)."""
    return float(volts.sum()), dot(volts, volts)


def numpy_outside(volts: Floats, low_v: float, high_v: float) -> int:
    """How many of the samples (m,) are not between two levels: at either, or beyond."""
    return int(np.count_nonzero((volts <= low_v) | (volts >= high_v)))


def numpy_copy(volts: Floats32, most_v: float, copy: Floats) -> None:
    """Copy samples (m,), V; those that are not within ±most_v become NaN."""
    copy[:] = volts
    copy[~(np.abs(copy) < most_v)] = np.nan


def compiled_outside(volts: Floats, low_v: float, high_v: float) -> int:
    """As numpy_outside."""
    assert kernel.compiled is not None
    number: int = kernel.compiled.count_outside(low_v, high_v, volts)
    return number


def compiled_sums(volts: Floats) -> tuple[float, float]:
    """As numpy_sums."""
    assert kernel.compiled is not None
    both: tuple[float, float] = kernel.compiled.add_samples(volts)
    return both


def compiled_copy(volts: Floats32, most_v: float, copy: Floats) -> None:
    """As numpy_copy."""
    assert kernel.compiled is not None
    kernel.compiled.copy_samples(most_v, volts, copy)


if kernel.compiled is None:
    sums, outside, copy_samples = numpy_sums, numpy_outside, numpy_copy
else:
    sums, outside, copy_samples = compiled_sums, compiled_outside, compiled_copy
