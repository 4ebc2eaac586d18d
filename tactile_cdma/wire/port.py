# SPDX-License-Identifier: Apache-2.0

"""The serial port, or what a pyserial URL stands for: open, read with the host's time, write."""

from __future__ import annotations

import os
import re
import select
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TypeVar

import serial

from ..base import kernel
from ..base.errors import CaptureError, PortError, SpecError
from ..places.indenters import Indenter
from .discovery import device_of
from .port_failures import NETWORK, SOCKET, TerminalError, lost, why_not_open

T = TypeVar("T")

READ_TIMEOUT_S = 0.1
"""s that a read waits for its first byte. Chosen: a driver that is told to stop waits this long."""
SKIP_S, IDLE_S = 0.1, 5e-3
"""s; skipping ends when nothing has come for IDLE_S, and after SKIP_S at the latest. Chosen: IDLE_S
has to outlast the pause in which the kernel refills a buffer that was full."""
READ_SIZE = 65_536
"""Bytes that one read takes at most; chosen well above the 4 kB that a Linux tty gives at once."""
HOST_GONE_S = 5.0
"""s without acknowledgement after which the host of a socket:// is taken for gone; chosen. TCP by
itself retries for a quarter of an hour."""
WRITE_TIMEOUT_S = 1.0
"""s; commands are shorter than 100 bytes, which any working port takes at once. Chosen."""
HANDLERS = ("tactile_cdma.sim", "tactile_cdma.replay")
"""Packages in which pyserial finds the handlers of sim:// and replay://."""
SPY = "spy://"
"""pyserial then writes to any file that the URL names, which a parameter must not be able to do."""
_LOST = (OSError, TypeError, TerminalError, CaptureError)
"""TypeError: from pyserial, reading a port that another thread has closed."""

serial.protocol_handler_packages += HANDLERS


class Port:
    """An open port: /dev/ttyACM0, usb://SERIAL, or a pyserial URL such as sim:// or socket://host:4000.

    Use as a context manager. Every operation raises PortError, with the likely cause.

    had_waited: the bytes of the last read() were there already, so may have come long before.
    over_network: the other end is another machine, where any number of bytes may be held back.
    pressable: a simulated skin that press() acts on. stepped: its frames pass only as press() asks
    for them, so that silence is no fault.
    """

    def __init__(self, url: str, baud: int) -> None:
        self.url = url
        # Looked up at every opening: a board that is plugged in again may be another device.
        pyserial_url = device_of(url)
        self.over_network = pyserial_url.startswith(NETWORK)
        self.had_waited = False
        if pyserial_url.startswith(SPY):
            raise PortError(
                f"{url}: {SPY} would write a file; tactile-cdma record keeps the bytes of a port"
            )
        try:
            self._serial = serial.serial_for_url(pyserial_url, do_not_open=True)
            self._serial.baudrate = baud
            self._serial.timeout = READ_TIMEOUT_S
            self._serial.write_timeout = WRITE_TIMEOUT_S
            if "://" not in pyserial_url:
                self._serial.exclusive = True
            self._serial.open()
            _reduce_latency(self._serial)
            _limit_wait_for_host(self._serial, pyserial_url)
            self._serial.reset_input_buffer()  # left from before this port was opened
            self._poll = _poll(self._serial, pyserial_url)
            self.pressable = bool(getattr(self._serial, "pressable", False))
            self.stepped = bool(getattr(self._serial, "stepped", False))
        except (*_LOST, ValueError, KeyError, re.error) as error:
            # SpecError is a ValueError; TypeError and re.error: options of alt:// and hwgrep://
            raise PortError(f"{url}: {why_not_open(error, pyserial_url)}") from None

    def read(self) -> tuple[bytes, float]:
        """What has arrived, after waiting up to READ_TIMEOUT_S for a byte, or a whole packet.

        Returns the bytes (none after the time-out) and the host's monotonic time, s, just after
        they were read.
        """
        try:
            data = self._wait() if self._poll is None else self._wait_in_kernel(self._poll)
        except _LOST as error:
            raise lost(self.url, "reading", error) from None
        return data, time.monotonic()

    @property
    def has_file(self) -> bool:
        """Whether `read_by` can be used: there is a file descriptor to wait for."""
        return self._poll is not None

    def read_by(self, read: Callable[[int, int], T]) -> T:
        """What `read` gives, which reads from a file descriptor for so many ms itself."""
        try:
            return read(self._serial.fileno(), round(READ_TIMEOUT_S * 1e3))
        except _LOST as error:
            raise lost(self.url, "reading", error) from None

    @property
    def waiting(self) -> int:
        """Bytes that have arrived and were not read; of a socket only whether there are any.

        A Linux tty reports 4095 at most, though more may wait behind them.
        """
        try:
            return int(self._serial.in_waiting)
        except _LOST as error:
            raise lost(self.url, "reading", error) from None

    def skip(self) -> int:
        """Discard what has arrived, and what waits behind it; returns the number of bytes."""
        skipped, end_s = 0, time.monotonic() + SKIP_S
        try:
            if self._poll is None:
                skipped = int(self._serial.in_waiting)
                self._serial.reset_input_buffer()
                return skipped
            while time.monotonic() < end_s and self._poll.poll(IDLE_S * 1e3):
                data = os.read(self._serial.fileno(), READ_SIZE)
                skipped += len(data)
                if not data:  # end of file: the next read() raises
                    break
        except _LOST as error:
            raise lost(self.url, "reading", error) from None
        return skipped

    def write(self, data: bytes) -> None:
        """Send bytes."""
        try:
            self._serial.write(data)
        except serial.SerialTimeoutException:
            raise PortError(f"{self.url}: takes no bytes; is the digitizer powered?") from None
        except _LOST as error:
            raise lost(self.url, "writing", error) from None

    def press(self, objects: Sequence[Indenter], frames: int = 0) -> None:
        """Let these objects, and no others, touch a simulated skin from its next frame on.

        frames: number of frames that may pass, of a skin that is stepped.
        """
        if not self.pressable:
            raise PortError(f"{self.url}: only sim://?scene=external can be pressed by a program")
        try:
            self._serial.press(objects, frames)
        except SpecError as error:
            raise PortError(f"{self.url}: {error}") from None
        except _LOST as error:
            raise lost(self.url, "pressing", error) from None

    def close(self) -> None:
        """Close the port; closing twice is harmless."""
        with suppress(OSError, TerminalError):  # the device is gone: there is nothing to close
            self._serial.close()

    def __enter__(self) -> Port:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wait(self) -> bytes:
        """Reads through pyserial: waits for one byte, then takes the others."""
        data: bytes = self._serial.read(1)
        return data + self._serial.read(self._serial.in_waiting) if data else data

    def _wait_in_kernel(self, poll: select.poll) -> bytes:
        """The same from a file descriptor, with two or three system calls.

        The compiled kernel waits until a packet ends: a tty gives only parts of large ones at once.
        """
        if kernel.compiled is not None:
            data: bytes
            data, self.had_waited = kernel.compiled.read_packets(
                self._serial.fileno(), round(READ_TIMEOUT_S * 1e3)
            )
            return data
        self.had_waited = bool(poll.poll(0))
        if not self.had_waited and not poll.poll(READ_TIMEOUT_S * 1e3):
            return b""
        some = os.read(self._serial.fileno(), READ_SIZE)
        if not some:
            raise OSError("end of file")
        return some


def _poll(port: serial.SerialBase, url: str) -> select.poll | None:
    """Waits for a port that has a file descriptor; None where only pyserial can read it."""
    if not hasattr(select, "poll") or ("://" in url and not url.startswith(SOCKET)):
        return None
    poll = select.poll()
    poll.register(port.fileno(), select.POLLIN)
    return poll


def _reduce_latency(port: serial.SerialBase) -> None:
    """Stop USB adapters from holding bytes back (FTDI: 16 ms), where their driver can do that."""
    with suppress(AttributeError, NotImplementedError, OSError, ValueError):
        port.set_low_latency_mode(True)


def _limit_wait_for_host(port: serial.SerialBase, url: str) -> None:
    """Make a socket fail HOST_GONE_S after its host has gone."""
    if url.startswith(SOCKET) and hasattr(socket, "TCP_USER_TIMEOUT"):
        with socket.fromfd(port.fileno(), socket.AF_INET, socket.SOCK_STREAM) as link:
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(HOST_GONE_S * 1e3))
