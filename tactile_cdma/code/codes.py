# SPDX-License-Identifier: Apache-2.0

"""Hadamard code books of any feasible order, and the pseudo-random signs of their rows.

A code book is a matrix C of ±1 with C·Cᵀ = N·I. Three constructions cover the orders:

- Sylvester (1867): [[1, 1], [1, -1]], and its Kronecker powers;
- Paley I (1933): order q + 1 for a prime power q ≡ 3 (mod 4);
- Paley II: order 2(q + 1) for a prime power q ≡ 1 (mod 4);

and the Kronecker product of two Hadamard matrices is one again. Factors above MOST_FACTOR are left
out. Powers of two are always Sylvester's matrix in natural order, which is also what MATLAB's and
scipy's `hadamard` give.
firmware/codes.md defines every entry of every book, for implementations elsewhere.
"""

import math
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.arrays import Indices
from ..base.errors import SpecError
from .paley import paley

MAX_ORDER = 65_536
"""Largest code order. Chosen; make bench-speed goes up to it."""
MOST_FACTOR = 1024
"""Largest factor of a book. Chosen: a product with larger ones takes longer than a chip more or two
cost, and every order up to it that has a matrix stays."""
SMALL_FACTOR = 100
"""Largest factor of books that are several times cheaper to correlate (make bench-speed)."""
MOST_EXTRA = 0.02
"""Share by which a default order, and a frame, may be longer to have small factors. Chosen."""


@dataclass(frozen=True)
class CodeBook:
    """A Hadamard matrix that is the Kronecker product of smaller ones.

    plan: orders of the factors, the first varying slowest: 1, 2 (Sylvester) or a Paley order.
    """

    plan: tuple[int, ...]

    @cached_property
    def order(self) -> int:
        """Number of rows, and of chips per bit."""
        return math.prod(self.plan)

    @cached_property
    def matrix(self) -> NDArray[np.int8]:
        """The whole book, (N, N) int8 of ±1; row 0 is all ones. N² bytes: meant for small N."""
        return self.rows(np.arange(self.order))

    def rows(self, indices: ArrayLike) -> NDArray[np.int8]:
        """Some rows, (len(indices), N) int8 of ±1, without forming the matrix."""
        remaining = np.asarray(indices, dtype=np.intp)
        if remaining.size and not 0 <= remaining.min() <= remaining.max() < self.order:
            raise SpecError(f"code rows run from 0 to {self.order - 1}, got {indices!r}")
        rows = np.ones((remaining.size, 1), dtype=np.int8)
        for order in reversed(self.plan):
            remaining, digit = np.divmod(remaining, order)
            if matrix := paley(order):
                factor = matrix.rows(digit)
            else:  # order 1 or 2
                factor = np.array([[1, 1], [1, -1]], dtype=np.int8)[digit, :order]
            width = rows.shape[1] * order
            rows = (factor[:, :, None] * rows[:, None, :]).reshape(remaining.size, width)
        return rows


@lru_cache(maxsize=32)
def code_book(order: int) -> CodeBook:
    """The code book of this order.

    Raises SpecError, naming the nearest feasible orders, where no construction applies.
    """
    if not 1 <= order <= MAX_ORDER:
        raise SpecError(f"code order {order} is outside 1…{MAX_ORDER}")
    plan = _plan(order)
    if plan is None:
        below = next(n for n in range(order - 1, 0, -1) if is_feasible(n))
        raise SpecError(
            f"no Hadamard matrix of order {order} can be built; "
            f"the nearest feasible orders are {below} and {smallest_order(order)}"
        )
    return CodeBook(plan)


def is_feasible(order: int) -> bool:
    """Whether one of the constructions yields a Hadamard matrix of this order."""
    return order >= 1 and _plan(order) is not None


def smallest_order(rows: int) -> int:
    """The smallest feasible order with at least this many rows.

    Raises SpecError above MAX_ORDER rows.
    """
    if not 1 <= rows <= MAX_ORDER:
        raise SpecError(f"{rows} code rows needed; orders run from 1 to {MAX_ORDER}")
    return next(order for order in range(rows, 2 * rows + 1) if is_feasible(order))


def default_order(rows: int) -> int:
    """The default order for so many rows: short, and cheap to correlate.

    The smallest order with at least this many rows or, if that has a large factor, the next one
    within MOST_EXTRA that has none: for 1025 rows 1040 = 20·52 instead of 1032 = 2·516. Raises
    SpecError above MAX_ORDER rows.
    """
    smallest = smallest_order(rows)
    limit = min(int(smallest * (1 + MOST_EXTRA)), MAX_ORDER)
    close = (order for order in range(smallest, limit + 1) if is_feasible(order))
    return next((n for n in close if max(code_book(n).plan) <= SMALL_FACTOR), smallest)


def row_signs(rows: Indices, seed: int | None) -> NDArray[np.int8]:
    """The fixed sign of each code row, (len(rows),) int8 of ±1; None gives natural (all +1) signs.

    Random signs keep the peak of the summed line near √n instead of n when all nodes send the
    same word. The sign is the top bit of MurmurHash3's 32-bit finalizer of seed + row·φ, cheap
    enough for a node's microcontroller to compute for itself.
    """
    if seed is None:
        return np.ones(len(rows), dtype=np.int8)
    return np.where(_hash(rows, seed) >> np.uint64(31), -1, 1).astype(np.int8)


def scrambler_state(seed: int) -> int:
    """State of the scrambler before a frame, 1…2³² − 1; seed: that of the row signs.

    It is the hash of a number that no row has.
    """
    (state,) = _hash([MAX_ORDER], seed)
    return int(state) or 1


def chip_flips(bits: int, order: int, seed: int) -> NDArray[np.int8]:
    """What all nodes that scramble multiply the chips of a frame by: (bits, order) int8 of ±1.

    A xorshift of octets (Marsaglia 2003) with the period 2³² − 1: the next one is made of the
    newest and the oldest of four. A bit takes the next ⌈order / 8⌉ octets, least significant bit
    first, and flips its chips where the last `order` of their bits are set.
    """
    octets = -(-order // 8)
    made = bytearray(scrambler_state(seed).to_bytes(4, "little"))
    for _ in range(bits * octets):
        newest, oldest = made[-1], made[-4] ^ (made[-4] << 1 & 0xFF)
        made.append(newest ^ newest >> 3 ^ oldest ^ oldest >> 1)
    own = np.frombuffer(made, np.uint8, offset=4).reshape(bits, octets)
    flipped = np.unpackbits(own, axis=1, bitorder="little")[:, -order:]
    return (1 - 2 * flipped.astype(np.int8)).astype(np.int8)


def _hash(numbers: ArrayLike, seed: int) -> NDArray[np.uint64]:
    """MurmurHash3's 32-bit finalizer of seed + number·φ."""
    golden, mask = 0x9E3779B9, 0xFFFFFFFF
    each = np.asarray(numbers, dtype=np.uint64)
    h: NDArray[np.uint64] = (np.uint64(seed) + each * np.uint64(golden)) & np.uint64(mask)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        h = ((h ^ (h >> np.uint64(shift))) * np.uint64(factor)) & np.uint64(mask)
    return h ^ (h >> np.uint64(16))


@cache
def _plan(order: int) -> tuple[int, ...] | None:
    """Orders of the primitive factors with the least total size; None where none exists.

    The total size of the factors is what a Kronecker transform costs per element.
    """
    if order == 1:
        return (1,)
    if order & (order - 1) == 0:
        return (2,) * (order.bit_length() - 1)
    if order % 4:
        return None
    plans: list[tuple[int, ...]] = [(order,)] if order <= MOST_FACTOR and paley(order) else []
    for small in (d for d in range(2, int(order**0.5) + 1) if order % d == 0):
        left, right = _plan(small), _plan(order // small)
        if left and right:
            plans.append(tuple(sorted(left + right)))
    return min(plans, key=lambda plan: (sum(plan), plan), default=None)
