"""Where in a stretch of samples a frame lies: burst search and chip clock recovery.

No stream state: `gap_timing` feeds it. Times are as in `fit`.

How a frame is found between two gaps. A frame has no preamble, its chip period is stretched by an
unknown 0…11 %, and where two nodes cancel its first or last chips look like the gap. But every
bit carries the same energy (the code rows are orthogonal), so the window of one frame's length
with the most energy holds the frame, and its loud part [first, last] bounds start and end:
last − k·N·T ≤ start ≤ first. Level changes happen on the chip lattice only, so the squared
differences of the line have a spectral line at 1/T, whose phase is the lattice's. That leaves a
few whole-chip shifts for each of a few T. Among these the most likely one (white noise) explains
the most energy of the samples by words of constant amplitude:

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

from .fit import Fit, Floats, Line, integrate, least_power, read_words, refine
from .frame import MAX_STRETCH, FrameSpec

_CLEAR = 10.0
"""A frame is certain if its log-likelihood exceeds that of any other by so much."""
_ASTRAY = 25.0
"""Most that log-likelihood falls off the raster."""
_DISTORTION = 0.02
"""Share of a chip's energy that counts as one unit of log-likelihood at least: jitter, rounding."""
_CELLS = 320
"""Burst search divides a frame into at most about this many cells, whatever its order."""
_LOUD = 6.0
"""A half-chip mean this many noise deviations off the gap level belongs to a frame."""
_LEAST_POWER = 1e-14
"""Power of what is not even rounding, V²."""
_MEDIAN = 0.455
"""Median of the square of a normal variable."""
_MOST_SHIFTS = 64
"""Quiet chips that a frame may begin with, so that the search stays bounded."""
_BATCH = 1 << 18
"""Chips that are looked at at once."""
_TURNS = 4
"""Chips that are looked at together in the search for the chip clock."""
_MAX_LINES = 12
"""Spectral lines that are tried at most."""


@dataclass(frozen=True, slots=True)
class Quiet:
    """Level of the gap, V, and variance of its half-chip means, V²."""

    level: float
    variance: float


@dataclass(frozen=True, slots=True)
class Burst:
    """The loud part of a line: samples first…last, and how far (slack, samples) they may be wrong.

    power: its mean power, V². variance: of half-chip means in the gap, V².
    pause: where it first keeps quiet for longer than a frame would; `last` if it never does.
    """

    first: float
    last: float
    slack: float
    power: float
    variance: float
    pause: float

    @property
    def snr(self) -> float:
        """Power over the variance of half-chip means in the gap."""
        return self.power / self.variance


@dataclass(frozen=True, slots=True)
class Beside:
    """Half-chip means of the gap on either side of a frame, nearest first, V, gap level removed."""

    before: Floats
    after: Floats

    @property
    def level(self) -> float:
        """Their mean, V."""
        both = np.concatenate((self.before, self.after))
        return float(both.mean()) if both.size else 0.0

    def variance(self, guess: float) -> float:
        """Variance of their noise, V²: of differences, which hum leaves alone, and by the median,
        which a piece of a frame does not sway. guess: of the quietest window, which is too low.
        """
        steps = np.concatenate((np.diff(self.before), np.diff(self.after)))
        if steps.size < 8:
            return guess
        median = float(np.sort(np.square(steps))[steps.size // 2])
        return max(median / (2 * _MEDIAN), guess)

    def is_quiet(self, size: int, variance: float, power: float) -> bool:
        """Whether so many on each side are gap: noise, and some hum against a frame's power."""
        for side in (self.before[:size], self.after[:size]):
            if side.size:
                noise = variance * (1.5 + 5 * math.sqrt(2 / side.size))
                drift = abs(float(side.mean())) - 6 * math.sqrt(variance / side.size)
                if drift > 0.2 * math.sqrt(power) or np.square(side).mean() > noise + 0.1 * power:
                    return False
        return True


@dataclass(frozen=True, slots=True)
class Found:
    """The most likely frame; tied: another one, some chips away, is about as likely."""

    fit: Fit
    tied: bool


@dataclass(frozen=True, slots=True)
class Expected:
    """A frame as the one before lets expect it: start, its scatter, chip duration; samples."""

    start: float
    scatter: float
    chip: float


class GapSearch:
    """Finds a frame of one specification between gaps, at one sampling rate.

    spec: the frame's shape. rate_hz: samples per second.
    """

    def __init__(self, spec: FrameSpec, rate_hz: float) -> None:
        """Derive the search's lengths; all in samples but where the name says otherwise."""
        self.spec = spec
        self.chip = rate_hz * spec.chip_s
        self.period = rate_hz * spec.frame_period_s
        self.shortest = spec.chips * self.chip
        self.longest = self.shortest * (1 + MAX_STRETCH)
        self.half = max(1, round(self.chip / 2))
        gap = max(self.period - self.longest, 0.3 * (self.period - self.shortest))
        self.quiet_halves = max(8, int(0.6 * gap / self.half))
        self.gap_size = math.ceil(max(self.period - self.longest, 5 * self.chip))
        self._mean = np.full(self.half, 1 / self.half)
        self.least_power = least_power(spec)

    @cached_property
    def snr_floor(self) -> float:
        """Mean excess power of a frame, in gap variances, that noise practically never reaches."""
        return 0.1 + 6.0 * math.sqrt(self.half / self.shortest)

    @cached_property
    def _tones(self) -> tuple[int, Floats]:
        """A block of about four chips of middling stretch: its length, and cosine and −sine of four
        whole turns in it, (block, 2)."""
        block = round(_TURNS * self.chip * (1 + MAX_STRETCH / 2))
        angle = 2 * np.pi * _TURNS * np.arange(block) / block
        return block, np.stack((np.cos(angle), -np.sin(angle)), axis=1)

    def quiet(self, volts: Floats, known: Quiet | None) -> list[Quiet]:
        """The gap's level: of the quietest window, judged from the known level if there is one.

        volts: (m,) float64, V. Returns candidates, most likely first; there are others only where
        a lone node on row 0 may hold the line at a constant level: equal bits on end are as quiet
        as the gap, at −a or +a or, in turns, both, and then the gap is midway.
        """
        means = self._halves(volts)
        width = min(self.quiet_halves, means.size)
        if width < 4:
            return []
        centre = float(np.median(means)) if known is None else known.level
        sums = _window_sums(means - centre, width) / width
        power = _window_sums(np.square(means - centre), width) / width
        variance = np.maximum(power - np.square(sums), 0.0)
        if known is not None:
            best = int(np.argmin(power))
            fresh = 1.2 * float(variance[best])  # a minimum over windows is biased low
            return [Quiet(centre + float(sums[best]), 0.7 * known.variance + 0.3 * fresh)]
        floor = float(variance.min()) + 1e-6 * float(power.max())
        found: list[Quiet] = []
        levels = 3 if self.spec.first_row == 0 else 1
        while len(found) < levels and (lowest := float(variance.min())) <= 4 * floor:
            level = float(sums[int(np.argmin(variance))])
            found.append(Quiet(centre + level, 1.2 * lowest))
            variance[np.abs(sums - level) <= 4 * math.sqrt(floor)] = np.inf
        if len(found) == 3:
            low, middle, high = sorted(found, key=lambda quiet: quiet.level)
            uneven = abs(high.level + low.level - 2 * middle.level)
            return [middle] if uneven < 0.2 * (high.level - low.level) else found[:2]
        return found

    def burst(self, volts: Floats, variance: float) -> Burst | None:
        """The window of one frame's length with the most energy, cut to its loud part.

        volts: (m,) float64, V, gap level removed. None where there is nothing but noise.
        """
        energy = np.square(self._halves(volts))
        group = max(1, round(self.shortest / self.half) // _CELLS)
        cells = energy[: energy.size // group * group].reshape(-1, group).mean(axis=1)
        size = self.half * group
        low, high = int(self.shortest / size), int(self.longest / size) + 1
        low = min(low, cells.size)
        if low < 8:
            return None
        sums = _window_sums(cells, low)
        peak = float(sums.max()) / low
        variance = max(variance, 1e-8 * peak)
        power = peak - variance
        if power < max(_LEAST_POWER, self.snr_floor * variance, self.least_power):
            return None
        # Of all windows of a possible length, the one with the greatest excess over half of the
        # frame's power; then cut quiet cells from its ends.
        gain = np.concatenate(([0.0], np.cumsum(cells - (variance + 0.5 * power))))
        ends = np.concatenate((gain[low:], np.full(high - low, -np.inf)))
        gains = np.lib.stride_tricks.sliding_window_view(ends, high - low + 1)
        begin = int(np.argmax(gains.max(axis=1) - gain[: len(gains)]))
        end = begin + low + int(np.argmax(gains[begin]))
        bit = int(np.ceil(self.spec.order * self.chip / size)) + 1
        first = begin + int(np.argmin(gain[begin : begin + bit + 1]))
        last = end - bit + int(np.argmax(gain[end - bit : end + 1])) if end > bit else end
        # Loud half chips are sharper than that, and reach beyond where chips are small.
        first, last = first * group, last * group
        node_power = max(self.least_power, power / (16 * self.spec.nodes))  # hum stays below
        loud = energy > max(_LOUD**2 * variance, node_power)
        before = np.flatnonzero(loud[max(0, first - bit * group) : first + group])
        after = np.flatnonzero(loud[last - group : last + bit * group])
        if before.size:
            first += int(before[0]) - min(first, bit * group)
        if after.size:
            last += int(after[-1]) + 1 - group
        snr = power / variance
        slack = self.chip * (1.5 + 60.0 / snr)
        if not (before.size and after.size):
            slack += size - self.half
        # Every bit has the same energy, and any two bits' time holds a whole one.
        pause, width = last, math.ceil(2 * (1 + MAX_STRETCH) * bit) * group
        if snr > 8 and last - first > width:
            powers = _window_sums(energy[first:last], width) / width - variance
            quiet = np.flatnonzero(powers < 0.2 * power)
            if quiet.size:
                pause = first + int(quiet[0])
                rest = np.flatnonzero(loud[pause : pause + width])
                pause += int(rest[-1]) + 1 if rest.size else 0
        edges = np.array([first, last, pause]) * self.half - 0.5
        return Burst(float(edges[0]), float(edges[1]), slack, power, variance, float(edges[2]))

    def fits(self, line: Line, burst: Burst, last: Expected | None) -> Iterator[Found]:
        """Frames around a burst, the first one that the samples bear out is it.

        last: what the frame before makes likely. If that is sharp, a frame on its raster that is
        loud from end to end comes first, which saves work; then the most likely one of all. The
        last chip duration is tried too: words with few level changes show little of their own.
        The raster decides where energies can't: with natural signs and the same word everywhere
        only one chip per bit is loud, and rows are shifts of each other, so that two nodes which
        cancel in their first and last chips may look exactly like two others, a few chips later.
        Without a raster, and after long silence, such frames are tied, and a loud first chip is
        the better guess.
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
        """Log-likelihood in white noise, no sharper than waveforms keep to the model, (c,)."""
        energy = self.spec.chips * chips * power
        unit = _DISTORTION / self.spec.chips * float(energy.max())
        score: Floats = energy / max(2 * self.half * burst.variance, unit, 1e-30)
        if last is not None:
            off = np.square((starts - last.start) / last.scatter)
            score -= np.minimum(0.5 * off, _ASTRAY)
        return score

    def _refined(self, line: Line, fit: Fit, tied: bool) -> Iterator[Found]:
        """The frame with its exact timing, if that is possible."""
        fit = refine(line, fit, self.spec)
        if 0.99 * self.chip <= fit.chip <= 1.01 * (1 + MAX_STRETCH) * self.chip:
            yield Found(fit, tied)

    def _chip_lines(self, volts: Floats, burst: Burst) -> list[tuple[float, float]]:
        """(chip duration, instant of some chip edge) for each strong line of squared differences.

        Levels are averaged over half a chip on either side of a difference against noise. Only
        frequencies near 1/chip matter: blocks of four chips are mixed down by a frequency of
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
    ) -> tuple[Floats, Floats, NDArray[np.float32]]:
        """Every whole-chip start that lets a frame cover the burst.

        edge, chip: (q,) an instant of some chip edge and the duration, for each clock. Returns
        starts, chip durations and powers of the words, (c,) each. Quiet chips at either end of a
        frame are fewer than a bit's.
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
        batches = min(chip.size, 1 + starts.size * spec.chips // _BATCH)
        powers = [
            self._powers(line, low[some], chip[some], shifts.size)
            for some in np.array_split(np.arange(chip.size), batches)
        ]
        power = np.concatenate(powers)[possible]
        return starts[possible], np.broadcast_to(chip[:, None], starts.shape)[possible], power

    def _powers(self, line: Line, low: Floats, chip: Floats, count: int) -> NDArray[np.float32]:
        """Power of the words for so many starts, a chip apart, of each clock, (q, count)."""
        spec, span = self.spec, self.spec.span_chips
        levels = line.means(low[:, None] + chip[:, None] * np.arange(span + count))
        windows = np.lib.stride_tricks.sliding_window_view(levels, span, axis=1)
        chips = windows[..., spec.places].reshape(-1, spec.line_bits, spec.order)
        return read_words(chips, spec).power.reshape(-1, count)

    def beside(self, volts: Floats, fit: Fit) -> Beside:
        """What lies up to a gap's length beside a frame; a chip next to it is left out."""
        first, end = int(fit.start - fit.chip), math.ceil(fit.end(self.spec) + fit.chip)
        before = volts[max(0, first - self.gap_size) : max(0, first)]
        return Beside(self._halves(before[::-1]), self._halves(volts[end : end + self.gap_size]))

    def _halves(self, volts: Floats) -> Floats:
        """Means of consecutive half chips, (m // half,)."""
        count = volts.size // self.half
        means: Floats = volts[: count * self.half].reshape(count, self.half) @ self._mean
        return means


def _window_sums(values: Floats, width: int) -> Floats:
    """Sums of all windows of this many values, (m − width + 1,)."""
    sums = np.concatenate((np.zeros(1), np.cumsum(values)))
    windows: Floats = np.subtract(sums[width:], sums[:-width])
    return windows
