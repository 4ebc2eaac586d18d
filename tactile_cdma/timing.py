"""Frame and chip timing: samples of the line in, the level of every chip of every frame out.

Two sources of timing: `LineTiming` is told where frames start, `GapTiming` has nothing but the
waveform. Both keep their own samples, and how the stream is cut into blocks changes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import SpecError
from .frame import MAX_STRETCH, FrameSpec
from .gap import (
    MAX_SPREAD,
    Burst,
    Expected,
    Fit,
    Floats,
    GapSearch,
    Line,
    Quiet,
    integrate,
    read_words,
    refine,
)

CLEAN_SPREAD = 0.08
"""Spread of words at which a frame marked by its sync is taken as timed right: ρ > 3.5."""
MAX_LINE_SPREAD = 0.25
"""Spread beyond which a frame marked by its sync is rejected after all stretches were tried."""
CLOCK_ERROR = 1e-4
"""What the frame period may be off from the digitizer's clock."""
ABSURD_V = 1e6
"""No digitizer reports more; such samples are treated like NaN."""


MIDDLE = 0.78
"""Share of a chip that is clear of edges up to 10 % of a chip off their ideal position."""


@dataclass(frozen=True, slots=True)
class SampleBlock:
    """Consecutive samples of the line.

    first_index: index of volts[0] in the digitizer's sample stream.
    volts: (m,) float32, V.
    sync: volts[0] is the first sample of a frame (line timing).
    """

    first_index: int
    volts: NDArray[np.float32]
    sync: bool = False


@dataclass(frozen=True, slots=True)
class FrameChips:
    """One frame, or one silent slot, as levels of its chips.

    start: stream index, fractional, at which the first chip begins; sample i is instant i.
    chip_samples: recovered chip duration, samples.
    volts: (k, N) float32, V: mean level of every chip, line offset removed.
    offset_v: that offset, V.
    clipped: share of the frame's samples at a rail, 0…1.
    idle: nothing but offset and noise in this slot; volts are zeros.
    """

    start: float
    chip_samples: float
    volts: NDArray[np.float32]
    offset_v: float
    clipped: float
    idle: bool


class _Samples:
    """The samples still needed, addressed by stream index; float64, V, NaN where absurd."""

    def __init__(self) -> None:
        self.begin = 0
        self.end = 0
        self._parts: list[Floats] = []

    def restart(self, index: int) -> None:
        """Forget all; the next sample has this index."""
        self.begin = self.end = index
        self._parts = []

    def append(self, volts: NDArray[np.float32]) -> None:
        part = np.array(volts, dtype=np.float64)
        part[~(np.abs(part) < ABSURD_V)] = np.nan
        self._parts.append(part)
        self.end += part.size

    def take(self, begin: int, end: int) -> Floats:
        """Samples begin…end − 1, as far as they are kept."""
        if len(self._parts) != 1:
            self._parts = [np.concatenate(self._parts) if self._parts else np.empty(0)]
        return self._parts[0][max(0, begin - self.begin) : max(0, end - self.begin)]

    def drop(self, before: int) -> None:
        """Forget samples before an index."""
        count = min(before, self.end) - self.begin
        while count > 0 and self._parts:
            head = self._parts[0]
            if head.size > count:
                self._parts[0] = head[count:]
                self.begin += count
                return
            self._parts.pop(0)
            self.begin += head.size
            count -= head.size


class _Timing:
    """What both sources share: the stream's continuity, and chips from a known start and period."""

    def __init__(
        self, spec: FrameSpec, rate_hz: float, rails_v: tuple[float, float] | None = None
    ) -> None:
        """Timing for one specification.

        rate_hz: samples per second. rails_v: lowest and highest level that the amplifier or the
        converter can give, V; None where unknown (nothing counts as clipped then).
        """
        if not (math.isfinite(rate_hz) and rate_hz * spec.chip_s > 0.99):
            raise SpecError(
                f"{rate_hz:g} samples/s are less than one sample per {spec.chip_s * 1e6:g} µs chip"
            )
        self.spec = spec
        self.rate_hz = rate_hz
        self.rails_v = rails_v
        self.rejected = 0
        """Stretches of the line that were no frame: cut off, too short, too long, poor fit."""
        self.holes = 0
        """Blocks that did not continue the one before."""
        self._samples = _Samples()
        self._fresh = True

    def reset(self) -> None:
        """The stream has a hole: forget the frame in progress."""
        self._fresh = True

    def _continue(self, block: SampleBlock) -> bool:
        """Whether a block follows the one before; restarts the samples there if not."""
        if not self._fresh and block.first_index == self._samples.end:
            return True
        if not self._fresh:
            self.holes += 1
            self.reset()
        self._samples.restart(block.first_index)
        self._fresh = False
        return False

    def _chips(
        self, line: Line, fit: Fit, limit: float, noise: float | None = None
    ) -> tuple[NDArray[np.float32], bool]:
        """Chips (k, N), V, and whether their words are believable within a limit of spread.

        Whole chips are the matched filter; their middle is blind to edges a tenth of a chip off.
        Taken is what gives the more even words.
        """
        start, chip = np.array([fit.start]), np.array([fit.chip])
        both = np.concatenate(
            [integrate(line, start, chip, self.spec, share) for share in (1.0, MIDDLE)]
        )
        words = read_words(both, self.spec)
        best = int(np.argmin(words.spread))
        return both[best], bool(words.believable(limit, self.spec, noise)[best])

    def _idle(self, start: float, chip: float, offset_v: float) -> FrameChips:
        zeros = np.zeros((self.spec.bits, self.spec.order), np.float32)
        return FrameChips(start, chip, zeros, offset_v, 0.0, True)

    def _clipped(self, volts: Floats) -> float:
        """Share of samples within a thousandth of the range of a rail."""
        if self.rails_v is None or not volts.size:
            return 0.0
        low, high = self.rails_v
        margin = 1e-3 * (high - low)
        return float(np.mean((volts <= low + margin) | (volts >= high - margin)))


class GapTiming(_Timing):
    """Frames from nothing but the waveform: they stand between gaps, stretched by 0…11 %.

    Samples from `_cursor` on are undecided. At `_due`, when they hold the frame expected next,
    the search decides: nothing, a frame, or something else. Decisions depend on sample positions
    only, so any cutting into blocks gives the same frames.
    """

    def __init__(
        self, spec: FrameSpec, rate_hz: float, rails_v: tuple[float, float] | None = None
    ) -> None:
        """See _Timing. Raises SpecError where frames leave no gap to find, or at too low a rate."""
        super().__init__(spec, rate_hz, rails_v)
        search = self._search = GapSearch(spec, rate_hz)
        if search.chip < 2.5:
            raise SpecError(
                f"{search.chip:.2g} samples per chip are too few to find frames by their gaps: "
                f"sample at {3 / spec.chip_s:.3g} Hz or more, or use line timing"
            )
        gap_chips = (search.period - search.shortest) / search.chip
        if gap_chips < spec.order / 2:
            raise SpecError(
                f"a gap of {gap_chips:.1f} chips is too short to find frames of order "
                f"{spec.order} by; lengthen frame_period_s or use line timing"
            )
        # From a frame's first loud sample to the instant at which it must be over.
        self._reach = math.ceil(search.longest + 3 * search.chip)
        self._bit = math.ceil(1.11 * spec.order * search.chip)
        gap = max(search.period - search.longest, 5 * search.chip)
        self._side = min(self._bit, math.ceil(0.4 * gap))
        self._quiet: Quiet | None = None
        self._last: Fit | None = None  # the last frame, in stream indices
        self._cursor = 0
        self._due = 0
        self._raster = 0.0  # start of the next slot
        self._failures = 0

    def feed(self, block: SampleBlock) -> list[FrameChips]:
        """Take samples in; return the frames and silent slots that they complete."""
        if not self._continue(block):
            self._begin_at(block.first_index)
        frames: list[FrameChips] = []
        volts, slice_size = np.asarray(block.volts), math.ceil(self._search.period)
        for begin in range(0, volts.size, slice_size):  # keeps the buffer bounded
            self._samples.append(volts[begin : begin + slice_size])
            while self._samples.end >= self._due:
                frames += self._decide(self._due)
        return frames

    def flush(self) -> list[FrameChips]:
        """The recording ends here: decode a last frame that is complete."""
        frames: list[FrameChips] = []
        cursor = -1
        while self._samples.end - self._cursor > self._search.shortest and cursor != self._cursor:
            cursor = self._cursor
            frames += self._decide(self._samples.end, final=True)
        self.reset()
        return frames

    def _begin_at(self, index: int) -> None:
        """Start looking at this sample; slots stay on their raster across a hole."""
        if self._last is None or index < self._raster - self._search.period:
            self._raster, self._last = float(index), None
        self._skip_to(index)

    def _skip_to(self, index: int) -> None:
        """Decide on samples from here on, and leave out slots that have gone by."""
        self._cursor = index
        late = math.ceil((index - self._raster) / self._search.period - 0.5)
        self._raster += max(0, late) * self._search.period
        self._schedule()

    def _schedule(self) -> None:
        """Forget what is decided; set when the next decision is due."""
        if self._quiet is None:  # a whole gap must be in view
            self._due = self._cursor + math.ceil(self._search.period) + self._reach
        else:
            self._due = max(math.ceil(self._raster), self._cursor) + self._reach
        self._samples.drop(self._cursor)

    def _decide(self, end: int, final: bool = False) -> list[FrameChips]:
        """Look at the samples from the cursor to `end`, and move on. final: none will follow."""
        volts = self._samples.take(self._cursor, end)
        bad = np.flatnonzero(np.isnan(volts))
        if bad.size:
            self.rejected += 1
            self._skip_to(self._cursor + int(bad[-1]) + 1)
            return []
        candidates = self._search.quiet(volts, self._quiet)
        seen: Burst | None = None
        for quiet in candidates:
            shifted = volts - quiet.level
            burst = self._first_burst(shifted, quiet)
            if burst is None:
                continue
            seen = burst
            if not final and self._incomplete(burst, volts.size):
                self._due = max(end + 1, self._cursor + math.ceil(burst.first) + self._reach)
                return []
            if burst.first < self._search.chip:
                continue  # no gap before it: the rest of a frame that began before the cursor
            line = Line(shifted)
            fit = self._search.fit(line, burst, self._expected(burst))
            if fit is None or fit.end(self.spec) > volts.size + 0.5 * fit.chip:
                continue
            chips, believable = self._chips(line, fit, MAX_SPREAD, burst.noise / fit.chip)
            around = self._around(volts, fit) - quiet.level
            if believable and burst.is_quiet(around):
                self._quiet = quiet
                level = quiet.level + (float(around.mean()) if around.size else 0.0)
                return self._emit(volts, fit, chips, level)
        if seen is None or seen.snr < 2 * self._search.snr_floor:
            self._quiet = candidates[0] if candidates and not final else self._quiet
            return [] if final else self._pass_idle(end)
        self.rejected += 1
        self._failures += 1
        if self._failures == 3:  # perhaps it is the level that is wrong
            self._quiet, self._failures = None, 0
        self._skip_to(self._cursor + max(self._bit, math.ceil(seen.pause)))
        return []

    def _first_burst(self, volts: Floats, quiet: Quiet) -> Burst | None:
        """The earliest burst: the strongest one may have a weaker one before it."""
        found = None
        while burst := self._search.burst(volts, quiet.variance):
            found = burst
            if burst.pause < burst.last:
                before = int(burst.pause) + self._bit
            else:
                before = int(burst.first - self._search.chip)
            if not self._search.shortest < before < volts.size:
                break
            volts = volts[:before]
        return found

    def _expected(self, burst: Burst) -> Expected | None:
        """A frame near the burst that keeps to the raster of the last one."""
        if self._last is None:
            return None
        period = self._search.period
        slots = round((self._cursor + burst.first - self._last.start) / period)
        start = self._last.start + slots * period - self._cursor
        return Expected(
            start, 0.5 * self._last.chip + CLOCK_ERROR * slots * period, self._last.chip
        )

    def _incomplete(self, burst: Burst, size: int) -> bool:
        """Whether chips of this burst's frame may still come after the samples in view."""
        if size > self._search.period + 2 * self._reach:
            return False
        return size < min(burst.first + self._reach, burst.last + self._bit)

    def _around(self, volts: Floats, fit: Fit) -> Floats:
        """Samples of the gap on both sides of a frame; a chip next to it is left out."""
        first, end = int(fit.start - fit.chip), math.ceil(fit.end(self.spec) + fit.chip)
        before = volts[max(0, first - self._side) : max(0, first)]
        return np.concatenate((before, volts[end : end + self._side]))

    def _emit(
        self, volts: Floats, fit: Fit, chips: NDArray[np.float32], offset: float
    ) -> list[FrameChips]:
        """The frame, after the silent slots before it. offset: the gap's level around it, V."""
        clipped = self._clipped(volts[max(0, round(fit.start)) : round(fit.end(self.spec))])
        start = self._cursor + fit.start
        frames = list(self._idle_slots(start - self._search.period / 2))
        assert self._quiet is not None
        chips = chips + np.float32(self._quiet.level - offset)
        frames.append(FrameChips(start, fit.chip, chips, offset, clipped, False))
        self._last, self._failures = Fit(start, fit.chip), 0
        self._raster = start + self._search.period
        self._cursor += math.ceil(fit.end(self.spec) + 0.5 * fit.chip)
        self._schedule()
        return frames

    def _pass_idle(self, end: int) -> list[FrameChips]:
        """Nothing up to `end`, but a frame may begin within the last frame's length before it."""
        frames = list(self._idle_slots(end - self._reach))
        self._cursor = max(self._cursor, end - self._reach)
        self._schedule()
        return frames

    def _idle_slots(self, until: float) -> Iterator[FrameChips]:
        """The silent slots that begin up to an index."""
        level = self._quiet.level if self._quiet else 0.0
        while self._raster <= until:
            yield self._idle(self._raster, self._search.chip, level)
            self._raster += self._search.period


class LineTiming(_Timing):
    """Frames that the digitizer marks: each starts at the first sample of a block with sync.

    At one sample per chip the digitizer integrates whole chips, and these are the frame. Raw
    samples are integrated with the nominal chip duration, refined on the frame's own edges; only
    where words do not come out clean, all stretches up to 11 % are searched, which takes the
    samples that such a frame would have.
    """

    def __init__(
        self, spec: FrameSpec, rate_hz: float, rails_v: tuple[float, float] | None = None
    ) -> None:
        """See _Timing."""
        super().__init__(spec, rate_hz, rails_v)
        self._nominal = rate_hz * spec.chip_s
        self._integrated = abs(self._nominal - 1) < 0.01
        if not self._integrated and self._nominal < 1.9:
            raise SpecError(
                f"{self._nominal:.2g} samples per chip: line timing takes one integrated value per "
                f"chip ({1 / spec.chip_s:.6g} Hz) or at least two samples"
            )
        self._gap_size = math.ceil(spec.order * self._nominal)
        self._nominal_size = math.ceil(spec.chips * self._nominal - 0.5)
        swing = spec.node_swing_v
        # A node may be half as strong as specified; less than half of that is no node.
        self._least_power = 0.0 if swing is None else (swing / 4) ** 2
        self._start: int | None = None
        self._due = 0
        self._gap_begin: int | None = None  # end of the last frame, if no hole followed
        self._level_v = 0.0
        self._noise = 0.0  # variance of a chip's level in the gap, V²; 0 where unknown
        self._chip = self._nominal

    def feed(self, block: SampleBlock) -> list[FrameChips]:
        """Take samples in; return the frames that they complete."""
        self._continue(block)
        frames: list[FrameChips] = []
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

    def flush(self) -> list[FrameChips]:
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
        if gap.size and not np.isnan(gap.sum()):
            self._level_v, self._noise = float(gap.mean()), float(gap.var()) / self._nominal
        elif self.spec.first_row > 0:
            self._level_v = 0.0  # row 0 is free and will show the offset
        self._samples.drop(index)
        self._start, self._due = index, index + self._nominal_size

    def _close(self) -> list[FrameChips]:
        """No more samples for the frame in progress: take what there is, or reject it."""
        frames: list[FrameChips] = []
        if self._start is not None:
            if self._samples.end - self._start >= self._nominal_size:
                frames = self._decide(self._start, self._samples.end, final=True)
            else:
                self._reject()
        return frames

    def _reject(self) -> None:
        self.rejected += 1
        self._start = self._gap_begin = None

    def _decide(self, start: int, end: int, final: bool) -> list[FrameChips]:
        """Decode the frame from samples up to `end`, or ask for more. final: none will follow."""
        spec, volts = self.spec, self._samples.take(start, end)
        if np.isnan(volts.sum()):
            self._reject()
            return []
        volts = volts - self._level_v
        if self._integrated:
            chips = volts[: spec.chips].astype(np.float32).reshape(spec.bits, spec.order)
            return self._emit(start, Fit(-0.5, 1.0), chips, volts, self._silent(chips))
        line = Line(volts)
        nominal = Fit(-0.5, self._nominal)  # the first sample stands for half a sample before it
        chips, _ = self._chips(line, nominal, CLEAN_SPREAD)
        power = self._power(chips)
        if power <= self._least_power:
            return self._emit(start, nominal, chips, volts, True)
        for chip in (self._nominal, self._chip):
            fit = self._refined(line, chip)
            chips, clean = self._chips(line, fit, CLEAN_SPREAD, self._noise or None)
            if clean and not self._silent(chips):
                missing = fit.end(spec) - volts.size
                if missing < 0.5 * chip or final:
                    return self._emit(start, fit, chips, volts, False)
                self._due = end + math.ceil(missing)
                return []
        if power <= 1.6 * self._noise:  # too weak to look for at other stretches
            return self._emit(start, nominal, chips, volts, True)
        longest = start + math.ceil((1 + MAX_STRETCH) * spec.chips * self._nominal)
        if end < longest and not final:
            self._due = longest
            return []
        fit = self._refined(line, self._stretched(line))
        chips, believable = self._chips(line, fit, MAX_LINE_SPREAD)
        silent = self._silent(chips)
        if believable or silent:
            return self._emit(start, fit, chips, volts, silent)
        self._reject()
        return []

    def _refined(self, line: Line, chip: float) -> Fit:
        """The frame refined around the first sample; as it was if that leads nowhere."""
        fit = refine(line, Fit(-0.5, chip), self.spec, earliest=-1.0, latest=0.5)
        possible = 0.99 <= fit.chip / self._nominal <= 1.01 * (1 + MAX_STRETCH)
        return fit if possible else Fit(-0.5, chip)

    def _stretched(self, line: Line) -> float:
        """The chip duration that explains the most energy, of all that end within the samples."""
        spec, step = self.spec, 0.5 / self.spec.chips
        chip = self._nominal * np.arange(1, 1 + MAX_STRETCH + step, step)
        chip = chip[chip * spec.chips <= line.volts.size + self._nominal]
        batches = np.array_split(chip, 1 + chip.size * spec.chips // 2**18)
        gains = [
            read_words(integrate(line, np.full(some.size, -0.5), some, spec), spec).power * some
            for some in batches
        ]
        return float(chip[np.argmax(np.concatenate(gains))])

    def _power(self, chips: NDArray[np.float32]) -> float:
        """Mean power of chips, V², without an unknown offset."""
        level = chips - chips.mean() if self.spec.first_row > 0 else chips
        return float(np.square(level).mean())

    def _silent(self, chips: NDArray[np.float32]) -> bool:
        """Whether no word rises above the gap's noise, or above what any node would send.

        Noise gives words of 0.8 ± 0.6/√k deviations of a correlation.
        """
        strongest = float(read_words(chips[None], self.spec).amplitude.max())
        return strongest**2 <= max(self._least_power, 4 * self._noise / self.spec.order)

    def _emit(
        self, start: int, fit: Fit, chips: NDArray[np.float32], volts: Floats, idle: bool
    ) -> list[FrameChips]:
        """The frame that begins at this sample."""
        self._start = None
        self._gap_begin = start + math.ceil(fit.end(self.spec) + 0.5 * fit.chip)
        if idle:
            return [self._idle(float(start), fit.chip, self._level_v)]
        self._chip = fit.chip
        clipped = self._clipped(volts[: round(fit.end(self.spec) + 0.5)] + self._level_v)
        return [FrameChips(float(start), fit.chip, chips, self._level_v, clipped, False)]
