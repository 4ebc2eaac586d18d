# SPDX-License-Identifier: Apache-2.0

"""Timing from the digitizer's marks: it says where each frame starts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.errors import SpecError
from ..code.frame import BIPOLAR, MAX_STRETCH, UNIPOLAR, FrameSpec
from ..code.separate import NodeLevels, node_levels
from ..code.transform import correlate
from ..wire._protocol import TAIL_CHIPS
from .fit import (
    MAX_SPREAD,
    ChipEdges,
    Fit,
    Floats,
    Line,
    dot,
    integrate,
    least_power,
    lowest_power,
    read_words,
    refine,
    word_floor,
)
from .frame_end import End, FrameEnds
from .timing import MOST_CLIPPED, FrameLevels, QuietBlock, SampleBlock, Timing

CHIP_ERROR = 2e-3
"""What chips may be shorter than nominal, or longer than the longest stretch."""
CLEAN_SPREAD = 0.08
"""Spread at which a frame timed as its sync says is believed where the noise is not known: ρ > 3.5.
Later, and where the noise is known, it is MAX_SPREAD."""
CARRIED_FRAMES = 15
"""A frame's timing serves so many frames after it, as long as it explains them."""
CARRIED_MISFIT = 3e-3
"""Power, relative to the words', that timing carried over may leave unexplained beside the noise:
an edge error of about a thousandth of a chip's power, 0.01 dB."""
RESTART_STEP = 1 / 16
"""Raster on which the nodes' common delay is sought where they restart, chips."""
LEAST_REST = 16
"""Samples that say what the line at rest is; those of several short gaps together."""
MOST_RISE = 4.0
"""By how much noise may rise from one gap to the next."""
GAP_WEIGHT = 0.25
"""Of the newest gap in the noise that is expected of the next frame."""
SEARCH_PER_S = 2e6
"""Chips that the search of all stretches looks at, for each second of frames: each takes it up to
0.15 µs, and a line that is disturbed must not hold up the stream."""
LARGEST_SEARCH = 1 << 21
"""Chips that it looks at at most at once: frames too long for that end where the line is loud."""


@dataclass(slots=True)
class _Carried:
    """Timing of a frame that was refined on its own edges, and how often it was used since."""

    fit: Fit
    edges: ChipEdges
    uses: int = 0


class LineTiming(Timing):
    """Frames that the digitizer marks: each starts at the first sample of a block with sync.

    At one sample per chip the digitizer integrates whole chips, and these are the frame. Raw
    samples are integrated with the timing of the frame before, as long as that leaves no more
    than noise; else with the nominal chip duration, refined on the frame's own edges; and only
    where words do not come out clean, all stretches up to 11 % are searched, which takes the
    samples that such a frame would have. Frames with restarts in them need none of this: their
    chips are where the digitizer's sync edges put them.
    """

    def __init__(
        self, spec: FrameSpec, rate_hz: float, rails_v: tuple[float, float] | None = None
    ) -> None:
        """See Timing."""
        super().__init__(spec, rate_hz, rails_v)
        self._nominal = rate_hz * spec.chip_s
        self._integrated = abs(self._nominal - 1) < 0.01
        if not self._integrated and self._nominal < 1.9:
            raise SpecError(
                f"{self._nominal:.2g} samples per chip: line timing takes one integrated value per "
                f"chip ({1 / spec.chip_s:.6g} Hz) or at least two samples"
            )
        self._nominal_fit = Fit(-0.5, self._nominal)  # the first sample is half a sample's instant
        self._gap_size = math.ceil(spec.order * self._nominal)
        # Where chips are integrated, guards have no samples.
        length = spec.chips if self._integrated else spec.span_chips
        self._nominal_size = math.ceil(length * self._nominal - 0.5)
        self._least_power = least_power(spec)
        self._start: int | None = None
        self._due = 0
        self._gap_begin: int | None = None  # end of the last frame, if no hole followed
        self._level_v = 0.0
        # All rows but the first have as many +1 as −1: without it a frame's mean is the offset.
        self._centred = spec.first_row > 0 and spec.drive == BIPOLAR
        self._level_known = False
        self._rest = np.zeros(3)  # samples of gaps not made use of yet: count, sum, sum of squares
        self._noise = 0.0  # variance of a chip's level in the gap, V²; 0 where unknown
        self._carried: _Carried | None = None
        self._restarted = self._nominal_fit
        self._restart_uses = 0
        self._chip = self._nominal
        self._ends = FrameEnds(spec)
        self._search = float(LARGEST_SEARCH)  # chips that may be looked at

    def feed(self, block: SampleBlock) -> list[FrameLevels]:
        """Take samples in; return the frames that they complete."""
        self._continue(block)
        frames: list[FrameLevels] = []
        if block.sync:
            frames += self._close()
            self._open(block.first_index)
        volts, slice_size = np.asarray(block.volts), self._nominal_size
        for begin in range(0, volts.size, slice_size):  # keeps the buffer bounded
            self._samples.append(volts[begin : begin + slice_size])
            while self._start is not None and self._samples.end >= self._due:
                frames += self._decide(self._start, self._due, final=False)
            if self._start is None:
                self._samples.drop(self._samples.end - self._gap_size)
        return frames

    def quiet(self, block: QuietBlock) -> list[FrameLevels]:
        """Take in what nobody spoke in: a marked frame and its tail, or samples of the gap.

        As `feed` does with such samples, at next to no cost.
        """
        frame_goes_on = block.count < self._nominal_size if block.sync else self._start is not None
        if frame_goes_on:
            return self.feed(block.samples())
        self._continue(block)
        frames: list[FrameLevels] = []
        if block.sync:
            frames += self._close()
            self._open(block.first_index)
            if self._clipped(np.array([block.mean_v])):
                self._reject()
            else:
                frames += self._idle_frame(block.first_index, self._nominal_fit, block.variance_v2)
        elif self._gap_begin is not None:
            self._at_rest(block.mean_v, block.variance_v2)
        end = block.first_index + block.count
        self._samples.restart(end)
        self._gap_begin = None if self._gap_begin is None else end
        return frames

    def flush(self) -> list[FrameLevels]:
        """The recording ends here: decode the frame in progress if it is complete."""
        frames = self._close()
        self.reset()
        return frames

    def reset(self) -> None:
        """The stream has a hole: forget the frame in progress."""
        super().reset()
        if self._start is not None:
            self.rejected += 1
        self._start = self._gap_begin = None

    def _open(self, index: int) -> None:
        """A frame begins at this sample; what came since the last frame's end is gap."""
        begin = index if self._gap_begin is None else max(self._gap_begin, index - self._gap_size)
        gap = self._samples.take(begin, index)
        if gap.size and not np.isnan(total := float(gap.sum())):
            self._rest += np.array((gap.size, total, dot(gap, gap)))
            count, total, squares = self._rest.tolist()
            if count >= LEAST_REST:
                mean = total / count
                self._at_rest(mean, max(0.0, squares - count * mean**2) / (count - 1))
                self._rest[:] = 0
        self._samples.drop(index)
        earned = SEARCH_PER_S * self.spec.frame_period_s
        self._search = min(self._search + earned, float(LARGEST_SEARCH))
        tail = 0 if self._integrated else math.ceil(TAIL_CHIPS * self._nominal)
        self._start, self._due = index, index + self._nominal_size + tail

    def _at_rest(self, mean_v: float, variance: float) -> None:
        """Samples of a gap have this mean, V, and variance, V²."""
        self._level_v = mean_v
        newest = variance / self._nominal
        if self._level_known:  # a burst in one gap is not the noise of the next frame
            newest = min(newest, MOST_RISE * self._noise + lowest_power(1e-3))
        self._noise += (GAP_WEIGHT if self._level_known else 1.0) * (newest - self._noise)
        self._level_known = True

    def _close(self) -> list[FrameLevels]:
        """No more samples for the frame in progress: take what there is, or reject it."""
        frames: list[FrameLevels] = []
        if self._start is not None:
            if self._samples.end - self._start >= self._nominal_size:
                frames = self._decide(self._start, self._samples.end, final=True)
            else:
                self._reject()
        return frames

    def _reject(self, over: int | None = None) -> None:
        """No frame came of the present one. over: index at which it is over, if that is known."""
        self.rejected += 1
        self._start = self._carried = None
        # Where chips are integrated no gap is sent: what follows is words, and no noise.
        self._gap_begin = None if self._integrated else over

    def _decide(self, start: int, end: int, final: bool) -> list[FrameLevels]:
        """Decode the frame from samples up to `end`, or ask for more. final: none will follow."""
        volts = self._samples.take(start, end)
        if self._centred and not self._level_known:
            self._level_v = float(volts[: self._nominal_size].mean())
        power = self._sample_power(volts[: self._nominal_size])
        if math.isnan(power):
            self._reject()
            return []
        # The energy gate: means of samples have no more power than the samples themselves.
        if power <= self._least_power:
            if self._clipped(volts[:1]):  # and so are all
                self._reject()
                return []
            return self._idle_frame(start, self._nominal_fit, power)
        return self._loud_frame(start, end, volts, final)

    def _loud_frame(self, start: int, end: int, volts: Floats, final: bool) -> list[FrameLevels]:
        """The frame of samples with enough power for a node; as _decide."""
        if self._integrated:
            return self._integrated_frame(start, volts)
        line = Line(volts - self._level_v)
        if self.spec.resync_chips:
            return self._resynced_frame(start, line, final)
        carried = self._carried
        if carried is not None and carried.uses < CARRIED_FRAMES:
            if carried.edges.size != volts.size:
                carried.edges = ChipEdges(carried.fit, self.spec, volts.size)
            rows = correlate(carried.edges.chips(line), self.spec.book)
            amplitude = self._explained(rows)
            if amplitude is not None:
                fit = carried.fit
                if self._more_needed(fit, end, volts.size, final):
                    return []
                levels = node_levels(rows, self.spec)
                if (after := self._after(line, fit, levels, amplitude)) != End.OTHER:
                    carried.uses += 1
                    return self._emit(start, fit, levels, volts, after)
        return self._refined_frame(start, end, line, final)

    def _refined_frame(self, start: int, end: int, line: Line, final: bool) -> list[FrameLevels]:
        """The frame whose timing follows from its own edges."""
        spec, volts = self.spec, line.volts
        power = self._chip_power(line)
        if power <= self._least_power:
            return self._idle_frame(start, self._nominal_fit, power * self._nominal)
        for chip in dict.fromkeys((self._nominal, self._chip)):
            fit = self._refined(line, chip)
            found = self._attempt(line, fit, self._clean_spread, self._noise or None)
            if found.believable and not self._silent(found.amplitude):
                if self._more_needed(fit, end, volts.size, final):
                    return []
                after = self._after(line, fit, found.levels, found.amplitude)
                if fit.end(spec) - volts.size < 0.5 * chip and after != End.OTHER:
                    self._carried = _Carried(fit, ChipEdges(fit, spec, volts.size))
                    return self._emit(start, fit, found.levels, volts + self._level_v, after)
        if power <= 1.6 * self._noise:  # too weak to look for at other stretches
            return self._idle_frame(start, self._nominal_fit, power * self._nominal)
        # The tail shows the level, or that it has not changed: row 0 would take that for a word.
        tail = 0 if self._level_known and spec.first_row > 0 else TAIL_CHIPS
        longest = start + math.ceil((1 + MAX_STRETCH) * (spec.chips + tail) * self._nominal)
        if end < longest and not final:
            self._due = longest
            return []
        for stretched in (self._by_loud_end(line), self._all_stretches(line)):
            if not stretched.size:
                continue
            fit = self._refined(line, self._strongest(line, stretched))
            found = self._attempt(line, fit, MAX_SPREAD, self._noise or None)
            if self._silent(found.amplitude):
                return self._idle_frame(start, fit, power * self._nominal)
            if found.believable:
                after = self._after(line, fit, found.levels, found.amplitude)
                if after != End.OTHER:
                    return self._emit(start, fit, found.levels, volts + self._level_v, after)
        self._reject(longest + math.ceil(self._nominal))
        return []

    def _integrated_frame(self, start: int, volts: Floats) -> list[FrameLevels]:
        """The frame of words that are chips already: taken as it is, or not at all."""
        spec, fit = self.spec, self._nominal_fit
        chips = np.subtract(volts[: spec.chips], self._level_v, dtype=np.float32)
        words = read_words(chips.reshape(1, spec.line_bits, spec.order), spec)
        if self._silent(words.amplitude[0]):
            return self._idle_frame(start, fit, self._sample_power(volts[: spec.chips]))
        if words.believable(MAX_SPREAD, spec):
            return self._emit(start, fit, node_levels(words.rows[0], spec), volts)
        self._reject()
        return []

    def _resynced_frame(self, start: int, line: Line, final: bool) -> list[FrameLevels]:
        """The frame with restarts in it: its chips are where they should be, or all a bit late."""
        if self._restart_uses % (CARRIED_FRAMES + 1) == 0:
            self._restarted = self._least_late(line)
        self._restart_uses += 1
        fit = self._restarted
        found = self._attempt(line, fit, MAX_SPREAD, self._noise or None)
        if self._silent(found.amplitude):
            self._restart_uses = 0
            return self._idle_frame(start, fit, self._chip_power(line) * self._nominal)
        if found.believable:
            after = self._after(line, fit, found.levels, found.amplitude)
            if after != End.OTHER:
                return self._emit(start, fit, found.levels, line.volts + self._level_v, after)
        self._reject(start + self._nominal_size + math.ceil(self._nominal))
        return []

    def _least_late(self, line: Line) -> Fit:
        """The start, up to a chip late, that explains the most energy."""
        late = np.arange(0, 1, RESTART_STEP) * self._nominal
        start, chip = self._nominal_fit.start + late, np.full(late.size, self._nominal)
        power = read_words(integrate(line, start, chip, self.spec), self.spec).power
        return Fit(float(start[np.argmax(power)]), self._nominal)

    def _explained(self, rows: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """Amplitudes (n,) of words that leave no more than the noise that the gap has shown.

        rows: (k, N) float32, V, all correlations. None where there are no such words. What makes
        words uneven is left over, too, so this says that they are even.
        """
        spec = self.spec
        level = np.abs(rows[:, spec.first_row : spec.first_row + spec.nodes])
        amplitude: NDArray[np.float32] = level.sum(axis=0) * np.float32(1 / spec.line_bits)
        amplitude *= amplitude > word_floor(amplitude, spec)
        power = dot(amplitude, amplitude)
        meant = rows
        if spec.drive == UNIPOLAR:
            power += (float(rows[:, 0].sum()) / spec.line_bits) ** 2
        elif spec.first_row > 0:
            meant = rows[:, 1:]
        total = float(np.einsum("kr,kr->", meant, meant)) / spec.line_bits
        if total - power < 1.5 * self._noise + CARRIED_MISFIT * power and not self._silent(
            amplitude
        ):
            return amplitude
        return None

    @property
    def _clean_spread(self) -> float:
        """Limit of spread at which a frame marked by its sync is taken as timed right."""
        return MAX_SPREAD if self._noise else CLEAN_SPREAD  # known noise makes the limit stricter

    def _more_needed(self, fit: Fit, end: int, size: int, final: bool) -> bool:
        """Whether the silence after this fit's end is still to come; sets when to look again."""
        missing = fit.end(self.spec) + TAIL_CHIPS * fit.chip - size
        if missing > 0.5 and not final:
            self._due = end + math.ceil(missing)
            return True
        return False

    def _after(
        self, line: Line, fit: Fit, levels: NodeLevels, amplitude: NDArray[np.float32]
    ) -> End:
        """What follows the fitted end; a level that is not known yet has no noise either."""
        noise = self._noise if self._level_known else levels.noise_v**2 * self.spec.order
        return self._ends.after(line, fit, amplitude, noise, self._level_known)

    def _refined(self, line: Line, chip: float) -> Fit:
        """The frame refined around the first sample; as it was if that leads nowhere."""
        fit = refine(line, Fit(-0.5, chip), self.spec, earliest=-1.0, latest=0.5)
        stretch = fit.chip / self._nominal
        possible = 1 - CHIP_ERROR <= stretch <= (1 + CHIP_ERROR) * (1 + MAX_STRETCH)
        return fit if possible else Fit(-0.5, chip)

    def _by_loud_end(self, line: Line) -> Floats:
        """Chip durations by which a frame ends where the line falls silent, or a bit later."""
        limit = 5 * math.sqrt(self._noise * self._nominal)
        loud = np.flatnonzero(np.abs(line.volts) > max(limit, 0.3 * math.sqrt(self._least_power)))
        end = int(loud[-1]) + 1 if loud.size else self._nominal_size
        chip: Floats = (end + self._nominal * np.arange(-1.0, 3.0, 0.5)) / self.spec.chips
        longest = (1 + CHIP_ERROR) * (1 + MAX_STRETCH) * self._nominal
        return np.minimum(np.maximum(chip, self._nominal), longest)

    def _all_stretches(self, line: Line) -> Floats:
        """All chip durations of frames that end within the samples; none if that is too much."""
        spec, step = self.spec, 0.5 / self.spec.chips
        chip: Floats = self._nominal * np.arange(1, 1 + MAX_STRETCH + step, step)
        chip = chip[chip * spec.chips <= line.volts.size + self._nominal]
        if chip.size * spec.chips > self._search:
            return np.empty(0)
        self._search -= chip.size * spec.chips
        return chip

    def _strongest(self, line: Line, chip: Floats) -> float:
        """The chip duration that explains the most energy."""
        spec = self.spec
        batches = np.array_split(chip, 1 + chip.size * spec.chips // 2**18)
        gains = [
            read_words(integrate(line, np.full(some.size, -0.5), some, spec), spec).power * some
            for some in batches
        ]
        return float(chip[np.argmax(np.concatenate(gains))])

    def _sample_power(self, volts: Floats) -> float:
        """Mean power of samples, V², without an unknown offset; NaN where one is absurd."""
        mean = float(volts.sum()) / volts.size
        power = dot(volts, volts) / volts.size
        if self.spec.first_row > 0:
            return max(power - mean**2, 0.0)  # NaN stays NaN
        return max(power - 2 * mean * self._level_v + self._level_v**2, 0.0)

    def _chip_power(self, line: Line) -> float:
        """Mean power of the chips at nominal timing, V², without an unknown offset."""
        fit = self._nominal_fit
        chips = integrate(line, np.array([fit.start]), np.array([fit.chip]), self.spec)
        return float(chips.var() if self.spec.first_row > 0 else np.square(chips).mean())

    def _silent(self, amplitude: NDArray[np.float32]) -> bool:
        """Whether no word rises above the gap's noise, or above what any node would send.

        Noise gives words of 0.8 ± 0.6/√k deviations of a correlation.
        """
        strongest = float(amplitude.max())
        return strongest**2 <= max(self._least_power, 4 * self._noise / self.spec.order)

    def _emit(
        self,
        start: int,
        fit: Fit,
        levels: NodeLevels,
        volts: Floats,
        after: End = End.SILENCE,
    ) -> list[FrameLevels]:
        """The frame whose first sample this is. volts: as received."""
        self._chip = fit.chip
        clipped = self._clipped(volts[: round(fit.end(self.spec) + 0.5)])
        if clipped > MOST_CLIPPED:
            self._reject(start + volts.size)
            return []
        begin = self._close_at(start, fit)
        tied = after == End.MISLED
        return [self._heard(begin, fit.chip, levels, self._level_v, clipped, tied)]

    def _idle_frame(self, start: int, fit: Fit, sample_power: float) -> list[FrameLevels]:
        """A frame in which nobody spoke: what power it has is the noise of its samples."""
        noise_rms_v = math.sqrt(sample_power / self._nominal)
        begin = self._close_at(start, fit)
        return [FrameLevels(begin, fit.chip, None, noise_rms_v, self._level_v, 0.0)]

    def _close_at(self, start: int, fit: Fit) -> float:
        """The frame in progress is done: its begin, and the gap from its end on."""
        self._start = None
        if self._integrated:  # no gap is sent; a word's index is the begin of its chip
            return float(start)
        self._gap_begin = start + math.ceil(fit.end(self.spec) + 0.5 * fit.chip)
        return start + fit.start  # of a raw sample it is the instant
