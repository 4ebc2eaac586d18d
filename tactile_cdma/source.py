"""The serial port: the only user of pyserial, but for the handler that makes sim:// one."""

from __future__ import annotations

import errno
import os
import select
import time
from contextlib import suppress
from types import TracebackType

import serial
from serial.tools import list_ports

from .errors import PortError, SpecError

try:
    import termios

    TerminalError = termios.error  # not an OSError, and pyserial lets it through
except ImportError:  # not a POSIX system
    TerminalError = OSError  # type: ignore[misc, assignment]

READ_TIMEOUT_S = 0.1
READ_SIZE = 65_536
"""Bytes that one read takes at most; a tty hands out 4 kB at once."""
SIM_HANDLERS = "tactile_cdma.sim"

if SIM_HANDLERS not in serial.protocol_handler_packages:
    serial.protocol_handler_packages.append(SIM_HANDLERS)  # makes sim:// a port like any other


class Port:
    """An open port, named by a pyserial URL: /dev/ttyACM0, sim://, socket://host:4000, …

    Use as a context manager. Raises PortError, with the likely cause, from every operation.
    """

    def __init__(self, url: str, baud: int) -> None:
        self.url = url
        try:
            self._serial = serial.serial_for_url(url, do_not_open=True)
            self._serial.baudrate = baud
            self._serial.timeout = READ_TIMEOUT_S
            self._serial.write_timeout = 1.0
            if "://" not in url:
                self._serial.exclusive = True
            self._serial.open()
            self._serial.reset_input_buffer()  # of what came for whoever had it open before
            self._poll = _poll(self._serial, url)
        except SpecError as error:  # an option of a sim:// URL
            raise PortError(f"{url}: {error}") from None
        except (OSError, ValueError, KeyError, TerminalError) as error:
            raise PortError(f"{url}: {_open_failure(error)}") from None

    def read(self) -> tuple[bytes, float]:
        """What has arrived, waiting at most READ_TIMEOUT_S for the first byte of it.

        Returns the bytes (none after a quiet time-out) and the host's monotonic time, s, just
        after they were read.
        """
        try:
            data = self._wait() if self._poll is None else self._wait_in_kernel(self._poll)
        except (
            OSError,
            TypeError,
            TerminalError,
        ) as error:  # TypeError: pyserial reading a port closed under it
            raise PortError(f"{self.url}: lost while reading; unplugged? ({error})") from None
        return data, time.monotonic()

    @property
    def waiting(self) -> int:
        """Bytes that have arrived and were not read; of a socket only whether there are any.

        A Linux tty tells of 4095 at most, though more may wait behind them.
        """
        try:
            return int(self._serial.in_waiting)
        except (OSError, TypeError, TerminalError) as error:
            raise PortError(f"{self.url}: lost while reading; unplugged? ({error})") from None

    def _wait(self) -> bytes:
        """By pyserial's means: waits for one byte, then takes the others."""
        data: bytes = self._serial.read(1)
        return data + self._serial.read(self._serial.in_waiting) if data else data

    def _wait_in_kernel(self, poll: select.poll) -> bytes:
        """The same from a file descriptor, with two system calls."""
        if not poll.poll(READ_TIMEOUT_S * 1e3):
            return b""
        data = os.read(self._serial.fileno(), READ_SIZE)
        if not data:
            raise OSError("end of file")
        return data

    def write(self, data: bytes) -> None:
        """Send bytes."""
        try:
            self._serial.write(data)
        except (OSError, TerminalError) as error:
            raise PortError(f"{self.url}: lost while writing; unplugged? ({error})") from None

    def close(self) -> None:
        """Close the port; closing twice is harmless."""
        with suppress(OSError, TerminalError):  # the device is gone: there is nothing left to close
            self._serial.close()

    def __enter__(self) -> Port:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _poll(port: serial.SerialBase, url: str) -> select.poll | None:
    """What waits for a port that has a file descriptor; None where pyserial alone can read it."""
    if not hasattr(select, "poll") or ("://" in url and not url.startswith("socket://")):
        return None
    poll = select.poll()
    poll.register(port.fileno(), select.POLLIN)
    return poll


def _open_failure(error: Exception) -> str:
    """Why a port did not open, and what to do about it."""
    code = error.args[0] if isinstance(error, TerminalError) else getattr(error, "errno", None)
    if code == errno.ENOENT:
        names = ", ".join(sorted(port.device for port in list_ports.comports())) or "none"
        return f"no such port; is the digitizer plugged in? Serial ports on this machine: {names}"
    if code in (errno.EACCES, errno.EPERM):
        return (
            "no permission; add yourself to the port's group "
            "(sudo usermod -aG dialout $USER, then log in again)"
        )
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in str(error):
        return "busy: another program has it open (another driver, a serial monitor?)"
    if "could not configure port" in str(error).lower() or code == errno.ENOTTY:
        return "not a serial port"
    if isinstance(error, ValueError) and "protocol" in str(error):
        return "unknown kind of port; use a device path, sim://, socket://host:port or rfc2217://…"
    return str(error)
