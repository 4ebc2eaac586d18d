# SPDX-License-Identifier: Apache-2.0

"""What stands at the other end of a virtual port: a simulator, a recording, a source."""

from abc import ABC, abstractmethod


class Device(ABC):
    """Holds the bytes that it has sent until the port takes them."""

    def __init__(self, first: bytes = b"") -> None:
        self._output = bytearray(first)

    @property
    def pending(self) -> int:
        """Count the bytes that take() can return now."""
        return len(self._output)

    @abstractmethod
    def advance(self, wanted: int) -> float:
        """Make pending what is due by now; a device without a pace of its own, `wanted` bytes.

        Returns the time until more is due, s.
        """

    def take(self, size: int) -> bytes:
        """Remove and return up to `size` pending bytes."""
        data = bytes(self._output[:size])
        del self._output[:size]
        return data

    @abstractmethod
    def receive(self, data: bytes) -> None:
        """Handle what was written to the port."""
