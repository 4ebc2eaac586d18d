# SPDX-License-Identifier: Apache-2.0

"""Rows of a code book that a delay makes alike: one node that is late may look like another one.

Scrambled codes have none, since flips differ from chip to chip.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .codes import code_book
from .transform import correlate

MOST_LATE = 2
"""Chips by which a node may be late or early, as in kernel/certificate.c."""
SHIFTS = tuple(shift for shift in range(-MOST_LATE, MOST_LATE + 1) if shift)
"""All of these, rising, as the kernel looks at them."""
ALIKE = 0.5
"""Correlation from which on two rows are alike. A node that is taken for another one leaves
1 − ALIKE² of its power over, 0.75 A², which shows as energy."""
TWIN = np.dtype(
    [("sent", "i4"), ("alike", "i4"), ("shift", "i4"), ("share", "f4"), ("wrap", "f4")], align=True
)
"""Members of the kernel's struct code_twin."""
AT_ONCE = 256
"""Rows that are shifted and correlated together: bounds the memory to some MB."""


@lru_cache(maxsize=4)
def twins(order: int, first_row: int, nodes: int) -> NDArray[np.void]:
    """The pairs of nodes' rows that are alike, (p,) of TWIN, by shift.

    share: Σᵢ sent[i + shift]·alike[i] / N within a bit; wrap: the same over the chips that lie in
    the bit beside.
    """
    book, found = code_book(order), []
    for shift in SHIFTS:
        for begin in range(0, nodes, AT_ONCE):
            sent = np.arange(begin, min(begin + AT_ONCE, nodes))
            rows = book.rows(first_row + sent).astype(np.float32)
            moved, beside = np.zeros_like(rows), np.zeros_like(rows)
            inner, outer = (slice(0, -shift), slice(-shift, None)) if shift > 0 else (
                slice(-shift, None), slice(0, -shift)
            )  # fmt: skip
            moved[:, inner] = rows[:, shift:] if shift > 0 else rows[:, :shift]
            beside[:, outer] = rows[:, :shift] if shift > 0 else rows[:, shift:]
            share = correlate(moved, book)[:, first_row : first_row + nodes]
            wrap = correlate(beside, book)[:, first_row : first_row + nodes]
            of, alike = np.nonzero(np.abs(share) > ALIKE)
            others = (sent[of] != alike) | (share[of, alike] < 0)  # a node's own row, inverted
            of, alike = of[others], alike[others]
            pairs = np.zeros(of.size, TWIN)
            pairs["sent"], pairs["alike"], pairs["shift"] = sent[of], alike, shift
            pairs["share"], pairs["wrap"] = share[of, alike], wrap[of, alike]
            found.append(pairs)
    return np.concatenate(found)
