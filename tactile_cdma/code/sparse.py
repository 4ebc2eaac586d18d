# SPDX-License-Identifier: Apache-2.0

"""Sparse codes: books of more nodes than chips per bit, for frames in which few of them speak.

All nodes send one shift-register sequence, each from a place of its own: its first digits are those
of the node's code number, the lowest first. So chip t of code i is the parity of i AND cₜ, where cₜ
does not depend on the node: correlation with all codes scatters chips to places cₜ of 2^m, and is a
Walsh–Hadamard transform from there on. The cₜ of a bit differ, and each bit goes on where the one
before ended, so that every bit has other codes.

Code numbers are node numbers, mixed up: codes whose numbers XOR to 0 add up to little more often
than others, and nodes beside each other, which are touched together, would have many such.

A node that is late sends another one's code: the scrambler, which all share, makes that noise.
firmware/codes.md defines every chip.
"""

from functools import lru_cache

import numpy as np

from ..base.arrays import Indices
from .codes import MAX_ORDER

MOST_NODES = MAX_ORDER - 1
"""Nodes of the largest book, which has places for 16 digits."""
ORDERS = (8, 4_096)
"""Chips per bit: least and most. Chosen."""
TAPS = {
    4: (1,), 5: (2,), 6: (1,), 7: (1,), 8: (2, 3, 4), 9: (4,), 10: (3,), 11: (2,), 12: (1, 4, 6),
    13: (1, 3, 4), 14: (1, 3, 5), 15: (1,), 16: (2, 3, 5),
}  # fmt: skip
"""Exponents of the primitive polynomials x^m + … + 1, by m."""
MIXER = 0x9E3779B1
"""2³² over the golden ratio, odd, so that a product modulo 2^m can be undone."""


def code_digits(nodes: int, order: int) -> int:
    """m: binary digits of the numbers of nodes, and of chips so that those of a bit differ."""
    return max(nodes, order).bit_length()


@lru_cache(maxsize=8)
def code_places(nodes: int, bits: int, order: int) -> Indices:
    """cₜ of every chip of a frame, (bits, order), 1…2^m − 1.

    Chip t + m is chip t times those t + a, for the exponents a of TAPS: so are their places, with
    XOR. A bit takes the next ⌈order / 8⌉ octets, and is the last `order` of their chips.
    """
    width = code_digits(nodes, order)
    octets = -(-order // 8)
    made = [1 << digit for digit in range(width)]
    taps = TAPS[width]
    for t in range(bits * octets * 8 - width):
        place = made[t]
        for tap in taps:
            place ^= made[t + tap]
        made.append(place)
    chips = np.array(made[: bits * octets * 8]).reshape(bits, octets * 8)
    return np.ascontiguousarray(chips[:, -order:])


def code_numbers(digits: int) -> Indices:
    """The code number of every number of so many digits, (2^m,); 0 has 0."""
    number, half = np.arange(1 << digits), (digits + 1) // 2
    number = (number ^ number >> half) * MIXER & ((1 << digits) - 1)
    return number ^ number >> half
