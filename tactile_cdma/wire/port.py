# SPDX-License-Identifier: Apache-2.0

"""The serial port, or what a pyserial URL stands for: open, read, write, and why that failed."""

import errno
import logging
import os
import re
import select
import socket
import sys
import time
from contextlib import suppress
from importlib import import_module
from typing import Self
from urllib.parse import urlsplit
from weakref import WeakValueDictionary

import serial

from ..base.errors import CaptureError, PortError, RecordingEndError, SpecError
from ..places.layout import Layout
from .discovery import device_of, held_back, holders, in_words, is_serial, serial_ports
from .identity import SOURCES, is_source
from .reader import NO_FILE, READ_SIZE, read_file

_log = logging.getLogger(__name__)

READ_TIMEOUT_S = 0.1
"""s that a read waits for its first byte. Chosen: a driver that is told to stop waits this long."""
READ_TIMEOUT_MS = round(READ_TIMEOUT_S * 1e3)
HAS_FILES = os.name == "posix" and sys.platform != "darwin"
"""Whether ports have descriptors that the kernel can read; on macOS poll(2) takes no devices. Else
pyserial reads them."""
SKIP_S, IDLE_S = 0.1, 5e-3
"""s; skipping ends when nothing has come for IDLE_S, and after SKIP_S at the latest. Chosen: IDLE_S
has to outlast the pause in which the kernel refills a buffer that was full."""
HOST_GONE_S = 5.0
"""s without acknowledgement after which the host of a socket:// is taken for gone; chosen. TCP by
itself retries for a quarter of an hour."""
WRITE_TIMEOUT_S = 1.0
"""s; commands are shorter than 100 bytes, which any working port takes at once. Chosen."""
HANDLERS = ("tactile_cdma.sim", "tactile_cdma.replay")
"""Packages in which pyserial finds the handlers of sim:// and replay://."""
REFUSED = {
    "spy://": "would write a file; tactile-cdma record keeps the bytes of a port",
    "rfc2217://": "is read too slowly for a skin, and without a bound; have the port's server pass "
    "the plain bytes, and use socket://host:port",
}
"""URLs that pyserial opens and this class does not, and why. spy:// writes to any file that the URL
names, which a parameter must not be able to do; rfc2217:// has a queue of single bytes that grows
with everything that waits (56 MB in 25 s), and takes no time limit for writing."""
_OPEN: WeakValueDictionary[int, "Port"] = WeakValueDictionary()
"""The ports, by id, that this process has opened, and perhaps closed since."""
TerminalError: type[Exception] = OSError
with suppress(ImportError):  # on Windows pyserial raises nothing but OSErrors
    TerminalError = import_module("termios").error
"""Error of termios, which is no OSError, and which pyserial lets through."""
_LOST = (OSError, TypeError, TerminalError, CaptureError)
"""TypeError: from pyserial, reading a port that another thread has closed."""
SOCKET = "socket://"
"""Begins the URLs of ports on another machine."""
NO_HOST = f"host and port (1…65535) are not named, as in {SOCKET}192.168.0.7:4000"
_AWAY = (errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO)
_NOT_SERIAL = (errno.ENOTTY, errno.EISDIR)

serial.protocol_handler_packages += HANDLERS


class Port:
    """An open port: /dev/ttyACM0, usb://SERIAL, or a pyserial URL such as sim:// or socket://host:4000.

    Use as a context manager. Every operation raises PortError, with the likely cause.

    device: pyserial's port, which does the work.
    had_waited: the bytes of the last read() were there already, so may have come long before.
    over_network: the other end is another machine, where any number of bytes may be held back.
    held_back: that its USB adapter does not hand on bytes as they come, in words; else empty.
    stepped: of a simulated skin whose frames pass as a program asks for them: silence is no fault.
    """

    def __init__(self, url: str, baud: int, layout: Layout | None = None) -> None:
        """layout: where the taxels of the skin are, for a simulated one; None: as its URL says."""
        self.url = url
        # Looked up at every opening: a board that is plugged in again may be another device.
        pyserial_url = device_of(url)
        self._path = pyserial_url
        with suppress(OSError):  # there is no working folder any more
            self._path = os.path.realpath(pyserial_url)
        self.over_network = pyserial_url.startswith(SOCKET)
        self.had_waited = False
        for scheme, reason in REFUSED.items():
            if pyserial_url.startswith(scheme):
                raise PortError(f"{url}: {scheme} {reason}")
        try:
            if is_source(pyserial_url):
                self.device = import_module(f"{SOURCES}.source_digitizer").Serial()
                self.device.port = pyserial_url
            else:
                self.device = serial.serial_for_url(pyserial_url, do_not_open=True)
            self.device.baudrate = baud
            self.device.timeout = READ_TIMEOUT_S
            self.device.write_timeout = WRITE_TIMEOUT_S
            if "://" not in pyserial_url:
                self.device.exclusive = True
            if hasattr(self.device, "layout"):
                self.device.layout = layout
            self.device.open()
            with suppress(AttributeError, NotImplementedError, OSError, ValueError):  # no adapter
                self.device.set_low_latency_mode(True)
            self.held_back = held_back(pyserial_url)
            if self.over_network and hasattr(socket, "TCP_USER_TIMEOUT"):
                link_of = self.device.fileno(), socket.AF_INET, socket.SOCK_STREAM
                with socket.fromfd(*link_of) as link:
                    patience_ms = int(HOST_GONE_S * 1e3)
                    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, patience_ms)
            self.device.reset_input_buffer()  # left from before this port was opened
            self._has_file = HAS_FILES and ("://" not in pyserial_url or self.over_network)
            self.stepped = bool(getattr(self.device, "stepped", False))
        except (*_LOST, ValueError, KeyError, re.error) as error:
            # SpecError is a ValueError; TypeError and re.error: options of alt:// and hwgrep://
            ports = [port for ref in _OPEN.valuerefs() if (port := ref())]  # threads add some
            is_ours = any(port._path == self._path and port.device.is_open for port in ports)
            raise PortError(f"{url}: {why_not_open(error, pyserial_url, is_ours)}") from None
        _OPEN[id(self)] = self
        _log.debug("%s is open, at %d baud", pyserial_url, baud)
        if self.held_back:
            _log.warning("%s: %s", url, self.held_back)

    def read(self) -> tuple[bytes, float]:
        """Return what has arrived; waits up to READ_TIMEOUT_S for a byte, or a whole packet.

        Returns the bytes (none after the time-out) and the host's monotonic time, s, just after
        they were read.
        """
        try:
            if self._has_file:
                data, self.had_waited = read_file(self.file, READ_TIMEOUT_MS)
            elif data := self.device.read(1):  # waits for one byte, then takes the others
                data += self.device.read(self.device.in_waiting)
        except _LOST as error:
            raise self.lost(error) from None
        return data, time.monotonic()

    @property
    def problem(self) -> str | None:
        """Tell why no frames come, where the port is of a source that knows."""
        said = getattr(self.device, "problem", None)
        return f"{self.url}: {said}" if said else None

    @property
    def file(self) -> int:
        """Return the descriptor that bytes may be read from in place of read(); else NO_FILE.

        Raises OSError where the port is closed.
        """
        return int(self.device.fileno()) if self._has_file else NO_FILE

    def lost(self, error: Exception, doing: str = "reading") -> PortError:
        """Make the error to raise for one that reading, or what else was being done, raised."""
        if isinstance(error, RecordingEndError):
            return error
        if isinstance(error, CaptureError):  # the file of replay:// was taken away
            return PortError(f"{self.url}: {error}")
        return PortError(f"{self.url}: lost while {doing}; unplugged? ({error})")

    @property
    def waiting(self) -> int:
        """Count the bytes that wait to be read; of a socket tell only whether there are any.

        A Linux tty reports 4095 at most, though more may wait behind them.
        """
        try:
            return int(self.device.in_waiting)
        except _LOST as error:
            raise self.lost(error) from None

    def skip(self) -> int:
        """Discard what has arrived, and what waits behind it; returns the number of bytes."""
        skipped, end_s = 0, time.monotonic() + SKIP_S
        try:
            if not self._has_file:
                skipped = int(self.device.in_waiting)
                self.device.reset_input_buffer()
                return skipped
            poll = select.poll()
            poll.register(self.file, select.POLLIN)
            while time.monotonic() < end_s and poll.poll(IDLE_S * 1e3):
                data = os.read(self.file, READ_SIZE)
                skipped += len(data)
                if not data:  # end of file: the next read() raises
                    break
        except _LOST as error:
            raise self.lost(error) from None
        return skipped

    def write(self, data: bytes) -> None:
        try:
            self.device.write(data)
        except serial.SerialTimeoutException:
            raise PortError(f"{self.url}: takes no bytes; is the digitizer powered?") from None
        except _LOST as error:
            raise self.lost(error, "writing") from None

    def let_go(self) -> None:
        """Close this process's copy of a port that it has from before a fork, and nothing else.

        The parent's goes on, and can be opened anew; `close` would end a connection of both.
        """
        self.device.is_open = False
        if (descriptor := getattr(self.device, "fd", None)) is not None:
            self.device.fd = None
            os.close(descriptor)

    def close(self) -> None:
        """Close the port; closing twice is harmless."""
        with suppress(OSError, TerminalError):  # the device is gone: there is nothing to close
            self.device.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def why_not_open(error: Exception, device: str, is_ours: bool = False) -> str:
    """Tell why a port did not open, and what to do about it. is_ours: it is open here already."""
    if isinstance(error, SpecError | CaptureError):  # an option of sim://, the file of replay://
        return str(error)
    code = error.args[0] if isinstance(error, TerminalError) else getattr(error, "errno", None)
    if not device:
        return f"no port is named; {in_words(serial_ports())}"
    if code in _AWAY and is_serial(device):
        what = "no such port" if code == errno.ENOENT else "no device is behind it, unplugged"
        return f"{what}; is the digitizer plugged in? {in_words(serial_ports())}"
    if not is_serial(device) or code in _NOT_SERIAL:
        return "not a serial port"
    if code in (errno.EACCES, errno.EPERM):
        return (
            "no permission; add yourself to the port's group "
            "(sudo usermod -aG dialout $USER, then log in again)"
        )
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in str(error):
        who = ", ".join(holders(device)) or "another driver, a serial monitor?"
        other = f"another program has it open ({who})"
        return f"busy: {'this program has it open already' if is_ours else other}"
    if "could not configure port" in str(error).lower():
        return "not a serial port"
    if device.startswith(SOCKET) and not _names_host_and_port(device):
        return NO_HOST
    if isinstance(error, ValueError) and "protocol" in str(error):
        return (
            "unknown kind of port; use a device path, usb://SERIAL, sim://, replay://FILE or "
            "socket://host:port"
        )
    return str(error)


def is_remote(url: str) -> bool:
    """Tell whether a port is on another machine, where it may take seconds to open.

    Raises PortError where a URL of such a port does not name host and port.
    """
    if not url.lower().startswith(SOCKET):
        return False
    if not _names_host_and_port(url):
        raise PortError(f"{url}: {NO_HOST}")
    return True


def _names_host_and_port(url: str) -> bool:
    try:
        parts = urlsplit(url)
        return bool(parts.hostname and parts.port)
    except ValueError:  # the port is no number, or too large
        return False


if hasattr(os, "register_at_fork"):  # not on Windows, which does not fork
    os.register_at_fork(after_in_child=lambda: [*map(Port.let_go, _OPEN.values())])
