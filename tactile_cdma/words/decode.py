# SPDX-License-Identifier: Apache-2.0

"""Node levels to words: who spoke in this frame, what was said, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..code.frame import FrameSpec
from ..code.separate import NodeLevels

ACTIVE_SHARE = 0.5
"""A node spoke where the mean of |r| over its word exceeds this share of its amplitude."""
AUTO_FLOOR = 6.0
"""With the amplitude unknown, words below this many noise deviations count as silence."""
LOW_RHO = 5.0
"""Words of lower amplitude/noise are flagged: below it, more than 3e-6 of them hold an error."""
LOW_MARGIN = 0.4
"""Words are flagged where one bit has less than this share of the word's mean amplitude."""

FAINT_SHARE = 0.25
"""Below this share of the expected amplitude nothing is taken for a node (fit.least_power)."""
FEW_SHARE = 0.25
"""Where fewer nodes stand out, the others are left out of all that is done per node."""
DOUBLE_SHARE = 1.6
"""A level above this share of a node's amplitude is that of two nodes."""
LOUD_SHARE = 1.25
"""Words above this share of a node's amplitude may be those of more than one."""
CLEAR_RHO = 8.0
"""Words that stand so far out of the noise have no levels of two nodes by chance."""
OFF, OFF_HIT, OFF_OTHERS, MOST_ODD = 2.0, 5.0, 4.0, 0.25
"""A level is uncertain below OFF times what the levels of its bit are off, of all nodes but
MOST_ODD, which may be broken; below OFF_HIT times that where it is OFF_OTHERS times that of most
bits: something has hit this one, and that is not alike for all nodes."""
UNLIKE, UNLIKE_OTHERS = 0.2, 5.0
"""A level is uncertain, too, if it is off by more than this share of the word's amplitude, and by
more than so many times what the levels of its bit and of most bits are: something else is on that
row."""
HIT, HIT_OTHERS, HIT_LEVEL = 1.0, 4.0, 0.3
"""Something has hit the line in a bit whose levels are off by more than those of most bits, by so
many squares of a node's amplitude for all nodes together and by so many times as much, one of them
by such a share of an amplitude: a slow discharge turns some nodes' levels and shows in others'."""


@dataclass(frozen=True, slots=True)
class Words:
    """What n nodes said in one frame.

    active: (n,) bool, False for a silent node (its other entries then mean nothing).
    codes: (n,) int32 ADC words.
    amplitude_v: (n,) float32, V, mean |r| over the word's bits.
    rho: (n,) float32, amplitude over the noise of one correlation (√N·a/σ in the signal model).
    margin: (n,) float32, |r| of the word's weakest bit over its amplitude.
    doubtful: (n,) bool, active words whose decision was close in at least one bit, or whose parity
        had to be mended, or that are too loud for one node.
    doubled: (n,) bool, words of which some bits have the level of two nodes or more, and others a
        much smaller one: more than one node speaks on their row.
    odd: (n,) bool, active words whose parity had to be mended.
    noise_rms_v: σ, noise of one chip sample, V; NaN if unknown.
    """

    active: NDArray[np.bool_]
    codes: NDArray[np.int32]
    amplitude_v: NDArray[np.float32]
    rho: NDArray[np.float32]
    margin: NDArray[np.float32]
    doubtful: NDArray[np.bool_]
    doubled: NDArray[np.bool_]
    odd: NDArray[np.bool_]
    noise_rms_v: float

    @property
    def confidence(self) -> NDArray[np.float32]:
        """Probability that each word's weakest bit is right, (n,) float32, 0.5…1.

        In white noise the log-likelihood ratio of a bit is 2·a·|r|/σᵣ² = 2·ρ²·margin.
        """
        ratio = np.minimum(np.float32(2) * np.square(self.rho) * self.margin, np.float32(80))
        confidence: NDArray[np.float32] = np.float32(1) / (np.float32(1) + np.exp(-ratio))
        return confidence

    def doubted(self) -> Words:
        """The same words, none of them certain."""
        return replace(self, doubtful=self.active)


def silent(nodes: int, noise_rms_v: float) -> Words:
    """The words of a frame in which nobody spoke."""
    nothing = np.zeros(nodes, dtype=np.float32)
    no = np.zeros(nodes, dtype=bool)
    codes = np.zeros(nodes, dtype=np.int32)
    return Words(no, codes, nothing, nothing, nothing, no, no, no, noise_rms_v)


def decode(
    levels: NodeLevels,
    spec: FrameSpec,
    threshold: float = ACTIVE_SHARE,
    swing_v: ArrayLike | None = None,
) -> Words:
    """Read the words of one frame.

    threshold: share of the expected amplitude above which a word counts as spoken. swing_v: that
    amplitude, scalar or (n,), V; the specification's by default, and where that has none, the
    largest of the frame. Activity is decided per word and not per bit: k levels average out the
    noise, which takes lost words from 0.32 to 1e-4 at ρ = 4.

    With parity, a word whose parity is odd has its weakest bit turned (Wagner 1954, the most
    likely even word) and is doubtful.
    """
    values, noise = levels.values, levels.noise_v
    level = np.abs(values)
    amplitude = level.sum(axis=0) * np.float32(1 / spec.line_bits)
    if swing_v is None:
        swing_v = spec.node_swing_v
    if swing_v is None:
        swing_v = max(float(amplitude.max()), AUTO_FLOOR * noise / threshold)
    expected = np.asarray(swing_v, dtype=np.float32)
    if expected.ndim == 0:
        expected = np.full(spec.nodes, expected)
    active = amplitude > np.float32(threshold) * expected
    rho = amplitude * np.float32(1 / max(noise, 1e-12))
    # Of nodes that are not even faint there is nothing more to know.
    noticed = amplitude > np.float32(min(threshold, FAINT_SHARE)) * expected
    if np.count_nonzero(noticed) < FEW_SHARE * spec.nodes:
        some = np.flatnonzero(noticed)
        read = _read(
            values[:, some],
            level[:, some],
            amplitude[some],
            rho[some],
            expected[some],
            spec.sign_mask[some],
            spec,
        ).among(some, spec.nodes)
    else:
        read = _read(values, level, amplitude, rho, expected, spec.sign_mask, spec)
    doubtful = read.doubtful & active
    if _are_uneven(level, amplitude, active):
        doubtful |= _disturbed(level, amplitude, active) & active
    for node in levels.unresolved:
        doubtful[node] = active[node]
    return Words(
        active,
        read.codes * active,
        amplitude,
        rho,
        read.margin * noticed,
        doubtful,
        read.doubled & doubtful,
        read.odd & active,
        noise * math.sqrt(spec.order),
    )


class _Read(NamedTuple):
    """Entries of Words for some nodes, active or not."""

    codes: NDArray[np.int32]
    margin: NDArray[np.float32]
    doubtful: NDArray[np.bool_]
    doubled: NDArray[np.bool_]
    odd: NDArray[np.bool_]

    def among(self, chosen: NDArray[np.intp], nodes: int) -> _Read:
        """The same for all nodes: zeros but for the chosen."""
        whole = [np.zeros(nodes, dtype=part.dtype) for part in self]
        for zeros, part in zip(whole, self, strict=True):
            zeros[chosen] = part
        return _Read._make(whole)


def _read(
    values: NDArray[np.float32],
    level: NDArray[np.float32],
    amplitude: NDArray[np.float32],
    rho: NDArray[np.float32],
    expected: NDArray[np.float32],
    sign_mask: NDArray[np.int32],
    spec: FrameSpec,
) -> _Read:
    """Words of some nodes, each from its own column alone. level: |values|."""
    weakest = level.min(axis=0)
    # Sums of powers of two below 2¹⁷ are exact in float32, which is the fastest here.
    codes = np.einsum("k,kn->n", _weights(spec.line_bits), values > 0).astype(np.int32)
    codes ^= sign_mask
    margin = weakest / np.maximum(amplitude, np.float32(1e-30))
    doubtful = (rho < LOW_RHO) | (margin < LOW_MARGIN)
    odd = doubled = np.zeros_like(doubtful)
    if spec.parity:
        odd = _is_odd(codes)
        turn = np.int32(1) << (spec.bits - level.argmin(axis=0)).astype(np.int32)
        codes = (codes ^ turn * odd) >> 1
        doubtful |= odd
    loud = amplitude > np.float32(LOUD_SHARE) * expected
    if doubtful.any() or loud.any():
        strongest, two = level.max(axis=0), np.float32(DOUBLE_SHARE) * expected
        cancelling = doubtful & (weakest < np.float32(LOW_MARGIN) * expected)
        three = loud & (rho > CLEAR_RHO) & (weakest < np.float32(0.5) * strongest)
        doubled = (cancelling | three) & (strongest > two)
        doubtful |= doubled | (amplitude > two)
    return _Read(codes, margin, doubtful, doubled, odd)


def _are_uneven(
    level: NDArray[np.float32], amplitude: NDArray[np.float32], active: NDArray[np.bool_]
) -> bool:
    """Whether a level of any word may be off by more than UNLIKE of it, among more than two nodes.

    One that is adds 1/k − 1/k² of its square to the mean square of the word's k levels.
    """
    bits, nodes = level.shape
    most = bits + UNLIKE**2 * (bits - 1) / bits
    uneven = np.einsum("kn,kn->n", level, level) > amplitude * amplitude * np.float32(most)
    uneven &= active
    return nodes > 2 and bool(uneven.any())


def _disturbed(
    level: NDArray[np.float32],
    amplitude: NDArray[np.float32],
    active: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Words with a bit that may be wrong by what has hit the line in it, (n,).

    A spike or a dip within one bit moves the levels of all nodes there, by about as much, and a
    jump or a slow discharge those of some rows, far enough to look right again: then no word is
    certain. Noise that is estimated from whole frames hardly shows any of these.
    """
    nodes = len(active)
    off, rank = np.abs(level - amplitude * active), round((1 - MOST_ODD) * (nodes - 1))
    unit = _middle(amplitude[active])
    # A node counts for its amplitude at most: a single one that is broken hits no bit.
    most_off = np.minimum(off, unit)
    power = np.einsum("kn,kn->k", most_off, most_off)
    most_power = _middle(power)
    hit = (power > HIT_OTHERS * most_power) & (power > most_power + HIT * unit * unit)
    if (hit & (off.max(axis=1) > HIT_LEVEL * unit)).any():
        return active
    usual = np.partition(off, rank, axis=1)[:, rank]
    of_most = _middle(usual)
    least = np.where(usual > OFF_OTHERS * of_most, np.float32(OFF_HIT), np.float32(OFF)) * usual
    most = np.maximum(UNLIKE * amplitude, UNLIKE_OTHERS * np.maximum(usual, of_most)[:, None])
    uncertain: NDArray[np.bool_] = ((level < least[:, None]) | (off > most)).any(axis=0)
    return uncertain


def _middle(values: NDArray[np.float32]) -> np.float32:
    """The upper median; numpy's own takes ten times as long for the few values of a word."""
    middle: np.float32 = np.sort(values)[values.size // 2]
    return middle


@cache
def _weights(bits: int) -> NDArray[np.float32]:
    """Value of each bit of a word, most significant first, (bits,)."""
    return np.exp2(np.arange(bits - 1, -1, -1, dtype=np.float32))


def _is_odd(words: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Whether words of up to 17 bits have an odd number of ones."""
    for shift in (16, 8, 4, 2, 1):
        words = words ^ (words >> shift)
    odd: NDArray[np.bool_] = (words & 1).astype(bool)
    return odd
