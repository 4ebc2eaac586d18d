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
MEMORY = 1e4
"""Frames over which width and share of slips are averaged: two minutes at 78 Hz."""
ON_RASTER = 0.5
"""Chips from the raster beyond which a frame has slipped: halfway to the next chip."""
NARROWEST = 0.05
"""Least width of the raster, chips: how well a start is measured (docs/signal-model.md)."""
KNOWN_PLACE = 0.1
"""Uncertainty of an expected frame's edges, chips, up to which it is not searched for: edges a
tenth of a chip off leave what the certificate allows."""
RARE_SLIPS = 0.05
"""Share of frames off the raster up to which the same holds: what may be the case after 30 frames
without one is less."""


@stage
class Expected:
    """Where the next frame is likely to start, and its standard deviation, samples.

    chip: duration of its chips, samples. sure: it need not be searched for.
    """

    start: float
    scatter: float
    chip: float
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
        chip, width, sure = self._chip, math.inf, False
        if self._known >= LEAST_KNOWN:
            slips = (self._slipped + 1) / (self._known + 2)  # Laplace's rule of succession
            width = math.hypot(
                NARROWEST, math.sqrt(self._square / max(self._known - self._slipped, 1))
            )
            sure = slips <= RARE_SLIPS
        scatter = math.hypot(width * chip, self._period_error * passed)
        sure &= scatter + self._change * self._span_chips <= KNOWN_PLACE * chip
        return Expected(self._start + passed, scatter, chip, sure)

    def learn(self, start: float, chip: float) -> None:
        """Take in a frame whose place the waveform alone decides: its start, a stream index."""
        if not math.isnan(self._start):
            slots = self._slots(start)
            if slots == 1:
                off = (start - (self._start + self._period)) / self._chip
                slipped, fade = abs(off) > ON_RASTER, 1 - 1 / MEMORY
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
