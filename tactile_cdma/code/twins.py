# SPDX-License-Identifier: Apache-2.0

"""Rows of a code book that a delay makes alike: one node that is late may look like another one.

Scrambled codes have none, since flips differ from chip to chip.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats32
from .codes import CodeBook, code_book

MOST_LATE = 2
"""Chips by which a node, or a mark, may be late or early, as in kernel/certifier.h."""
SHIFTS = tuple(shift for shift in range(-MOST_LATE, MOST_LATE + 1) if shift)
"""All of these, rising, as the kernel looks at them."""
ALIKE = 0.5
"""Correlation from which on two rows are alike. A node that is taken for another one leaves
1 − ALIKE² of its power over, 0.75 A², which shows as energy."""
TWIN = np.dtype(
    [("sent", "i4"), ("alike", "i4"), ("shift", "i4"), ("share", "f4"), ("wrap", "f4")], align=True
)
"""Members of the kernel's struct code_twin."""
LEAST_FACTOR = math.ceil(MOST_LATE / ALIKE)
"""Order from which on a factor's rows tell which rows are alike: a delay takes MOST_LATE of so many
chips into the next block, where others can be alike in no more than ALIKE."""


@lru_cache(maxsize=4)
def twins(order: int, first_row: int, nodes: int) -> NDArray[np.void]:
    """The pairs of nodes' rows that are alike, (p,) of TWIN, by shift.

    share: Σᵢ sent[i + shift]·alike[i] / N within a bit; wrap: the same over the chips that lie in
    the bit beside.

    Rows are products of those of a high and a low factor, h ⊗ l. With another h they are alike in
    no more than the chips that a delay takes into the next block; with the same one in what is
    alike within blocks of l, and h's likeness to itself a block later times that across them.
    """
    plan, found = code_book(order).plan, []
    ways = range(len(plan) - 1, -1, -1)
    split = next((at for at in ways if math.prod(plan[at:]) > LEAST_FACTOR), 0)
    high, low = CodeBook(plan[:split]), CodeBook(plan[split:])
    blocks, chips = high.order, low.order
    itself, ends = _likeness(high)
    rows = low.matrix.astype(np.float32)
    for shift in SHIFTS:
        late = abs(shift)
        inside = rows[:, late:] @ rows[:, :-late].T / chips
        across = rows[:, :late] @ rows[:, -late:].T / chips
        if shift < 0:
            inside, across = inside.T, across.T
        sent, alike = np.nonzero(np.abs(inside) + np.abs(across) > ALIKE)
        share = inside[sent, alike] + itself[:, None] * across[sent, alike]
        wrap = ends[:, None] * across[sent, alike] / blocks
        base = chips * np.arange(blocks)[:, None] - first_row
        pairs = np.zeros(share.shape, TWIN)
        pairs["sent"], pairs["alike"], pairs["shift"] = base + sent, base + alike, shift
        pairs["share"], pairs["wrap"] = share, wrap
        others = (sent != alike) | (share < 0)  # a node's own row, inverted
        for place in (base + sent, base + alike):
            others &= (place >= 0) & (place < nodes)
        found.append(pairs[others & (np.abs(share) > ALIKE)])
    return np.concatenate(found)


def _likeness(book: CodeBook) -> tuple[Floats32, Floats32]:
    """Return each row's correlation with itself a chip later, and its first chip times its last.

    Where a row is h ⊗ l, neighbours within a block are those of l, and across its end those of h.
    """
    itself, ends = np.zeros(1, np.float32), np.ones(1, np.float32)
    for order in book.plan:
        rows = CodeBook((order,)).matrix.astype(np.float32)
        inside = np.einsum("ij,ij->i", rows[:, 1:], rows[:, :-1]) / order
        across = rows[:, 0] * rows[:, -1]
        itself = (inside + itself[:, None] * across / order).ravel()
        ends = np.outer(ends, across).ravel()
    return itself, ends
