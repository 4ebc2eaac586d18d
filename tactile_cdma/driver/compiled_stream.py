# SPDX-License-Identifier: Apache-2.0

"""A stream in the compiled kernel (kernel/frame_stream.h): one call per frame.

The kernel decides the frames that leave nothing to decide. Of others it says why they are in doubt,
and goes on with the verdict that is reached here, by the same recognisers as with numpy.
"""

import logging
import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from ..base import kernel
from ..code.separate import NodeLevels, frame_fields, may_be_offset
from ..code.transform import compiled_transform
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
from ..wire.packets import PacketParser
from ..wire.reader import NO_FILE
from .description import Description
from .stream import Decisions, Event
from .timeline import CLOCK_SLACK_S, CLOCK_TOLERANCE, MAX_DEVICE_TIME_US, Answer, Placement, Step

_log = logging.getLogger(__name__)


_NEEDS_BYTES, _FULL, _HEARD, _SILENT, _PACKET, _FOREIGN, _DOUBT, _BLOCK = range(8)
"""Kinds of the kernel's events: enum stream_event in kernel/frame_stream.h."""
_DECIDED = _HEARD, _SILENT
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
_NO_TIMING = DOUBTS.index("no timing yet")
REFINED = "timing refined"
"""Instead, where an earlier frame's timing was used as often as it may be."""
GAP_TIMING = "gap timing"

_SHARED_LIMITS = (
    "deafened", "carried_noise", "carried_misfit", "loud", "spread", "misfit", "left",
    "clear_spread", "chips", "few", "whole", "hiding", "kept", "rest", "at_rest",
    "tail_noise", "tail_scatter", "tail_level", "least_tail", "rise",
)  # fmt: skip
"""Of `Limits`, and members of the kernel's rules by the same names."""
_NO_EDGES = (np.empty(0, np.int32), np.empty(0), np.empty(0), np.empty(0, np.int32))


class CompiledStream:
    """A Stream in the kernel."""

    def __init__(self, parser: PacketParser, decisions: Decisions) -> None:
        assert kernel.compiled is not None
        self.parser, self.decisions = parser, decisions
        self._kernel = kernel.compiled.Stream(parser.scanner)
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
        self._timing = kernel.settings(
            "stream_timing", due=1, over=0, uses=0, has_frame=False,
            chip=0, until=0, heard=0, tail=0, tail_end=0,
        )  # fmt: skip

    def describe(self, description: Description, frames: bool) -> None:
        spec, timing = description.spec, description.timing
        self._description, self._fit = description, None
        self._rows = np.zeros((spec.line_bits, spec.row_count), np.float32)
        self._values = self._rows[:, spec.node_slice]
        self._line = timing.line if isinstance(timing, MarkedTiming) else None
        self._chip_noise = math.sqrt(spec.order)
        self._sparse = timing if isinstance(timing, SparseTiming) else None
        transform = compiled_transform(spec.book.plan, spreading=False)
        flips = None if spec.sparse else spec.flips
        flips = np.empty(0, np.float32) if flips is None else np.ascontiguousarray(flips)
        self._kernel.describe(_rules(description, frames), transform, flips, self._rows)
        if self._sparse is not None:
            self._spoke = np.empty(spec.nodes, np.int32)
            self._kernel.detect_by(self._sparse.detector.kernel, self._spoke)
        if isinstance(timing, MarkedTiming):
            self._carry(timing)

    def forget(self) -> None:
        self._description = None
        self._kernel.forget()

    def give(self, data: bytes, t_host: float, backlog: bool) -> None:
        """Raises RuntimeError while other bytes are not used up."""
        self._kernel.give(data, t_host, backlog)

    def next(self, file: int = NO_FILE, timeout_ms: int = 0) -> Event:
        """Raises RuntimeError while another thread is here."""
        if self._frames:
            return Event([], self._frames.popleft(), None, False, *self._read)
        kind, about, passed, t_host, backlog = self._kernel.next(file, timeout_ms)
        if kind in _DECIDED:
            return Event(passed, self._found(kind, *about), None, False, t_host, backlog)
        self._read = t_host, backlog
        frame: FrameLevels | None = None
        packet: Received | None = None
        if kind == _PACKET:
            packet = self.parser.interpret(*about)
        elif kind == _FOREIGN:
            packet = self._ask(self.parser.interpret(*about))
        elif kind == _DOUBT:
            frame = self._decide(*about)
        elif kind == _BLOCK:
            self._feed(*about)
            frame = self._frames.popleft() if self._frames else None
        elif kind == _NEEDS_BYTES and self._ending:
            self._conclude()
        needs_bytes = kind == _NEEDS_BYTES and not self._frames
        return Event(passed, frame, packet, needs_bytes, *self._read)

    def place(self, placement: Placement) -> None:
        asked, description = self._asked, self._description
        sums = (asked.mean, asked.variance) if isinstance(asked, Quiet) else (0.0, 0.0)
        anew = placement.step is not Step.CONTINUES
        cut_short = self._kernel.place(placement.answer, placement.origin, anew, *sums)
        if description is None:
            return
        if cut_short:
            description.timing.rejections += INCOMPLETE
        if anew and isinstance(description.timing, GapTiming):
            description.timing.reset()

    def end(self) -> None:
        self._kernel.end()
        self._ending = True

    def _found(
        self,
        kind: int,
        start: int,
        noise_v: float,
        level_v: float,
        clipped: float,
        known: bool,
        speakers: int,
        turn: int,
    ) -> FrameLevels:
        """A frame that the kernel has decided."""
        line = self._line
        assert line is not None, "only marked frames are found in the kernel"
        line.level_known = known
        self.decisions.compiled += 1
        if self._reason:
            _log.debug("frames are decided in the kernel from sample %d on", start)
            self._reason = ""
        if self._sparse is not None:
            self._sparse.load = self._sparse.load.after(speakers)
        fit, levels = line.nominal, None
        if kind == _HEARD:
            levels = self._levels(noise_v, known, speakers)
            fit = self._fit or fit
            noise_v *= self._chip_noise
        begin = float(start) if line.integrated else start + fit.start
        return FrameLevels(begin, fit.chip, levels, noise_v, level_v, clipped, turn=turn)

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

    def _decide(
        self,
        look: int,
        start: int,
        volts: bytes,
        final: bool,
        opened: int,
        carried: int,
        ended: int,
        summed_up: bool,
        sums: tuple[float, float],
        rest: tuple[float, float, bool],
        turn: int,
    ) -> FrameLevels | None:
        """Answer whether samples are a frame, which it returns."""
        timing = self._marked
        line = timing.line
        line.level_v, line.noise, line.level_known = rest
        if summed_up:
            verdict = timing.summed_up(start, *sums)
        else:
            samples = np.frombuffer(volts, np.float32).astype(np.float64)
            frame = MarkedFrame(start, samples, final, opened, carried, ended)
            verdict = timing.recognise(frame)
        reason = REFINED if look == _NO_TIMING and self._fit is not None else DOUBTS[look]
        due, over = (-1 if at is None else at for at in (verdict.due, verdict.over))
        self._kernel.decide(due, over, line.level_v, line.noise)
        self._carry(timing)
        if verdict.due is None:
            self.decisions.in_python[reason] += 1
            if reason not in (REFINED, self._reason):
                _log.debug("frames are decided in Python from sample %d on: %s", start, reason)
                self._reason = reason
        return verdict.frame.in_turn(turn) if verdict.frame else None

    def _feed(self, start: int, volts: memoryview) -> None:
        """Find frames in samples that are not marked. volts: valid until the kernel is answered."""
        assert self._description is not None and isinstance(self._description.timing, GapTiming)
        timing = self._description.timing
        samples = np.frombuffer(volts, np.float32)
        self._add(timing.feed(SampleBlock(start, samples, checked=True)))
        self._kernel.look(timing.due)

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
        carried, setting, edges = timing.recogniser.carried, self._timing, _NO_EDGES
        fit = carried.edges.fit if carried.edges else None
        setting["has_frame"] = fit is not None
        setting["due"], setting["uses"] = carried.due, carried.uses
        if carried.edges:
            edges, fit = carried.edges.within(carried.due), carried.edges.fit
            if fit is not self._fit:
                spec = timing.line.spec
                end = fit.end(spec)
                setting["over"], setting["chip"] = timing.line.over(fit), fit.chip
                setting["until"], setting["heard"] = end + TAIL_CHIPS * fit.chip, round(end + 0.5)
                setting["tail"], setting["tail_end"] = tail_of(fit, spec)
        self._fit = fit
        self._kernel.carry(setting, *edges)


def _rules(description: Description, frames: bool) -> NDArray[np.void]:
    """The kernel's struct stream_rules for a digitizer."""
    info, pace, timing = description.info, description.pace, description.timing
    spec = description.spec
    # Where frames are not marked, any line will do.
    marked = isinstance(timing, MarkedTiming)
    line = timing.line if isinstance(timing, MarkedTiming) else MarkedLine(spec, 2 / spec.chip_s)
    swing_v, spare = spec.node_swing_v, spec.spare_rows
    rail_low, rail_high = within_rails(line.rails_v)
    return kernel.settings(
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
