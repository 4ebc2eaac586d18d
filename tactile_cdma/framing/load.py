# SPDX-License-Identifier: Apache-2.0

"""How many nodes may speak in one frame, and how many do."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.arrays import Floats32, Indices
from ..code.frame import FrameSpec
from ..code.transform import rows_of
from ..wire._protocol import TURN_MOST_LOG2
from ..words.limits import LIMITS

CAPACITY, LOST = 0.65, 2.0
"""Nodes that may speak in a frame, of the chips per bit but LOST times their square root: beyond,
some frames do not settle (make bench-sparse)."""
ALIKE_BELOW = 128
"""Chips per bit below which codes of those who speak may add up to nothing. Derived: of four whose
numbers XOR to 0 they do in a bit once in 0.75^-N times, in 10¹⁶ at 128 chips."""


class Load(NamedTuple):
    """Nodes that speak at once.

    capacity: most that are told apart. now, peak: in the newest frame, and in any so far; of those
    that are not told apart, as many as have the line's power. overloads: frames of more than the
    capacity, or of nodes whose codes are not told apart; crowded: the newest one is of these.
    """

    capacity: int
    now: int = 0
    peak: int = 0
    overloads: int = 0
    crowded: bool = False

    def after(self, now: int, crowded: bool = False) -> Load:
        """With a frame more, in which so many spoke."""
        overloads = self.overloads + (crowded or now > self.capacity)
        return Load(self.capacity, now, max(self.peak, now), overloads, crowded)


def capacity(spec: FrameSpec) -> int:
    """Nodes that may speak in one frame."""
    if not spec.sparse:
        return spec.nodes
    return min(spec.nodes, told_apart(spec.order))


def told_apart(order: int) -> int:
    """Nodes that may speak in one frame of so many chips per bit."""
    return max(1, int(CAPACITY * (order - LOST * math.sqrt(order))))


def groups_for_all(spec: FrameSpec) -> int:
    """In how many groups all nodes may speak by turns, and are told apart; 0: in none."""
    codes = spec.code_numbers[spec.rows]
    products = _products(spec) if spec.order < ALIKE_BELOW else None
    for log2 in range(TURN_MOST_LOG2 + 1):
        groups = [codes[first :: 1 << log2] for first in range(1 << log2)]
        most = max(each.size for each in groups)
        if most <= capacity(spec) and (
            products is None or all(_told_apart(each, products, LIMITS.left) for each in groups)
        ):
            return len(groups)
    return 0


def _products(spec: FrameSpec) -> Floats32:
    """Return products of codes i and j over the chips per bit, at i XOR j, (k, 2^m)."""
    assert spec.flips is not None, "sparse codes are scrambled"
    products = np.empty((spec.line_bits, spec.row_count), np.float32)
    # Those of code 0, whose chips are the flips, with all.
    products[:, spec.code_numbers] = rows_of(spec.flips, spec)
    return products


def _told_apart(codes: Indices, products: Floats32, least: float) -> bool:
    """Whether all other bits of these codes change a bit's power by so much, amplitudes squared."""
    gram = products[:, codes[:, None] ^ codes].astype(np.float64)
    diagonal = np.arange(codes.size)
    gram[:, diagonal, diagonal] -= least / 8
    try:
        np.linalg.cholesky(gram)
    except np.linalg.LinAlgError:
        return False
    return True
