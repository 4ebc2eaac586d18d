# SPDX-License-Identifier: Apache-2.0

"""Proposes where a frame between two gaps begins, and how long its chips last.

No stream state: `gap_timing` feeds it, and the kernel's certificate judges what it proposes. Times
are in samples; levels are means of half chips: short enough for every chip to show, and less noisy
than samples.

How a frame is found. It has no preamble, its chip period is stretched by an unknown 0…11 %, and
where two nodes cancel its first or last chips look like the gap. Every bit of it carries the same
energy (the code rows are orthogonal), so the window of one frame's length with the most energy
holds it. Its loud part [first, last] bounds start and end: last − k·N·T ≤ start ≤ first. Level
changes happen on the chip lattice only, so the squared differences of the line have a spectral line
at 1/T, whose phase is the lattice's. That leaves a few whole-chip shifts for each of a few T. Of
these the most likely one (white noise) explains the most energy by words of constant amplitude: a
wrong shift or period makes levels vary from bit to bit or leaves loud samples out.
"""

from __future__ import annotations

import math
from functools import cached_property
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from ...base import kernel
from ...base.arrays import Floats, Floats32
from ...base.stage import stage
from ...code.frame import MAX_STRETCH
from ...words.limits import LIMITS
from ..frame_reader import TIED, FrameReader

CELLS = 320
"""Most cells, about, that the search for a burst divides a frame into: bounds its cost."""
LOUD = LIMITS.unknown_noise
"""Deviations of noise beyond which a level is none of noise, and its mean over a frame."""
FAINT = LIMITS.faint_bit
"""Share of a node's amplitude below which nothing is a burst."""
QUIET = 0.6
"""Share of a gap in which its level is measured: clear of both frames wherever it begins."""
SETTLING = 1.5
"""Chips beside a frame in which the line comes to rest: low-passes, late nodes."""
MOST_SILENT = 64
"""Most silent chips that a frame may begin with, and by which noise at an SNR of 1 hides the ends
of a burst; bounds the search."""
TURNS = 4
"""Chips per block in the search for the chip clock: its band of 11 % then is 0.4 turns wide."""
MOST_LINES = 12
"""Spectral lines that are tried at most."""


@stage
class Gap:
    """The line between frames.

    level: V. variance: of its half-chip means, V². begin, size: samples in which it was measured.
    """

    level: float
    variance: float
    begin: int
    size: int


class Burst(NamedTuple):
    """The loud part of a line: samples first…last, each uncertain by `slack` samples.

    may_be_noise: whether noise is once in a while as loud.
    """

    first: float
    last: float
    slack: float
    may_be_noise: bool


class GapSearch:
    """Finds bursts between gaps, and frames in them; lengths are in samples."""

    def __init__(self, reader: FrameReader, rate_hz: float) -> None:
        """rate_hz: samples per second."""
        spec = reader.spec
        self._reader, self._spec = reader, spec
        self.chip = reader.chip
        self.period = rate_hz * spec.frame_period_s
        self.shortest = spec.span_chips * self.chip
        self.longest = self.shortest * (1 + MAX_STRETCH)
        self.half = max(1, round(self.chip / 2))
        self.gap = max(self.period - self.longest, 0.3 * (self.period - self.shortest))
        self.bit = math.ceil((1 + MAX_STRETCH) * spec.order * self.chip)
        self._width = max(8, int(QUIET * self.gap / self.half))
        self._group = max(1, round(self.shortest / self.half) // CELLS)  # half chips of a cell
        cell = self.half * self._group
        self._low, self._high = int(self.shortest / cell), int(self.longest / cell) + 1
        self._bit_cells = math.ceil(spec.order * self.chip / cell) + 1
        self._steady = spec.first_row == 0 and not spec.scramble
        # Mean excess power of a frame's length, in variances, that noise practically never reaches.
        self._least_snr = 0.1 + LOUD * math.sqrt(self.half / self.shortest)

    def gaps(self, volts: Floats32, known_v: float | None) -> list[Gap]:
        """Return what may be the gap, most likely first: the quietest window.

        volts: (m,), V. known_v: the gap's level, if known. There are others only where it is not
        and a lone node on row 0 may hold the line at a constant level: equal bits on end are as
        quiet as the gap, at −a or +a or, in turns, both, and then the gap is midway.
        """
        means = self._halves(volts)
        width = min(self._width, means.size)
        if width < 4:
            return []
        centre = float(np.median(means)) if known_v is None else known_v
        level = _window_sums(means - centre, width) / width
        power = _window_sums(np.square(means - centre), width) / width
        variance = np.maximum(power - np.square(level), 0.0)
        size = width * self.half
        if known_v is not None:
            best = int(np.argmin(power))
            least = _usual(variance[power <= 4 * float(power[best])], width)
            return [Gap(centre + float(level[best]), least, best * self.half, size)]
        floor = float(variance.min()) + 1e-6 * float(power.max())
        found: list[Gap] = []
        most = 3 if self._steady else 1
        while len(found) < most and (lowest := float(variance.min())) <= 4 * floor:
            best = int(np.argmin(variance))
            there = float(level[best])
            usual = _usual(variance[variance <= 4 * lowest], width)
            found.append(Gap(centre + there, usual, best * self.half, size))
            variance[np.abs(level - there) <= 4 * math.sqrt(floor)] = np.inf
        if len(found) == 3:
            low, middle, high = sorted(found, key=lambda gap: gap.level)
            off_middle = abs(high.level + low.level - 2 * middle.level)
            return [middle] if off_middle < 0.2 * (high.level - low.level) else found[:2]
        return found

    @property
    def views(self) -> tuple[bool, ...]:
        """In which views bursts are looked for, see first_burst.

        A word on row 0 may hold the line at one level, where its moves show nothing.
        """
        return (False, True) if self._steady else (True,)

    def first_burst(self, volts: Floats32, gap: Gap, moves: bool, swing_v: float) -> Burst | None:
        """Return the earliest burst: the strongest one may have a weaker one before it.

        volts: (m,), V. moves: loud is what moves from chip to chip, which hum does not, else what
        is off the gap's level. swing_v: amplitude of a node; 0: unknown. None where there is
        nothing but noise.
        """
        found, levels = None, self._halves(volts) - gap.level
        if moves:
            before = np.concatenate((levels[:1], levels[:1], levels[:-2]))
            levels = (levels - before) * math.sqrt(0.5)
        while burst := self._burst(levels, gap.variance, (FAINT * swing_v) ** 2):
            if found and burst.may_be_noise:
                break  # the frame after it is in view
            if moves:  # so far after its end
                burst = burst._replace(last=burst.last - 2 * self.half)
            found = burst
            end = int((found.first - self.chip) / self.half)
            if end * self.half < self.shortest:
                break
            levels = levels[:end]
        return found

    def frame(
        self, volts: Floats32, burst: Burst, chips: tuple[float, ...]
    ) -> tuple[float, float] | None:
        """Return start and chip duration of the frame that explains the most energy of a burst.

        volts: (m,), V, whose level at rest the reader knows. chips: durations that are tried
        besides those that the burst itself shows.
        """
        clocks = self._chip_lines(volts, burst)
        for chip in ((burst.last - burst.first) / self._spec.span_chips, *chips):
            clocks += [(chip, burst.first), (chip, burst.last)]
        found: list[tuple[float, float, float]] = []
        for chip, edge in clocks:
            low, high = self._range(burst, chip)
            low = edge + math.ceil((low - edge) / chip) * chip
            count = 1 + math.floor((high - low) / chip)
            if count < 1:
                continue
            energy = chip * self._reader.explained(volts, low, chip, count)
            found += [(e, low + i * chip, chip) for i, e in enumerate(energy.tolist())]
        if not found:
            return None
        # Two nodes that cancel at the start of every bit are possible, but not likely.
        likely = (1 - TIED) * max(found)[0]
        _, start, chip = min(
            (each for each in found if each[0] >= likely),
            key=lambda each: (round(abs(each[1] - burst.first) / self.chip), -each[0]),
        )
        return start, chip

    def misses_one(self, noise: float) -> bool:
        """Whether a node that speaks alone may pass for noise: variance of a chip's level, V²."""
        swing_v = self._reader.swing_v
        variance = noise * self.chip / self.half
        return swing_v is not None and swing_v**2 < 2 * self._least_snr * variance

    def quiet_after(self, volts: Floats32, gap: Gap, burst: Burst) -> int:
        """Return where the line is first as quiet as the gap after a burst that is no frame."""
        width = gap.size // self.half
        power = _window_sums(np.square(self._halves(volts) - gap.level), width) / width
        after = int((burst.first + self.bit) / self.half)
        quiet = np.flatnonzero(power[after:] <= 4 * gap.variance)
        return (after + int(quiet[0])) * self.half if quiet.size else 0

    def _burst(self, levels: Floats, variance: float, least_power: float) -> Burst | None:
        """Return the window of one frame's length with the most energy, cut to its loud part.

        levels: of half chips, V, without that of the gap; variance: of those in the gap, V².
        least_power: of a node that is no noise, V².
        """
        energy = np.square(levels)
        group, bit = self._group, self._bit_cells
        cells = energy[: energy.size // group * group].reshape(-1, group).mean(axis=1)
        low, high = min(self._low, cells.size), self._high
        if low < 8:
            return None
        peak = float(_window_sums(cells, low).max()) / low
        variance = max(variance, 1e-8 * peak)
        power = peak - variance
        if power <= max(self._least_snr * variance, least_power):
            return None
        # Of all windows of a possible length, the one with the greatest excess over half of the
        # frame's power; then cut quiet cells from its ends.
        gain = np.concatenate(([0.0], np.cumsum(cells - (variance + 0.5 * power))))
        ends = np.concatenate((gain[low:], np.full(high - self._low, -np.inf)))
        gains = np.lib.stride_tricks.sliding_window_view(ends, high - self._low + 1)
        begin = int(np.argmax(gains.max(axis=1) - gain[: len(gains)]))
        end = begin + low + int(np.argmax(gains[begin]))
        first = begin + int(np.argmin(gain[begin : begin + bit + 1]))
        last = end - bit + int(np.argmax(gain[end - bit : end + 1])) if end > bit else end
        # Loud half chips are sharper than that, and reach beyond where chips are small.
        first, last = first * group, last * group
        node_power = max(least_power, power / (16 * self._spec.nodes))  # hum stays below
        loud = energy > max(LOUD**2 * variance, node_power)
        before = np.flatnonzero(loud[max(0, first - bit * group) : first + group])
        after = np.flatnonzero(loud[last - group : last + bit * group])
        if before.size:
            first += int(before[0]) - min(first, bit * group)
        if after.size:
            last += int(after[-1]) + 1 - group
        slack = self.chip * (SETTLING + MOST_SILENT * variance / power)
        if not (before.size and after.size):
            slack += self.half * (group - 1)
        may_be_noise = power < 2 * self._least_snr * variance
        return Burst(first * self.half - 0.5, last * self.half - 0.5, slack, may_be_noise)

    def _halves(self, volts: Floats32) -> Floats:
        """Return means of consecutive half chips, (m // half,)."""
        count = volts.size // self.half
        halves = volts[: count * self.half].reshape(count, self.half)
        means: Floats = halves.mean(axis=1, dtype=np.float64)
        return means

    @cached_property
    def _tones(self) -> tuple[int, Floats]:
        """Length of a block of TURNS chips of middling stretch; cosine, −sine, (block, 2)."""
        block = round(TURNS * self.chip * (1 + MAX_STRETCH / 2))
        angle = 2 * np.pi * TURNS * np.arange(block) / block
        return block, np.stack((np.cos(angle), -np.sin(angle)), axis=1)

    def _chip_lines(self, volts: Floats32, burst: Burst) -> list[tuple[float, float]]:
        """(chip duration, instant of some chip edge) for each strong line of squared differences.

        To reduce noise, levels are averaged over half a chip on either side of a difference. Only
        frequencies near 1/chip matter: blocks of TURNS chips are mixed down by a frequency of
        whole turns per block, and what is left varies slowly.
        """
        begin = max(0, int(burst.first - burst.slack))
        seen = volts[begin : int(burst.last + burst.slack) + 2]
        sums = np.concatenate(([0.0], np.cumsum(seen, dtype=np.float64)))
        h = self.half if self.chip >= 5 else 1
        steps = np.square(sums[2 * h :] - 2 * sums[h:-h] + sums[: -2 * h])
        steps -= steps.sum() / steps.size
        block, tones = self._tones
        count = steps.size // block
        mixed = steps[: count * block].reshape(count, block) @ tones
        size = 1 << int(4 * count - 1).bit_length()
        spectrum = np.fft.fft(mixed[:, 0] + 1j * mixed[:, 1], size)
        low = math.floor((block / (self.chip * (1 + MAX_STRETCH) * 1.004) - TURNS) * size)
        high = math.ceil((block / (self.chip * 0.996) - TURNS) * size)
        bins = np.arange(low - 1, high + 2)
        band = spectrum[bins]  # negative ones are at its end
        power = np.abs(band)
        inner = power[1:-1]
        peaks = np.flatnonzero((inner >= power[:-2]) & (inner > power[2:]))
        peaks = peaks[inner[peaks] > 0.5 * inner.max()]
        peaks = peaks[np.argsort(-inner[peaks])][:MOST_LINES]
        left, mid, right = power[peaks], power[peaks + 1], power[peaks + 2]
        shift = 0.5 * (left - right) / (left - 2 * mid + right)
        offset = (bins[peaks + 1] + shift) / size  # turns per block off the mixing frequency
        frequency = (TURNS + offset) / block
        # The phase turns by about π·(count/size) per bin off the peak, and by the offset within
        # half a block.
        phase = np.angle(band[peaks + 1]) - np.pi * (
            shift * count / size + offset * (1 - 1 / block)
        )
        edge = begin + h - 0.5 - phase / (2 * np.pi * frequency)
        return list(zip((1 / frequency).tolist(), edge.tolist(), strict=True))

    def _range(self, burst: Burst, chip: float) -> tuple[float, float]:
        """Return earliest and latest start with which a frame of such chips covers a burst.

        It is taken to have less than a bit's silent chips at either end.
        """
        length, bit = self._spec.span_chips * chip, self._spec.order * chip
        low = max(burst.last - length, burst.first - bit, burst.first - MOST_SILENT * chip)
        return low - burst.slack, min(burst.first, burst.last + bit - length) + burst.slack


def _usual(quiet: Floats, width: int) -> float:
    """Return the variance of noise, of which windows of so many levels show these.

    Where nobody spoke, so many are of the gap that the least is half of them all: the tenth part of
    them is quieter than the one that is taken, and noise than that by chance.
    """
    tenth = 0.1
    chance: float = kernel.lib.certificate_chance(width - 1, NormalDist().inv_cdf(tenth))
    return float(np.quantile(quiet, tenth)) / chance


def _window_sums(values: Floats, width: int) -> Floats:
    """Return the sums of all windows of this many values, (m − width + 1,)."""
    sums = np.concatenate((np.zeros(1), np.cumsum(values)))
    return np.subtract(sums[width:], sums[:-width])
