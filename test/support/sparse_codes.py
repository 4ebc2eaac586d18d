# SPDX-License-Identifier: Apache-2.0

"""Sparse codes and scrambler by firmware/codes.md, octet by octet: no line of the package."""

import numpy as np
from numpy.typing import NDArray

TAPS = {
    4: (1,), 5: (2,), 6: (1,), 7: (1,), 8: (2, 3, 4), 9: (4,), 10: (3,), 11: (2,), 12: (1, 4, 6),
    13: (1, 3, 4), 14: (1, 3, 5), 15: (1,), 16: (2, 3, 5),
}  # fmt: skip


def mixed(number: int, seed: int) -> int:
    """MurmurHash3's finalizer, but for its last step."""
    h = (seed + number * 0x9E3779B9) & 0xFFFFFFFF
    h = ((h ^ h >> 16) * 0x85EBCA6B) & 0xFFFFFFFF
    return ((h ^ h >> 13) * 0xC2B2AE35) & 0xFFFFFFFF


def code_number(node: int, m: int) -> int:
    h = (m + 1) // 2
    y = (node ^ node >> h) * 0x9E3779B1 % 2**m
    return y ^ y >> h


def octets(code: int, m: int, count: int) -> list[int]:
    """The first m from the bits, the others from octets."""
    bits = [code >> digit & 1 for digit in range(m)]
    while len(bits) < 8 * m:
        bits.append(bits[-m] ^ sum(bits[-m + a] for a in TAPS[m]) % 2)
    made = [sum(bits[8 * q + j] << j for j in range(8)) for q in range(m)]
    while len(made) < count:
        new = made[-m]
        for a in TAPS[m]:
            new ^= made[a - m]
        made.append(new)
    return made[:count]


def scrambler(count: int, seed: int) -> list[int]:
    h = mixed(65_536, seed)
    h ^= h >> 16
    made = list((h or 1).to_bytes(4, "little"))
    while len(made) < 4 + count:
        t = (made[-4] ^ made[-4] << 1) & 255
        made.append(made[-1] ^ made[-1] >> 3 ^ t ^ t >> 1)
    return made[4:]


def node_chips(
    node: int, nodes: int, order: int, bits: int, seed: int = 1, flipped: bool = True
) -> NDArray[np.float32]:
    """What a node, counted from 1, sends for 1 bits: (bits, order) of ±1."""
    m, each = max(nodes, order).bit_length(), -(-order // 8)
    made = np.array(octets(code_number(node, m), m, bits * each))
    if flipped:
        made ^= np.array(scrambler(bits * each, seed))
    ones = (made[:, None] >> np.arange(8) & 1).reshape(bits, 8 * each)[:, -order:]
    sign = -1 if mixed(node, seed) >> 31 else 1
    return (sign * (1.0 - 2.0 * ones)).astype(np.float32)
