# SPDX-License-Identifier: Apache-2.0

"""The digitizer's bytes → frames, packet by packet: what both kinds of stream share, and numpy's.

A stream is given bytes, and goes from event to event: a frame, a packet that has nothing to do with
frames, or a packet of samples that does not continue the stream, about which it asks. Whoever
decides that answers by `place`, and the stream goes on where it was. There is one stream per
connection, whether the digitizer is known yet or not, and one way for bytes of a live port, a
recording or a test.

`CompiledStream` does the same in the kernel and asks Python about frames in doubt only; the frames
are the same, to the bit, as the tests hold.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from ..framing.timing import FrameLevels, SampleBlock
from ..wire.messages import Quiet, Received, Samples
from ..wire.packets import PacketParser
from ..wire.reader import NO_FILE, read_file
from .clock import PassedPacket
from .description import Description
from .timeline import Answer, Arrival, Placement, Step, end_index, sample_count

NUMPY = "numpy"
"""Why frames are decided in Python where there is no kernel, or it is not to be used."""


@dataclass(slots=True)
class Decisions:
    """Where frames were decided, accepted or not; every number only grows.

    compiled: in the kernel. in_python: by the reason why not there. words_in_python: frames whose
    words were read there, wherever it was decided that they are frames.
    """

    compiled: int = 0
    in_python: Counter[str] = field(default_factory=Counter)
    words_in_python: int = 0

    @property
    def total(self) -> int:
        return self.compiled + self.in_python.total()

    @property
    def python_share(self) -> float:
        """Share of all that was decided in Python, 0…1."""
        return self.in_python.total() / max(1, self.total)

    @property
    def reasons(self) -> str:
        """Why frames were decided in Python, and how many for that: the most frequent first."""
        return ", ".join(f"{reason} {count}" for reason, count in self.in_python.most_common())

    def since(self, before: Decisions) -> Decisions:
        """Those since a moment; `before` is what this method gave then for none before."""
        in_python = self.in_python.copy()  # whose reasons stay, while another thread adds some
        return Decisions(
            self.compiled - before.compiled,
            in_python - before.in_python,
            self.words_in_python - before.words_in_python,
        )


class Event(NamedTuple):
    """What a stream has come to.

    passed: packets of samples that were accepted since the event before. frame: one that they
    completed. packet: one that is for others; one of samples has to be answered by `place`.
    needs_bytes: there is nothing else in the bytes so far.
    t_host, backlog: when the last bytes were read, s, host's monotonic clock; whether they waited.
    """

    passed: list[PassedPacket]
    frame: FrameLevels | None
    packet: Received | None
    needs_bytes: bool
    t_host: float
    backlog: bool


class Stream(Protocol):
    """Goes through a digitizer's bytes from event to event.

    parser: counts its packets. decisions: see there.
    """

    parser: PacketParser
    decisions: Decisions

    def describe(self, description: Description, frames: bool) -> None:
        """The packets from here on are of such a digitizer; frames: see Pipeline."""

    def forget(self) -> None:
        """Nothing is known any more of the digitizer."""

    def give(self, data: bytes, t_host: float, backlog: bool) -> None:
        """Bytes that were read elsewhere, when those before are used up; see Event."""

    def next(self, file: int = NO_FILE, timeout_ms: int = 0) -> Event:
        """Go on to the next event, with the bytes at hand and then those read from a file.

        May run in a thread while others ask for counts, and nothing else. Raises OSError where
        nothing can be read.
        """

    def place(self, placement: Placement) -> None:
        """Answer where the packet of samples of the last event belongs."""

    def end(self) -> None:
        """No more samples will follow those so far: decide the frame in progress by them."""


class NumpyStream:
    """A Stream in Python, with numpy: the reference, and what is left without the kernel."""

    def __init__(self, parser: PacketParser, decisions: Decisions) -> None:
        self.parser, self.decisions = parser, decisions
        self._description: Description | None = None
        self._frames_wanted = True
        self._packets: deque[Received] = deque()
        self._frames: deque[FrameLevels] = deque()
        self._read = 0.0, False  # t_host and backlog of the packets
        self._passed: list[PassedPacket] = []
        self._origin = 0  # the digitizer's index of index 0
        self._last: Samples | Quiet | None = None  # accepted
        self._held: Arrival | None = None

    def describe(self, description: Description, frames: bool) -> None:
        self._description, self._frames_wanted = description, frames

    def forget(self) -> None:
        self._description = None

    def give(self, data: bytes, t_host: float, backlog: bool) -> None:
        self._packets.extend(self.parser.feed(data))
        self._read = t_host, backlog

    def next(self, file: int = NO_FILE, timeout_ms: int = 0) -> Event:
        if file != NO_FILE and not self._packets and not self._frames:
            data, had_waited = read_file(file, timeout_ms)
            self.give(data, time.monotonic(), had_waited)
        while not self._frames:
            if not self._packets:
                return self._event(needs_bytes=True)
            packet = self._packets[0]
            if not isinstance(packet, (Samples, Quiet)):
                return self._event(packet=self._packets.popleft())
            if not self._continues(packet):
                return self._event(packet=packet)
            self._take(Arrival(packet, *self._read))
            self._packets.popleft()
        return self._event(frame=self._frames.popleft())

    def place(self, placement: Placement) -> None:
        packet = self._packets[0]
        assert isinstance(packet, (Samples, Quiet)), "a packet of samples was asked about"
        arrival, held = Arrival(packet, *self._read), self._held
        if placement.answer is not Answer.TAKE_HELD:
            self._packets.popleft()
        if placement.answer is Answer.IGNORE:
            return
        self._held = arrival if placement.answer is Answer.HOLD else None
        if placement.answer is Answer.HOLD:
            return
        if placement.answer is Answer.TAKE_HELD:
            assert held is not None, "it was held back"
            arrival = held
        self._origin = placement.origin
        if placement.step is not Step.CONTINUES and self._description is not None:
            self._description.timing.reset()
        self._take(arrival)

    def end(self) -> None:
        if self._description is not None and self._frames_wanted:
            self._add(self._description.timing.flush())

    def _event(
        self,
        frame: FrameLevels | None = None,
        packet: Received | None = None,
        needs_bytes: bool = False,
    ) -> Event:
        passed, self._passed = self._passed, []
        return Event(passed, frame, packet, needs_bytes, *self._read)

    def _continues(self, packet: Samples | Quiet) -> bool:
        """Whether a packet continues the stream, so that it need not be asked about."""
        if self._description is None or self._last is None or self._held is not None:
            return False
        pace = self._description.pace
        follows = packet.first_index == end_index(self._last) and pace.fits(self._last, packet)
        return follows and pace.is_plausible(packet)

    def _take(self, arrival: Arrival) -> None:
        """Accept a packet, and find the frames in it."""
        packet, description = arrival.packet, self._description
        assert description is not None, "packets of an unknown digitizer are not accepted"
        index, self._last = packet.first_index - self._origin, packet
        entry = (index, packet.device_time_us, sample_count(packet), packet.sequence)
        self._passed.append((*entry, arrival.t_host, arrival.backlog))
        if self._frames_wanted:
            block, timing = description.block(index, packet), description.timing
            self._add(timing.feed(block) if isinstance(block, SampleBlock) else timing.quiet(block))

    def _add(self, frames: list[FrameLevels]) -> None:
        self._frames.extend(frames)
        self.decisions.in_python[NUMPY] += len(frames)
