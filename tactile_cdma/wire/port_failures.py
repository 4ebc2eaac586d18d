# SPDX-License-Identifier: Apache-2.0

"""Failures of a port in words: the likely cause, and what to do about it."""

import errno
from contextlib import suppress
from importlib import import_module
from urllib.parse import urlsplit

from ..base.errors import CaptureError, PortError, RecordingEndError, SpecError
from .discovery import holders, in_words, is_serial, serial_ports

TerminalError: type[Exception] = OSError
with suppress(ImportError):  # on Windows pyserial raises nothing but OSErrors
    TerminalError = import_module("termios").error
"""Error of termios, which is no OSError, and which pyserial lets through."""
SOCKET = "socket://"
"""Begins the URLs of ports on another machine."""
NO_HOST = f"host and port (1…65535) are not named, as in {SOCKET}192.168.0.7:4000"
_AWAY = (errno.ENOENT, errno.ENXIO, errno.ENODEV, errno.EIO)
_NOT_SERIAL = (errno.ENOTTY, errno.EISDIR)


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


def lost(url: str, doing: str, error: Exception) -> PortError:
    """Make the error to raise for one that reading or writing raised."""
    if isinstance(error, RecordingEndError):
        return error
    if isinstance(error, CaptureError):  # the file of replay:// was taken away
        return PortError(f"{url}: {error}")
    return PortError(f"{url}: lost while {doing}; unplugged? ({error})")


def _names_host_and_port(url: str) -> bool:
    try:
        parts = urlsplit(url)
        return bool(parts.hostname and parts.port)
    except ValueError:  # the port is no number, or too large
        return False
