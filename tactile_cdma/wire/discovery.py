# SPDX-License-Identifier: Apache-2.0

"""Serial ports of this machine: their names, which is usb://SERIAL, who has one open, latency."""

import logging
import os
import stat
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports

from ..base.errors import PortError
from ..base.text import plain

_log = logging.getLogger(__name__)

USB = "usb://"
"""Begins the URL of a port that is named by the serial number of its USB device."""
LINK_FOLDERS = ("/dev/tactile", "/dev/serial/by-id", "/dev/serial/by-path")
"""Folders of udev with names that survive replugging; our own rules fill the first."""
ADAPTERS = Path("/sys/bus/usb-serial/devices")
"""Folder with one per serial port; FTDI's driver puts a file latency_timer into it, ms."""
LEAST_MS = 2
"""Latency that is not worth a word, ms; chosen: FTDI's default is 16, its least 1."""
MEMORY = 1
"""Major number of /dev/null and its kind (Linux, Documentation/admin-guide/devices.txt)."""


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port of this machine.

    usb_serial: serial number of its USB device, empty where there is none.
    links: names of the port that survive replugging.
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
    """Return the serial ports of this machine, sorted by name."""
    try:
        found = sorted(list_ports.comports())
    except (OSError, TypeError, ValueError):  # one was unplugged during the search: search again
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


def in_words(ports: Sequence[SerialPort]) -> str:
    """End a message: tell which serial ports there are."""
    return f"Serial ports on this machine: {'; '.join(map(str, ports)) or 'none'}"


def device_of(url: str) -> str:
    """Return the device that usb://SERIAL is now; of any other URL, its scheme in lower case.

    Raises PortError.
    """
    scheme, mark, rest = url.partition("://")
    if mark:
        url = scheme.lower() + mark + rest
    if not url.startswith(USB):
        return url
    device = find_usb(url, serial_ports())
    _log.debug("%s is %s", url, device)
    return device


def find_usb(url: str, ports: Sequence[SerialPort]) -> str:
    """Return the device that usb://SERIAL means; upper and lower case are the same.

    Raises PortError, listing the ports there are, unless exactly one has this serial number.
    """
    wanted = url.removeprefix(USB)
    if not wanted:
        raise PortError(f"{url}: the serial number of a USB device is missing; {in_words(ports)}")
    found = [port for port in ports if port.usb_serial.lower() == wanted.lower()]
    if not found:
        raise PortError(
            f"{url}: no port has this USB serial number; is the digitizer plugged in? "
            f"{in_words(ports)}"
        )
    if len(found) > 1:
        raise PortError(
            f"{url}: {len(found)} ports have this USB serial number, name one by its place "
            f"instead (/dev/serial/by-path/…): {'; '.join(map(str, found))}"
        )
    return found[0].device


def is_away(url: str) -> bool:
    """Tell whether opening a device path is bound to fail: no such device, or no permission.

    Takes microseconds. False for anything but a device path, of which nothing is known; COM3 of
    Windows is none.
    """
    if "://" in url or "\0" in url or os.name != "posix":
        return False
    effective = os.access in os.supports_effective_ids
    return not os.access(url, os.R_OK | os.W_OK, effective_ids=effective)


def is_serial(device: str) -> bool:
    """Tell whether a path can be a serial port: no file, folder, pipe or device of another kind.

    The device is not opened. True for a path that is not there, and for all names of Windows but
    those of files.
    """
    try:
        status = os.stat(device)
    except (OSError, ValueError):
        return True
    if not hasattr(os, "major"):
        return not stat.S_ISREG(status.st_mode) and not stat.S_ISDIR(status.st_mode)
    major = os.major(status.st_rdev)
    kind = os.path.realpath(f"/sys/dev/char/{major}:{os.minor(status.st_rdev)}/subsystem")
    if not os.path.exists(kind):  # of a pseudo-terminal, or there is no /sys
        return stat.S_ISCHR(status.st_mode) and major != MEMORY
    return stat.S_ISCHR(status.st_mode) and os.path.basename(kind) == "tty"


def holders(device: str) -> list[str]:
    """List programs that have a device open, as far as this user may see: 'minicom (pid 42)'.

    Empty for a pseudo-terminal: the program that made it has it open, too.
    """
    real = os.path.realpath(device)
    if real.startswith("/dev/pts/"):
        return []
    found: dict[str, None] = {}  # an ordered set: a program may have it open several times
    for process in filter(str.isdigit, _entries("/proc")):
        for descriptor in _entries(f"/proc/{process}/fd"):
            with suppress(OSError):  # the process has ended, or has closed it
                if os.readlink(f"/proc/{process}/fd/{descriptor}") == real:
                    name = Path(f"/proc/{process}/comm").read_text("utf-8", errors="replace")
                    found[f"{name.strip()} (pid {process})"] = None
    return list(found)


def leave_alone_if_open(url: str) -> None:
    """Raises PortError if another program has this port open, whether or not it has locked it.

    Not for what is no serial port, which opening it tells: many programs have /dev/null open.
    """
    device = device_of(url)
    if is_serial(device) and (others := holders(device)):
        raise PortError(f"{url}: busy: another program has it open ({', '.join(others)})")


def held_back(device: str, adapters: Path = ADAPTERS) -> str:
    """Return a sentence about the adapter of an open port if it holds bytes back, else nothing.

    device: path of the port, or a URL.
    """
    try:
        timer = adapters / os.path.basename(os.path.realpath(device)) / "latency_timer"
        held_ms = int(timer.read_text("ascii"))
    except (OSError, ValueError):  # an adapter, a port, or a working folder, without one
        return ""
    if held_ms <= LEAST_MS:
        return ""
    return (
        f"its USB adapter holds bytes back for up to {held_ms} ms, and that could not be changed: "
        f"echo 1 | sudo tee {timer}"
    )


def _links(device: str) -> tuple[str, ...]:
    links = (f"{folder}/{name}" for folder in LINK_FOLDERS for name in sorted(_entries(folder)))
    return tuple(link for link in links if os.path.realpath(link) == device)


def _entries(folder: str) -> list[str]:
    """Return the names in a folder; none if it is gone, or another user's, both at any moment."""
    with suppress(OSError):
        return os.listdir(folder)
    return []
