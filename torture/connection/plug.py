# SPDX-License-Identifier: Apache-2.0

"""The far end of a port: a tty that can be unplugged, or a network host."""

from __future__ import annotations

import fcntl
import os
import select
import socket
import struct
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tactile_cdma.sim.pty import Digitizer

TICK_S = 10e-3
"""Largest advance of the digitizers' time per step, s."""
MOST = 65_536


class Plug(ABC):
    """The far end of a port.

    device: a digitizer or any other device; None: nothing.
    stalled: the device runs, but no byte gets through.
    now_s: the digitizers' time, s. It stands still while their output is not read, so that a busy
        machine is no fault, except if `hasty` or stalled.
    All happens in `step`, so that the caller chooses the moment of every fault.
    """

    def __init__(self) -> None:
        self.device: Digitizer | None = None
        self.stalled = self.hasty = False
        self.now_s = 0.0
        self._host_s = time.monotonic()
        self._outgoing = b""

    @property
    @abstractmethod
    def url(self) -> str:
        """The port that the driver opens."""

    def plug(self, device: Digitizer) -> None:
        """Create the port, with this device behind it."""
        self.swap(device)

    def swap(self, device: Digitizer) -> None:
        """Replace the device behind the port; output of the old one is lost."""
        self.device, self._outgoing = device, b""

    def unplug(self) -> None:
        """Remove the port."""
        self.device, self._outgoing = None, b""

    def step(self, most: int = MOST) -> None:
        """Carry bytes both ways, at most `most` to the host."""
        self._tick()
        if self.device is None:
            return
        self.device.advance(MOST)
        if not self.stalled:
            self._outgoing = self._outgoing or self.device.take(most)
            self._outgoing = self._carry(self.device, self._outgoing)

    def _tick(self) -> None:
        host_s = time.monotonic()
        if self.stalled or self.hasty or not self._outgoing:
            self.now_s += min(host_s - self._host_s, TICK_S)
        self._host_s = host_s

    @abstractmethod
    def _carry(self, device: Digitizer, outgoing: bytes) -> bytes:
        """Exchange bytes with the client; returns the output it did not take."""


class Tty(Plug):
    """A pseudo-terminal behind a symbolic link, a new one whenever it is plugged in."""

    def __init__(self, link: Path) -> None:
        super().__init__()
        self._link = link
        self.host = self.side = -1  # descriptors: the device's end, and the host's

    @property
    def url(self) -> str:
        """The link."""
        return str(self._link)

    @property
    def asked(self) -> bool:
        """Whether bytes of the host are waiting."""
        return bool(select.select([self.host], [], [], 0)[0])

    def plug(self, device: Digitizer) -> None:
        """Make the terminal and its link."""
        self.make()
        self.show(device)

    def make(self) -> None:
        """Make the terminal, without its link."""
        self.host, self.side = os.openpty()
        tty.setraw(self.side)
        os.set_blocking(self.host, False)

    def show(self, device: Digitizer) -> None:
        """Link the terminal."""
        self.swap(device)
        self._link.symlink_to(os.ttyname(self.side))

    def unplug(self) -> None:
        """Remove the terminal and its link."""
        if self.device is not None:
            self._link.unlink()
            os.close(self.host)
            os.close(self.side)
        super().unplug()

    def permit(self, mode: int) -> None:
        """Set who may open the terminal."""
        os.chmod(os.ttyname(self.side), mode)

    def lock(self, how: int) -> None:
        """Lock the terminal, or unlock it: fcntl.LOCK_EX or LOCK_UN."""
        fcntl.flock(self.side, how)

    def fill(self) -> None:
        """Fill the buffer that the host writes to, like a device that reads nothing."""
        os.set_blocking(self.side, False)
        for _ in range(3):  # the kernel makes some room a little later
            with suppress(BlockingIOError):
                while True:
                    os.write(self.side, bytes(1024))
            time.sleep(0.01)

    def _carry(self, device: Digitizer, outgoing: bytes) -> bytes:
        writing = [self.host] if outgoing else []
        readable, writable, _ = select.select([self.host], writing, [], 0)
        if readable:
            device.receive(os.read(self.host, MOST))
        if writable:
            outgoing = outgoing[os.write(self.host, outgoing) :]
        return outgoing


class Host(Plug):
    """A host in the network that serves a port to one client at a time."""

    def __init__(self) -> None:
        super().__init__()
        with socket.create_server(("127.0.0.1", 0)) as server:
            self._address = server.getsockname()
        self._server: socket.socket | None = None
        self._client: socket.socket | None = None

    @property
    def url(self) -> str:
        """Its address, which never changes."""
        return "socket://{}:{}".format(*self._address)

    def plug(self, device: Digitizer) -> None:
        """Begin to listen, with the device switched on."""
        self._server = socket.create_server(self._address, reuse_port=False)
        super().plug(device)

    def unplug(self) -> None:
        """Close the connection, and stop listening."""
        self.hang_up()
        if self._server is not None:
            self._server.close()
        self._server = None
        super().unplug()

    def hang_up(self) -> None:
        """End the client's connection."""
        if self._client is not None:
            self._client.close()
        self._client = None

    def reset(self) -> None:
        """Reset the client's connection, as a restarted host does."""
        if self._client is not None:
            self._client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.hang_up()

    def half_close(self) -> None:
        """Shut down the sending side, and go on receiving."""
        if self._client is not None:
            self._client.shutdown(socket.SHUT_WR)

    def _carry(self, device: Digitizer, outgoing: bytes) -> bytes:
        assert self._server is not None
        reading = [self._server, *([self._client] if self._client else [])]
        writing = [self._client] if self._client and outgoing else []
        readable, writable, _ = select.select(reading, writing, [], 0)
        if self._server in readable:
            self.hang_up()
            self._client, _ = self._server.accept()
            self._client.setblocking(False)
        elif readable:
            self._hear(device)
        if writable and self._client is not None:
            with suppress(OSError):  # the client has gone: the next read will tell
                outgoing = outgoing[self._client.send(outgoing) :]
        # Like a tty's: output is lost while nobody listens.
        return outgoing if self._client is not None else b""

    def _hear(self, device: Digitizer) -> None:
        assert self._client is not None
        try:
            data = self._client.recv(MOST)
        except OSError:
            data = b""
        if data:
            device.receive(data)
        else:
            self.hang_up()


@contextmanager
def as_ordinary_user(folder: Path) -> Iterator[None]:
    """Drop root's rights, which no permission stops, and own this folder."""
    if os.geteuid() != 0:
        yield
        return
    os.chown(folder, NOBODY, NOBODY)
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


NOBODY = 65_534
