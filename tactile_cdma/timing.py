"""Frame and chip timing: samples of the line in, the level of every chip of every frame out.

Two sources of timing: `LineTiming` is told where frames start, `GapTiming` has nothing but the
waveform. Both keep their own samples, and how the stream is cut into blocks changes nothing.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import SpecError
from .frame import MAX_STRETCH, FrameSpec
from .gap import MAX_SPREAD, Burst, Fit, Floats, GapSearch, Line, Quiet, integrate, read_words, refine

ABSURD_V = 1e6
"""No digitizer reports more; such samples are treated like NaN."""


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
    """The samples that are still needed, addressed by stream index. float64, V; NaN where absurd."""

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

    Samples from `_cursor` on are undecided; as soon as there are enough of them to hold the
    frame expected next, the search decides: nothing, a frame, or something else. What is decided
    depends on sample positions only, so any cutting into blocks gives the same frames.
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
        self._guard = math.ceil(3 * search.chip)
        self._bit = math.ceil(1.11 * spec.order * search.chip)
        self._quiet: Quiet | None = None
        self._chip: float | None = None
        self._cursor = 0
        self._raster = 0.0
        self._failures = 0

    def feed(self, block: SampleBlock) -> list[FrameChips]:
        """Take samples in; return the frames and silent slots that they complete."""
        if not self._continue(block):
            self._cursor = block.first_index
            missed = math.ceil((block.first_index - self._raster) / self._search.period)
            if self._chip is None or missed < 0:
                self._raster = float(block.first_index)
            else:
                self._raster += missed * self._search.period
        frames: list[FrameChips] = []
        volts, slice_size = np.asarray(block.volts), math.ceil(self._search.period)
        for begin in range(0, volts.size, slice_size):  # keeps the buffer bounded
            self._samples.append(volts[begin : begin + slice_size])
            frames += self._decide()
        return frames

    def flush(self) -> list[FrameChips]:
        """The recording ends here: decode a last frame that is complete."""
        frames: list[FrameChips] = []
        while self._samples.end - self._cursor > self._search.shortest:
            before = self._cursor
            frames += self._step(self._samples.end, final=True)
            if self._cursor <= before:
                break
        self.reset()
        return frames
