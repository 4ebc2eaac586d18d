# SPDX-License-Identifier: Apache-2.0

"""The serial port: the only user of pyserial, but for the handlers of sim:// and replay://."""

from __future__ import annotations

import errno
import os
import re
import select
import socket
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from urllib.parse import urlsplit

import serial
from serial.tools import list_ports

from ..base.errors import CaptureError, PortError, RecordingEndError, SpecError
from ..base.plain_text import plain

try:
    import termios

    TerminalError = termios.error  # not an OSError, and pyserial lets it through
except ImportError:  # not a POSIX system
    TerminalError = OSError  # type: ignore[misc, assignment]

READ_TIMEOUT_S = 0.1
SKIP_S, IDLE_S = 0.1, 5e-3
"""What arrives is thrown away until nothing has come for IDLE_S, but not for longer than SKIP_S."""
READ_SIZE = 65_536
"""Bytes that one read takes at most; a tty hands out 4 kB at once."""
HOST_GONE_S = 5.0
"""A host in the network that acknowledges nothing for so long is gone."""
HANDLERS = ("tactile_cdma.sim", "tactile_cdma.replay")
"""What makes sim:// and replay:// ports like any other."""
USB = "usb://"
"""Beginning of the ports that are named by the serial number of their USB device."""
LINK_FOLDERS = ("/dev/tactile", "/dev/serial/by-id", "/dev/serial/by-path")
"""Where udev keeps names of ports that outlive replugging; the first is of our own rules."""

SPY = "spy://"
"""What pyserial writes to any file that the URL names: whoever sets a parameter must not."""
NETWORK = ("socket://", "rfc2217://")
"""Beginnings of the ports that are on another machine."""
_NO_TTY = (errno.ENOTTY, errno.EISDIR, errno.ENXIO)

serial.protocol_handler_packages += [
    package for package in HANDLERS if package not in serial.protocol_handler_packages
]


class Port:
    """An open port: /dev/ttyACM0, usb://SERIAL, or any pyserial URL, as sim:// and socket://host:4000.

    Use as a context manager. Raises PortError, with the likely cause, from every operation.

    had_waited: what read() gave last was there already, so that it may have come long before.
    """

    def __init__(self, url: str, baud: int) -> None:
        self.url = url
        if url.lower().startswith(SPY):
            raise PortError(
                f"{url}: {SPY} would write a file; tactile-cdma record keeps the bytes of a port"
            )
        # Looked up anew each time: a board that is plugged in again may be another device.
        pyserial_url = device_of(url)
        try:
            self._serial = serial.serial_for_url(pyserial_url, do_not_open=True)
            self._serial.baudrate = baud
            self._serial.timeout = READ_TIMEOUT_S
            self._serial.write_timeout = 1.0
            if "://" not in pyserial_url:
                self._serial.exclusive = True
            self._serial.open()
            _hurry(self._serial)
            _give_up_soon(self._serial, pyserial_url)
            self._serial.reset_input_buffer()  # of what came for whoever had it open before
            self._poll = _poll(self._serial, pyserial_url)
            self.had_waited = False
        except (SpecError, CaptureError) as error:  # an option of a URL, the file of replay://
            raise PortError(f"{url}: {error}") from None
        except (OSError, ValueError, KeyError, TypeError, re.error, TerminalError) as error:
            # TypeError and re.error: the options of alt:// and hwgrep://
            raise PortError(f"{url}: {_open_failure(error, pyserial_url)}") from None

    def read(self) -> tuple[bytes, float]:
        """What has arrived, waiting at most READ_TIMEOUT_S for the first byte of it.

        Returns the bytes (none after a quiet time-out) and the host's monotonic time, s, just
        after they were read.
        """
        try:
            data = self._wait() if self._poll is None else self._wait_in_kernel(self._poll)
        except RecordingEndError:
            raise
        except CaptureError as error:  # the file of replay:// was taken away
            raise PortError(f"{self.url}: {error}") from None
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
        except CaptureError as error:  # see read
            raise PortError(f"{self.url}: {error}") from None
        except (OSError, TypeError, TerminalError) as error:
            raise PortError(f"{self.url}: lost while reading; unplugged? ({error})") from None

    def _wait(self) -> bytes:
        """By pyserial's means: waits for one byte, then takes the others."""
        data: bytes = self._serial.read(1)
        return data + self._serial.read(self._serial.in_waiting) if data else data

    def _wait_in_kernel(self, poll: select.poll) -> bytes:
        """The same from a file descriptor, with two or three system calls."""
        self.had_waited = bool(poll.poll(0))
        if not self.had_waited and not poll.poll(READ_TIMEOUT_S * 1e3):
            return b""
        data = os.read(self._serial.fileno(), READ_SIZE)
        if not data:
            raise OSError("end of file")
        return data

    def skip(self) -> int:
        """Throw away what has arrived, and what waits behind it; returns how many bytes."""
        skipped, end_s = 0, time.monotonic() + SKIP_S
        try:
            if self._poll is None:
                skipped = int(self._serial.in_waiting)
                self._serial.reset_input_buffer()
                return skipped
            while time.monotonic() < end_s and self._poll.poll(IDLE_S * 1e3):
                data = os.read(self._serial.fileno(), READ_SIZE)
                skipped += len(data)
                if not data:  # the end of the file, which the next read tells
                    break
        except (OSError, TypeError, TerminalError) as error:
            raise PortError(f"{self.url}: lost while reading; unplugged? ({error})") from None
        return skipped

    def write(self, data: bytes) -> None:
        """Send bytes."""
        try:
            self._serial.write(data)
        except serial.SerialTimeoutException:
            raise PortError(f"{self.url}: takes no bytes; is the digitizer powered?") from None
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


def _give_up_soon(port: serial.SerialBase, url: str) -> None:
    """Have a network port fail where its host is gone, not after minutes as TCP would."""
    if url.startswith("socket://") and hasattr(socket, "TCP_USER_TIMEOUT"):
        with socket.fromfd(port.fileno(), socket.AF_INET, socket.SOCK_STREAM) as link:
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(HOST_GONE_S * 1e3))


def _hurry(port: serial.SerialBase) -> None:
    """Ask adapters that hold bytes back, FTDI's for 16 ms, not to; others know no such thing."""
    with suppress(AttributeError, NotImplementedError, OSError, ValueError):
        port.set_low_latency_mode(True)


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port of this machine.

    usb_serial: serial number of its USB device; empty where it has none, or is no USB device.
    links: names of it that outlive replugging.
    """

    device: str
    description: str
    usb_serial: str = ""
    links: tuple[str, ...] = ()

    def __str__(self) -> str:
        number = f"USB serial number {self.usb_serial}" if self.usb_serial else ""
        said = ", ".join(part for part in (self.description, number) if part)
        return plain(f"{self.device} ({said})" if said else self.device)


def serial_ports() -> list[SerialPort]:
    """The serial ports of this machine, in the order of their names."""
    try:
        found = sorted(list_ports.comports())
    except (OSError, TypeError, ValueError):  # one of them was unplugged while it was looked at
        found = sorted(list_ports.comports())
    return [
        SerialPort(
            device=port.device,
            description="" if port.description == "n/a" else port.description,
            usb_serial=port.serial_number or "",
            links=_links(port.device),
        )
        for port in found
    ]


def device_of(url: str) -> str:
    """The device that usb://SERIAL is now; any other port as it is. Raises PortError."""
    return find_usb(url, serial_ports()) if url.startswith(USB) else url


def is_away(url: str) -> bool:
    """Whether it is certain that a port cannot be opened: no such device, or no permission.

    Takes microseconds. Of anything but a device path nothing is certain.
    """
    if "://" in url or "\0" in url:
        return False
    effective = os.access in os.supports_effective_ids
    return not os.access(url, os.R_OK | os.W_OK, effective_ids=effective)


def find_usb(url: str, ports: Sequence[SerialPort]) -> str:
    """The device that usb://SERIAL means, upper and lower case alike.

    Raises PortError, listing what is there, unless exactly one of the ports has this number.
    """
    wanted = url.removeprefix(USB)
    if not wanted:
        raise PortError(f"{url}: the serial number of a USB device is missing; {_listed(ports)}")
    found = [port for port in ports if port.usb_serial.lower() == wanted.lower()]
    if not found:
        raise PortError(
            f"{url}: no port has this USB serial number; is the digitizer plugged in? "
            f"{_listed(ports)}"
        )
    if len(found) > 1:
        raise PortError(
            f"{url}: {len(found)} ports have this USB serial number, name one by its place "
            f"instead (/dev/serial/by-path/…): {'; '.join(map(str, found))}"
        )
    return found[0].device


def holders(device: str) -> list[str]:
    """Programs that have a device open, as far as this user may see: 'minicom (pid 42)'.

    None for a pseudo-terminal, which is open in the program that made it, too.
    """
    found: list[str] = []
    if os.path.realpath(device).startswith("/dev/pts/"):
        return found
    for descriptor in Path("/proc").glob("[0-9]*/fd/*"):
        with suppress(OSError):  # ended, closed, or somebody else's
            if os.readlink(descriptor) == os.path.realpath(device):
                process = descriptor.parents[1]
                name = f"{(process / 'comm').read_text().strip()} (pid {process.name})"
                found += [name] if name not in found else []
    return found


def leave_alone_if_open(url: str) -> None:
    """Raises PortError if another program has this port open, whether or not it has locked it."""
    if others := holders(device_of(url)):
        raise PortError(f"{url}: busy: another program has it open ({', '.join(others)})")


def _links(device: str) -> tuple[str, ...]:
    links = (link for folder in LINK_FOLDERS for link in sorted(Path(folder).glob("*")))
    return tuple(str(link) for link in links if os.path.realpath(link) == device)


def _listed(ports: Sequence[SerialPort]) -> str:
    return f"Serial ports on this machine: {'; '.join(map(str, ports)) or 'none'}"


def _poll(port: serial.SerialBase, url: str) -> select.poll | None:
    """What waits for a port that has a file descriptor; None where pyserial alone can read it."""
    if not hasattr(select, "poll") or ("://" in url and not url.startswith("socket://")):
        return None
    poll = select.poll()
    poll.register(port.fileno(), select.POLLIN)
    return poll


def _names_host_and_port(url: str) -> bool:
    try:
        parts = urlsplit(url)
        return bool(parts.hostname and parts.port)
    except ValueError:  # a port that is no number, or too large
        return False


def _open_failure(error: Exception, device: str) -> str:
    """Why a port did not open, and what to do about it."""
    code = error.args[0] if isinstance(error, TerminalError) else getattr(error, "errno", None)
    if not device:
        return f"no port is named; {_listed(serial_ports())}"
    if code == errno.ENOENT:
        return f"no such port; is the digitizer plugged in? {_listed(serial_ports())}"
    if code in (errno.EACCES, errno.EPERM):
        return (
            "no permission; add yourself to the port's group "
            "(sudo usermod -aG dialout $USER, then log in again)"
        )
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in str(error):
        who = ", ".join(holders(device)) or "another driver, a serial monitor?"
        return f"busy: another program has it open ({who})"
    if "could not configure port" in str(error).lower() or code in _NO_TTY:
        return "not a serial port"
    if device.startswith(NETWORK) and not _names_host_and_port(device):
        return f"host and port (1…65535) are not named, as in {NETWORK[0]}192.168.0.7:4000"
    if isinstance(error, ValueError) and "protocol" in str(error):
        return (
            "unknown kind of port; use a device path, usb://SERIAL, sim://, replay://FILE, "
            "socket://host:port or rfc2217://…"
        )
    return str(error)
