# SPDX-License-Identifier: Apache-2.0

"""Finds words that may be those of a late node on another row.

In Paley's orders rows are nearly each other's shifts, so a node that is late by chips speaks on
another one's row. But its first chips of a bit still say what the bit before did, its last ones if
it is early what the next one does, and of a word that is sent on time no chip does that.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from ..base.arrays import Bools, Floats32
from ..code.amplitude import HIDDEN, LEAST_SHARE
from ..code.codes import CodeBook
from ..code.frame import FrameSpec
from ..code.separate import NodeLevels
from ..code.transform import chips_of, correlate, rows_of
from .limits import SOUND_SHARE

OFF_THE_MARK = 0.6
"""Delay of FEW words of one value per chip, in chips of what is left of them, from which on others
may be less than FAINT_SHARE, as with a mark half a chip off; raw samples are read as late as they
are. Chosen: d chips are d/(1 - d), and a low-pass of 0.3 chip looks like 0.3."""
EDGE, OF_TWO = 2, 1.07
"""Chips at either end of a bit that are looked at, by themselves and together: how much more these
have by chance. Chosen: later nodes miss these, too; e^(−5.36²/2) is as rare as 5 deviations."""
LATE_SHARE = 0.35
"""Share of its amplitude with which a word shows in the wrong bits' chips, or on a row that no node
has, if it is late. Chosen: one late by 0.6 chip shows in full there, or by 0.6."""
LEAKED = 0.3
"""Share of the next chip that a chip may hold with nobody late. Chosen: a low-pass of 0.3 chip."""
BY_CHANCE = 5.0
"""Deviations by which it must show in chips. Chosen: by chance in one of 500 frames of 1,000."""
SHOWN, ANYWHERE = 4.0, 6.0
"""Standard deviations of a mean |r| by which it must show on a row; the same of a faint word, of
any node. Chosen: of noise alone, levels of ten bits exceed the latter once in 10⁵ rows."""
A_CHIP, FEW_SHARE = 1.0, 0.5
"""Energy that words may leave over in a bit without a closer look, in chips of the weakest of them;
FEW_SHARE of it where there are FEW.
Chosen: of a node that is a chip late one chip is inverted in half of its bits, which leaves 2."""
PART = 0.6
"""Share of a node's amplitude below which a word may be a part of one that is out of step. Chosen:
one that is half a chip late has half of it on either row."""
OUT_OF_STEP, FEW = 0.25, 3
"""Difference of two words' delays, chips, beyond which either may be on another's row: half of the
delay at which rows change places; most words of which their delays are told apart. Both chosen."""


def out_of_place(
    levels: NodeLevels, amplitude: Floats32, active: Bools, expected: float, spec: FrameSpec
) -> Bools | None:
    """Words that may be those of other nodes, (n,) bool; None where nothing is out of place.

    amplitude: (n,) V, of every node's word. active: (n,) bool, at least one. expected: amplitude of
    a node, V. They are looked for where the words leave over as much as a chip of one of them.
    """
    if levels.rows is None or spec.sparse:  # there, detection has looked for all that
        return None
    rows = levels.rows if spec.first_row == 0 else levels.rows[:, 1:]
    spoken = amplitude[active]
    left = float(np.einsum("kr,kr->", rows, rows)) / spec.line_bits - float(np.square(spoken).sum())
    least, are_few = float(spoken.min()), spoken.size <= FEW
    weakest = min(least, expected) if spec.scramble else least
    least_v2 = (few_share(spec) if are_few else 1.0) * least_left(spec) * weakest**2 / spec.order
    if spec.scramble and left >= least_v2:
        left -= common_energy(levels.rows, amplitude, active, spec)
    if left < least_v2:
        return None
    if spec.scramble:
        others, hidden = displaced(levels, amplitude, active, expected, spec)
        return others if hidden or others.any() else None
    if are_few and few_differ(levels, amplitude, active, expected, spec):
        return active
    are_late = late(levels, amplitude, active, spec)
    if are_late.any():  # words that are weak may be parts of these
        return are_late | (active & (amplitude < SOUND_SHARE * expected))
    spare = np.abs(levels.rows[:, spec.spare_rows]).mean(axis=0)
    return are_late if (spare > LATE_SHARE * least).any() else None


def few_differ(
    levels: NodeLevels, amplitude: Floats32, active: Bools, expected: float, spec: FrameSpec
) -> bool:
    """Whether one of FEW words may be a part of another, or they differ in their delays.

    Arguments as of out_of_place.
    """
    least = float(amplitude[active].min())
    most_v2 = few_share(spec) * least_left(spec) * least**2 / spec.order
    if least < PART * expected and not _leaks(levels, amplitude, active, most_v2, spec):
        return True
    by = delays(levels, amplitude, active, spec)
    return bool(np.ptp(by) > OUT_OF_STEP or np.abs(by).max() > OFF_THE_MARK)


def _leaks(
    levels: NodeLevels, amplitude: Floats32, active: Bools, most_v2: float, spec: FrameSpec
) -> bool:
    """Whether one share of the chip before, in all chips alike, explains what the words leave over.

    That a low-pass leaves, or samples taken while the level changes; a part of a late word is more
    than LEAKED of it late. most_v2: what may be left of it in a bit, V².
    """
    signs, meant, left = _taken_apart(levels, amplitude, active, spec)
    chips = chips_of(meant, spec).ravel()
    before = rows_of(np.append(np.float32(0), chips[:-1]).reshape(left.shape), spec)
    beside = before[:, spec.node_slice]
    beside -= (beside * signs).mean(axis=0) * signs  # which is part of the words' amplitude
    if spec.first_row > 0:
        before[:, 0] = 0.0
    product, power = float((left * before).sum()), float(np.square(before).sum())
    rest = float(np.square(left).sum()) - product**2 / power
    return 0 <= product < LEAKED * power and rest < most_v2 * spec.line_bits


def common_energy(rows: Floats32, amplitude: Floats32, active: Bools, spec: FrameSpec) -> float:
    """Energy per bit that one offset of all chips explains of what words leave over, V².

    No word, late or not, has it. Of a scrambled frame whose line at rest is unknown, so that its
    mean is taken for the level. Least squares for the offset and all amplitudes at once, which hold
    a part of it: the k-th, and if all nodes speak, that much would be left. rows: (k, N) V.
    """
    begin = 0 if spec.first_row == 0 else 1
    offset = offset_rows(spec).reshape(rows.shape)
    nodes = np.flatnonzero(active)
    signs = np.sign(rows[:, spec.node_slice][:, nodes])
    along = (signs * offset[:, spec.node_slice][:, nodes]).sum(axis=0)
    offset = offset[:, begin:]
    product = float(np.einsum("kr,kr->", rows[:, begin:], offset)) - float(along @ amplitude[nodes])
    norm = float(np.einsum("kr,kr->", offset, offset)) - float(along @ along) / spec.line_bits
    return product**2 / norm / spec.line_bits


@lru_cache(maxsize=8)
def offset_rows(spec: FrameSpec) -> Floats32:
    """Rows of an offset of 1 V, (k N,); none where chips are not scrambled."""
    if not spec.scramble or spec.sparse:
        return np.empty(0, np.float32)
    return rows_of(np.ones((spec.line_bits, spec.order), np.float32), spec).ravel()


def least_left(spec: FrameSpec) -> float:
    """Energy that is left over for a closer look, in chips of the weakest word."""
    if spec.sparse or spec.order <= 2 * EDGE:  # a bit of so few chips is all edges
        return math.inf
    # Scrambled: half of what a word has that displaced finds.
    return 0.5 * LATE_SHARE**2 * spec.order if spec.scramble else A_CHIP


def few_share(spec: FrameSpec) -> float:
    """Share of that where FEW words were spoken."""
    return 1.0 if spec.scramble else FEW_SHARE


def displaced(
    levels: NodeLevels, amplitude: Floats32, active: Bools, expected: float, spec: FrameSpec
) -> tuple[Bools, bool]:
    """Nodes whose words show when the chips are read early or late, (n,) bool; whether others may.

    Chips that are late show in other rows, in parts, or, if they are scrambled, in none; read as
    late as they are, they are words again. They are looked for in what words in time leave over.
    Later nodes, and other flips of chips, can only be told from noise by how much is left.
    """
    _, _, left = _taken_apart(levels, amplitude, active, spec)
    left_v = math.sqrt(float(np.square(left).sum()) / spec.line_bits)  # of a chip, RMS
    chips = np.pad(chips_of(left, spec).ravel(), EDGE)
    least, deviations = LATE_SHARE * float(amplitude[active].min(initial=expected)), SHOWN
    if not active.any():  # then nothing of anybody's word is left over
        least, deviations = LEAST_SHARE * expected, ANYWHERE
    found = np.zeros(spec.nodes, np.bool_)
    in_place = most = 0.0
    for late_chips in range(-EDGE, EDGE + 1):
        first = EDGE + late_chips
        read = chips[first : first + spec.chips].reshape(left.shape)
        mean = np.abs(rows_of(read, spec)[:, spec.node_slice]).mean(axis=0)
        # Noise, as which all else shows: mean of |r|, and how far it scatters by chance.
        by_chance = float(np.median(mean)) * (1 + deviations * 0.76 / math.sqrt(spec.line_bits))
        shows = mean > max(least, by_chance)
        loud = shows & ~active & (mean > 0.5 * mean.max(where=~active, initial=0))
        power = float(np.square(mean[loud]).sum())
        if late_chips:
            found, most = found | shows, max(most, power)
        else:
            in_place = power
    if most < in_place:  # words that are only faint show in place
        found[:] = False
    return found, left_v > HIDDEN * expected


def late(levels: NodeLevels, amplitude: Floats32, active: Bools, spec: FrameSpec) -> Bools:
    """Active nodes whose words show in chips of other bits than theirs, (n,) bool.

    amplitude: (n,) V, of every node's word. active: (n,) bool, those that spoke or may have.
    """
    signs, meant, left = _taken_apart(levels, amplitude, active, spec)
    chips = _without_leakage(chips_of(left, spec), chips_of(meant, spec))
    earlier, later = signs[:-1], signs[1:]
    variance = np.square(chips[:, EDGE:-EDGE]).mean(axis=1, dtype=np.float32)
    most_by_chance = by_chance_of(spec)

    def shows(word: Floats32, owner: Floats32, edge: Floats32, noise: Floats32) -> Bools:
        # How much of each word there is in the chips next to its bits, beside what is due to the
        # bits that own these chips: linear regression on both.
        alike = np.einsum("kn,kn->n", word, owner) / np.float32(len(word))
        scale = 1 / np.maximum(len(word) * (1 - np.square(alike)), np.float32(1e-3))
        weights = word - alike * owner
        each = np.abs(edge.T @ weights) * scale
        most = np.maximum(each.max(axis=0), np.hypot(*each) * np.float32(1 / OF_TWO))
        by_chance = most_by_chance * scale * np.sqrt(noise @ np.square(weights))
        is_shown: Bools = most > np.maximum(LATE_SHARE * amplitude, by_chance)
        return is_shown

    def found(word: Floats32, owner: Floats32, edge: Floats32, noise: Floats32) -> Bools:
        is_found, height = shows(word, owner, edge, noise), np.abs(edge).max(axis=1)
        others = np.arange(len(edge)) != height.argmax()
        if height.max() < BY_CHANCE * math.sqrt(noise[~others].item()):
            return is_found
        # A late word shows wherever its bits change, what has hit one chip in one place.
        rest = word[others], owner[others], edge[others]
        changes_once = (rest[0] == rest[1]).all(axis=0)
        is_found &= changes_once | shows(*rest, np.zeros(others.sum(), np.float32))
        return is_found

    are_late: Bools = found(earlier, later, chips[1:, :EDGE], variance[1:])
    are_late |= found(later, earlier, chips[:-1, -EDGE:], variance[:-1])
    return active & are_late


def by_chance_of(spec: FrameSpec) -> float:
    """As rare as BY_CHANCE, in deviations estimated from the inner chips of a single bit.

    Of Student's t, in Peiser's approximation (1943).
    """
    return BY_CHANCE * (1 + (BY_CHANCE**2 + 1) / (4 * max(spec.order - 2 * EDGE, 1)))


def _without_leakage(left: Floats32, meant: Floats32) -> Floats32:
    """Chips that words leave over, without what they hold of the chips beside them, (k, N) V.

    That is a share of all chips alike, and seen within the bits, too; what is late is not.
    """
    within = np.s_[..., EDGE:-EDGE]
    before, after = np.pad(meant.ravel(), (1, 0))[:-1], np.pad(meant.ravel(), (0, 1))[1:]
    beside = np.stack((before, after)).reshape(2, *meant.shape)
    cause = beside[within].reshape(2, -1)
    share = np.linalg.lstsq(cause @ cause.T, cause @ left[within].ravel(), rcond=None)[0]
    return left - np.tensordot(share.clip(0, LEAKED).astype(np.float32), beside, 1)


def delays(levels: NodeLevels, amplitude: Floats32, active: Bools, spec: FrameSpec) -> Floats32:
    """How many chips late each of m active words is, (m,), for delays of less than half a chip.

    A word that is d late is (1 − d) of itself and d of what it was a chip ago. So what the words
    leave over, shifted by a chip to either side, has d of the word's amplitude in its difference.
    The words' common delay is in the frame's timing already.
    """
    signs, _, left = _taken_apart(levels, amplitude, active, spec)
    chips = np.pad(chips_of(left, spec).ravel(), 1)
    turned = (chips[2:] - chips[:-2]).reshape(left.shape)
    nodes = np.flatnonzero(active)
    early = rows_of(turned, spec)[:, spec.first_row + nodes]
    late_chips: Floats32 = (early * signs[:, nodes]).mean(axis=0, dtype=np.float32)
    late_chips /= np.maximum(amplitude[nodes], np.float32(1e-30))
    return late_chips


def _taken_apart(
    levels: NodeLevels, amplitude: Floats32, active: Bools, spec: FrameSpec
) -> tuple[Floats32, Floats32, Floats32]:
    """Signs of the words, (k, n); the rows that they mean, and what is left of all, (k, N) V."""
    assert levels.rows is not None
    signs: Floats32 = np.sign(levels.values) * active
    meant = np.zeros_like(levels.rows)
    meant[:, spec.node_slice] = signs * amplitude
    left = levels.rows - meant
    if spec.first_row > 0 and not spec.scramble:
        left[:, 0] = 0.0  # the line's offset
    return signs, meant, left


@lru_cache(maxsize=8)
def edge_rows(book: CodeBook) -> Floats32:
    """The last and then the first chips of all rows, (2·EDGE, N); 0 where these are all chips."""
    if book.order <= 2 * EDGE:
        return np.zeros((2 * EDGE, book.order), np.float32)
    chosen = np.zeros((2 * EDGE, book.order), np.float32)
    chosen[np.arange(2 * EDGE), np.arange(-EDGE, EDGE)] = book.order
    return correlate(chosen, book)
