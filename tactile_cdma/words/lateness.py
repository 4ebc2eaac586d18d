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
from ..code.amplitude import HIDDEN
from ..code.codes import CodeBook
from ..code.frame import FrameSpec
from ..code.separate import NodeLevels
from ..code.transform import chips_of, correlate, rows_of

OFF_THE_MARK = 0.6
"""Delay of FEW words of one value per chip, in chips of what is left of them, from which on others
may be less than FAINT_SHARE, as with a mark half a chip off; raw samples are read as late as they
are. Chosen: d chips are d/(1 - d), and a low-pass of 0.3 chip looks like 0.3."""
EDGE = 2
"""Chips at either end of a bit that are looked at. Chosen: later nodes miss these, too."""
LATE_SHARE = 0.35
"""Share of its amplitude with which a word shows in the wrong bits' chips, or on a row that no node
has, if it is late. Chosen: one late by 0.6 chip shows in full there, or by 0.6."""
LEAKED = 0.3
"""Share of a chip that may be the one beside it without anybody being late. Chosen: a low-pass of
0.3 chip."""
BY_CHANCE = 4.0
"""Standard deviations by which it must show. Chosen."""
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
    weakest, few = float(spoken.min()), few_share(spec) if spoken.size <= FEW else 1.0
    if spec.scramble:
        left -= common_energy(levels.rows, amplitude, active, spec)
        weakest = min(weakest, expected)
    least_v2 = few * least_left(spec) * weakest**2 / spec.order
    if left < least_v2:
        return None
    if spec.scramble:
        others, hidden = late_scrambled(levels, amplitude, active, expected, spec)
        return others if hidden or others.any() else None
    least = float(spoken.min())
    if spoken.size <= FEW:
        by = delays(levels, amplitude, active, spec)[active]
        weak = least < PART * expected and not _leaks(levels, amplitude, active, least_v2, spec)
        if weak or np.ptp(by) > OUT_OF_STEP or np.abs(by).max() > OFF_THE_MARK:
            return active
    are_late = late(levels, amplitude, active, spec)
    spare = np.abs(levels.rows[:, spec.spare_rows]).mean(axis=0)
    return are_late if are_late.any() or (spare > LATE_SHARE * least).any() else None


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
    """Energy per bit of what one offset of all chips leaves over, V²: no word, late or not, has it.

    Of a scrambled frame whose line at rest is unknown, so that its mean is taken for the level.
    rows: (k, N) V.
    """
    begin = 0 if spec.first_row == 0 else 1
    offset = offset_rows(spec).reshape(rows.shape)
    nodes = np.flatnonzero(active)
    signs = np.sign(rows[:, spec.node_slice][:, nodes])
    words = (signs * offset[:, spec.node_slice][:, nodes]).sum(axis=0) @ amplitude[nodes]
    offset = offset[:, begin:]
    product = float(np.einsum("kr,kr->", rows[:, begin:], offset)) - float(words)
    return product**2 / float(np.einsum("kr,kr->", offset, offset)) / spec.line_bits


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
    # Scrambled: half of what a word has that late_scrambled finds.
    return 0.5 * LATE_SHARE**2 * spec.order if spec.scramble else A_CHIP


def few_share(spec: FrameSpec) -> float:
    """Share of that where FEW words were spoken."""
    return 1.0 if spec.scramble else FEW_SHARE


def late_scrambled(
    levels: NodeLevels, amplitude: Floats32, active: Bools, expected: float, spec: FrameSpec
) -> tuple[Bools, bool]:
    """Nodes whose words show when the chips are read early or late, (n,) bool; whether others may.

    Scrambled chips that are late by whole chips show in no row; read as late as they are, they are
    words again. They are looked for in what the words that are in time leave over. A node that is
    later, or flips its chips otherwise, can only be told from noise by how much is left.
    """
    _, _, left = _taken_apart(levels, amplitude, active, spec)
    left_v = math.sqrt(float(np.square(left).sum()) / spec.line_bits)  # of a chip, RMS
    chips = np.pad(chips_of(left, spec).ravel(), EDGE)
    least = LATE_SHARE * min(expected, float(amplitude[active].min()))
    found = np.zeros(spec.nodes, np.bool_)
    for late_chips in (*range(-EDGE, 0), *range(1, EDGE + 1)):
        first = EDGE + late_chips
        read = chips[first : first + spec.chips].reshape(left.shape)
        mean = np.abs(rows_of(read, spec)[:, spec.node_slice]).mean(axis=0)
        # Noise, as which all else shows: mean of |r|, and how far it scatters by chance.
        by_chance = float(np.median(mean)) * (1 + BY_CHANCE * 0.76 / math.sqrt(spec.line_bits))
        found |= mean > max(least, by_chance)
    return found, left_v > HIDDEN * expected


def late(levels: NodeLevels, amplitude: Floats32, active: Bools, spec: FrameSpec) -> Bools:
    """Active nodes whose words show in chips of other bits than theirs, (n,) bool.

    amplitude: (n,) V, of every node's word. active: (n,) bool, those that spoke or may have.
    """
    first, last = _edges(spec.book)
    signs, meant, left = _taken_apart(levels, amplitude, active, spec)
    earlier, later = signs[:-1], signs[1:]
    alike = np.einsum("kn,kn->n", earlier, later) / np.float32(len(earlier))
    # How much of each word there is in the chips next to its bits, beside what is due to the bits
    # that own these chips: linear regression on both.
    scale = 1 / np.maximum(len(earlier) * (1 - np.square(alike)), np.float32(1e-3))

    def shares(word: Floats32, owner: Floats32, chips: Floats32, leaked: Floats32) -> Floats32:
        both: Floats32 = np.abs(np.hstack((chips, leaked)).T @ (word - alike * owner)) * scale
        beside: Floats32 = both[:-1].max(axis=0) - np.float32(LEAKED) * both[-1]
        return beside

    begins, ends = left @ first, left @ last
    before = shares(earlier, later, begins[1:], (meant @ last[:, -1:])[:-1])
    after = shares(later, earlier, ends[:-1], (meant @ first[:, :1])[1:])
    by_chance_v = BY_CHANCE * np.sqrt(_variance_within(left, begins, ends) * scale)
    limit = np.maximum(LATE_SHARE * amplitude, by_chance_v)
    found: Bools = active & (np.maximum(before, after) > limit)
    return found


def _variance_within(left: Floats32, begins: Floats32, ends: Floats32) -> float:
    """Mean square of the chips left over but at the edges of bits, V²: (k, N) rows to a number.

    begins, ends: (k, EDGE) V, the chips at the edges.
    """
    bits, order = left.shape
    edges = np.square(begins).sum() + np.square(ends).sum()
    within = float(order * np.einsum("kr,kr->", left, left)) - float(edges)
    return max(within, 0.0) / float(bits * (order - 2 * EDGE))


def delays(levels: NodeLevels, amplitude: Floats32, active: Bools, spec: FrameSpec) -> Floats32:
    """How many chips late each word is, (n,), for delays of less than half a chip.

    A word that is d late is (1 − d) of itself and d of what it was a chip ago. So what the words
    leave over, shifted by a chip to either side, has d of the word's amplitude in its difference.
    The words' common delay is in the frame's timing already.
    """
    signs, _, left = _taken_apart(levels, amplitude, active, spec)
    chips = np.pad(chips_of(left, spec).ravel(), 1)
    turned = (chips[2:] - chips[:-2]).reshape(left.shape)
    early = rows_of(turned, spec)[:, spec.node_slice]
    late_chips: Floats32 = (early * signs).mean(axis=0, dtype=np.float32)
    late_chips /= np.maximum(amplitude, np.float32(1e-30))
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


def _edges(book: CodeBook) -> tuple[Floats32, Floats32]:
    """The first and the last chips of all rows, (N, EDGE) each."""
    rows = edge_rows(book)
    return rows[EDGE:].T, rows[:EDGE].T


@lru_cache(maxsize=8)
def edge_rows(book: CodeBook) -> Floats32:
    """The last and then the first chips of all rows, (2·EDGE, N); 0 where these are all chips."""
    if book.order <= 2 * EDGE:
        return np.zeros((2 * EDGE, book.order), np.float32)
    chosen = np.zeros((2 * EDGE, book.order), np.float32)
    chosen[np.arange(2 * EDGE), np.arange(-EDGE, EDGE)] = book.order
    return correlate(chosen, book)
