# SPDX-License-Identifier: Apache-2.0

"""A digitizer on a pty that tells the same stretch over and over in real time: a soak's skin.

    python -m torture.soak.lap_digitizer LINK

It takes next to no CPU time, and its clock is the host's monotonic one since power-up. So whoever
knows the stretch and the power-up, which is said on stdout, knows all that a driver must publish.
"""

from __future__ import annotations

import argparse
import signal
import threading
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import NamedTuple

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.pty import serve
from tactile_cdma.wire._protocol import Result
from tactile_cdma.wire.messages import Command, Configure, GetInfo, Start, Status, Stop
from tactile_cdma.wire.packets import PacketParser

from ..laps import LapWriter, Stretch, Told, record

LAP_FRAMES = 390
"""5 s: all contacts of the scene come and go, and every node has had its heartbeats."""
SCENE = "presses"
BUFFER_BYTES = 65_536
"""Output that waits for a slow host: 0.4 s. What has no room is dropped, packet by packet."""
REPORT_S = 1.0


def stretch(config: SkinConfig) -> Stretch:
    """What it tells."""
    return record(config, SimOptions(scene=SCENE), LAP_FRAMES)


class LapDigitizer:
    """Tells a stretch in real time, between START and STOP, from a whole frame on.

    powered_s: host time of its time 0. No I/O; see sim.pty.Digitizer.
    """

    def __init__(self, told: Stretch) -> None:
        self.powered_s = time.monotonic()
        self._told = told
        self._parser, self._writer = PacketParser(), LapWriter()
        self._output = bytearray()
        self._coming: Iterator[_Coming] | None = None
        self._next: _Coming | None = None
        self._report_s = 0.0
        self._dropped = 0

    def receive(self, data: bytes) -> None:
        """Obey the commands that these bytes complete, and answer them."""
        for packet in self._parser.feed(data):
            if isinstance(packet, Command):
                self._obey(packet)

    def advance(self, wanted: int) -> float:
        """Make what is due by now; return the seconds until something else is."""
        now_s = time.monotonic() - self.powered_s
        while self._report_s <= now_s:
            self._report()
        while self._next is not None and self._next.due_s <= now_s:
            self._send(self._writer.tell(*self._next[:3]))
            assert self._coming is not None
            self._next = next(self._coming)
        due_s = self._next.due_s if self._next is not None else self._report_s
        return max(0.0, min(due_s, self._report_s) - (time.monotonic() - self.powered_s))

    def take(self, size: int) -> bytes:
        """Remove at most `size` bytes of the output."""
        data = bytes(self._output[:size])
        del self._output[:size]
        return data

    def _obey(self, command: Command) -> None:
        self._send(self._writer.encode(command.ack(Result.OK)))
        match command:
            case Start():
                self._coming = self._packets()
                self._next = next(self._coming)
            case Stop():
                self._coming = self._next = None
            case GetInfo() | Configure():
                self._send(self._writer.encode(self._told.info))

    def _packets(self) -> Iterator[_Coming]:
        """The stream from the next whole frame on."""
        told = self._told
        now_us = (time.monotonic() - self.powered_s) * 1e6
        for index, number in enumerate(count(int(now_us // told.period_us) + 1)):
            begin_us = number * told.period_us
            for packet in told.frames[number % len(told)]:
                due_s = (begin_us + packet.due_us) * 1e-6
                yield _Coming(packet, begin_us, index * told.period_samples, due_s)

    def _report(self) -> None:
        uptime_us = round(self._report_s * 1e6)
        streaming = self._coming is not None
        status = Status(uptime_us, packets_dropped=self._dropped, streaming=streaming)
        self._send(self._writer.encode(status))
        self._send(self._writer.encode(self._told.info))
        self._report_s += REPORT_S

    def _send(self, data: bytes) -> None:
        if len(self._output) + len(data) <= BUFFER_BYTES:
            self._output += data
        else:
            self._dropped += 1


class _Coming(NamedTuple):
    """A packet, the start of its frame period (µs, index), and when it is due, device time, s."""

    told: Told
    begin_us: int
    begin_index: int
    due_s: float


def main() -> None:
    """Serve until SIGTERM or SIGINT."""
    parser = argparse.ArgumentParser(
        prog="python -m torture.soak.lap_digitizer", description=__doc__
    )
    parser.add_argument("link", type=Path, help="symbolic link to the terminal")
    link = parser.parse_args().link
    stop, told = threading.Event(), stretch(SkinConfig.of({}))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())

    def power_up() -> LapDigitizer:
        digitizer = LapDigitizer(told)
        print(digitizer.powered_s, flush=True)
        return digitizer

    serve(power_up, link, stop, lambda _: None)


if __name__ == "__main__":
    main()
