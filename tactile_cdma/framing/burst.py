# SPDX-License-Identifier: Apache-2.0

"""Finds the loud part of a stretch of samples, and measures the gap beside it.

No stream state. Levels are means of half chips: short enough for every chip to show, and less noisy
than samples. Every bit of a frame carries the same energy (the code rows are orthogonal), so the
window of one frame's length with the most energy holds the frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..base.arrays import Floats
from ..code.frame import MAX_STRETCH, FrameSpec
from .fit import Fit, least_power
from .limits import LIMITS

_CELLS = 320
"""Most cells, about, that the burst search divides a frame into, whatever its order. Chosen: bounds
its cost."""
_LOUD = 6.0
"""Noise deviations off the gap level beyond which a half-chip mean belongs to a frame. Chosen:
noise exceeds that once in 5·10⁸."""
_LEAST_POWER = 1e-14
"""Power below which there is not even rounding, V²: (0.1 µV)²."""
_CALMER = 1000.0
"""Ratio of the known variance of the gap to the newest one beyond which it is no chance: what had
raised it is over. Chosen."""
_DRIFTING = 4.0
"""Ratio of a gap's variance to that of its differences beyond which the rest is drift, not noise.
Chosen: noise alone gets to 1.8 (20 differences)."""
_MEDIAN = 0.455
"""Median of the square of a normal variable."""


@dataclass(frozen=True, slots=True)
class Quiet:
    """Level of the gap, V, and variance of its half-chip means, V².

    begin: first sample of the window in which it was measured.
    """

    level: float
    variance: float
    begin: int


@dataclass(frozen=True, slots=True)
class Burst:
    """The loud part of a line: samples first…last, each uncertain by `slack` samples.

    power: its mean power, V². variance: of half-chip means in the gap, V².
    pause: where it is first silent for longer than a frame would be; `last` if it never is.
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
        """Variance of their noise, V².

        guess: of the quietest window, which is too low, or far too high where the line drifts.
        Taken from differences, which cancel hum, by their median, which a piece of a frame does
        not sway.
        """
        steps = np.concatenate((np.diff(self.before), np.diff(self.after)))
        if steps.size < 8:
            return guess
        median = float(np.sort(np.square(steps))[steps.size // 2])
        noise = median / (2 * _MEDIAN)
        return max(noise, min(guess, _DRIFTING * noise) if noise else guess)

    def is_quiet(self, size: int, variance: float, power: float) -> bool:
        """Whether the nearest `size` on each side are gap: noise, and little hum."""
        for side in (self.before[:size], self.after[:size]):
            if side.size:
                noise = variance * (1.5 + 5 * math.sqrt(2 / side.size))
                drift = abs(float(side.mean())) - 6 * math.sqrt(variance / side.size)
                excess = float(np.square(side).mean()) - noise
                if drift > LIMITS.beside_level * math.sqrt(power) or excess > LIMITS.beside * power:
                    return False
        return True


class BurstSearch:
    """Finds what is loud between gaps, for frames of one specification at one sampling rate.

    spec: the frame's shape. rate_hz: samples per second.
    """

    def __init__(self, spec: FrameSpec, rate_hz: float) -> None:
        """Derive the lengths of the search, in samples unless the name says otherwise."""
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
        """Mean excess power of a window, in gap variances, that noise practically never reaches."""
        return 0.1 + 6.0 * math.sqrt(self.half / self.shortest)

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
            smooth = min(0.7 * known.variance + 0.3 * fresh, _CALMER * fresh)
            return [Quiet(centre + float(sums[best]), smooth, best * self.half)]
        floor = float(variance.min()) + 1e-6 * float(power.max())
        found: list[Quiet] = []
        levels = 3 if self.spec.first_row == 0 else 1
        while len(found) < levels and (lowest := float(variance.min())) <= 4 * floor:
            best = int(np.argmin(variance))
            level = float(sums[best])
            found.append(Quiet(centre + level, 1.2 * lowest, best * self.half))
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
