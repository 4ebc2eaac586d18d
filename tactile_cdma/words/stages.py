# SPDX-License-Identifier: Apache-2.0

"""The stages of `decode` that pass over all levels or all nodes."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools, Floats32
from ..code.amplitude import FAINT_SHARE, LEAST_NOISE, LOW_MARGIN, hiding_rho, rises
from .limits import (
    CLEAR_RHO,
    DOUBLE_SHARE,
    LOW_RHO,
    LOWER_SHARE,
    SHARED_SHARE,
    SOUND_SHARE,
    UNLIKE,
)


class Measures(NamedTuple):
    """What k levels r say of each of n nodes.

    amplitude, weakest, strongest: (n,) float32, V: mean, least and greatest |r|.
    squares: (n,) float32, V²: sum of r². signs: (n,) int32: signs of r as bits, the first highest.
    weakest_bit: (n,) int32: the first bit of the least |r|.
    """

    amplitude: Floats32
    weakest: Floats32
    strongest: Floats32
    squares: Floats32
    signs: NDArray[np.int32]
    weakest_bit: NDArray[np.int32]


class Decided(NamedTuple):
    """What words say if each is taken by itself.

    codes: (n,) int32, parity mended and removed. rho, margin: (n,) float32, see Words.
    doubtful, doubled, odd: (n,) bool, see Words; the latter two of silent nodes, too.
    uneven: whether a level of any word may be off by more than UNLIKE of it, among more than two
        nodes.
    """

    codes: NDArray[np.int32]
    rho: Floats32
    margin: Floats32
    doubtful: Bools
    doubled: Bools
    odd: Bools
    uneven: bool


def measure(values: Floats32) -> Measures:
    """Measure levels (k, n), V."""
    level: Floats32 = np.abs(values)
    bits = len(values)
    # Sums of powers of two below 2¹⁷ are exact in float32, which is the fastest here.
    signs = np.einsum("k,kn->n", _weights(bits), values > 0).astype(np.int32)
    return Measures(
        level.sum(axis=0) * np.float32(1 / bits),
        level.min(axis=0),
        level.max(axis=0),
        np.einsum("kn,kn->n", level, level),
        signs,
        level.argmin(axis=0).astype(np.int32),
    )


def find_active(
    measures: Measures,
    expected: Floats32,
    active_share: float,
    noise: float,
    bits: int,
    order: int,
) -> tuple[Bools, Bools, bool]:
    """Words that were spoken; those of a node that is too weak; whether any may be.

    Noise that would hide such a word may be what leaks from neighbours. expected: (n,) V.
    active_share: part of the expected amplitude of words that count. noise: RMS of a level, V.
    bits: of a word. order: chips per bit.
    """
    amplitude = measures.amplitude
    active = amplitude > np.float32(active_share) * expected
    sound = SOUND_SHARE * np.minimum(expected, amplitude.max())  # two on a row are louder
    faint = (amplitude > FAINT_SHARE * expected) & ((amplitude < sound) | ~active)
    faint |= ~active & rises(measures.squares, expected, noise, bits)
    rho = expected * np.float32(1 / max(noise, LEAST_NOISE))
    hiding = rho < np.float32(hiding_rho(bits, order))
    return active, faint, bool((faint | ~active & hiding).any())


def decide(
    measures: Measures,
    active: Bools,
    expected: Floats32,
    sign_mask: NDArray[np.int32],
    noise: float,
    bits: int,
    parity: bool,
) -> Decided:
    """Codes, and how sure they are.

    active: (n,) words that were spoken. expected: (n,) V, amplitude of a node. sign_mask: (n,), see
    FrameSpec. noise: RMS of a level, V. bits: on the line. parity: the last one is that.
    """
    amplitude, weakest = measures.amplitude, measures.weakest
    rho: Floats32 = amplitude * np.float32(1 / max(noise, LEAST_NOISE))
    above_zero: Floats32 = np.maximum(amplitude, np.float32(1e-30))
    margin = weakest / above_zero
    codes = measures.signs ^ sign_mask
    doubtful = (rho < LOW_RHO) | (margin < LOW_MARGIN)
    odd = np.zeros_like(active)
    if parity:
        odd = _is_odd(codes)
        turn = np.int32(1) << (bits - 1 - measures.weakest_bit)
        codes = (codes ^ turn * odd) >> 1
        doubtful |= odd
    two = np.float32(DOUBLE_SHARE) * expected
    cancelling = doubtful & (weakest < np.float32(LOW_MARGIN) * expected)
    loud = amplitude > np.float32(SHARED_SHARE) * expected
    three = loud & (rho > CLEAR_RHO) & (weakest < np.float32(LOWER_SHARE) * measures.strongest)
    doubled = (cancelling | three) & (measures.strongest > two)
    doubtful |= doubled | (amplitude > two)
    doubtful &= active
    uneven = measures.squares > amplitude * amplitude * np.float32(most_square(bits))
    is_uneven = active.size > 2 and bool((uneven & active).any())
    return Decided(codes, rho, margin, doubtful, doubled, odd, is_uneven)


def most_square(bits: int) -> float:
    """Sum of squares over the squared amplitude, of a word with one level that is off by UNLIKE.

    Such a level adds 1/k − 1/k² of its square to the mean square of the word's k levels.
    """
    return bits + UNLIKE**2 * (bits - 1) / bits


@cache
def _weights(bits: int) -> Floats32:
    """Value of each bit of a word, most significant first, (bits,)."""
    return np.exp2(np.arange(bits - 1, -1, -1, dtype=np.float32))


def _is_odd(words: NDArray[np.int32]) -> Bools:
    """Whether words of up to 17 bits have an odd number of ones."""
    for shift in (16, 8, 4, 2, 1):
        words = words ^ (words >> shift)
    odd: Bools = (words & 1).astype(bool)
    return odd
