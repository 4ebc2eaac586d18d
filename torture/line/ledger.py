# SPDX-License-Identifier: Apache-2.0

"""A ledger of sent and arrived packets: the counts that a receiver must arrive at.

It compares bytes: what equals a sent packet has arrived, anything else between two delimiters is
broken. So it shares no code with the parser it is compared with.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from tactile_cdma.wire.messages import Info, Quiet, Received, Samples

KEPT = 2048
"""Packets that are remembered, to recognise repetitions."""
RECENT = 1024
"""Newest of these that may be repeated: packets in transit must not displace them."""


@dataclass(frozen=True, slots=True)
class Sent:
    """A packet. start: index of its START. begin, end: indices of its samples; equal if none."""

    start: int
    begin: int = 0
    end: int = 0
    describes: bool = False
    impossible: bool = False


@dataclass(slots=True)
class Unbroken:
    """A range of samples that arrived without a gap."""

    start: int
    begin: int
    end: int


@dataclass(slots=True)
class Counts:
    """What the driver must have counted.

    broken: damaged packets. impossible: packets with a right CRC and contradictory contents.
    """

    bytes: int = 0
    packets: int = 0
    broken: int = 0
    lost_packets: int = 0
    repeated: int = 0
    samples: int = 0
    lost_samples: int = 0
    unannounced: int = 0
    impossible: int = 0
    restarts: int = 0


class Ledger:
    """Kept by the man in the middle."""

    def __init__(self) -> None:
        self.counts = Counts()
        self.unbroken: list[Unbroken] = []
        self.sent_until = 0  # index of the sample that is to be sent next
        self._past: deque[bytes] = deque(maxlen=KEPT)
        self._sent: dict[bytes, tuple[int, Sent]] = {}
        self._number = 0
        self._newest: int | None = None  # that arrived
        self._run = b""  # since the last delimiter
        self._described = False

    @property
    def past(self) -> list[bytes]:
        """The packets sent last, in order."""
        return list(self._past)[-RECENT:]

    def sent(self, packet: bytes, said: Received, start: int) -> None:
        """Note a packet of the digitizer. said: its contents. start: index of the last START."""
        entry = Sent(start, describes=isinstance(said, Info))
        if isinstance(said, Samples | Quiet):
            count = said.count if isinstance(said, Quiet) else len(said.counts)
            entry = Sent(start, said.first_index, said.first_index + count)
            self.sent_until = entry.end
        if len(self._past) == KEPT:
            self._sent.pop(self._past[0][:-1], None)
        self._past.append(packet)
        self._sent[packet[:-1]] = self._number, entry
        self._number += 1

    def forged(self, packet: bytes, claim: bytes) -> None:
        """Note that the packet sent last was replaced by another one."""
        number, entry = self._sent.pop(packet[:-1])
        self._sent[claim[:-1]] = number, Sent(entry.start, impossible=True)
        self._past[-1] = claim

    def arrived(self, data: bytes) -> None:
        """Note bytes handed to the receiver."""
        self.counts.bytes += len(data)
        *runs, rest = (self._run + data).split(b"\0")
        self._run = rest
        for run in filter(None, runs):
            number, sent = self._sent.get(run, (-1, None))
            if sent is None:
                self.counts.broken += 1
            else:
                self.counts.packets += 1
                self._take(number, sent)

    def _take(self, number: int, sent: Sent) -> None:
        counts = self.counts
        if self._newest is not None and number <= self._newest:
            counts.repeated += 1
            return
        if self._newest is not None:
            counts.lost_packets += number - self._newest - 1
        self._newest = number
        self._described |= sent.describes
        if sent.impossible:
            counts.impossible += 1
        elif sent.end > sent.begin and not self._described:
            counts.unannounced += sent.end - sent.begin
        elif sent.end > sent.begin:
            self._samples(sent)

    def _samples(self, sent: Sent) -> None:
        self.counts.samples += sent.end - sent.begin
        last = self.unbroken[-1] if self.unbroken else None
        if last is not None and (last.start, last.end) == (sent.start, sent.begin):
            last.end = sent.end
            return
        if last is not None and last.start == sent.start:
            self.counts.lost_samples += sent.begin - last.end
        self.counts.restarts += last is not None and last.start != sent.start
        self.unbroken.append(Unbroken(sent.start, sent.begin, sent.end))
