# SPDX-License-Identifier: Apache-2.0

"""Where frames are to be expected: on a raster whose period and width are learnt."""

import math

import numpy as np

from ..base.arrays import Floats
from ..base.stage import stage
from .fit import Fit

CLOCK_ERROR = 1e-4
"""Relative error of the nominal frame period in the digitizer's clock: two crystals of 50 ppm."""
CLOCK_DRIFT = 1e-5
"""Relative change of the frame period between frames, once learnt from two. Chosen."""
LEAST_KNOWN = 30
"""Frames timed by the waveform alone, before the raster's width is believed. Chosen: an estimate of
a width from 30 values is right to 13 % (1/√(2·30))."""
MEMORY = 1e4
"""Frames over which width and share of slips are averaged. Chosen: two minutes at 78 Hz; with none
slipped, frames that are one chip off a narrow raster are then ruled out (see limits.doubt)."""
WIDE = 3.0
"""Scale of starts that are off the raster, or whose raster is not known, chips. Chosen; its
distribution (Cauchy's) decides little whatever the scale: a factor of 2 over the first 3 chips."""
ON_RASTER = 0.5
"""Chips from the raster beyond which a frame has slipped: halfway to the next chip."""
NARROWEST = 0.05
"""Least width of the raster, chips: how well a start is measured (docs/signal-model.md)."""


@stage
class Expected:
    """Where the next frame is likely to start, and its standard deviation, samples.

    chip: of the last frame. change: how much it differs from the one before, samples. slips: share
    of frames that are off the raster.
    """

    start: float
    scatter: float
    chip: float
    change: float
    slips: float

    def is_near(self, fit: Fit) -> bool:
        """Whether a frame is where the raster says."""
        return abs(fit.start - self.start) < ON_RASTER * fit.chip

    def log_prior(self, starts: Floats) -> Floats:
        """Log of the probability density, per chip, of these starts, samples.

        A mixture: frames on the raster are normal about it, those that slipped are spread wide.
        """
        off = np.square((starts - self.start) / self.chip)
        wide = self.slips / (np.pi * WIDE) / (1 + off * WIDE**-2)
        width = self.scatter / self.chip
        narrow = np.exp(off * (-0.5 / width**2)) * (
            (1 - self.slips) / (math.sqrt(2 * np.pi) * width)
        )
        return np.log(wide + narrow)


class Raster:
    """Starts of frames whose place the waveform alone decides, and what follows for the next ones.

    Only these teach the width: a place that the raster has decided would confirm it.
    """

    def __init__(self, period: float) -> None:
        """period: nominal frame period, samples."""
        self._nominal = self._period = period
        self._period_error = CLOCK_ERROR
        self._anchor: Fit | None = None  # the last frame whose place was certain
        self._change = math.inf  # of its chip duration since the one before
        self._known = self._slipped = self._square = 0.0  # fading sums: frames, slips, chips²

    def forget_place(self) -> None:
        """Stop expecting frames anywhere; the width stays."""
        self._anchor = None

    def expect(self, index: float, origin: float = 0.0) -> Expected | None:
        """A frame in the slot nearest to a stream index; None where no frame was certain yet.

        origin: stream index relative to which its start is given.
        """
        if self._anchor is None:
            return None
        passed = self._slots(index) * self._period
        chip, slips, width = self._anchor.chip, 1.0, WIDE
        if self._known >= LEAST_KNOWN:
            slips = (self._slipped + 1) / (self._known + 2)  # Laplace's rule of succession
            width = math.sqrt(NARROWEST**2 + self._square / (self._known - self._slipped))
        scatter = math.hypot(width * chip, self._period_error * passed)
        return Expected(self._anchor.start + passed - origin, scatter, chip, self._change, slips)

    def learn(self, fit: Fit, unaided: bool) -> None:
        """Take in a frame whose place is certain; unaided: without the raster's help.

        fit: in stream indices.
        """
        if self._anchor is not None:
            slots = self._slots(fit.start)
            if slots == 1 and unaided:
                off = (fit.start - (self._anchor.start + self._period)) / self._anchor.chip
                slipped, fade = abs(off) > ON_RASTER, 1 - 1 / MEMORY
                self._known = fade * self._known + 1
                self._slipped = fade * self._slipped + slipped
                self._square = fade * self._square + (0.0 if slipped else off**2)
            if slots:
                period = (fit.start - self._anchor.start) / slots
                if abs(period - self._nominal) < CLOCK_ERROR * period:
                    self._period, self._period_error = period, CLOCK_DRIFT
            self._change = abs(fit.chip - self._anchor.chip)
        self._anchor = fit

    def _slots(self, index: float) -> int:
        """Frame periods from the anchor to an index."""
        assert self._anchor is not None
        return round((index - self._anchor.start) / self._period)
