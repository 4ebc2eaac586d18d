# SPDX-License-Identifier: Apache-2.0

"""Serves a simulated digitizer on a real tty, for programs that open a device path."""

import logging
import os
import select
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Protocol

from ..base.errors import PortError
from ..base.interrupt import Stop

_log = logging.getLogger(__name__)

_CHUNK = 65_536
"""Bytes offered to the terminal at once; it takes what it has room for."""
_STOP_POLL_S = 0.1
"""Longest wait before `stop` is looked at, s."""


class Digitizer(Protocol):
    """Stands behind a pseudo-terminal: VirtualDigitizer, or firmware in an emulator."""

    def receive(self, data: bytes) -> None:
        """Take bytes of the host."""

    def advance(self, wanted: int) -> float:
        """Do what is due by now; return the seconds until something else is due."""

    def take(self, size: int) -> bytes:
        """Remove at most `size` bytes of the output, for the host."""


def serve(
    power_up: Callable[[], Digitizer],
    link: Path | None,
    stop: threading.Event | Stop,
    on_ready: Callable[[Path], None],
) -> None:
    """Run a digitizer on a pseudo-terminal until `stop` is set.

    link: a symbolic link to create to the terminal, replacing one of an earlier run. on_ready is
    called with the path to open, the link's if there is one. Clients may come and go: the digitizer
    stays powered and, between START and STOP, streams on; what nobody reads is dropped and counted.
    Raises PortError where there is no pseudo-terminal or the link cannot be made.
    """
    with ExitStack() as stack:
        host, path = stack.enter_context(_raw_terminal())
        if link is not None:
            stack.enter_context(_symlink(link, path))
        _log.debug("a digitizer is at %s", path)
        digitizer = power_up()
        on_ready(link or path)
        _pump(digitizer, host, stop)


def _pump(digitizer: Digitizer, host: int, stop: threading.Event | Stop) -> None:
    """Carry bytes both ways, at the digitizer's pace."""
    outgoing = b""
    while not stop.is_set():
        wait_s = digitizer.advance(_CHUNK)
        outgoing = outgoing or digitizer.take(_CHUNK)
        readable, writable, _ = select.select(
            [host], [host] if outgoing else [], [], min(wait_s, _STOP_POLL_S)
        )
        if readable:
            digitizer.receive(os.read(host, _CHUNK))
        if writable:
            outgoing = outgoing[os.write(host, outgoing) :]


@contextmanager
def _raw_terminal() -> Iterator[tuple[int, Path]]:
    """Yield a pseudo-terminal in raw mode: the host's side and the path of the other one.

    The device's side is kept open, too: its mode and unread bytes outlive clients that close it.
    """
    try:
        import tty

        host, device = os.openpty()
    except ImportError:
        raise PortError("this system has no pseudo-terminals: use the port sim://") from None
    except OSError as error:
        raise PortError(f"no pseudo-terminal is available: {error.strerror}") from None
    try:
        tty.setraw(device)
        os.set_blocking(host, False)
        yield host, Path(os.ttyname(device))
    finally:
        os.close(host)
        os.close(device)


@contextmanager
def _symlink(link: Path, target: Path) -> Iterator[None]:
    if os.path.lexists(link) and not (
        link.is_symlink() and Path(os.readlink(link)).parent == target.parent
    ):
        raise PortError(f"{link} exists and is no link to a pseudo-terminal; it is left alone")
    try:
        link.unlink(missing_ok=True)
        link.symlink_to(target)
    except OSError as error:
        raise PortError(f"cannot create the link {link}: {error.strerror}") from None
    try:
        yield
    finally:
        if link.is_symlink() and Path(os.readlink(link)) == target:
            link.unlink()
