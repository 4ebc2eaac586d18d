# SPDX-License-Identifier: Apache-2.0

"""The digitizer's bytes → frames, in the compiled kernel (kernel/frame_stream.h).

A stream is given bytes, and goes from event to event: a frame, a packet that has nothing to do with
frames, or a packet of samples that does not continue the stream, about which it asks. Whoever
decides that answers by `place`, and the stream goes on where it was. There is one stream per
connection, whether the digitizer is known yet or not, and one way for bytes of a live port, a
recording or a test.

The kernel decides the frames that leave nothing to decide, each in one call. Of others it says why
they are in doubt, and goes on with the verdict that the recognisers reach here.
"""

import logging
import math
from collections import deque
from typing import Any

import numpy as np

from ..base import kernel
from ..base.arrays import Floats32
from ..code.separate import NodeLevels, frame_fields, may_be_offset
from ..code.transform import Transform
from ..framing.fit import Fit, least_power
from ..framing.frame_end import tail_of
from ..framing.gaps.gap_timing import GapTiming
from ..framing.limits import LIMITS
from ..framing.marked_timing import GAP_WEIGHT, LEAST_REST, MarkedFrame, MarkedLine, MarkedTiming
from ..framing.sparse_timing import SparseTiming
from ..framing.timing import (
    ABSURD_V,
    INCOMPLETE,
    FrameLevels,
    SampleBlock,
    blinding_noise_v,
    within_rails,
)
from ..wire._protocol import TAIL_CHIPS
from ..wire.messages import Quiet, Received, Samples
from ..wire.packets import PacketParser, content_of
from ..wire.reader import NO_FILE, failure_of
from .description import Description
from .stream import Decisions, Event
from .timeline import CLOCK_SLACK_S, CLOCK_TOLERANCE, MAX_DEVICE_TIME_US, Answer, Placement, Step

_log = logging.getLogger(__name__)


DOUBTS = (
    "",
    "",
    "its end is not seen",
    "cut short",
    "absurd samples",
    "clipped",
    "noisy silence",
    "rest unknown yet",
    "no timing yet",
    "unexplained",
    "line not at rest",
)
"""Why a frame is decided in Python: enum frame_look in kernel/marked_frame.h."""
REFINED = "timing refined"
"""Instead, where an earlier frame's timing was used as often as it may be."""
GAP_TIMING = "gap timing"

_SHARED_LIMITS = (
    "deafened", "carried_noise", "carried_misfit", "loud", "spread", "misfit", "left",
    "clear_spread", "chips", "few", "whole", "hiding", "kept", "rest", "at_rest",
    "tail_noise", "tail_scatter", "tail_level", "least_tail", "rise",
)  # fmt: skip
"""Of `Limits`, and members of the kernel's rules by the same names."""
_ANOTHER_THREAD = "another thread follows this stream"


class CompiledStream:
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
        self._found, self._rest = ffi.addressof(self._about[0], "found"), self._about.rest
        self._reader = ffi.new("struct reader *", {"stream": self._stream, "scanner": scanner.at})
        self._cut_short = ffi.new("bool *")
        self._passed = ffi.new("const struct stream_passed **")
        library.stream_passed(self._stream, self._passed)
        self._packets = [self._passed[0][i] for i in range(library.STREAM_MOST_PASSED)]
        self._used: dict[str, object] = {}  # what the kernel's stream points to
        self._description: Description | None = None
        self._frames: deque[FrameLevels] = deque()  # decided, but not told yet
        self._asked: Samples | Quiet | None = None
        self._ending = False
        self._reason = ""  # why the last frame was decided in Python, if it was
        self._read = 0.0, False  # t_host and backlog of the last event
        self._rows = self._values = np.empty((0, 0), np.float32)  # of the last frame; the nodes'
        self._line: MarkedLine | None = None  # where frames are marked
        self._sparse: SparseTiming | None = None  # where codes are sparse
        self._spoke = np.empty(0, np.int32)  # who did in the last frame, of these
        self._chip_noise = 1.0  # noise of a chip, in that of a correlation
        self._fit: Fit | None = None
        self._timing = kernel.ffi.new("struct stream_timing *", {"due": 1})
        self._edges = kernel.ffi.new("struct frame_edges *")

    def describe(self, description: Description, frames: bool) -> None:
        """Take the packets from here on for those of such a digitizer; frames: see Pipeline."""
        spec, timing, pointer = description.spec, description.timing, kernel.pointer
        self._description, self._fit = description, None
        shape = spec.line_bits, spec.row_count
        self._rows = np.zeros(shape, np.float32)
        self._values = self._rows[:, spec.node_slice]
        self._line = timing.line if isinstance(timing, MarkedTiming) else None
        self._chip_noise = math.sqrt(spec.order)
        self._sparse = timing if isinstance(timing, SparseTiming) else None
        transform, flips = Transform(spec.book.plan, spreading=False), kernel.ffi.NULL
        if spec.flips is not None and not spec.sparse:
            flips = pointer(np.ascontiguousarray(spec.flips, np.float32), *shape)
        code = {"transform": transform.at, "flips": flips}
        rules, rows = _rules(description, frames), pointer(self._rows, *shape)
        self._answer("stream_describe", rules.at, kernel.ffi.new("struct frame_code *", code), rows)
        self._used |= {"transform": transform, "flips": flips, "rows": rows}
        if self._sparse is not None:
            self._spoke = np.empty(spec.nodes, np.int32)
            sparse, spoke = self._sparse.detector.kernel, pointer(self._spoke, spec.nodes)
            self._answer("stream_detect_by", sparse.at, spoke)
            self._used |= {"sparse": sparse, "spoke": spoke}
        if isinstance(timing, MarkedTiming):
            self._carry(timing)

    def forget(self) -> None:
        """Forget the digitizer: nothing is known of it any more."""
        self._description, null = None, kernel.ffi.NULL
        self._answer("stream_describe", null, null, null)

    def give(self, data: bytes, t_host: float, backlog: bool) -> None:
        """Take bytes that were read elsewhere; see Event.

        Raises RuntimeError while other bytes are not used up.
        """
        self._expect_idle()
        given = kernel.ffi.from_buffer("uint8_t[]", data)
        if not kernel.lib.reader_give(self._reader, given, len(data), t_host, backlog):
            raise RuntimeError("other bytes are not used up")
        self._used["bytes"] = given

    def next(self, file: int = NO_FILE, timeout_ms: int = 0) -> Event:
        """Go on to the next event, with the bytes at hand and then those read from a file.

        May run in a thread while others ask for counts, and nothing else. Raises OSError where
        nothing can be read, and RuntimeError while another thread is here.
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
        frame: FrameLevels | None = None
        packet: Received | None = None
        t_host, backlog = reader.t_host, reader.backlog
        if kind in (library.STREAM_HEARD, library.STREAM_SILENT):
            frame = self._decided(kind == library.STREAM_HEARD)
            return Event(passed, frame, None, False, t_host, backlog)
        self._read = t_host, backlog
        needs_bytes = kind == library.STREAM_NEEDS_BYTES
        if needs_bytes and self._ending:
            self._conclude()
            needs_bytes = not self._frames
        elif kind == library.STREAM_PACKET:
            packet = self.parser.interpret(*content_of(self._packet))
        elif kind == library.STREAM_FOREIGN:
            packet = self._ask(self.parser.interpret(*content_of(self._packet)))
        elif kind == library.STREAM_DOUBT:
            frame = self._decide()
        elif kind == library.STREAM_BLOCK:
            self._feed()
            frame = self._frames.popleft() if self._frames else None
        return Event(passed, frame, packet, needs_bytes, t_host, backlog)

    def place(self, placement: Placement) -> None:
        """Answer where the packet of samples of the last event belongs."""
        asked, description = self._asked, self._description
        sums = (asked.mean, asked.variance) if isinstance(asked, Quiet) else (0.0, 0.0)
        anew = placement.step is not Step.CONTINUES
        self._answer(
            "stream_place", placement.answer, placement.origin, anew, *sums, self._cut_short
        )
        if description is None:
            return
        if self._cut_short[0]:
            description.timing.rejections += INCOMPLETE
        if anew and isinstance(description.timing, GapTiming):
            description.timing.reset()

    def end(self) -> None:
        """Decide the frame in progress by the samples so far: no more will follow."""
        self._expect_idle()
        kernel.lib.stream_conclude(self._stream)
        self._ending = True

    def _expect_idle(self) -> None:
        """Raises RuntimeError while a thread is in `next`."""
        if self._reader.busy:
            raise RuntimeError(_ANOTHER_THREAD)

    def _answer(self, function: str, *arguments: Any) -> None:
        """Call one of the kernel's functions that tell whether the stream could take it."""
        self._expect_idle()
        if not getattr(kernel.lib, function)(self._stream, *arguments):
            raise ValueError(f"{function}: not asked for, does not fit the frames, or no memory")

    def _decided(self, is_heard: bool) -> FrameLevels:
        """Return a frame that the kernel has decided."""
        line, found, about = self._line, self._found, self._about
        assert line is not None, "only marked frames are found in the kernel"
        known, start = self._rest.known, about.start
        line.level_known = known
        self.decisions.compiled += 1
        if self._reason:
            _log.debug("frames are decided in the kernel from sample %d on", start)
            self._reason = ""
        if self._sparse is not None:
            self._sparse.load = self._sparse.load.after(found.speakers)
        fit, levels, noise_v = line.nominal, None, found.noise
        if is_heard:
            levels = self._levels(noise_v, known, found.speakers)
            fit = self._fit or fit
            noise_v *= self._chip_noise
        begin = float(start) if line.integrated else start + fit.start
        of_line = found.level, found.clipped
        return FrameLevels(begin, fit.chip, levels, noise_v, *of_line, turn=about.turn)

    def _levels(self, noise_v: float, known: bool, speakers: int) -> NodeLevels:
        rows, line = self._rows, self._line
        assert line is not None, "only marked frames are found in the kernel"
        if self._sparse is not None:
            values = rows.ravel()[: len(rows) * speakers].reshape(len(rows), speakers)
            return NodeLevels(values, noise_v, spoke=self._spoke[:speakers])
        unknown = line.integrated and not known and may_be_offset(rows, line.spec)
        return NodeLevels(self._values, noise_v, rows=rows, level_unknown=unknown)

    def _ask(self, packet: Received | None) -> Samples | Quiet | None:
        """A packet of samples that is to be asked about; none if no samples can be those."""
        self._asked = packet if isinstance(packet, (Samples, Quiet)) else None
        if self._asked is None:
            self.place(Placement(Answer.IGNORE))
        return self._asked

    def _decide(self) -> FrameLevels | None:
        """Answer whether samples are a frame, which it returns."""
        timing, about = self._marked, self._about
        line, rest, start, turn = timing.line, self._rest, about.start, about.turn
        line.level_v, line.noise, line.level_known = rest.level, rest.noise, rest.known
        is_summed_up, look = about.summed_up, about.look
        if is_summed_up:
            verdict = timing.summed_up(start, about.mean, about.variance)
        else:
            samples = self._volts().astype(np.float64)
            seen = about.final, about.marks, about.uses, about.ended
            verdict = timing.recognise(MarkedFrame(start, samples, *seen))
        is_refined = look == kernel.lib.FRAME_NO_TIMING and self._fit is not None
        reason = REFINED if is_refined else DOUBTS[look]
        due, over = (-1 if at is None else at for at in (verdict.due, verdict.over))
        self._answer("stream_decide", due, over, line.level_v, line.noise)
        self._carry(timing)
        if verdict.due is None:
            self.decisions.in_python[reason] += 1
            if reason not in (REFINED, self._reason):
                _log.debug("frames are decided in Python from sample %d on: %s", start, reason)
                self._reason = reason
        return verdict.frame.in_turn(turn) if verdict.frame else None

    def _feed(self) -> None:
        """Find frames in samples that are not marked."""
        assert self._description is not None and isinstance(self._description.timing, GapTiming)
        timing = self._description.timing
        self._add(timing.feed(SampleBlock(self._about.start, self._volts(), checked=True)))
        self._answer("stream_look", timing.due)

    def _volts(self) -> Floats32:
        """Return the samples that the kernel hands on: they are lent until it is answered."""
        about = self._about
        return np.frombuffer(kernel.ffi.buffer(about.volts, 4 * about.count), np.float32)

    def _conclude(self) -> None:
        """All samples are used up, and no more will follow."""
        self._ending = False
        if self._description and isinstance(self._description.timing, GapTiming):
            self._add(self._description.timing.flush())

    def _add(self, frames: list[FrameLevels]) -> None:
        self._frames.extend(frames)
        self.decisions.in_python[GAP_TIMING] += len(frames)

    @property
    def _marked(self) -> MarkedTiming:
        assert self._description and isinstance(self._description.timing, MarkedTiming)
        return self._description.timing

    def _carry(self, timing: MarkedTiming) -> None:
        """Hand on how the next frames are read."""
        carried, setting, edges = timing.recogniser.carried, self._timing, self._edges
        fit = carried.edges.fit if carried.edges else None
        setting.has_frame = fit is not None
        setting.due, setting.uses = carried.due, carried.uses
        used = self._used.get("edges")
        if carried.edges and fit is not None:
            whole, share, number, places = carried.edges.within(carried.due)
            pointer, all_edges = kernel.pointer, edges.all
            all_edges.count = count = len(whole)
            used = all_edges.whole, all_edges.share, all_edges.number, edges.places = (
                pointer(whole, count),
                pointer(share, count),
                pointer(number, count - 1),
                pointer(places, timing.line.spec.chips),
            )
            if fit is not self._fit:
                spec, frame = timing.line.spec, setting.frame
                end = fit.end(spec)
                setting.over, frame.chip = timing.line.over(fit), fit.chip
                frame.until, frame.heard = end + TAIL_CHIPS * fit.chip, round(end + 0.5)
                frame.tail, frame.tail_end = tail_of(fit, spec)
        self._fit = fit
        self._answer("stream_carry", setting, edges)
        self._used["edges"] = used


def _rules(description: Description, frames: bool) -> kernel.Held:
    """The kernel's struct stream_rules for a digitizer."""
    info, pace, timing = description.info, description.pace, description.timing
    spec = description.spec
    # Where frames are not marked, any line will do.
    marked = isinstance(timing, MarkedTiming)
    line = timing.line if isinstance(timing, MarkedTiming) else MarkedLine(spec, 2 / spec.chip_s)
    swing_v, spare = spec.node_swing_v, spec.spare_rows
    rail_low, rail_high = within_rails(line.rails_v)
    return kernel.struct(
        "stream_rules",
        **frame_fields(spec),
        **{name: getattr(LIMITS, name) for name in _SHARED_LIMITS},
        spare=spare.start,
        spare_count=spare.stop - spare.start,
        size=line.size,
        whole_size=round(line.nominal.end(spec) + 0.5),
        chip=line.chip,
        least_power=line.least_power,
        silent_power=line.silent_power,
        noise_share=line.noise_share,
        most_silent_noise=line.most_noise,
        most_noise=blinding_noise_v(spec),
        rail_low=rail_low,
        rail_high=rail_high,
        integrated=line.integrated,
        mean_is_offset=line.mean_is_offset,
        scrambled=spec.scramble,
        silent_rise=LIMITS.rise if swing_v is None else 1.0,
        silent_more=0.0 if swing_v is None else swing_v**2 / 4,
        marked=marked and frames,
        in_blocks=not marked and frames,
        zero_count=info.zero_count,
        volts_per_count=info.volts_per_count,
        most_volts=ABSURD_V,
        gap_size=math.ceil(spec.order * line.chip),
        least_rest=LEAST_REST,
        gap_weight=GAP_WEIGHT,
        rise_v2=least_power(1e-3),
        silent_over=line.over(line.nominal),
        rate_hz=pace.rate_hz,
        slack_s=CLOCK_SLACK_S,
        slack=CLOCK_TOLERANCE,
        gap_s=pace.gap_s,
        gaps=pace.gaps,
        least_gap_s=pace.least_gap_s,
        most_device_us=MAX_DEVICE_TIME_US,
        most_quiet=pace.longest_quiet,
        most_quiet_v2=pace.most_quiet_v2,
    )
