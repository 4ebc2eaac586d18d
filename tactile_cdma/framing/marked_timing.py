# SPDX-License-Identifier: Apache-2.0

"""Cuts the stream at the digitizer's marks, and learns the line at rest from the gaps.

What a marked frame says is left to a Recogniser, as in `line_timing` and `sparse_timing`.
"""

import math
from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from ..base.arrays import Bools, Floats, Floats32
from ..base.errors import SpecError
from ..base.sums import sums
from ..code.amplitude import LEAST_SHARE, MOVED_SHARE, SILENT_RHO, rises
from ..code.frame import BIPOLAR, UNIPOLAR, FrameSpec
from ..code.separate import NodeLevels
from .fit import ChipEdges, Fit, least_power
from .limits import LIMITS
from .timing import (
    ABSURD,
    AT_RAIL,
    INCOMPLETE,
    NOISY,
    FrameLevels,
    QuietBlock,
    Rails,
    Rejections,
    SampleBlock,
    Timing,
    share_clipped,
    silence_hidden,
)

LEAST_REST = 16
"""Gap samples that an estimate of level and noise takes, collected over several short gaps. Chosen:
the variance of 16 samples is right to a third (√(2/15))."""
GAP_WEIGHT = 0.25
"""Weight of the newest gap in the running noise estimate. Chosen: averages about seven gaps."""
EDGES = [0, 1, -2, -1]
"""Chips of a bit in which half a node's chips may meet those of another bit, of up to 1.5 chips."""

_NOTHING = (0.0, 0.0, 0.0)


class MarkedFrame(NamedTuple):
    """The samples of a marked frame.

    start: stream index of the mark. volts: (m,) float64, V, from the mark on, as received.
    final: no more samples will follow.
    opened: how many frames were marked since the recogniser was last asked, this one included.
    carried, ended: how many were decided by the carried timing since, and seen to end in silence.
    """

    start: int
    volts: Floats
    final: bool
    opened: int = 1
    carried: int = 0
    ended: int = 0


class Verdict(NamedTuple):
    """A recogniser's decision.

    frame: the decoded frame; None where it is rejected or not decided yet.
    rejected: why it is no frame; None for a frame, and while undecided.
    over: stream index from which on the line is at rest again; None if unknown.
    due: stream index up to which samples are needed to decide; None once decided.
    """

    frame: FrameLevels | None = None
    over: int | None = None
    due: int | None = None
    rejected: Rejections | None = None


class CarriedTiming(NamedTuple):
    """The timing that the next frames are tried with.

    due: samples from the mark on until a frame can be decided. edges: of an earlier frame's chips;
    None where there is none. uses: frames that may be read by it.
    """

    due: int
    edges: ChipEdges | None = None
    uses: int = 0


class MarkedLine:
    """How the line is sampled, and its level and noise at rest: shared by stream and recogniser.

    chip: nominal chip duration, samples. integrated: one sample is the mean of one chip, and gaps
    and guards have no samples. nominal: timing of an unstretched frame, relative to its mark.
    size: samples of an unstretched frame.
    least_power: below which there is no node, V². silent_power: below which no row holds what would
    be asked about, V². Both are 0 where the amplitude is unknown.
    noise_share: share of the noise that, with silent_power, no frame exceeds in which none speaks.
    most_noise: of that no more, V²: noise may end as a node begins.
    level_v: of the line at rest, V; the last frame's mean until a gap has shown it (level_known).
    noise: variance of a chip's level in the gap, V²; 0 where unknown.
    """

    def __init__(self, spec: FrameSpec, rate_hz: float, rails_v: Rails = None) -> None:
        """Raises SpecError at a rate that line timing cannot use. rails_v: see share_clipped."""
        self.spec, self.rails_v = spec, rails_v
        self.chip = rate_hz * spec.chip_s
        self.integrated = abs(self.chip - 1) < 0.01
        if not (self.integrated or self.chip >= 1.9):
            raise SpecError(
                f"{self.chip:.2g} samples per chip: line timing takes one integrated value per "
                f"chip ({1 / spec.chip_s:.6g} Hz) or at least two samples"
            )
        self.nominal = Fit(-0.5, self.chip)  # sample i stands for i − ½ … i + ½
        length = spec.chips if self.integrated else spec.span_chips
        self.size = math.ceil(length * self.chip - 0.5)
        self.least_power = least_power(spec.node_swing_v)
        self.silent_power = (LEAST_SHARE * (spec.node_swing_v or 0.0)) ** 2
        self.noise_share = self.most_noise = 0.0
        # All rows but the first have as many +1 as −1: without it a frame's mean is the offset. So
        # it is, nearly, where rows are scrambled: off by √(n/kN)·A, of which a row shows a √N-th.
        self.mean_is_offset = (spec.first_row > 0 or spec.scramble) and spec.drive == BIPOLAR
        self.level_v = self.noise = 0.0
        self.level_known = False
        self.gap = _NOTHING  # samples not evaluated yet: count, sum, sum of squares

    @property
    def sample_noise_v(self) -> float:
        """Noise of one sample, V RMS; 0 where unknown."""
        return math.sqrt(self.noise * self.chip)

    def add_gap(self, volts: Floats) -> None:
        """Learn level and noise from samples of a gap, which may be none."""
        if not volts.size:
            return
        total, squares = sums(volts)
        if math.isnan(total):
            return
        gap = self.gap
        self.gap = gap = (gap[0] + volts.size, gap[1] + total, gap[2] + squares)
        if gap[0] >= LEAST_REST:
            count, total, squares = gap
            mean = total / count
            self.at_rest(mean, max(0.0, squares - count * mean**2) / (count - 1))
            self.gap = _NOTHING

    def at_rest(self, mean_v: float, variance_v2: float) -> None:
        """Learn level and noise from mean and variance of the samples of a gap."""
        newest = variance_v2 / self.chip
        if self.level_known:
            newest = min(newest, LIMITS.rise * self.noise + least_power(1e-3))
        self.noise += (GAP_WEIGHT if self.level_known else 1.0) * (newest - self.noise)
        self.level_v, self.level_known = mean_v, True

    def gate(self, frame: MarkedFrame) -> Verdict | None:
        """Decide a frame that is cut short, has absurd samples or too little power for any node."""
        if frame.volts.size < self.size:
            return Verdict(rejected=INCOMPLETE)
        volts = frame.volts[: self.size]
        if self.mean_is_offset and not self.level_known:
            self.level_v = sums(volts)[0] / volts.size
        power = self.sample_power(volts)
        if math.isnan(power):
            return Verdict(rejected=ABSURD)
        # Chips are means of samples, so they have no more power than the samples.
        noise = min(self.noise_share * self.noise, self.most_noise)
        return self.silent(frame, power) if power <= self.silent_power + noise else None

    def sample_power(self, volts: Floats) -> float:
        """Mean power of samples, V², without an unknown offset; NaN where one is absurd."""
        total, squares = sums(volts)
        mean, power = total / volts.size, squares / volts.size
        if self.spec.first_row > 0:
            return max(power - mean**2, 0.0)  # NaN stays NaN
        return max(power - 2 * mean * self.level_v + self.level_v**2, 0.0)

    def is_silent(self, amplitude: Floats32) -> bool:
        """Whether no word rises above the gap's noise, or above what any node would send.

        amplitude: (n,) V, mean |r| of every node.
        """
        strongest = float(amplitude.max())
        return strongest**2 <= max(self.least_power, LIMITS.loud**2 * self.noise / self.spec.order)

    def silent(self, frame: MarkedFrame, power: float, levels: NodeLevels | None = None) -> Verdict:
        """A frame in which no node spoke; rejected where one that did might not show.

        power: mean power of its samples, V², all of it noise. levels: of the nodes, which hold
        words that are too faint, or noise; None where the power excludes these.
        """
        clipped = share_clipped(frame.volts[: self.size], self.rails_v)
        noise_v = math.sqrt(power / self.chip)
        if reason := silence_hidden(clipped, max(noise_v, math.sqrt(self.noise)), self.spec):
            return Verdict(over=frame.start + frame.volts.size, rejected=reason)
        gap, swing_v = self.noise * self.chip, self.spec.node_swing_v
        # Scrambled chips that are late show in no row, but as noise that the gap has not: a quarter
        # of a node's power, or, of unknown amplitude, more than the gap's noise may rise.
        most = LIMITS.rise * gap if swing_v is None else gap + swing_v**2 / 4
        if self.spec.scramble and power > most:
            return Verdict(over=frame.start + frame.volts.size, rejected=NOISY)
        doubtful = None
        may_stick_out = self.integrated and not self.spec.sparse and frame.volts.size >= self.size
        if may_stick_out and self._sticks_out(frame.volts):
            doubtful = np.ones(self.spec.nodes, bool)
        if levels is not None and not self._holds_more(levels):
            levels = None
            most = LIMITS.carried_noise * self.noise + self.silent_power  # what the gap explains
            if not self.integrated and power > most * self.chip:
                doubtful = np.ones(self.spec.nodes, bool)
        return self._decided(frame.start, self.nominal, levels, noise_v, clipped, doubtful)

    def _sticks_out(self, volts: Floats) -> bool:
        """Whether chips at the edges of bits stand out from the noise of the others.

        All that half a chip's shift leaves of a lone node's row of the most level changes; but for
        its mean, if it is unipolar.
        """
        spec = self.spec
        level = np.abs(volts[: spec.chips] - self.level_v).reshape(spec.line_bits, spec.order)
        least = LIMITS.rest * (spec.node_swing_v or math.inf)
        most, usual = float(level[:, EDGES].max()), float(np.median(level))
        is_mean = spec.drive == UNIPOLAR and usual > least
        return is_mean or (most > least and most > LIMITS.lone_chip * usual)

    def _holds_more(self, levels: NodeLevels) -> bool:
        """Whether a row holds more than noise, noise may be a word, or the line moves."""
        swing_v = self.spec.node_swing_v or 0.0
        if levels.noise_v * SILENT_RHO > swing_v > 0:
            return True
        squares = np.einsum("kn,kn->n", levels.values, levels.values)
        if rises(squares, np.float32(swing_v), levels.noise_v, self.spec.line_bits).any():
            return True
        if levels.rows is None or self.spec.first_row == 0 or not swing_v:
            return False
        return float(levels.rows[:, 0].var()) > (MOVED_SHARE * swing_v) ** 2

    def heard(
        self, frame: MarkedFrame, fit: Fit, levels: NodeLevels, doubtful: Bools | None = None
    ) -> Verdict:
        """A frame in which nodes spoke; rejected where too many of its samples are at a rail."""
        clipped = share_clipped(frame.volts[: round(fit.end(self.spec) + 0.5)], self.rails_v)
        if clipped > LIMITS.clipped:
            return Verdict(over=frame.start + frame.volts.size, rejected=AT_RAIL)
        if clipped > LIMITS.deafened:
            doubtful = np.ones(self.spec.nodes, bool)
        noise_rms_v = levels.noise_v * math.sqrt(self.spec.order)
        return self._decided(frame.start, fit, levels, noise_rms_v, clipped, doubtful)

    def _decided(
        self,
        start: int,
        fit: Fit,
        levels: NodeLevels | None,
        noise_rms_v: float,
        clipped: float,
        doubtful: Bools | None = None,
    ) -> Verdict:
        # An integrated value's index is the begin of its chip, a raw sample's its instant.
        begin = float(start) if self.integrated else start + fit.start
        found = FrameLevels(begin, fit.chip, levels, noise_rms_v, self.level_v, clipped, doubtful)
        return Verdict(found, start + self.over(fit))

    def over(self, fit: Fit) -> int:
        """Samples from the mark on until the line is at rest after a frame."""
        return math.ceil(fit.end(self.spec) + 0.5 * fit.chip)


class Recogniser(ABC):
    """Decodes marked frames, one after the other; by itself, of a fixed size and timing."""

    def __init__(self, line: MarkedLine) -> None:
        """line: shared with the stream, which keeps its level and noise at rest up to date."""
        self._line, self._spec = line, line.spec

    @abstractmethod
    def recognise(self, frame: MarkedFrame) -> Verdict:
        """Decode a frame, reject it, or ask for more samples."""

    def forget(self) -> None:  # noqa: B027 - one of a fixed timing carries none
        """Drop timing carried over from earlier frames, since a frame was rejected."""

    @property
    def carried(self) -> CarriedTiming:
        """The timing by which the next frames may be decided."""
        return CarriedTiming(self._line.size)


class MarkedTiming(Timing):
    """Frames that the digitizer marks: each starts at the first sample of a block with sync."""

    def __init__(self, line: MarkedLine, recogniser: Recogniser) -> None:
        """line: shared with the recogniser."""
        super().__init__()
        self.line, self.recogniser = line, recogniser
        self.gap_size = math.ceil(line.spec.order * line.chip)  # most that is learnt from
        self._start: int | None = None  # the mark of the frame in progress
        self._turn = 0  # whose it is
        self._due = 0
        self._gap_begin: int | None = None  # end of the last frame, if no hole followed
        self._opened = 0  # since the recogniser was asked

    def recognise(self, frame: MarkedFrame) -> Verdict:
        """The recogniser's verdict; counts a rejected frame."""
        return self._noted(self.recogniser.recognise(frame))

    def summed_up(self, start: int, mean_v: float, variance_v2: float) -> Verdict:
        """The verdict on a frame, or more, in which no node transmitted; counts a rejected one."""
        frame = MarkedFrame(start, np.array([mean_v]), final=True)
        return self._noted(self.line.silent(frame, variance_v2))

    def _noted(self, verdict: Verdict) -> Verdict:
        if verdict.rejected is not None:
            self.rejections += verdict.rejected
            self.recogniser.forget()
        return verdict

    def feed(self, block: SampleBlock) -> list[FrameLevels]:
        """Take samples in; return the frames that they complete."""
        frames = self._begin(block)
        # Slices keep the buffer bounded; a value more than a frame has shows that it is too long.
        volts, slice_size = np.asarray(block.volts, np.float32), self.line.size + 1
        for begin in range(0, volts.size, slice_size):
            self._samples.append(volts[begin : begin + slice_size])
            while self._start is not None and self._samples.end >= self._due:
                end = self._samples.end if self.line.integrated else self._due
                frames += self._decide(self._start, end, final=False)
            if self._start is None:
                self._samples.drop(self._samples.end - self.gap_size)
        return frames

    def quiet(self, block: QuietBlock) -> list[FrameLevels]:
        """Process a block in which no node transmitted: a frame with its tail, or part of a gap.

        Gives what `feed` gives for such samples, at next to no cost.
        """
        line = self.line
        if block.count < line.size if block.sync else self._start is not None:
            return self.feed(block.samples())  # the frame goes on
        frames = self._begin(block)
        if block.sync:
            frames += self._settle(
                self.summed_up(block.first_index, block.mean_v, block.variance_v2)
            )
        elif self._gap_begin is not None:
            line.at_rest(block.mean_v, block.variance_v2)
        end = block.first_index + block.count
        self._samples.restart(end)
        self._gap_begin = None if self._gap_begin is None else end
        return frames

    def flush(self) -> list[FrameLevels]:
        """End of the recording: decode the frame in progress if it is complete."""
        frames = self._close()
        self.reset()
        return frames

    def reset(self) -> None:
        """Forget the frame in progress, since the stream has a hole."""
        super().reset()
        if self._start is not None:
            self.rejections += INCOMPLETE
        self._start = self._gap_begin = None

    def _begin(self, block: SampleBlock | QuietBlock) -> list[FrameLevels]:
        """Join a block to the stream; a mark ends the frame in progress, which is returned."""
        self._join(block)
        if not block.sync:
            return []
        frames, index = self._close(), block.first_index
        if self._gap_begin is not None:
            gap_begin = max(self._gap_begin, index - self.gap_size)
            self.line.add_gap(self._samples.take(gap_begin, index))
        self._samples.drop(index)
        self._start, self._turn = index, block.turn
        self._opened += 1
        self._due = index + self.recogniser.carried.due
        return frames

    def _close(self) -> list[FrameLevels]:
        """Decide the frame in progress, for which no more samples will come."""
        if self._start is None:
            return []
        return self._decide(self._start, self._samples.end, final=True)

    def _decide(self, start: int, end: int, final: bool) -> list[FrameLevels]:
        frame = MarkedFrame(start, self._samples.take(start, end), final, self._opened)
        self._opened = 0
        return self._settle(self.recognise(frame))

    def _settle(self, verdict: Verdict) -> list[FrameLevels]:
        """Act on a verdict."""
        if verdict.due is not None:
            self._due = verdict.due
            return []
        self._start = None
        # Where chips are integrated no gap is sent: what follows is words, and no noise.
        self._gap_begin = None if self.line.integrated else verdict.over
        return [] if verdict.frame is None else [verdict.frame.in_turn(self._turn)]
