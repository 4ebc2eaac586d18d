# SPDX-License-Identifier: Apache-2.0

"""The digitizer's bytes → frames, packet by packet (kernel/frame_stream.h): one call per frame.

A stream is given bytes, and goes from event to event: a frame, a packet that has nothing to do with
frames, or a packet of samples that does not continue the stream, about which it asks. Whoever
decides that answers by `place`, and the stream goes on where it was. There is one stream per
connection, whether the digitizer is known yet or not, and one way for bytes of a live port, a
recording or a test.
"""

import logging
import math
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import numpy as np

from ..base import kernel
from ..base.arrays import Floats32
from ..code.twins import MOST_LATE
from ..config.parameters import GAP
from ..config.skin_config import SkinConfig
from ..framing.frame_reader import FrameReader
from ..framing.frames import Clause, LineFrame, Rejections, line_frame, rejections_of, words_memory
from ..framing.gaps.gap_timing import SIDE_CHIPS, GapTiming
from ..framing.proposals import Proposer
from ..wire.messages import Info, Quiet, Received, Samples
from ..wire.packets import PacketParser, content_of
from ..wire.reader import NO_FILE, failure_of
from ..words.limits import GAP_WEIGHT, LEAST_REST, MOST_RISE
from .clock import PassedPacket
from .timeline import Answer, Pace, Placement, Step

_log = logging.getLogger(__name__)
_ANOTHER_THREAD = "another thread follows this stream"
ABSURD_V = 1e6
"""Level that no digitizer reports, V: such samples are treated like NaN."""
LEAST_RISE = 1e-3
"""Share of a quarter of a node's amplitude, RMS, that noise may have, however little it was."""
MOST_WAITS = 64
"""Frames that are read after a search in vain until the next one: half a second at 128 Hz."""
MOST_STRETCHED = 1.12
"""Nominal durations that a frame of the longest chips lasts: MAX_STRETCH and its error."""


class Description:
    """How samples are to be understood, for a digitizer that is set as its INFO says.

    reader: reads the frames. gaps: finds them where they are not marked, else None. proposer:
    searches for the timing of marked ones. pace: what the digitizer's packets may claim.
    """

    def __init__(self, info: Info, config: SkinConfig, swing_v: float | None) -> None:
        """Raise SpecError for a sampling that cannot be decoded.

        swing_v: amplitude of a node's row, V; None: unknown.
        """
        self.info, self.spec = info, config.spec
        spec, rate_hz = config.spec, info.sample_rate_hz
        low_v, high_v = info.volts(np.array([info.min_count, info.max_count], dtype=np.int16))
        rails_v = float(low_v), float(high_v)
        self.pace = Pace(info, spec)
        is_marked = config.timing != GAP
        side_chips = MOST_LATE if is_marked else SIDE_CHIPS
        self.reader = FrameReader(spec, rate_hz, rails_v, config.active_share, swing_v, side_chips)
        self.proposer = Proposer(self.reader)
        self.gaps = None if is_marked else GapTiming(self.reader, rate_hz)

    def rules(self, frames: bool) -> kernel.Held:
        """Return the kernel's struct stream_rules; frames: see Pipeline."""
        info, spec, chip = self.info, self.spec, self.reader.chip
        gap_size = math.ceil(spec.order * chip)
        pause_s = spec.frame_period_s - MOST_STRETCHED * spec.frame_s
        marked = frames and self.gaps is None
        return kernel.struct(
            "stream_rules",
            marked=marked,
            in_blocks=frames and not marked,
            zero_count=info.zero_count,
            volts_per_count=info.volts_per_count,
            most_volts=ABSURD_V,
            gap_size=gap_size,
            sure_gap=min(gap_size, max(0, int(pause_s / spec.chip_s * chip))),
            least_rest=LEAST_REST,
            gap_weight=GAP_WEIGHT,
            rise=MOST_RISE,
            rise_v2=(LEAST_RISE * 0.25 * (spec.node_swing_v or 0.0)) ** 2,
            most_waits=MOST_WAITS,
            **self.pace.limits,
        )


@dataclass(slots=True)
class Decisions:
    """How frames were read; every number only grows.

    frames: with words or without. searches: frames whose timing had to be searched for. doubts:
    frames in doubt, by the clause that is farthest beyond its limit.
    """

    frames: int = 0
    searches: int = 0
    doubts: Counter[Clause] = field(default_factory=Counter)

    @property
    def reasons(self) -> str:
        """Why frames were in doubt, and how many for that: the most frequent first."""
        return ", ".join(f"{clause.doubt}: {count}" for clause, count in self.doubts.most_common())

    def since(self, before: Self) -> Self:
        """Return those since a moment; `before` is what this method gave then for none before."""
        doubts = self.doubts.copy()  # whose clauses stay, while another thread adds some
        frames, searches = self.frames - before.frames, self.searches - before.searches
        return type(self)(frames, searches, doubts - before.doubts)

    def note(self, frame: LineFrame) -> None:
        self.frames += 1
        if frame.certificate is not None and not frame.certificate.holds:
            self.doubts[frame.certificate.weakest] += 1


class Event(NamedTuple):
    """What a stream has come to.

    passed: packets of samples that were accepted since the event before. frame: one that they
    completed. packet: one that is for others; one of samples has to be answered by `place`.
    needs_bytes: there is nothing else in the bytes so far.
    t_host, backlog: when the last bytes were read, s, host's monotonic clock; whether they waited.
    again, jumped: the packet came before; its number is not that of the stream before it.
    """

    passed: list[PassedPacket]
    frame: LineFrame | None
    packet: Received | None
    needs_bytes: bool
    t_host: float
    backlog: bool
    again: bool = False
    jumped: bool = False


class Stream:
    """Goes through a digitizer's bytes from event to event.

    parser: counts its packets. decisions: see there.
    """

    def __init__(self, parser: PacketParser, decisions: Decisions) -> None:
        self.parser, self.decisions = parser, decisions
        library, scanner = kernel.lib, parser.scanner
        self._held = kernel.Held(library.stream_new(scanner.at), library.stream_free)
        self._stream, ffi = self._held.at, kernel.ffi
        self._about = library.stream_subject(self._stream)
        self._packet = ffi.addressof(self._about[0], "packet")
        self._found = ffi.addressof(self._about[0], "found")
        self._reader = ffi.new("struct reader *", {"stream": self._stream, "scanner": scanner.at})
        self._passed = ffi.new("const struct stream_passed **")
        library.stream_passed(self._stream, self._passed)
        self._packets = [self._passed[0][i] for i in range(library.STREAM_MOST_PASSED)]
        self._memory = np.zeros(0, np.uint8)  # where the kernel writes a frame's words
        self._used: tuple[object, ...] = ()  # what the kernel's stream points to
        self._bytes: object = None
        self._description: Description | None = None
        self._frames: deque[LineFrame] = deque()  # found in samples that are not marked
        self._searched = 0  # frames when one was last searched for
        self._asked: Samples | Quiet | None = None
        self._ending = False
        self._read = 0.0, False  # t_host and backlog of the last event

    @property
    def rejections(self) -> Rejections:
        """Frames that were rejected since the digitizer was described."""
        description = self._description
        if description is not None and description.gaps is not None:
            return description.gaps.rejections
        return rejections_of(self._about.rejected)

    @property
    def level_v(self) -> float:
        """Return the line at rest, V, as gaps last showed it."""
        return float(self._about.rest.level)

    def describe(self, description: Description, frames: bool) -> None:
        """Take the packets from here on for those of such a digitizer; frames: see Pipeline."""
        self._description, reader = description, description.reader
        self._memory = words_memory(description.spec.nodes)
        where = kernel.pointer(self._memory, self._memory.size, written=True)
        rules = description.rules(frames)
        marked = reader.at if frames and description.gaps is None else kernel.ffi.NULL
        self._answer("stream_describe", rules.at, marked, where)
        self._used = reader, where

    def forget(self) -> None:
        self._description, null = None, kernel.ffi.NULL
        self._answer("stream_describe", null, null, null)

    def give(self, data: bytes, t_host: float, backlog: bool) -> None:
        """Go on with bytes that were read elsewhere, when those before are used up; see Event.

        Raises RuntimeError while other bytes are not used up.
        """
        self._expect_idle()
        given = kernel.ffi.from_buffer("uint8_t[]", data)
        if not kernel.lib.reader_give(self._reader, given, len(data), t_host, backlog):
            raise RuntimeError("other bytes are not used up")
        self._bytes = given

    def next(self, file: int = NO_FILE, timeout_ms: int = 0) -> Event:
        """Go on to the next event, with the bytes at hand and then those read from a file.

        May run in a thread while others ask for counts, and nothing else. Raises RuntimeError while
        another thread is here, OSError where nothing can be read.
        """
        if self._frames:
            return Event([], self._frames.popleft(), None, False, *self._read)
        library, reader = kernel.lib, self._reader
        kind = library.reader_follow(reader, file, timeout_ms)
        if kind < 0:
            raise RuntimeError(_ANOTHER_THREAD)
        if reader.failure:
            raise failure_of(reader)
        passed = [
            (one.index, one.device_time_us, one.count, one.sequence, one.t_host, one.backlog)
            for one in self._packets[: library.stream_passed(self._stream, self._passed)]
        ]
        self._read = read = reader.t_host, reader.backlog
        if kind == library.STREAM_FRAME:
            return Event(passed, self._frame(), None, False, *read)
        packet = self._answered(kind)
        if self._frames:
            return Event(passed, self._frames.popleft(), packet, False, *read)
        if kind in (library.STREAM_PACKET, library.STREAM_FOREIGN):
            order = self._packet.again, self._packet.jumped
            return Event(passed, None, packet, False, *read, *order)
        return Event(passed, None, None, kind == library.STREAM_NEEDS_BYTES, *read)

    def _answered(self, kind: int) -> Received | None:
        """Answer what the kernel asks; returns a packet that is for others."""
        library = kernel.lib
        if kind == library.STREAM_PACKET:
            return self.parser.interpret(*content_of(self._packet))
        if kind == library.STREAM_FOREIGN:
            packet = self.parser.interpret(*content_of(self._packet))
            self._asked = packet if isinstance(packet, (Samples, Quiet)) else None
            if self._asked is None:  # no samples can be those
                self.place(Placement(Answer.IGNORE))
            return self._asked
        if kind == library.STREAM_SEARCH:
            self._search()
        elif kind == library.STREAM_BLOCK:
            self._feed()
        elif kind == library.STREAM_NEEDS_BYTES and self._ending:  # all samples are used up
            self._ending = False
            if self._description is not None and self._description.gaps is not None:
                self._add(self._description.gaps.flush())
        return None

    def place(self, placement: Placement) -> None:
        """Answer where the packet of samples of the last event belongs."""
        asked, description = self._asked, self._description
        sums = (asked.mean, asked.variance) if isinstance(asked, Quiet) else (0.0, 0.0)
        anew = placement.step is not Step.CONTINUES
        self._answer("stream_place", placement.answer, placement.origin, anew, *sums)
        if anew and description is not None and description.gaps is not None:
            description.gaps.reset()

    def end(self) -> None:
        """Expect no more samples: the frame in progress is read from those that there are."""
        self._expect_idle()
        kernel.lib.stream_conclude(self._stream)
        self._ending = True

    def _expect_idle(self) -> None:
        """Raise RuntimeError while a thread is in `next`."""
        if self._reader.busy:
            raise RuntimeError(_ANOTHER_THREAD)

    def _answer(self, function: str, *arguments: Any) -> None:
        """Call one of the kernel's functions that tell whether the stream could take it."""
        self._expect_idle()
        if not getattr(kernel.lib, function)(self._stream, *arguments):
            raise ValueError(f"{function}: not asked for, does not fit the frames, or no memory")

    def _frame(self) -> LineFrame:
        """Return a frame that the kernel has read; its arrays are its own."""
        about, description = self._about, self._description
        assert description is not None, "only a known digitizer's frames are read"
        memory = self._memory.copy() if about.has_words else self._memory
        place = about.start, description.spec.nodes, about.turn, about.asked
        frame = line_frame(self._found, about.has_words, memory, *place)
        self.decisions.note(frame)
        return frame

    def _search(self) -> None:
        """Propose a timing for a frame that none of the known ones explains."""
        assert self._description is not None
        rest, decisions = self._about.rest, self.decisions
        frames = decisions.frames - self._searched
        decisions.searches, self._searched = decisions.searches + 1, decisions.frames
        volts = self._volts() - np.float32(self._found.level)
        chip = self._description.proposer.propose(volts, rest.noise_v2, frames)
        _log.debug("chips of %s samples are tried at sample %d", chip, self._about.start)
        self._answer("stream_propose", -0.5, chip or 0.0)

    def _feed(self) -> None:
        """Find frames in samples that are not marked."""
        assert self._description is not None and self._description.gaps is not None
        gaps = self._description.gaps
        self._add(gaps.feed(self._about.start, self._volts()))
        self._answer("stream_gather", gaps.due)

    def _volts(self) -> Floats32:
        """Return the samples that the kernel hands on: they are lent until it is answered."""
        about = self._about
        return np.frombuffer(kernel.ffi.buffer(about.volts, 4 * about.count), np.float32)

    def _add(self, frames: list[LineFrame]) -> None:
        for frame in frames:
            self.decisions.note(frame)
        self._frames.extend(frames)
