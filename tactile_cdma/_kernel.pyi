# SPDX-License-Identifier: Apache-2.0

"""The compiled kernel, built from kernel/: its functions take contiguous arrays and check them.

They raise TypeError or ValueError for arrays of another type or size. base/kernel.py chooses
whether the kernel is used.
"""

from typing import final

import numpy as np
from numpy.typing import NDArray

from .wire.packets import Found

VERSION: int
"""Of these functions."""
LANES: int
"""float32 values that are computed at once on this processor."""

@final
class Transform:
    """Product with a Kronecker product of Hadamard matrices, the first varying slowest."""

    def __new__(
        cls, twos: int, factors: tuple[bytes, ...], scale: float, lanes: int = 0
    ) -> Transform:
        """twos: factors of order 2, which come first. factors: (P, P) int8 of ±1 each, P ≤ 512.

        scale: of the product. lanes: 1, 4 or 8; 0 for what the processor has. The result is the
        same bits for any number of lanes.
        """

    def multiply(self, source: NDArray[np.float32], out: NDArray[np.float32], /) -> None:
        """Vectors (…, N) times the transposed matrix, into out of the same size, or in place."""

@final
class Scanner:
    """Finds the intact packets in a stream of bytes; as Scanner in wire/packets.py."""

    def __new__(cls, most_repeated: int) -> Scanner: ...
    def feed(self, data: bytes, /) -> list[Found]:
        """Type, sequence and payload of the packets that these bytes complete."""

    def skip(self) -> None:
        """Bytes were left out here."""

    def held(self) -> int:
        """Bytes of an incomplete packet."""

    def counts(self) -> dict[str, int]:
        """Fields of Counters."""
