# SPDX-License-Identifier: Apache-2.0

"""Reads one frame's words from the nodes' levels: who spoke, which code, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.arrays import Bools, Floats32
from ..base.stage import stage
from ..code.amplitude import (
    ACTIVE_SHARE,
    FAINT_SHARE,
    HIDDEN,
    LEAST_NOISE,
    LOW_MARGIN,
    MOVED_SHARE,
    SILENT_RHO,
    hiding_rho,
    pooled_noise,
    rises,
    usual_amplitude,
)
from ..code.frame import FrameSpec
from ..code.separate import NodeLevels
from .lateness import displaced, out_of_place
from .leakage import unexplained
from .limits import (
    CLEAR_RHO,
    DOUBLE_SHARE,
    LOW_RHO,
    LOWER_SHARE,
    SHARED_SHARE,
    SOUND_SHARE,
    UNLIKE,
    most_square,
)
from .tones import toned

AUTO_FLOOR = 6.0
"""Of unknown amplitude, words below this many noise deviations count as silence. Chosen: far above
noise's mean |r|, 0.8 ± 0.6/√k, or 0.99 at k = 10, as noise is not all there is."""
LEAKED_SHARE = 0.5
"""Share of a word's amplitude that must be left beside what leaks from louder words for it to be a
word. Chosen: a word that was sent keeps √(1 − 3/k) of it, 0.84 at k = 10."""
COMPARABLE = 0.6
"""Share of a word's amplitude above which a fainter one may be the rest of it. Chosen: of a word
half a chip late both rows have half."""
OFF, OFF_HIT, OFF_OTHERS, MOST_BROKEN = 2.0, 5.0, 4.0, 0.25
"""A level is uncertain below OFF times the typical deviation of that bit's levels, of all nodes but
MOST_BROKEN; below OFF_HIT times that where it is OFF_OTHERS times that of most bits: something has
hit this bit, and that is not alike for all nodes. Chosen on disturbed lines (make torture)."""
LEAST_ALIKE = 8
"""Levels that are not all turned by what shows in none as another one. Chosen: a spike has the same
sign in so many rows once in 100."""
UNLIKE_OTHERS = 5.0
"""A level is also uncertain if it is off by more than UNLIKE of the word's amplitude, and by more
than UNLIKE_OTHERS times the typical deviation of its bit and of most bits: something else is on
that row. Chosen on disturbed lines (make torture)."""
HIT, HIT_OTHERS, HIT_LEVEL = 1.0, 4.0, 0.3
"""Something has hit the line in a bit whose levels are off, all nodes together, by HIT squares of a
node's amplitude more than those of most bits and by HIT_OTHERS times as much, one of them by
HIT_LEVEL of an amplitude: a slow discharge turns some nodes' levels and shows in others'. Chosen on
disturbed lines (make torture)."""
JUMP = 2.0
"""Steps of the line's level from bit to bit beyond which one that is more than an amplitude is a
jump, within either bit. Chosen: those of hum are alike."""


@stage
class Words:
    """The words of n nodes in one frame.

    active: (n,) bool, False for a silent node (its other entries then mean nothing).
    codes: (n,) int32 ADC words.
    amplitude_v: (n,) float32, V, mean |r| over the word's bits; of a silent node without what leaks
        from its neighbours.
    rho: (n,) float32, amplitude over the noise of one correlation (√N·a/σ in the signal model).
    margin: (n,) float32, |r| of the word's weakest bit over its amplitude.
    doubtful: (n,) bool, words with a close decision in at least one bit, with a mended parity, or
        too loud for one node; and nodes of which it is not certain whether they were silent.
    doubled: (n,) bool, words in which some bits have the level of two nodes or more and others a
        much lower one: more than one node speaks on their row.
    odd: (n,) bool, active words whose parity had to be mended.
    astray: (n,) bool, nodes on whose rows there may be another one's word, of a node out of time.
    faint: (n,) bool, nodes that did not speak loudly enough, but on whose rows there is more than
        noise and their neighbours explain.
    noise_rms_v: σ, noise of one chip sample, V; NaN if unknown.

    Treat the arrays as read-only: frames share those in which no node is True or heard.
    """

    active: Bools
    codes: NDArray[np.int32]
    amplitude_v: Floats32
    rho: Floats32
    margin: Floats32
    doubtful: Bools
    doubled: Bools
    odd: Bools
    astray: Bools
    faint: Bools
    noise_rms_v: float

    @property
    def confidence(self) -> Floats32:
        """Probability that each word's weakest bit is right, (n,) float32, 0.5…1.

        In white noise the log-likelihood ratio of a bit is 2·a·|r|/σᵣ² = 2·ρ²·margin.
        """
        ratio = np.minimum(np.float32(2) * np.square(self.rho) * self.margin, np.float32(80))
        confidence: Floats32 = np.float32(1) / (np.float32(1) + np.exp(-ratio))
        return confidence

    def disturbed(self, broken: Bools) -> bool:
        """Whether something is on the line that these words do not explain, nor noise.

        A word that is uneven without noise may have that of a late node, which appears silent, on
        its row; one that is doubled has. broken: (n,) bool, nodes known for uneven words.
        """
        uneven = self.doubtful & (self.rho > CLEAR_RHO) & ~broken
        return bool((self.active & (uneven | self.doubled)).any())

    def doubted(self, nodes: Bools) -> Words:
        """The same words, of which those of some nodes (n,) bool are doubtful, too.

        Of a silent node this says that it may have spoken.
        """
        return replace(self, doubtful=self.doubtful | nodes)


def silent(nodes: int, noise_rms_v: float) -> Words:
    """The words of a frame in which no node spoke; these share their arrays."""
    no, codes, nothing = _zeros(nodes)
    return Words(no, codes, nothing, nothing, nothing, no, no, no, no, no, noise_rms_v)


def nobody(nodes: int) -> Bools:
    """(n,) bool, False for all nodes: an array that frames share, and nobody can write to."""
    return _zeros(nodes)[0]


@lru_cache(maxsize=4)
def _zeros(nodes: int) -> tuple[Bools, NDArray[np.int32], Floats32]:
    zeros = np.zeros(nodes, np.bool_), np.zeros(nodes, np.int32), np.zeros(nodes, np.float32)
    for array in zeros:
        array.flags.writeable = False
    return zeros


def decode(
    levels: NodeLevels,
    spec: FrameSpec,
    active_share: float = ACTIVE_SHARE,
    swing_v: ArrayLike | None = None,
) -> Words:
    """Read the words of one frame.

    active_share: share of the expected amplitude above which a word counts as spoken. swing_v: that
    amplitude, scalar or (n,), V; the specification's by default, and where that has none, the
    usual one of the frame. Activity is decided per word and not per bit: k levels average out the
    noise, which takes lost words from 0.32 to 1e-4 at ρ = 4. A word that louder ones explain by
    leakage is none, nor one that tones or an offset explain. Silence is doubtful where a row holds
    more than noise and leakage.

    With parity, a word whose parity is odd has its weakest bit turned (Wagner 1954, the most
    likely even word) and is doubtful.
    """
    levels = levels.whole(spec)
    frame = _spoken(levels, spec, active_share, swing_v)
    measures, active = frame.measures, frame.active
    codes, rho, margin, doubtful, doubled, odd, uneven = _decide(frame)
    if uneven:
        doubtful |= _disturbed(frame)
    # Rows that hold a part of a word, or more than noise and leakage.
    doubtful |= frame.astray | frame.hidden
    doubtful |= _silent_by_parts(frame) | _silent_elsewhere(frame)
    # Where somebody is out of place, any silent node may be the one that spoke; and where the level
    # moves so much that the frame may be somewhere else.
    moves = bool(_line_levels(frame).std() > MOVED_SHARE * frame.expected_v)
    doubtful |= ~active & (frame.is_late or moves)
    tones = toned(levels, measures.amplitude, active, spec) if active.any() else None
    none = nobody(len(active)) if tones is None else tones
    if levels.level_unknown and active[0]:
        none = none | (np.arange(active.size) == 0)
    active = active & ~none
    # A tone that passes for a word may have given the frame its timing, too.
    doubtful |= none | (~active & (tones is not None))
    # The margin of what is not even faint says nothing, and would look like a doubt.
    margin *= measures.amplitude > np.float32(min(active_share, FAINT_SHARE)) * frame.expected
    codes, doubled, odd = codes * active, doubled & doubtful, odd & active
    sigma = levels.noise_v * math.sqrt(spec.order)
    return Words(
        *(active, codes, measures.amplitude, rho, margin, doubtful, doubled, odd),
        *(frame.astray, frame.hidden, sigma),
    )


class _Measures(NamedTuple):
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


class _Decided(NamedTuple):
    """What words say if each is taken by itself.

    codes: (n,) int32, parity mended and removed. rho, margin: (n,) float32, see Words.
    doubtful, doubled, odd: (n,) bool, see Words; the latter two of silent nodes, too.
    uneven: whether, of more than two nodes, any word may have a level off by more than UNLIKE.
    """

    codes: NDArray[np.int32]
    rho: Floats32
    margin: Floats32
    doubtful: Bools
    doubled: Bools
    odd: Bools
    uneven: bool


class _Frame(NamedTuple):
    """Who spoke in a frame, by which doubt is judged.

    expected: (n,) V, each node's amplitude; expected_v: the least. is_learnt: it is the frame's
    own. active: (n,) bool, words that count; weak: those of them that are too faint for a sound
    node. parts: (n,) bool, rows that may hold a part of another's word; astray: those, and words
    that may be those of others; is_late: whether some may. hidden: see Words.faint. noise_v: RMS of
    a level.
    """

    levels: NodeLevels
    spec: FrameSpec
    measures: _Measures
    expected: Floats32
    expected_v: float
    is_learnt: bool
    active: Bools
    weak: Bools
    parts: Bools
    astray: Bools
    is_late: bool
    hidden: Bools
    noise_v: float


def _spoken(
    levels: NodeLevels, spec: FrameSpec, active_share: float, swing_v: ArrayLike | None
) -> _Frame:
    """Who spoke: words that are loud enough, and neither leakage nor parts of others."""
    noise, is_learnt = levels.noise_v, swing_v is None and spec.node_swing_v is None
    measures = _measure(levels.values)
    expected = _expected(measures.amplitude, noise, active_share, swing_v, spec)
    expected_v = float(expected.min())
    active, faint, any_faint = _find_active(measures, expected, active_share, noise, spec)
    weak, parts, hidden = np.zeros((3, len(active)), np.bool_)
    if any_faint:
        rest, noise = unexplained(levels, active & ~faint, faint, spec)
        # Faint words that louder ones explain have but what is left of them.
        amplitude, left = measures.amplitude, np.abs(rest).mean(axis=0)
        amplitude = np.where(faint & (left < LEAKED_SHARE * amplitude), left, amplitude)
        measures = measures._replace(amplitude=amplitude)
        spoke = amplitude > np.float32(active_share) * expected
        parts = _out_of_step(amplitude, active, spoke, expected)
        squares, bits = np.einsum("kn,kn->n", rest, rest), spec.line_bits
        in_silence = pooled_noise(noise, squares[~spoke], bits)
        hidden = ~spoke & rises(squares, expected, in_silence, bits)
        active = spoke & ~parts
        weak = active & faint
    others = None
    if active.any():
        others = out_of_place(levels, measures.amplitude, active, expected_v, spec)
    astray = parts.copy() if others is None else parts | others
    astray[list(levels.late)] = True
    return _Frame(
        *(levels, spec, measures, expected, expected_v, is_learnt, active, weak, parts),
        *(astray, others is not None, hidden, noise),
    )


def _measure(values: Floats32) -> _Measures:
    """Measure levels (k, n), V."""
    level: Floats32 = np.abs(values)
    bits = len(values)
    # Sums of powers of two below 2¹⁷ are exact in float32, which is the fastest here.
    signs = np.einsum("k,kn->n", _weights(bits), values > 0).astype(np.int32)
    return _Measures(
        level.sum(axis=0) * np.float32(1 / bits),
        level.min(axis=0),
        level.max(axis=0),
        np.einsum("kn,kn->n", level, level),
        signs,
        level.argmin(axis=0).astype(np.int32),
    )


def _find_active(
    measures: _Measures, expected: Floats32, active_share: float, noise: float, spec: FrameSpec
) -> tuple[Bools, Bools, bool]:
    """Words that were spoken; those of a node that is too weak; whether any may be.

    Noise that would hide such a word may be what leaks from neighbours. expected: (n,) V.
    active_share: part of the expected amplitude of words that count. noise: RMS of a level, V.
    """
    amplitude, bits, order = measures.amplitude, spec.line_bits, 0 if spec.sparse else spec.order
    active = amplitude > np.float32(active_share) * expected
    sound = SOUND_SHARE * np.minimum(expected, amplitude.max())  # two on a row are louder
    faint = (amplitude > FAINT_SHARE * expected) & ((amplitude < sound) | ~active)
    faint |= ~active & rises(measures.squares, expected, noise, bits)
    rho = expected * np.float32(1 / max(noise, LEAST_NOISE))
    hiding = rho < np.float32(hiding_rho(bits, order))
    return active, faint, bool((faint | ~active & hiding).any())


def _decide(frame: _Frame) -> _Decided:
    """Codes, and how sure they are."""
    measures, active, expected, spec = frame.measures, frame.active, frame.expected, frame.spec
    amplitude, weakest, noise = measures.amplitude, measures.weakest, frame.levels.noise_v
    bits = spec.line_bits
    rho: Floats32 = amplitude * np.float32(1 / max(noise, LEAST_NOISE))
    above_zero: Floats32 = np.maximum(amplitude, np.float32(1e-30))
    margin = weakest / above_zero
    codes = measures.signs ^ spec.sign_mask
    doubtful = (rho < LOW_RHO) | (margin < LOW_MARGIN)
    odd = np.zeros_like(active)
    if spec.parity:
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
    return _Decided(codes, rho, margin, doubtful, doubled, odd, is_uneven)


def _silent_by_parts(frame: _Frame) -> Bools:
    """Silent nodes whose word may be on others' rows in parts: it leaves nothing on its own."""
    parts, active = frame.parts & ~frame.active, frame.active
    # The same number for a word and its opposite, as parts of one late word are.
    signs = frame.measures.signs
    said = np.minimum(signs, signs ^ np.int32((1 << frame.spec.line_bits) - 1))
    words, counts = np.unique(said[parts], return_counts=True)
    if (counts > 1).any() or (frame.is_learnt and parts.any()):
        # Where parts outnumber words, these may be parts, too; so may one that says the same.
        outnumbered = np.count_nonzero(parts) > np.count_nonzero(active & ~frame.weak)
        return ~active | frame.weak | outnumbered | np.isin(said, words[counts > 1])
    amplitude, usual = frame.measures.amplitude, frame.expected
    if frame.is_learnt and frame.weak.any():  # that is of the loud, if most are
        usual = np.minimum(usual, np.median(amplitude[active]))
    is_shared = active & (amplitude > SHARED_SHARE * usual)
    return frame.weak & is_shared.any()  # the rest of weak ones may be there


def _silent_elsewhere(frame: _Frame) -> Bools:
    """Silent nodes, where one of them shows if the chips are read early or late, or noise hides it.

    Looked for where rows hold more than words, or the noise of a chip may be a node. Of sparse
    codes the certificate says what noise may hide.
    """
    levels, spec, active = frame.levels, frame.spec, frame.active
    if not spec.sparse and levels.noise_v * SILENT_RHO > frame.expected_v:
        return ~active  # as faint as words may be
    may_hide = frame.noise_v * math.sqrt(spec.order) > HIDDEN * frame.expected_v
    if spec.sparse or not (may_hide or frame.hidden.any() or not active.any()):
        return nobody(len(active))
    # Of nodes of unknown amplitude, noise that leaves none may be words.
    loudest, by_chance = float(frame.measures.amplitude.max()), 0.8 + 2 / math.sqrt(spec.line_bits)
    is_seen = frame.is_learnt and not active.any() and loudest > by_chance * frame.noise_v
    if levels.rows is None or spec.scramble:
        is_seen |= may_hide
    else:
        found, _ = displaced(levels, frame.measures.amplitude, active, frame.expected_v, spec)
        is_seen |= bool((found & ~active).any())
    return ~active & is_seen


def _expected(
    amplitude: Floats32,
    noise: float,
    active_share: float,
    swing_v: ArrayLike | None,
    spec: FrameSpec,
) -> Floats32:
    """The amplitude of each node, (n,), V: as told to decode, specified, or the frame's usual."""
    if swing_v is None:
        swing_v = spec.node_swing_v
    if swing_v is None:
        swing_v = max(float(usual_amplitude(amplitude)[0]), AUTO_FLOOR * noise / active_share)
    if isinstance(swing_v, np.ndarray) and swing_v.dtype == np.float32:
        return swing_v
    return np.full(spec.nodes, swing_v, dtype=np.float32)


def _out_of_step(amplitude: Floats32, active: Bools, spoke: Bools, expected: Floats32) -> Bools:
    """Nodes on whose rows there may be a part of a word, of which others have the rest, (n,).

    active: words without regard of leakage. spoke: words that it does not explain.
    """
    astray = ~spoke & (active | (amplitude > FAINT_SHARE * expected))
    if astray.any():  # what weak words lack may be there, and they out of their places
        most = np.float32(amplitude[astray].max()) / np.float32(COMPARABLE)
        sound = SOUND_SHARE * np.minimum(expected, amplitude.max())
        astray |= spoke & (amplitude < np.maximum(sound, most))
        # A line that weakens words weakens faint ones, too.
        astray |= ~spoke & (amplitude > np.float32(FAINT_SHARE) * amplitude.max())
    return astray


def _line_levels(frame: _Frame) -> Floats32:
    """The line's level in each bit, V; none where no row shows it."""
    levels, spec = frame.levels, frame.spec
    if levels.rows is None or spec.first_row == 0 or spec.scramble:
        return np.zeros(2, np.float32)
    return levels.rows[:, 0]


def _disturbed(frame: _Frame) -> Bools:
    """Words with a bit that a disturbance of the line may have turned, (n,).

    A spike or a dip within one bit moves the levels of all nodes there, by about as much, and a
    jump or a slow discharge those of some rows, far enough to look right again: then no word is
    certain. Noise that is estimated from whole frames hardly shows any of these.
    """
    levels, found = frame.levels, np.zeros_like(frame.active)
    # Rows without a level show no noise, by which others could be told.
    rows = slice(None) if levels.spoke is None else np.sort(levels.spoke)
    active, amplitude = frame.active[rows], frame.measures.amplitude[rows]
    level, nodes = np.abs(levels.values[:, rows]), len(active)
    off, rank = level - amplitude * active, round((1 - MOST_BROKEN) * (nodes - 1))
    if nodes >= LEAST_ALIKE:  # what lowers all levels, as clipping does, turns none of them
        off -= off.max(axis=1, keepdims=True).clip(max=0)
    off = np.abs(off)
    unit = _middle(amplitude[active])
    # A node counts for its amplitude at most: a single one that is broken hits no bit.
    most_off = np.minimum(off, unit)
    power = np.einsum("kn,kn->k", most_off, most_off)
    most_power = _middle(power)
    hit = (power > HIT_OTHERS * most_power) & (power > most_power + HIT * unit * unit)
    steps = np.abs(np.diff(_line_levels(frame)))  # those of hum are alike
    jumps = steps > unit + JUMP * _middle(steps)
    if (hit & (off.max(axis=1) > HIT_LEVEL * unit)).any() or jumps.any():
        return frame.active
    usual = np.partition(off, rank, axis=1)[:, rank]
    of_most = _middle(usual)
    if levels.spoke is not None:  # of few words what is usual is not known, but noise is
        of_most = np.maximum(of_most, np.float32(levels.noise_v))
    least = np.where(usual > OFF_OTHERS * of_most, np.float32(OFF_HIT), np.float32(OFF)) * usual
    most = np.maximum(UNLIKE * amplitude, UNLIKE_OTHERS * np.maximum(usual, of_most)[:, None])
    found[rows] = active & ((level < least[:, None]) | (off > most)).any(axis=0)
    return found


def _middle(values: Floats32) -> np.float32:
    """The upper median; numpy's own takes ten times as long for the few values of a word."""
    middle: np.float32 = np.sort(values)[values.size // 2]
    return middle


@cache
def _weights(bits: int) -> Floats32:
    """Value of each bit of a word, most significant first, (bits,)."""
    return np.exp2(np.arange(bits - 1, -1, -1, dtype=np.float32))


def _is_odd(words: NDArray[np.int32]) -> Bools:
    """Whether words of up to 17 bits have an odd number of ones."""
    for shift in (16, 8, 4, 2, 1):
        words = words ^ (words >> shift)
    return (words & 1).astype(bool)
