# SPDX-License-Identifier: Apache-2.0

"""The RP2040's image in its emulator: a known line at its ADC, the host's parser at its ports."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rp2040 import Rp2040
from tactile_cdma.driver.timeline import sample_count
from tactile_cdma.wire._protocol import SYNC_LEAD, SYNC_UNIT_US
from tactile_cdma.wire.messages import (
    Ack,
    Command,
    Configure,
    FrameLayout,
    Packet,
    Quiet,
    Samples,
    Start,
    Status,
)
from tactile_cdma.wire.packets import PacketParser, PacketWriter

T = TypeVar("T", bound=Packet)
UART, USB = "uart", "usb"
FLASH_ID = bytes.fromhex("e661640843123456")
LEAD_NS = SYNC_LEAD * SYNC_UNIT_US * 1000
READY_S = 0.05
"""By this time, s, a USB host present since power-up has configured the device."""
TICK_NS = 1000 / 48
TIME_NS = 1100
"""Largest error of device_time_us: the stream's start and the place in it are whole µs."""


def sine(times_ns: NDArray[np.float64]) -> NDArray[Any]:
    """50 Hz, nearly the whole range of the ADC."""
    return np.rint(2048 + 2000 * np.sin(times_ns * 1e-9 * 2 * np.pi * 50))


def ramp(times_ns: NDArray[np.float64]) -> NDArray[Any]:
    """A sawtooth over the whole range: one count more every 3 µs."""
    return times_ns // 3000 % 4096


class Bench:
    """A board, the packets it has sent, and the counts its ADC was given.

    link: "uart" or "usb", where the host is. shape: the line's counts at times in ns.
    """

    def __init__(
        self,
        image: Path,
        link: str = USB,
        shape: Callable[[NDArray[np.float64]], NDArray[Any]] = sine,
        flash_id: bytes = FLASH_ID,
    ) -> None:
        self.link, self._shape = link, shape
        self.parser, self.writer = PacketParser(), PacketWriter()
        self.packets: list[Packet] = []
        self.edges: list[tuple[float, bool]] = []
        """Edges of the sync line: time in ns, whether rising."""
        self._parts: list[tuple[NDArray[np.float64], NDArray[np.uint16]]] = []
        self.board = Rp2040(
            image, self._line, lambda t_ns, high: self.edges.append((t_ns, high)), flash_id
        )
        if link == USB:
            self.board.plug_usb()
        self.run(READY_S)

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *error: object) -> None:
        self.board.close()

    def _line(self, times_ns: NDArray[np.float64]) -> NDArray[np.uint16]:
        counts = self._shape(times_ns).astype(np.uint16)
        if len(self._parts) > 1:
            period_ns = self._parts[1][0][0] - self._parts[0][0][0]
            if abs(times_ns[0] - self._parts[-1][0][-1] - period_ns) > 1:
                self._parts.clear()  # a new stream
        self._parts.append((times_ns, counts))
        return counts

    @property
    def times_ns(self) -> NDArray[np.float64]:
        """Start times of the latest stream's conversions; a few may lie ahead."""
        return np.concatenate([times for times, _ in self._parts])

    @property
    def counts(self) -> NDArray[np.uint16]:
        """Their counts."""
        return np.concatenate([counts for _, counts in self._parts])

    def write(self, data: bytes) -> None:
        """Deliver bytes from the host."""
        (self.board.write_usb if self.link == USB else self.board.write_uart)(data)

    def send(self, *commands: Command) -> None:
        """Deliver commands from the host, back to back, after a delimiter."""
        self.write(b"\0" + b"".join(self.writer.encode(command) for command in commands))

    def run(self, seconds: float) -> list[Packet]:
        """Let time pass; return the packets received meanwhile, which must be intact."""
        self.board.run(self.board.now + seconds)
        received = self.parser.feed(self.read())
        seen = self.parser.counters
        assert not seen.crc_errors + seen.framing_errors + seen.malformed + seen.unknown, seen
        self.packets += received  # type: ignore[arg-type]
        return received  # type: ignore[return-value]

    def read(self) -> bytes:
        """Packets received since the last call."""
        return self.board.read_usb() if self.link == USB else self.board.read_uart()

    def run_deaf(self, seconds: float) -> None:
        """Let time pass and ignore the output; discard all packets so far."""
        self.board.run(self.board.now + seconds)
        self.read()
        self.packets.clear()

    def listen_again(self, seconds: float) -> None:
        """Like run, but begin at the first whole packet."""
        self.board.run(self.board.now + seconds)
        data = self.read()
        self.packets += self.parser.feed(data[data.index(b"\0") :])  # type: ignore[arg-type]

    def stream(self, asked: Configure | FrameLayout, seconds: float) -> None:
        """Configure, start and let time pass."""
        asked = Configure(asked) if isinstance(asked, FrameLayout) else asked
        self.send(asked, Start())
        self.run(seconds)
        assert [ack.result for ack in self.of(Ack)][-2:] == [0, 0]

    def of(self, kind: type[T]) -> list[T]:
        """All packets of a kind so far."""
        return [packet for packet in self.packets if isinstance(packet, kind)]

    @property
    def status(self) -> Status:
        """The latest."""
        return self.of(Status)[-1]

    @property
    def line(self) -> list[Samples | Quiet]:
        """All packets of samples so far."""
        return [packet for packet in self.packets if isinstance(packet, Samples | Quiet)]

    @property
    def pulses(self) -> list[tuple[float, float]]:
        """Pulses of the sync line: rising edges and lengths, ns."""
        assert [high for _, high in self.edges] == [True, False] * (len(self.edges) // 2)
        times = [t_ns for t_ns, _ in self.edges]
        return [(up, down - up) for up, down in zip(times[::2], times[1::2], strict=True)]

    def check(self, packets: list[Samples | Quiet]) -> int:
        """Check that packets of the latest stream have the line's counts at the right times.

        Returns how many samples they speak of.
        """
        total, times_ns, line = 0, self.times_ns, self.counts
        for packet in packets:
            first, size = packet.first_index, sample_count(packet)
            counts = line[first : first + size]
            if isinstance(packet, Quiet):
                assert (packet.sum, packet.count) == (counts.astype(np.int64).sum(), counts.size)
            else:
                np.testing.assert_array_equal(packet.counts, counts)
            assert abs(packet.device_time_us * 1000 - times_ns[first]) <= TIME_NS
            total += size
        return total
