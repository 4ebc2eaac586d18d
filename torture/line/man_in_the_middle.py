# SPDX-License-Identifier: Apache-2.0

"""A man in the middle, who damages a digitizer's bytes by a seeded schedule."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.nodes import Turns
from tactile_cdma.sim.options import Setup
from tactile_cdma.sim.pty import Digitizer
from tactile_cdma.wire._protocol import PacketType, Result, SyncMode
from tactile_cdma.wire.messages import Ack, Info, Packet, Quiet, Samples, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter

from .damage import Kind
from .ledger import Ledger

CHUNK = 4096
"""Bytes taken from the digitizer at once."""
POLL_S = 2e-3
"""Polling interval."""
PEACE = (1.1, 2.1)
"""Frame periods between two faults, drawn between these: enough to recover, and to show it."""
PEACE_WITHOUT_MARKS = (3.1, 4.1)
"""Frame periods between two faults without marks, where frames take one or two more to find."""


@dataclass(frozen=True, slots=True)
class Counted:
    """Initial counters: sequence of packets, device time in µs, index of samples."""

    sequence: int = 0
    device_time_us: int = 0
    first_index: int = 0


class Started(NamedTuple):
    """A START that was obeyed: device time, s, set-up, and the turns of its stream."""

    device_s: float
    setup: Setup
    turns: Turns


class Renumbered:
    """A digitizer that has run for long: adds these counters to all it sends."""

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


@dataclass
class Schedule:
    """A number of faults of one kind, with a few sound frames before each.

    done: faults that changed something. bytes: exposed to faults.
    """

    kind: Kind
    times: int
    rng: np.random.Generator
    done: int = 0
    tried: int = 0
    bytes: int = 0


class ManInTheMiddle:
    """Stands between a virtual digitizer and a host; see tactile_cdma.sim.pty.Digitizer.

    Bytes pass only while there is a schedule, and after the host's first command.

    ledger: what was sent and what arrived. starts: every START.
    """

    def __init__(
        self,
        digitizer: VirtualDigitizer,
        begin: Counted | None = None,
        spoil: Callable[[bytes], bytes] | None = None,
    ) -> None:
        """begin: state of the digitizer's counters. spoil: changes the host's first commands."""
        self.ledger = Ledger()
        self.starts: list[Started] = []
        self._spoil = spoil
        self._virtual, self._begin = digitizer, begin or Counted()
        self._digitizer: Digitizer = Renumbered(digitizer, begin) if begin else digitizer
        self._spoken_to = False
        self._schedule: Schedule | None = None
        self._parser = PacketParser()  # of what the digitizer says, unharmed
        self._partial = b""
        self._exposed: list[bytes] = []
        self._peace_until: int | None = None
        self._leaving: deque[tuple[bytes, float]] = deque()  # clumps, and the pause after each
        self._free_s = 0.0

    @property
    def frame_samples(self) -> float:
        """Samples, or chips if integrated, of a frame period."""
        setup = self._virtual.setup
        if setup.integrated:
            return setup.spec.chips
        return setup.rate_hz * setup.spec.frame_period_s

    def begin(self, schedule: Schedule) -> None:
        """Carry bytes, and damage them by this schedule, until it is over."""
        self._peace_until = None
        self._schedule = schedule

    def over(self) -> bool:
        """Whether the last schedule is over and everything was handed on."""
        return self._schedule is None and not self._leaving

    def receive(self, data: bytes) -> None:
        """Take bytes of the host."""
        self._spoken_to = True
        if self._spoil is not None:
            data, self._spoil = self._spoil(data), None
        self._digitizer.receive(data)

    def advance(self, wanted: int) -> float:
        """Do what is due by now; return the seconds until something else is due."""
        if not self._spoken_to:
            return POLL_S
        while self._schedule is not None and sum(len(data) for data, _ in self._leaving) < wanted:
            self._digitizer.advance(CHUNK)
            if not (data := self._digitizer.take(CHUNK)):
                break
            *runs, self._partial = (self._partial + data).split(b"\0")
            for number, run in enumerate(runs):
                self._pass(run + b"\0")
                if self._schedule is None:  # the rest waits for the next one
                    self._partial = b"\0".join((*runs[number + 1 :], self._partial))
                    break
        return max(self._free_s - time.monotonic(), POLL_S)

    def take(self, size: int) -> bytes:
        """Give away at most `size` bytes for the host."""
        data, hold_s = b"", 0.0
        while (
            self._leaving and not hold_s and time.monotonic() >= self._free_s and len(data) < size
        ):
            clump, hold_s = self._leaving.popleft()
            room = size - len(data)
            data += clump[:room]
            if clump[room:]:
                self._leaving.appendleft((clump[room:], hold_s))
                hold_s = 0.0
        if hold_s:
            self._free_s = time.monotonic() + hold_s
        self.ledger.arrived(data)
        return data

    def _pass(self, packet: bytes) -> None:
        """Hand a packet on, or keep it to be damaged."""
        schedule = self._schedule
        assert schedule is not None
        self._note(packet)
        if self._peace_until is None:
            marked = self._virtual.setup.sync != SyncMode.NONE
            frames = schedule.rng.uniform(*(PEACE if marked else PEACE_WITHOUT_MARKS))
            self._peace_until = self.ledger.sent_until + round(frames * self.frame_samples)
        kind = schedule.kind
        if self.ledger.sent_until < self._peace_until or schedule.tried == schedule.times:
            self._leaving.append((packet, 0.0))
            if self.ledger.sent_until >= self._peace_until:
                self._schedule = None
            return
        self._exposed.append(packet)
        if len(self._exposed) >= kind.packets and sum(map(len, self._exposed)) >= kind.size:
            self._harm(schedule)
            self._peace_until = None

    def _harm(self, schedule: Schedule) -> None:
        """Damage the packets that were kept."""
        kind, window, self._exposed = schedule.kind, self._exposed, []
        clumps = kind.damage(window, self.ledger.past, schedule.rng)
        harmed = kind.hold_s > 0 or b"".join(clumps) != b"".join(window)
        if kind.forges and harmed:
            self.ledger.forged(window[0], clumps[0])
        schedule.tried += 1
        schedule.done += harmed
        schedule.bytes += sum(map(len, window))
        self._leaving += ((clump, kind.hold_s) for clump in clumps)

    def _note(self, packet: bytes) -> None:
        """Enter a packet of the digitizer in the ledger."""
        for said in self._parser.feed(packet):
            if isinstance(said, Ack) and (said.command, said.result) == _STARTED:
                started_s = self._virtual.started_s + self._begin.device_time_us * 1e-6
                virtual = self._virtual
                self.starts.append(Started(started_s, virtual.setup, virtual.turns))
                self.ledger.sent_until, self._peace_until = self._begin.first_index, None
            self.ledger.sent(packet, said, len(self.starts) - 1)


_STARTED = (PacketType.START, Result.OK)
