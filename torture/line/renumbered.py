# SPDX-License-Identifier: Apache-2.0

"""A digitizer that has been running for long: its counters are about to wrap, or beyond."""

from __future__ import annotations

from dataclasses import dataclass, replace

from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.wire.messages import Ack, Info, Packet, Quiet, Samples, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter


@dataclass(frozen=True, slots=True)
class Counted:
    """Where counters begin: sequence of packets, device time in µs, index of samples."""

    sequence: int = 0
    device_time_us: int = 0
    first_index: int = 0


class Renumbered:
    """Hands on what a digitizer says, with its counters set on."""

    def __init__(self, digitizer: VirtualDigitizer, begin: Counted) -> None:
        self._digitizer, self._begin = digitizer, begin
        self._parser, self._writer = PacketParser(), PacketWriter(begin.sequence)
        self._output = bytearray(b"\0")

    def receive(self, data: bytes) -> None:
        """Take bytes of the host."""
        self._digitizer.receive(data)

    def advance(self, wanted: int) -> float:
        """Do what is due by now."""
        return self._digitizer.advance(wanted)

    def take(self, size: int) -> bytes:
        """Give away at most `size` bytes for the host."""
        if not self._output:
            for packet in self._parser.feed(self._digitizer.take(size)):
                assert isinstance(packet, Info | Samples | Quiet | Status | Ack)
                self._output += self._writer.encode(self._set_on(packet))
        data = bytes(self._output[:size])
        del self._output[:size]
        return data

    def _set_on(self, packet: Packet) -> Packet:
        begin = self._begin
        if isinstance(packet, Samples | Quiet):
            return replace(
                packet,
                device_time_us=packet.device_time_us + begin.device_time_us,
                first_index=packet.first_index + begin.first_index,
            )
        if isinstance(packet, Status):
            return replace(packet, uptime_us=packet.uptime_us + begin.device_time_us)
        return packet
