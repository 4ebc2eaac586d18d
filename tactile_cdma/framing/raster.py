# SPDX-License-Identifier: Apache-2.0

"""Where frames are to be expected: on a raster whose period and width are learnt."""

import math

from ..base.stage import stage

CLOCK_ERROR = 1.5e-4
"""Relative error of the nominal frame period in the digitizer's clock: two crystals of 75 ppm."""
CLOCK_DRIFT = 1e-5
"""Relative change of the frame period between frames, once learnt from two: a crystal that warms by
10 K between frames far apart."""
LEAST_KNOWN = 30
"""Frames timed by the waveform alone, before the raster's width is believed: an estimate of a width
from 30 values is right to 13 % (1/√(2·30))."""
MEMORY = 1e3
"""Frames over which a line's width and share of slips are averaged, and its amplitude is kept: 13 s
at 78 Hz, and a width from so many is right to 2 %."""
NARROWEST = 0.05
"""Least width of the raster, chips: how well a start is measured (docs/signal-model.md)."""
KNOWN_PLACE = 0.1
"""Uncertainty of an expected frame's edges, chips, up to which it is not searched for: edges a
tenth of a chip off leave what the certificate allows."""
RARE_SLIPS = 2 / (LEAST_KNOWN + 2)
"""Share of frames off the raster up to which the same holds: one of LEAST_KNOWN, by Laplace's rule
of succession."""


@stage
class Expected:
    """Where the next frame is likely to start, and its standard deviation, samples.

    chip: duration of its chips, samples. begins: whether its start is known. sure: its chips are
    known, too, so that it need not be searched for.
    """

    start: float
    scatter: float
    chip: float
    begins: bool
    sure: bool


class Raster:
    """Starts of frames whose place the waveform alone decides, and what follows for the next ones.

    Only these teach it: a place that the raster has decided would confirm it.
    """

    def __init__(self, period: float, span_chips: int) -> None:
        """period: nominal frame period, samples. span_chips: length of a frame."""
        self._nominal = self._period = period
        self._span_chips = span_chips
        self._period_error = CLOCK_ERROR
        self._start = self._chip = math.nan  # of the last frame whose place was certain
        self._change = math.inf  # of its chip duration since the one before
        self._known = self._slipped = self._square = 0.0  # fading sums: frames, slips, chips²

    def forget_place(self) -> None:
        """Stop expecting frames anywhere; the width stays."""
        self._start = math.nan

    def expect(self, index: float) -> Expected | None:
        """Return a frame in the slot nearest to a stream index; None where none was certain yet."""
        if math.isnan(self._start):
            return None
        passed = self._slots(index) * self._period
        chip, width, begins = self._chip, math.inf, False
        if self._known >= LEAST_KNOWN:
            slips = (self._slipped + 1) / (self._known + 2)
            width = math.hypot(
                NARROWEST, math.sqrt(self._square / max(self._known - self._slipped, 1))
            )
            begins = slips <= RARE_SLIPS
        scatter, most = math.hypot(width * chip, self._period_error * passed), KNOWN_PLACE * chip
        begins &= scatter <= most
        sure = begins and scatter + self._change * self._span_chips <= most
        return Expected(self._start + passed, scatter, chip, begins, sure)

    def learn(self, start: float, chip: float) -> None:
        """Take in a frame whose place the waveform alone decides: its start, a stream index."""
        if not math.isnan(self._start):
            slots = self._slots(start)
            if slots == 1:
                off = (start - (self._start + self._period)) / self._chip
                slipped, fade = round(off) != 0, 1 - 1 / MEMORY
                self._known = fade * self._known + 1
                self._slipped = fade * self._slipped + slipped
                self._square = fade * self._square + (0.0 if slipped else off**2)
            if slots:
                off_period = (start - self._start) / slots - self._period
                period = self._period + off_period * min(
                    1.0, max(slots / LEAST_KNOWN, 1 / max(self._known, 1))
                )
                if abs(period - self._nominal) < CLOCK_ERROR * period:
                    self._period, self._period_error = period, CLOCK_DRIFT
            self._change = abs(chip - self._chip)
        self._start, self._chip = start, chip

    def _slots(self, index: float) -> int:
        """Return the frame periods from the last certain frame to an index."""
        return round((index - self._start) / self._period)
