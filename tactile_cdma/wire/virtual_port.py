# SPDX-License-Identifier: Apache-2.0

"""A port that pyserial opens without hardware: what sim:// and replay:// have in common."""

from __future__ import annotations

import math
import threading
import time
from abc import abstractmethod
from typing import Generic, Protocol, TypeVar

from serial.serialutil import PortNotOpenError, SerialBase, SerialException, to_bytes


class Device(Protocol):
    """What is at the other end of a virtual port."""

    @property
    def pending(self) -> int:
        """Bytes that can be taken."""

    def advance(self, wanted: int) -> float:
        """Have pending what is due by now; without a pace of its own, at least so many bytes.

        Returns the seconds until more is due.
        """

    def take(self, size: int) -> bytes:
        """At most so many of the pending bytes."""


AnyDevice = TypeVar("AnyDevice", bound=Device)


class VirtualPort(SerialBase, Generic[AnyDevice]):
    """A device that open() makes and close() throws away.

    The baud rate, as all that concerns lines, is accepted and ignored.
    """

    READ_AHEAD = 65_536
    """Bytes that in_waiting has pending where the pace is as fast as they are read."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        self._device: AnyDevice | None = None
        # Guards the device; notified when bytes may have become due or a read is to end.
        self._changed = threading.Condition()
        self._cancelled = False
        self.is_open = False
        super().__init__(*args, **kwargs)

    @abstractmethod
    def _made(self, url: str) -> AnyDevice:
        """The device that a URL describes."""

    def _receive(self, device: AnyDevice, data: bytes) -> None:
        """What is written goes nowhere."""

    def _has_ended(self, device: AnyDevice, data: bytes) -> bool:
        """Whether a read() is to return these bytes without waiting for more; it may raise, too."""
        return False

    def open(self) -> None:
        """Make the device. Raises SerialException where already open, else what _made does."""
        if self._port is None:
            raise SerialException("Port must be configured before it can be used.")
        if self.is_open:
            raise SerialException("Port is already open.")
        self._device = self._made(self._port)
        self.is_open = True

    def close(self) -> None:
        """Throw the device away, and end a read() in another thread."""
        with self._changed:
            self.is_open = False
            self._device = None
            self._changed.notify_all()

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read at once."""
        with self._changed:
            device = self._opened()
            device.advance(self.READ_AHEAD)
            return device.pending

    def read(self, size: int = 1) -> bytes:
        """Wait for `size` bytes, at most as long as the timeout; returns what there is."""
        deadline = math.inf if self._timeout is None else time.monotonic() + self._timeout
        data = b""
        with self._changed:
            while True:
                device = self._opened()
                wait_s = device.advance(size - len(data))
                data += device.take(size - len(data))
                ended = self._has_ended(device, data)
                left_s = deadline - time.monotonic()
                if len(data) >= size or left_s <= 0 or self._cancelled or ended:
                    self._cancelled = False
                    return data
                self._changed.wait(min(wait_s, left_s, threading.TIMEOUT_MAX))

    def write(self, data: bytes | bytearray | memoryview) -> int:
        """Send bytes to the device; returns their number."""
        sent = to_bytes(data)
        with self._changed:
            self._receive(self._opened(), sent)
            self._changed.notify_all()
        return len(sent)

    def cancel_read(self) -> None:
        """End a read() in another thread, or the next one if there is none."""
        with self._changed:
            self._cancelled = True
            self._changed.notify_all()

    def reset_output_buffer(self) -> None:
        """Nothing to discard: what is written is received at once."""
        self._opened()

    @property
    def out_waiting(self) -> int:
        """Bytes written and not yet received: none."""
        self._opened()
        return 0

    def flush(self) -> None:
        """Nothing to wait for: what is written is received at once."""
        self._opened()

    def _opened(self) -> AnyDevice:
        if self._device is None:
            raise PortNotOpenError()
        return self._device

    # SerialBase calls these when a setting changes; a virtual port has no lines to set.

    def _reconfigure_port(self) -> None:
        pass

    def _update_rts_state(self) -> None:
        pass

    def _update_dtr_state(self) -> None:
        pass

    def _update_break_state(self) -> None:
        pass
