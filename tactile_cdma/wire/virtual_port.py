# SPDX-License-Identifier: Apache-2.0

"""A pyserial port without hardware: the base of sim:// and replay://."""

import math
import threading
import time
from abc import abstractmethod
from typing import Generic, Protocol, TypeVar

from serial.serialutil import PortNotOpenError, SerialBase, SerialException, to_bytes


class Device(Protocol):
    """Stands at the other end of a virtual port."""

    @property
    def pending(self) -> int:
        """Count the bytes that take() can return now."""

    def advance(self, wanted: int) -> float:
        """Make pending what is due by now; a device without a pace of its own, `wanted` bytes.

        Returns the time until more is due, s.
        """

    def take(self, size: int) -> bytes:
        """Remove and return up to `size` pending bytes."""

    def receive(self, data: bytes) -> None:
        """Handle what was written."""


AnyDevice = TypeVar("AnyDevice", bound=Device)


class VirtualPort(SerialBase, Generic[AnyDevice]):
    """A device that open() makes and close() discards.

    Baud rate and other settings of a serial line are accepted and ignored.
    """

    READ_AHEAD = 65_536
    """Bytes that in_waiting makes pending where a device has no pace of its own. Chosen."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        self._device: AnyDevice | None = None
        # Guards the device; notified when bytes may be due or a read has to end.
        self._changed = threading.Condition()
        self.is_open = False
        super().__init__(*args, **kwargs)

    @abstractmethod
    def _made(self, url: str) -> AnyDevice:
        """Make the device that a URL describes."""

    def _has_ended(self, device: AnyDevice, data: bytes) -> bool:
        """Tell whether read() has to return these bytes without waiting for more. May raise."""
        return False

    def open(self) -> None:
        """Make the device. Raises SerialException if it is open already, or what _made raises."""
        if self._port is None:
            raise SerialException("Port must be configured before it can be used.")
        if self.is_open:
            raise SerialException("Port is already open.")
        self._device = self._made(self._port)
        self.is_open = True

    def close(self) -> None:
        """Discard the device, and end a read() in another thread."""
        with self._changed:
            self.is_open = False
            self._device = None
            self._changed.notify_all()

    @property
    def in_waiting(self) -> int:
        with self._changed:
            device = self._opened()
            device.advance(self.READ_AHEAD)
            return device.pending

    def read(self, size: int = 1) -> bytes:
        """Wait for `size` bytes, at most for the timeout; returns what has come."""
        deadline = math.inf if self._timeout is None else time.monotonic() + self._timeout
        data = b""
        with self._changed:
            while True:
                device = self._opened()
                wait_s = device.advance(size - len(data))
                data += device.take(size - len(data))
                ended = self._has_ended(device, data)
                left_s = deadline - time.monotonic()
                if len(data) >= size or left_s <= 0 or ended:
                    return data
                self._changed.wait(min(wait_s, left_s, threading.TIMEOUT_MAX))

    def write(self, data: bytes | bytearray | memoryview) -> int:
        sent = to_bytes(data)
        with self._changed:
            self._opened().receive(sent)
            self._changed.notify_all()
        return len(sent)

    def flush(self) -> None:
        """Do nothing: what is written is received at once, and what was not read stays."""
        self._opened()

    reset_input_buffer = reset_output_buffer = flush

    def _opened(self) -> AnyDevice:
        if self._device is None:
            raise PortNotOpenError()
        return self._device

    def _reconfigure_port(self) -> None:
        """Do nothing: SerialBase calls this, and the following, when a setting changes."""

    _update_rts_state = _update_dtr_state = _update_break_state = _reconfigure_port
