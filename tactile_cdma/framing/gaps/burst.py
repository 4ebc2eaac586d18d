# SPDX-License-Identifier: Apache-2.0

"""Finds the loud part of a stretch of samples, and measures the gap beside it.

No stream state. Levels are means of half chips: short enough for every chip to show, and less noisy
than samples. Every bit of a frame carries the same energy (the code rows are orthogonal), so the
window of one frame's length with the most energy holds the frame.
"""

import math
from functools import cached_property

import numpy as np

from ...base import kernel
from ...base.arrays import Floats
from ...base.stage import stage
from ...code.frame import MAX_STRETCH, FrameSpec
from ..fit import Fit, least_power
from ..limits import LIMITS

_CELLS = 320
"""Most cells, about, that the burst search divides a frame into, to bound its cost. Chosen."""
_LOUD = 6.0
"""Noise deviations off the gap level beyond which a half-chip mean is no noise (2e-9). Chosen."""
_LEAST_POWER = 1e-14
"""Power below which there is not even rounding, V²: (0.1 µV)²."""
_CALMER = 1000.0
"""Ratio of the known variance to the newest gap's beyond which what raised it is over. Chosen."""
_DRIFTING = 4.0
"""Ratio of a gap's variance to that of its differences beyond which the rest is drift, not noise.
Chosen: noise alone gets to 1.8 (20 differences)."""
_MEDIAN = 0.455
"""Median of the square of a normal variable."""
_BIAS = 1.2
"""Factor on the least variance of many windows, which is too low. Chosen."""
_NEWEST = 0.3
"""Weight of the newest gap in the variance that is known. Chosen: averages about six gaps."""


@stage
class Gap:
    """The line between frames.

    level: V. variance: of its half-chip means, V².
    begin: first sample of the window in which it was measured.
    """

    level: float
    variance: float
    begin: int


@stage
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


@stage
class Beside:
    """The gaps on either side of a frame.

    level: their mean, V, gap level removed. variance: of their half-chip means' noise, V².
    quiet: whether the nearest on each side are gap: noise, and little hum. noise: variance of a
    sample by what changes from half chip to half chip, V².
    """

    level: float
    variance: float
    quiet: bool
    noise: float


class BurstSearch:
    """Finds what is loud between gaps, for frames of one specification at one sampling rate.

    Lengths are in samples unless their name says otherwise; `least_power` is that of a node, V².
    """

    def __init__(self, spec: FrameSpec, rate_hz: float) -> None:
        """rate_hz: samples per second."""
        self.spec = spec
        self.chip = rate_hz * spec.chip_s
        self.period = rate_hz * spec.frame_period_s
        self.shortest = spec.chips * self.chip
        self.longest = self.shortest * (1 + MAX_STRETCH)
        self.half = max(1, round(self.chip / 2))
        gap = max(self.period - self.longest, 0.3 * (self.period - self.shortest))
        self.window_halves = max(8, int(0.6 * gap / self.half))  # in which a gap is measured
        self.gap_size = math.ceil(max(self.period - self.longest, 5 * self.chip))
        self.bit = math.ceil((1 + MAX_STRETCH) * spec.order * self.chip)
        self.side_halves = math.ceil(min(self.bit, 0.4 * self.gap_size) / self.half)
        self.group = max(1, round(self.shortest / self.half) // _CELLS)  # half chips of a cell
        cell = self.half * self.group
        self.low_cells, self.high_cells = int(self.shortest / cell), int(self.longest / cell) + 1
        self.bit_cells = math.ceil(spec.order * self.chip / cell) + 1
        # Every bit has the same energy, and any two bits' time holds a whole one.
        self.bit_halves = math.ceil(2 * (1 + MAX_STRETCH) * self.bit_cells) * self.group
        self.least_power = least_power(spec.node_swing_v)
        self._mean = np.full(self.half, 1 / self.half)

    @cached_property
    def snr_floor(self) -> float:
        """Mean excess power of a window, in gap variances, that noise practically never reaches."""
        return 0.1 + 6.0 * math.sqrt(self.half / self.shortest)

    @cached_property
    def settings(self) -> kernel.Held:
        """What the kernel's functions take."""
        return kernel.struct(
            "burst_search",
            half=self.half,
            window=self.window_halves,
            group=self.group,
            low=self.low_cells,
            high=self.high_cells,
            bit=self.bit_cells,
            width=self.bit_halves,
            gap_size=self.gap_size,
            side=self.side_halves,
            nodes=self.spec.nodes,
            chip=self.chip,
            snr_floor=self.snr_floor,
            loud=_LOUD,
            no_power=_LEAST_POWER,
            bias=_BIAS,
            newest=_NEWEST,
            calmer=_CALMER,
            drifting=_DRIFTING,
            median=_MEDIAN,
            beside_level=LIMITS.beside_level,
            beside=LIMITS.beside,
        )

    def gaps(self, volts: Floats, known: Gap | None) -> list[Gap]:
        """The gap's level: of the quietest window, judged from the known level if there is one.

        volts: (m,) float64, V. Returns candidates, most likely first; there are others only where
        a lone node on row 0 may hold the line at a constant level: equal bits on end are as quiet
        as the gap, at −a or +a or, in turns, both, and then the gap is midway.
        """
        means = self.halves(volts)
        width = min(self.window_halves, means.size)
        if width < 4:
            return []
        centre = float(np.median(means)) if known is None else known.level
        sums, power, variance = _windows(means - centre, width)
        if known is not None:
            best = int(np.argmin(power))
            fresh = _BIAS * float(variance[best])
            smooth = min((1 - _NEWEST) * known.variance + _NEWEST * fresh, _CALMER * fresh)
            return [Gap(centre + float(sums[best]), smooth, best * self.half)]
        floor = float(variance.min()) + 1e-6 * float(power.max())
        found: list[Gap] = []
        levels = 3 if self.spec.first_row == 0 else 1
        while len(found) < levels and (lowest := float(variance.min())) <= 4 * floor:
            best = int(np.argmin(variance))
            level = float(sums[best])
            found.append(Gap(centre + level, _BIAS * lowest, best * self.half))
            variance[np.abs(sums - level) <= 4 * math.sqrt(floor)] = np.inf
        if len(found) == 3:
            low, middle, high = sorted(found, key=lambda gap: gap.level)
            uneven = abs(high.level + low.level - 2 * middle.level)
            return [middle] if uneven < 0.2 * (high.level - low.level) else found[:2]
        return found

    def burst(self, volts: Floats, variance: float) -> Burst | None:
        """The window of one frame's length with the most energy, cut to its loud part.

        volts: (m,) float64, V, gap level removed. variance: of half-chip means in the gap, V².
        None where there is nothing but noise.
        """
        energy = np.square(self.halves(volts))
        group, bit = self.group, self.bit_cells
        cells = energy[: energy.size // group * group].reshape(-1, group).mean(axis=1)
        low, high = min(self.low_cells, cells.size), self.high_cells
        if low < 8:
            return None
        peak = float(_window_sums(cells, low).max()) / low
        variance = max(variance, 1e-8 * peak)
        power = peak - variance
        if power < max(_LEAST_POWER, self.snr_floor * variance, self.least_power):
            return None
        # Of all windows of a possible length, the one with the greatest excess over half of the
        # frame's power; then cut quiet cells from its ends.
        gain = np.concatenate(([0.0], np.cumsum(cells - (variance + 0.5 * power))))
        ends = np.concatenate((gain[low:], np.full(high - self.low_cells, -np.inf)))
        gains = np.lib.stride_tricks.sliding_window_view(ends, high - self.low_cells + 1)
        begin = int(np.argmax(gains.max(axis=1) - gain[: len(gains)]))
        end = begin + low + int(np.argmax(gains[begin]))
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
            slack += self.half * (group - 1)
        pause, width = last, self.bit_halves
        if snr > 8 and last - first > width:
            powers = _window_sums(energy[first:last], width) / width - variance
            quiet = np.flatnonzero(powers < 0.2 * power)
            if quiet.size:
                pause = first + int(quiet[0])
                rest = np.flatnonzero(loud[pause : pause + width])
                pause += int(rest[-1]) + 1 if rest.size else 0
        edges = np.array([first, last, pause]) * self.half - 0.5
        return Burst(float(edges[0]), float(edges[1]), slack, power, variance, float(edges[2]))

    def beside(self, volts: Floats, fit: Fit, burst: Burst) -> Beside:
        """What lies up to a gap's length beside a frame; a chip next to it is left out.

        The known variance is that of the quietest window: too low, or far too high if it drifts. So
        it is taken from differences, which cancel hum, by their median, which no frame sways.
        """
        first, end = int(fit.start - fit.chip), math.ceil(fit.end(self.spec) + fit.chip)
        first = max(0, first)
        gap, variance = volts[max(0, first - self.gap_size) : first], burst.variance
        sides = self.halves(gap[::-1]), self.halves(volts[end : end + self.gap_size])
        both = np.concatenate(sides)
        steps = np.square(np.concatenate([np.diff(side) for side in sides]))
        noise = variance
        if steps.size >= 8:
            noise = float(np.sort(steps)[steps.size // 2]) / (2 * _MEDIAN)
            variance = max(noise, min(variance, _DRIFTING * noise) if noise else variance)
        quiet = True
        for side in (side[: self.side_halves] for side in sides):
            if side.size:
                most = variance * (1.5 + 5 * math.sqrt(2 / side.size))
                drift = abs(float(side.mean())) - 6 * math.sqrt(variance / side.size)
                excess = float(np.square(side).mean()) - most
                quiet &= drift <= LIMITS.beside_level * math.sqrt(burst.power)
                quiet &= excess <= LIMITS.beside * burst.power
        return Beside(float(both.mean()) if both.size else 0.0, variance, quiet, noise * self.half)

    def halves(self, volts: Floats) -> Floats:
        """Means of consecutive half chips, (m // half,)."""
        count = volts.size // self.half
        means: Floats = volts[: count * self.half].reshape(count, self.half) @ self._mean
        return means


def _windows(off: Floats, width: int) -> tuple[Floats, Floats, Floats]:
    """Mean, power and variance of all windows of this many values, (m − width + 1,) each."""
    sums, power = _window_sums(off, width) / width, _window_sums(np.square(off), width) / width
    return sums, power, np.maximum(power - np.square(sums), 0.0)


def _window_sums(values: Floats, width: int) -> Floats:
    """Sums of all windows of this many values, (m − width + 1,)."""
    sums = np.concatenate((np.zeros(1), np.cumsum(values)))
    return np.subtract(sums[width:], sums[:-width])
