# SPDX-License-Identifier: Apache-2.0

"""Finds words that may be those of a late node on another row.

In Paley's orders rows are nearly each other's shifts, so a node that is late by chips speaks on
another one's row. But its first chips of a bit still say what the bit before did, its last ones if
it is early what the next one does, and of a word that is sent on time no chip does that.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools, Floats32
from ..code.codes import CodeBook
from ..code.frame import FrameSpec
from ..code.separate import NodeLevels
from ..code.transform import correlate, spread

EDGE = 2
"""Chips at either end of a bit that are looked at. Chosen: later nodes miss these, too."""
LATE_SHARE = 0.35
"""Share of its amplitude with which a word shows in the wrong bits' chips if it is late. Chosen:
one late by 0.6 chip shows in full."""
LEAKED = 0.3
"""Share of a chip that may be the one beside it without anybody being late. Chosen: a low-pass of
0.3 chip."""
BY_CHANCE = 4.0
"""Standard deviations by which it must show. Chosen."""


def late(levels: NodeLevels, amplitude: Floats32, active: Bools, spec: FrameSpec) -> Bools:
    """Active nodes whose words show in chips of other bits than theirs, (n,) bool.

    amplitude: (n,) V, of every node's word. active: (n,) bool, those that spoke or may have.
    """
    assert levels.rows is not None
    first, last = _edges(spec.book)
    signs = np.sign(levels.values) * active
    meant = np.zeros_like(levels.rows)
    meant[:, spec.node_slice] = signs * amplitude
    left = levels.rows - meant
    if spec.first_row > 0:
        left[:, 0] = 0.0  # the line's offset
    earlier, later = signs[:-1], signs[1:]
    alike = np.einsum("kn,kn->n", earlier, later) / np.float32(len(earlier))
    # How much of each word there is in the chips next to its bits, beside what is due to the bits
    # that own these chips: linear regression on both.
    scale = 1 / np.maximum(len(earlier) * (1 - np.square(alike)), np.float32(1e-3))

    def share(word: Floats32, owner: Floats32, chips: NDArray[Any]) -> Floats32:
        found: Floats32 = np.abs((word - alike * owner).T @ chips).max(axis=1) * scale
        return found

    before = share(earlier, later, (left @ first)[1:])
    before -= LEAKED * share(earlier, later, (meant @ last[:, -1:])[:-1])
    after = share(later, earlier, (left @ last)[:-1])
    after -= LEAKED * share(later, earlier, (meant @ first[:, :1])[1:])
    by_chance_v = BY_CHANCE * np.sqrt(_variance_within(left, first, last) * scale)
    limit = np.maximum(LATE_SHARE * amplitude, by_chance_v)
    found: Bools = active & (np.maximum(before, after) > limit)
    return found


def _variance_within(left: Floats32, first: Floats32, last: Floats32) -> float:
    """Mean square of the chips left over but at the edges of bits, V²: (k, N) rows to a number."""
    bits, order = left.shape
    edges = np.square(left @ first).sum() + np.square(left @ last).sum()
    within = float(order * np.square(left).sum()) - float(edges)
    return max(within, 0.0) / float(bits * max(order - 2 * EDGE, 1))


def delays(levels: NodeLevels, amplitude: Floats32, active: Bools, spec: FrameSpec) -> Floats32:
    """How many chips late each word is, (n,), for delays of less than half a chip.

    A word that is d late is (1 − d) of itself and d of what it was a chip ago. So what the words
    leave over, shifted by a chip to either side, has d of the word's amplitude in its difference.
    The words' common delay is in the frame's timing already.
    """
    assert levels.rows is not None
    signs = np.sign(levels.values) * active
    left = levels.rows.copy()
    left[:, spec.node_slice] -= signs * amplitude
    chips = np.pad(spread(left, spec.book).ravel(), 1)
    turned = (chips[2:] - chips[:-2]).reshape(left.shape)
    early = correlate(turned, spec.book)[:, spec.node_slice]
    late_chips: Floats32 = (early * signs).mean(axis=0) / np.maximum(amplitude, np.float32(1e-30))
    return late_chips


@lru_cache(maxsize=8)
def _edges(book: CodeBook) -> tuple[Floats32, Floats32]:
    """The first and the last chips of all rows, (N, EDGE) each."""
    chosen = np.zeros((2 * EDGE, book.order), np.float32)
    chosen[np.arange(2 * EDGE), np.arange(-EDGE, EDGE)] = book.order
    columns = correlate(chosen, book).T
    return columns[:, EDGE:].copy(), columns[:, :EDGE].copy()
