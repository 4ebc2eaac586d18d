# SPDX-License-Identifier: Apache-2.0

"""What the two sources of timing share: samples of the line in, the nodes' levels out.

`line_timing` is told where frames start, `gap_timing` has nothing but the waveform. Both keep
their own samples, and how the stream is cut into blocks changes nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.errors import SpecError
from ..code.frame import FrameSpec
from ..code.separate import NodeLevels, node_levels
from .fit import Fit, Floats, Line, integrate, read_words

ABSURD_V = 1e6
"""No digitizer reports more; such samples are treated like NaN."""


UNEVEN = 0.02
"""Spread of words in which another look at the chips is worth its while: ρ < 7."""
MOST_CLIPPED = 0.5
"""Of the samples of a frame: where more are at a rail, nobody can tell who was silent."""
MIDDLE = 0.78
"""Share of a chip that is clear of edges up to 10 % of a chip off their ideal position."""


@dataclass(frozen=True, slots=True)
class SampleBlock:
    """Consecutive samples of the line.

    first_index: index of volts[0] in the digitizer's sample stream.
    volts: (m,) float32, V.
    sync: volts[0] is the first sample of a frame (line timing).
    called: of a frame that belongs to a roll call.
    """

    first_index: int
    volts: NDArray[np.float32]
    sync: bool = False
    called: bool = False


@dataclass(frozen=True, slots=True)
class QuietBlock:
    """Consecutive samples that nobody spoke in, of which the digitizer sent no more than this.

    first_index, sync, called: as in SampleBlock. count: number of samples.
    mean_v, variance_v2: of the samples, V and V².
    """

    first_index: int
    count: int
    mean_v: float
    variance_v2: float
    sync: bool = False
    called: bool = False

    def samples(self) -> SampleBlock:
        """Samples that might have been: of this mean, and of this variance where even in number."""
        volts = np.full(self.count, self.mean_v, dtype=np.float32)
        deviation_v = math.sqrt(self.variance_v2)
        volts[::2] += deviation_v
        volts[1::2] -= deviation_v
        return SampleBlock(self.first_index, volts, self.sync, self.called)


@dataclass(frozen=True, slots=True)
class FrameLevels:
    """One frame, or one silent slot.

    start: stream index, fractional, at which the first chip begins; sample i is instant i.
    chip_samples: recovered chip duration, samples.
    levels: of the nodes; None where there is nothing but offset and noise in this slot.
    noise_rms_v: noise of one chip's level, V; NaN where unknown.
    offset_v: the line's level in silence, V.
    clipped: share of the frame's samples at a rail, 0…1.
    tied: other words, some chips away, explain the samples as well, or a node was late, and may be
        taken for another: these are a guess.
    """

    start: float
    chip_samples: float
    levels: NodeLevels | None
    noise_rms_v: float
    offset_v: float
    clipped: float
    tied: bool = False


class Attempt(NamedTuple):
    """What a fit makes of the samples.

    levels: of the nodes. amplitude: (n,) float32, V, of every node's word, 0 where silent.
    believable: whether the words account for the chips.
    """

    levels: NodeLevels
    amplitude: NDArray[np.float32]
    believable: bool


_LEAST_STORE = 4096
"""Samples that a buffer has room for from the start."""


class SampleBuffer:
    """The samples still needed, addressed by stream index; float64, V, NaN where absurd."""

    def __init__(self) -> None:
        self.begin = 0
        self.end = 0
        self._store = np.empty(_LEAST_STORE)
        self._at = 0  # place of `begin` in the store

    def restart(self, index: int) -> None:
        """Forget all; the next sample has this index."""
        self.begin = self.end = index
        self._at = 0

    def append(self, volts: NDArray[np.float32]) -> None:
        """The samples that follow."""
        kept = self.end - self.begin
        if self._at + kept + volts.size > self._store.size:
            self._make_room(kept + volts.size)
        place = self._at + kept
        part = self._store[place : place + volts.size]
        part[:] = volts
        if not max(part.max(initial=0.0), -part.min(initial=0.0)) < ABSURD_V:
            part[~(np.abs(part) < ABSURD_V)] = np.nan
        self.end += volts.size

    def take(self, begin: int, end: int) -> Floats:
        """Samples begin…end − 1, as far as they are kept; a view, valid until the next append."""
        first, stop = max(begin, self.begin), max(min(end, self.end), self.begin)
        return self._store[self._at + first - self.begin : self._at + max(stop, first) - self.begin]

    def drop(self, before: int) -> None:
        """Forget samples before an index."""
        count = min(before, self.end) - self.begin
        if count > 0:
            self.begin += count
            self._at += count

    def _make_room(self, size: int) -> None:
        """Move what is kept to the front of a store that holds at least twice as much as needed."""
        kept = self._store[self._at : self._at + self.end - self.begin]
        if 2 * size > self._store.size:
            self._store = np.empty(4 * size)
        self._store[: kept.size] = kept
        self._at = 0


class Timing:
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
        self._samples = SampleBuffer()
        self._fresh = True

    def reset(self) -> None:
        """The stream has a hole: forget the frame in progress."""
        self._fresh = True

    def _continue(self, block: SampleBlock | QuietBlock) -> bool:
        """Whether a block follows the one before; restarts the samples there if not."""
        if not self._fresh and block.first_index == self._samples.end:
            return True
        if not self._fresh:
            self.reset()
        self._samples.restart(block.first_index)
        self._fresh = False
        return False

    def _attempt(self, line: Line, fit: Fit, limit: float, noise: float | None = None) -> Attempt:
        """What a fit makes of the samples, to be believed within a limit of spread.

        Whole chips are the matched filter; their middle is blind to edges a tenth of a chip off.
        It is taken where words are uneven and it makes them more even than noise would by chance.
        """
        start, chip = np.array([fit.start]), np.array([fit.chip])
        words = read_words(integrate(line, start, chip, self.spec), self.spec)
        if words.spread[0] > UNEVEN:
            middle = read_words(integrate(line, start, chip, self.spec, MIDDLE), self.spec)
            if middle.spread[0] < 0.6 * words.spread[0]:
                words = middle
        believable = words.believable(limit, self.spec, noise)
        return Attempt(node_levels(words.rows[0], self.spec), words.amplitude[0], believable)

    def _heard(
        self,
        start: float,
        chip: float,
        levels: NodeLevels,
        offset_v: float,
        clipped: float,
        tied: bool = False,
    ) -> FrameLevels:
        """A frame in which somebody spoke."""
        noise_rms_v = levels.noise_v * math.sqrt(self.spec.order)
        return FrameLevels(start, chip, levels, noise_rms_v, offset_v, clipped, tied)

    def _clipped(self, volts: Floats) -> float:
        """Share of samples within a thousandth of the range of a rail."""
        if self.rails_v is None or not volts.size:
            return 0.0
        low, high = self.rails_v
        margin = 1e-3 * (high - low)
        if volts.min() > low + margin and volts.max() < high - margin:
            return 0.0
        return float(np.mean((volts <= low + margin) | (volts >= high - margin)))
