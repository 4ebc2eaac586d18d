# SPDX-License-Identifier: Apache-2.0

"""The stages of `decode` that pass over all levels or all nodes.

The kernel does them at once where no word needs a closer look; it gives the same decisions.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base import kernel
from ..base.arrays import Bools, Floats32
from ..code.amplitude import FAINT_SHARE
from ..code.frame import FrameSpec

SOUND_SHARE = 0.8
"""Share of the loudest word's amplitude below which a word may be what leaks from louder ones.
Chosen: spreads of sound nodes are a few percent."""
LOW_RHO = 5.0
"""ρ below which words are flagged: there more than 3e-6 of them hold a wrong bit, k·Q(ρ) for k =
10."""
LOW_MARGIN = 0.4
"""A word is flagged where one bit has less than this share of the word's mean amplitude. Chosen."""
DOUBLE_SHARE = 1.6
"""Share of a node's amplitude above which a level is that of two nodes. Chosen: nodes with equal
bits give 2, one 60 % too strong is out of tolerance anyway."""
SHARED_SHARE = 1.25
"""Share of a node's amplitude above which a word may be that of more than one: two nodes with
random bits give 1 on average, three give 1.5. Chosen between these."""
CLEAR_RHO = 8.0
"""ρ above which noise does not give a word levels of two nodes: 0.6 amplitudes are then 4.8
deviations of a level."""
UNLIKE = 0.2
"""Share of a word's amplitude by which one of its levels may be off. Chosen on disturbed lines
(make torture)."""

LOWER_SHARE = 0.5
"""Share of a word's strongest level below which its weakest one is that of fewer nodes. Chosen:
three nodes give 3 and 1."""
LEAST_NOISE = 1e-12
"""V; less is taken for this, so that ρ stays finite."""

NEED_STAGES, LEAVE_ENERGY = 0, 1
"""What the kernel says of a frame that it read at once, as enum words_look in words.h."""


Settings = tuple[NDArray[np.void], NDArray[np.void]]
"""Of the kernel: those of a frame, and what its words are read by."""


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
    amplitude: Floats32, expected: Floats32, threshold: float
) -> tuple[Bools, Bools, bool]:
    """Words that were spoken; those of a node that is too weak, and whether there are any.

    amplitude, expected: (n,) V. threshold: share of the expected amplitude of words that count.
    """
    active = amplitude > np.float32(threshold) * expected
    sound = SOUND_SHARE * np.minimum(expected, amplitude.max())  # two on a row are louder
    faint = (amplitude > FAINT_SHARE * expected) & ((amplitude < sound) | ~active)
    return active, faint, bool(faint.any())


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
    uneven = measures.squares > amplitude * amplitude * np.float32(_most_square(bits))
    is_uneven = active.size > 2 and bool((uneven & active).any())
    return Decided(codes, rho, margin, doubtful, doubled, odd, is_uneven)


class Read(NamedTuple):
    """The words of a frame of which none is faint or uneven; see Words.

    codes: (n,) int32. amplitude, rho, margin: (n,) float32. The others: (n,) bool.
    """

    active: Bools
    codes: NDArray[np.int32]
    amplitude: Floats32
    rho: Floats32
    margin: Floats32
    doubtful: Bools
    doubled: Bools
    odd: Bools


def read(
    settings: Settings,
    rows: Floats32,
    expected: Floats32,
    sign_mask: NDArray[np.int32],
    noise: float,
    least_usual: float,
) -> tuple[Read, bool] | None:
    """All stages of `decode` at once, compiled; None if any word is faint or uneven.

    Besides, whether the words leave over as much energy as a chip of one of them.

    rows: (k, N) float32, V, contiguous. expected: (n,) V. least_usual: NaN; or least amplitude, V,
    of the usual one, which is then written to `expected`. The others: as in `decide`.
    """
    assert kernel.compiled is not None
    nodes = sign_mask.size
    floats, ints = np.empty((6, nodes), np.float32), np.empty((3, nodes), np.int32)
    flags = np.empty((5, nodes), np.bool_)
    look: int = kernel.compiled.read_words(
        *settings, 1 / max(noise, LEAST_NOISE), least_usual, rows, sign_mask, expected, floats,
        ints, flags,
    )  # fmt: skip
    if look == NEED_STAGES:
        return None
    amplitude, rho, margin, *_ = floats
    active, doubtful, doubled, odd, _ = flags
    words = Read(active, ints[0], amplitude, rho, margin, doubtful, doubled, odd)
    return words, look == LEAVE_ENERGY


def reading_settings(
    spec: FrameSpec, threshold: float, a_chip: float, few: int, few_share: float
) -> NDArray[np.void]:
    """What the kernel reads words by. threshold: see find_active. The others: see lateness.py."""
    return kernel.settings(
        "words_reading",
        threshold=threshold,
        faint_share=FAINT_SHARE,
        sound_share=SOUND_SHARE,
        most_square=_most_square(spec.line_bits),
        a_chip=a_chip,
        few=few,
        few_share=few_share,
        parity=spec.parity,
        low_rho=LOW_RHO,
        low_margin=LOW_MARGIN,
        shared=SHARED_SHARE,
        two=DOUBLE_SHARE,
        clear_rho=CLEAR_RHO,
        lower=LOWER_SHARE,
    )


def _most_square(bits: int) -> float:
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
