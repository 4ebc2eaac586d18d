# SPDX-License-Identifier: Apache-2.0

"""Failures of a port in words: the likely cause, and what to do about it."""

import errno
import termios
from urllib.parse import urlsplit

from ..base.errors import CaptureError, PortError, RecordingEndError, SpecError
from .discovery import holders, in_words, is_serial, serial_ports

TerminalError = termios.error
"""Error of termios, which is no OSError, and which pyserial lets through."""
SOCKET = "socket://"
"""Begins the URLs of ports on another machine."""
NO_HOST = f"host and port (1…65535) are not named, as in {SOCKET}192.168.0.7:4000"
_NOT_SERIAL = "not a serial port"
_REASONS = {
    **dict.fromkeys((errno.ENOTTY, errno.EISDIR), _NOT_SERIAL),
    **dict.fromkeys(
        (errno.ENXIO, errno.ENODEV, errno.EIO), "no device is behind this name; unplugged?"
    ),
    **dict.fromkeys(
        (errno.EACCES, errno.EPERM),
        "no permission; add yourself to the port's group "
        "(sudo usermod -aG dialout $USER, then log in again)",
    ),
}


def why_not_open(error: Exception, device: str, is_open_here: bool = False) -> str:
    """Tell why a port did not open, and what to do about it. is_open_here: in this process."""
    if isinstance(error, SpecError | CaptureError):  # an option of sim://, the file of replay://
        return str(error)
    code = error.args[0] if isinstance(error, TerminalError) else getattr(error, "errno", None)
    if not device:
        return f"no port is named; {in_words(serial_ports())}"
    if code == errno.ENOENT:
        return f"no such port; is the digitizer plugged in? {in_words(serial_ports())}"
    if not is_serial(device):
        return _NOT_SERIAL
    if code in _REASONS:
        return _REASONS[code]
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in str(error):
        who = ", ".join(holders(device)) or "another driver, a serial monitor?"
        other = f"another program has it open ({who})"
        return f"busy: {'this program has it open already' if is_open_here else other}"
    if "could not configure port" in str(error).lower():
        return _NOT_SERIAL
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
