"""Timing from the digitizer's marks: it says where each frame starts."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .errors import SpecError
from .fit import Fit, Floats, Line, integrate, least_power, read_words, refine
from .frame import BIPOLAR, MAX_STRETCH, FrameSpec
from .timing import Chips, FrameChips, SampleBlock, Timing

MAX_SPREAD = 0.12
"""Spread beyond which a marked frame is rejected after all stretches were tried."""
CHIP_ERROR = 2e-3
"""What chips may be shorter than nominal, or longer than the longest stretch."""
TAIL_CHIPS = 3
"""So many chips after its end must be silent for a frame to be taken."""
CLEAN_SPREAD = 0.08
"""Spread of words at which a frame marked by its sync is taken as timed right: ρ > 3.5."""


class LineTiming(Timing):
    """Frames that the digitizer marks: each starts at the first sample of a block with sync.

    At one sample per chip the digitizer integrates whole chips, and these are the frame. Raw
    samples are integrated with the nominal chip duration, refined on the frame's own edges; only
    where words do not come out clean, all stretches up to 11 % are searched, which takes the
    samples that such a frame would have.
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
        self._gap_size = math.ceil(spec.order * self._nominal)
        self._nominal_size = math.ceil(spec.chips * self._nominal - 0.5)
        self._least_power = least_power(spec)
        self._start: int | None = None
        self._due = 0
        self._gap_begin: int | None = None  # end of the last frame, if no hole followed
        self._level_v = 0.0  # until a gap was seen; a free row 0 then shows the offset
        self._level_known = False
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
            self._level_known = True
        self._samples.drop(index)
        tail = 0 if self._integrated else math.ceil(TAIL_CHIPS * self._nominal)
        self._start, self._due = index, index + self._nominal_size + tail

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
            return self._integrated_frame(start, volts)
        line = Line(volts)
        nominal = Fit(-0.5, self._nominal)  # the first sample stands for half a sample before it
        power = self._power(line, nominal)
        if power <= self._least_power:
            return self._idle_frame(start, nominal)
        for chip in dict.fromkeys((self._nominal, self._chip)):
            fit = self._refined(line, chip)
            chips = self._chips(line, fit, CLEAN_SPREAD, self._noise or None)
            if chips.believable and not self._silent(chips.amplitude):
                missing = fit.end(spec) + TAIL_CHIPS * fit.chip - volts.size
                if missing > 0.5 and not final:
                    self._due = end + math.ceil(missing)
                    return []
                if fit.end(spec) - volts.size < 0.5 * chip and self._ends(volts, fit, chips):
                    return self._emit(start, fit, chips.volts, volts)
        if power <= 1.6 * self._noise:  # too weak to look for at other stretches
            return self._idle_frame(start, nominal)
        longest = start + math.ceil((1 + MAX_STRETCH) * spec.chips * self._nominal)
        if end < longest and not final:
            self._due = longest
            return []
        fit = self._refined(line, self._stretched(line))
        chips = self._chips(line, fit, MAX_SPREAD)
        if self._silent(chips.amplitude):
            return self._idle_frame(start, fit)
        if chips.believable and self._ends(volts, fit, chips):
            return self._emit(start, fit, chips.volts, volts)
        self._reject()
        return []

    def _integrated_frame(self, start: int, volts: Floats) -> list[FrameChips]:
        """The frame of words that are chips already: taken as it is, or not at all."""
        spec, fit = self.spec, Fit(-0.5, 1.0)
        chips = volts[: spec.chips].astype(np.float32).reshape(spec.bits, spec.order)
        words = read_words(chips[None], spec)
        if self._silent(words.amplitude[0]):
            return self._idle_frame(start, fit)
        if words.believable(MAX_SPREAD, spec)[0]:
            return self._emit(start, fit, chips, volts)
        self._reject()
        return []

    def _ends(self, volts: Floats, fit: Fit, chips: Chips) -> bool:
        """Whether the line is at rest after the fitted end: the frame is neither longer nor other.

        This tells a stretched frame from a shorter fit of its words, and words of more bits than
        specified. volts: from the frame's start on, gap level removed. True where that level is
        not to be known, or nothing was received after the end.
        """
        end = fit.end(self.spec) + 0.5
        tail = volts[math.ceil(end + 0.25 * fit.chip) : math.floor(end + TAIL_CHIPS * fit.chip)]
        free = self.spec.first_row > 0 and self.spec.drive == BIPOLAR
        if tail.size < 0.5 * fit.chip or not (self._level_known or free):
            return True
        level = 0.0 if self._level_known else float(chips.volts.mean())
        least = float(chips.amplitude[chips.amplitude > 0].min(initial=np.inf))
        power = float(np.square(tail - level).mean())
        return power < (0.4 * least) ** 2 + 4 * self._noise * fit.chip

    def _refined(self, line: Line, chip: float) -> Fit:
        """The frame refined around the first sample; as it was if that leads nowhere."""
        fit = refine(line, Fit(-0.5, chip), self.spec, earliest=-1.0, latest=0.5)
        stretch = fit.chip / self._nominal
        possible = 1 - CHIP_ERROR <= stretch <= (1 + CHIP_ERROR) * (1 + MAX_STRETCH)
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

    def _power(self, line: Line, fit: Fit) -> float:
        """Mean power of a fit's chips, V², without an unknown offset."""
        chips = integrate(line, np.array([fit.start]), np.array([fit.chip]), self.spec)
        return float(chips.var() if self.spec.first_row > 0 else np.square(chips).mean())

    def _silent(self, amplitude: NDArray[np.float32]) -> bool:
        """Whether no word rises above the gap's noise, or above what any node would send.

        Noise gives words of 0.8 ± 0.6/√k deviations of a correlation.
        """
        strongest = float(amplitude.max())
        return strongest**2 <= max(self._least_power, 4 * self._noise / self.spec.order)

    def _emit(
        self, start: int, fit: Fit, chips: NDArray[np.float32], volts: Floats
    ) -> list[FrameChips]:
        """The frame whose first sample this is."""
        self._chip = fit.chip
        clipped = self._clipped(volts[: round(fit.end(self.spec) + 0.5)] + self._level_v)
        begin = self._close_at(start, fit)
        return [FrameChips(begin, fit.chip, chips, self._level_v, clipped, False)]

    def _idle_frame(self, start: int, fit: Fit) -> list[FrameChips]:
        """A frame in which nobody spoke."""
        return [self._idle(self._close_at(start, fit), fit.chip, self._level_v)]

    def _close_at(self, start: int, fit: Fit) -> float:
        """The frame in progress is done: its begin, and the gap from its end on."""
        self._start = None
        self._gap_begin = start + math.ceil(fit.end(self.spec) + 0.5 * fit.chip)
        # An integrated word's index is the begin of its chip, a raw sample's is its instant.
        return float(start) if self._integrated else start + fit.start
