# SPDX-License-Identifier: Apache-2.0

"""Recovers the chip clock of a burst, and chooses among all frames that it could be.

No stream state: `gap_timing` feeds it. Times are as in `fit`.

How a frame is found between two gaps. A frame has no preamble, its chip period is stretched by an
unknown 0…11 %, and where two nodes cancel its first or last chips look like the gap. But its loud
part [first, last] (`burst`) bounds start and end: last − k·N·T ≤ start ≤ first. Level changes
happen on the chip lattice only, so the squared differences of the line have a spectral line at
1/T, whose phase is the lattice's. That leaves a few whole-chip shifts for each of a few T. Among
these the most likely one (white noise) explains the most energy of the samples by words of
constant amplitude:

    E(start, T) = k·N·T · Σ_active nodes (mean over bits of |r|)²,      r = correlations.

A wrong shift or period makes |r| vary from bit to bit or leaves loud samples out, and both cost
energy. With the words known, every level change of the model tells by how much it comes late;
weighted linear regression over all of them gives the final start and T (and averages jitter that
does not accumulate).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats, Floats32
from ..code.frame import MAX_STRETCH
from .burst import Burst, BurstSearch
from .fit import CHIPS_AT_ONCE, Fit, Line, integrate, read_words, refine

_CLEAR = 10.0
"""Margin of log-likelihood over every rival with which a frame counts as certain. Chosen: odds of
2·10⁴ if noise is white."""
_ASTRAY = 25.0
"""Largest penalty, in log-likelihood, for a start off the raster: seven of its deviations. Chosen:
beyond that a frame has been delayed, and it no longer matters how far."""
_DISTORTION = 0.02
"""Share of a chip's energy that counts as at least one unit of log-likelihood, for jitter and
rounding, which limit how far a line without noise tells candidates apart. Chosen."""
_MOST_SHIFTS = 64
"""Largest number of silent chips that a frame may begin with; bounds the search. Chosen."""
_TURNS = 4
"""Chips per block in the search for the chip clock: its band of 11 % then is 0.4 turns wide."""
_MAX_LINES = 12
"""Spectral lines that are tried at most. Chosen."""


@dataclass(frozen=True, slots=True)
class Found:
    """A likely frame; tied: another one, some chips away, is about as likely."""

    fit: Fit
    tied: bool


@dataclass(frozen=True, slots=True)
class Expected:
    """A frame as expected after the one before: start, its scatter, chip duration; samples."""

    start: float
    scatter: float
    chip: float


class GapSearch(BurstSearch):
    """Finds a frame of one specification between gaps, at one sampling rate."""

    def fits(self, line: Line, burst: Burst, last: Expected | None) -> Iterator[Found]:
        """Candidate frames around a burst, best first: take the first that the samples bear out.

        last: what the frame before makes likely. If that is sharp, a frame on its raster that is
        loud from end to end comes first, which saves work; then the most likely one of all. The
        last chip duration is tried, too: words with few level changes show little of their own.
        The raster decides where energies can't: with natural signs and the same word everywhere
        only one chip per bit is loud, and rows are shifts of each other, so two nodes that cancel
        in their first and last chips may look exactly like two others, a few chips later. Without
        a raster, and after long silence, such frames are tied, and a loud first chip is the better
        guess.
        """
        spec, loud = self.spec, burst.last - burst.first
        if not self.shortest - 1.5 * spec.order * self.chip <= loud + 2 * burst.slack:
            return
        if loud - 2 * burst.slack > self.longest:
            return
        clocks = self._chip_lines(line.volts, burst)
        for chip in (loud / spec.span_chips, *((last.chip,) if last else ())):
            clocks += [(chip, burst.first), (chip, burst.last)]
        chip, edge = np.array(clocks).T
        if last and last.scatter < 0.5 * self.chip:
            start = edge + np.rint((last.start - edge) / chip) * chip
            words = read_words(integrate(line, start, chip, spec), spec)
            best = int(np.argmax(self._score(start, chip, words.power, burst, last)))
            fit = Fit(start[best], chip[best])
            if abs(fit.start - burst.first) + abs(fit.end(spec) - burst.last) < 1.25 * fit.chip:
                yield from self._refined(line, fit, tied=False)
        starts, chips, power = self._shifts(line, burst, edge, chip)
        if not starts.size:
            return
        score = self._score(starts, chips, power, burst, last)
        guess = score - np.log1p(np.square((starts - burst.first) / (0.5 * self.chip)))
        best = int(np.argmax(guess))
        rivals = score[np.abs(starts - starts[best]) > 0.5 * self.chip]
        tied = bool(rivals.max(initial=-np.inf) > score[best] - _CLEAR)
        yield from self._refined(line, Fit(starts[best], chips[best]), tied)

    def _score(
        self,
        starts: Floats,
        chips: Floats,
        power: NDArray[np.floating],
        burst: Burst,
        last: Expected | None,
    ) -> Floats:
        """Log-likelihood in white noise, no sharper than _DISTORTION allows, (c,)."""
        energy = self.spec.chips * chips * power
        unit = _DISTORTION / self.spec.chips * float(energy.max())
        score: Floats = energy / max(2 * self.half * burst.variance, unit, 1e-30)
        if last is not None:
            off = np.square((starts - last.start) / last.scatter)
            score -= np.minimum(0.5 * off, _ASTRAY)
        return score

    def _refined(self, line: Line, fit: Fit, tied: bool) -> Iterator[Found]:
        """The frame with its exact timing, if its chips have a possible duration."""
        fit = refine(line, fit, self.spec)
        if 0.99 * self.chip <= fit.chip <= 1.01 * (1 + MAX_STRETCH) * self.chip:
            yield Found(fit, tied)

    @cached_property
    def _tones(self) -> tuple[int, Floats]:
        """Length of a block of _TURNS chips of middling stretch; cosine, −sine, (block, 2)."""
        block = round(_TURNS * self.chip * (1 + MAX_STRETCH / 2))
        angle = 2 * np.pi * _TURNS * np.arange(block) / block
        return block, np.stack((np.cos(angle), -np.sin(angle)), axis=1)

    def _chip_lines(self, volts: Floats, burst: Burst) -> list[tuple[float, float]]:
        """(chip duration, instant of some chip edge) for each strong line of squared differences.

        To reduce noise, levels are averaged over half a chip on either side of a difference. Only
        frequencies near 1/chip matter: blocks of _TURNS chips are mixed down by a frequency of
        whole turns per block, and what is left varies slowly.
        """
        begin = max(0, int(burst.first - burst.slack))
        sums = np.concatenate(([0.0], np.cumsum(volts[begin : int(burst.last + burst.slack) + 2])))
        h = self.half if self.chip >= 5 else 1
        steps = np.square(sums[2 * h :] - 2 * sums[h:-h] + sums[: -2 * h])
        steps -= steps.sum() / steps.size
        block, tones = self._tones
        count = steps.size // block
        mixed = steps[: count * block].reshape(count, block) @ tones
        size = 1 << int(4 * count - 1).bit_length()
        spectrum = np.fft.fft(mixed[:, 0] + 1j * mixed[:, 1], size)
        low = math.floor((block / (self.chip * (1 + MAX_STRETCH) * 1.004) - _TURNS) * size)
        high = math.ceil((block / (self.chip * 0.996) - _TURNS) * size)
        bins = np.arange(low - 1, high + 2)
        band = spectrum[bins]  # negative ones are at its end
        power = np.abs(band)
        inner = power[1:-1]
        peaks = np.flatnonzero((inner >= power[:-2]) & (inner > power[2:]))
        peaks = peaks[inner[peaks] > 0.5 * inner.max()]
        peaks = peaks[np.argsort(-inner[peaks])][:_MAX_LINES]
        left, mid, right = power[peaks], power[peaks + 1], power[peaks + 2]
        shift = 0.5 * (left - right) / (left - 2 * mid + right)
        offset = (bins[peaks + 1] + shift) / size  # turns per block off the mixing frequency
        frequency = (_TURNS + offset) / block
        # The phase turns by about π·(count/size) per bin off the peak, and by the offset within
        # half a block.
        phase = np.angle(band[peaks + 1]) - np.pi * (
            shift * count / size + offset * (1 - 1 / block)
        )
        edge = begin + h - 0.5 - phase / (2 * np.pi * frequency)
        return list(zip((1 / frequency).tolist(), edge.tolist(), strict=True))

    def _shifts(
        self, line: Line, burst: Burst, edge: Floats, chip: Floats
    ) -> tuple[Floats, Floats, Floats32]:
        """Every whole-chip start that lets a frame cover the burst.

        edge, chip: (q,) an instant of some chip edge and the duration, for each clock. Returns
        starts, chip durations and powers of the words, (c,) each. A frame is taken to have less
        than a bit's silent chips at either end.
        """
        spec, span = self.spec, self.spec.span_chips
        length, bit = span * chip, spec.order * chip
        low = np.maximum(burst.last - length, burst.first - bit) - burst.slack
        high = np.minimum(burst.first, burst.last + bit - length) + burst.slack
        low = np.maximum(low, burst.first - burst.slack - _MOST_SHIFTS * chip)
        low = edge + np.ceil((low - edge) / chip) * chip
        shifts = np.arange(max(1, int(np.max((high - low) / chip)) + 1))
        starts = low[:, None] + shifts * chip[:, None]
        possible = starts <= high[:, None]
        batches = min(chip.size, 1 + starts.size * spec.chips // CHIPS_AT_ONCE)
        powers = [
            self._powers(line, low[some], chip[some], shifts.size)
            for some in np.array_split(np.arange(chip.size), batches)
        ]
        power = np.concatenate(powers)[possible]
        return starts[possible], np.broadcast_to(chip[:, None], starts.shape)[possible], power

    def _powers(self, line: Line, low: Floats, chip: Floats, count: int) -> Floats32:
        """Power of the words for `count` starts, a chip apart, of each clock, (q, count)."""
        spec, span = self.spec, self.spec.span_chips
        levels = line.means(low[:, None] + chip[:, None] * np.arange(span + count))
        windows = np.lib.stride_tricks.sliding_window_view(levels, span, axis=1)
        chips = windows[..., spec.places].reshape(-1, spec.line_bits, spec.order)
        return read_words(chips, spec).power.reshape(-1, count)
