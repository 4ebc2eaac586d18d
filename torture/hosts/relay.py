# SPDX-License-Identifier: Apache-2.0

"""A switch whose frames are late, lost or cut, for kernels without `tc netem`.

A program: creates a TAP interface of each name given, says "ready", and forwards Ethernet frames
between them. A line of JSON on its input sets the Weather; it answers with the counts so far.
"""

from __future__ import annotations

import fcntl
import heapq
import json
import os
import selectors
import struct
import sys
import time
from dataclasses import asdict, dataclass, fields
from itertools import count
from random import Random

TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000  # linux/if_tun.h
MOST_BYTES = 2048
"""More than an Ethernet frame has at Linux's default MTU."""
MOST_WAITING = 20_000
"""Frames that may wait in the switch; more are lost. Chosen: seconds of all that a test sends."""
MULTICAST = 0x01
"""This bit of the first byte of a destination means all hosts (broadcast) or some of them."""


@dataclass(frozen=True, slots=True)
class Weather:
    """What happens to each frame on its way to one host.

    delay_s, jitter_s: it takes delay_s ± jitter_s, equally distributed, so that frames overtake
    each other. loss: probability to vanish. cut: names of hosts that send and receive nothing.
    multicast: whether multicast passes, which discovery needs; broadcast (ARP) always does.
    """

    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    cut: tuple[str, ...] = ()
    multicast: bool = True


@dataclass(slots=True)
class Counts:
    """Frames: forwarded, lost by chance or for want of room, stopped by a cut or as multicast."""

    forwarded: int = 0
    lost: int = 0
    stopped: int = 0


class Switch:
    """Decides where frames go, and when. Learns from their sources who is where."""

    def __init__(self, ports: tuple[str, ...], seed: int) -> None:
        self.weather, self.counts = Weather(), Counts()
        self._ports, self._rng, self._numbers = ports, Random(seed), count()
        self._port_of: dict[bytes, str] = {}
        self._waiting: list[tuple[float, int, str, bytes]] = []

    def take(self, frame: bytes, port: str, now_s: float) -> None:
        """Take in a frame that a host sent."""
        destination, source = frame[:6], frame[6:12]
        self._port_of[source] = port
        weather = self.weather
        to_many = bool(destination[0] & MULTICAST)
        to = [p for p in self._ports if p != port]
        if not to_many and destination in self._port_of:
            to = [self._port_of[destination]]
        is_stopped = to_many and not weather.multicast and destination != b"\xff" * 6
        for target in to:
            if is_stopped or port in weather.cut or target in weather.cut:
                self.counts.stopped += 1
            elif self._rng.random() < weather.loss or len(self._waiting) >= MOST_WAITING:
                self.counts.lost += 1
            else:
                late_s = weather.delay_s + weather.jitter_s * self._rng.uniform(-1.0, 1.0)
                entry = now_s + max(0.0, late_s), next(self._numbers), target, frame
                heapq.heappush(self._waiting, entry)

    def due(self, now_s: float) -> list[tuple[str, bytes]]:
        """The frames that arrive by now, with their ports."""
        found = []
        while self._waiting and self._waiting[0][0] <= now_s:
            _, _, port, frame = heapq.heappop(self._waiting)
            found.append((port, frame))
        self.counts.forwarded += len(found)
        return found

    def pause_s(self, now_s: float) -> float | None:
        """Time until the next frame is due, s; None if none waits."""
        return max(0.0, self._waiting[0][0] - now_s) if self._waiting else None


def tap(name: str) -> int:
    """A file descriptor of a new TAP interface of this name, which lives as long as it."""
    descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(descriptor, TUNSETIFF, struct.pack("16sH22x", name.encode(), IFF_TAP | IFF_NO_PI))
    return descriptor


def main() -> None:
    """Forward until the input ends."""
    seed, *names = sys.argv[1:]
    taps = {name: tap(name) for name in names}
    switch = Switch(tuple(names), int(seed))
    selector = selectors.DefaultSelector()
    for name, descriptor in taps.items():
        selector.register(descriptor, selectors.EVENT_READ, name)
    selector.register(sys.stdin.fileno(), selectors.EVENT_READ)
    print("ready", flush=True)
    while True:
        for key, _ in selector.select(switch.pause_s(time.monotonic())):
            if key.data is None:
                line = sys.stdin.readline()
                if not line:
                    return
                content = json.loads(line)
                switch.weather = Weather(**{f.name: content[f.name] for f in fields(Weather)})
                print(json.dumps(asdict(switch.counts)), flush=True)
            else:
                switch.take(os.read(key.fd, MOST_BYTES), key.data, time.monotonic())
        for name, frame in switch.due(time.monotonic()):
            try:
                os.write(taps[name], frame)
            except OSError:  # its interface is not up yet
                switch.counts.forwarded -= 1
                switch.counts.lost += 1


if __name__ == "__main__":
    main()
