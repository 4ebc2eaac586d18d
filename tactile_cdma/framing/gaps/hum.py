# SPDX-License-Identifier: Apache-2.0

"""Learns hum from the line's gaps, and removes it; removes impulses, too.

Between frames the line carries nothing but its offset and disturbances. If its level moves there by
more than noise explains, and a sine of 45…65 Hz explains most of that, or later one of up to 320,
it is hum, and the sine tells what it adds to the frames between.
"""

import operator
from collections import deque
from typing import NamedTuple

import numpy as np

from ...base.arrays import Floats
from ...base.sums import in_order, sums

FREQUENCIES_HZ = np.arange(45.0, 65.1, 1.0)
"""Hum that is looked for first: mains of 50 and 60 Hz, and what small generators make of them."""
FASTER_HZ = np.arange(66.0, 320.1, 1.0)
"""And then, once most of MEMORY_S is known: their multiples, and what motors and lamps make."""
FULL = 0.75
"""Share of MEMORY_S that is known then. Chosen: frames of up to 60 ms leave less than the rest."""
FINE_HZ = np.arange(-0.5, 0.51, 0.1)
"""Steps between these; half of one turns the phase by 0.04 in half of MEMORY_S."""
MEMORY_S = 0.25
"""Time from which hum is learnt, s. Chosen: tells 50 from 54 Hz, and mains keep phase so long."""
PARTS = 4
"""Parts of a quiet window whose means are fitted: enough to tell its slope. Chosen."""
_LEAST_WINDOWS = 4
"""Windows from which hum is learnt: 16 means for its 4 unknowns."""
_BEYOND_NOISE = 9.0
"""Ratio of the means' variance to that of noise beyond which the level moves. Chosen: 16 means of
nothing but noise get there once in 10²⁰."""
_LEFT = 0.05
"""Share of that variance that hum may leave unexplained. Chosen; jumps and drift leave more."""


class _Tone(NamedTuple):
    """Hum of cosine·cos(angle·(i − origin)) + sine·sin(…) at sample i, V."""

    angle: float
    origin: int
    cosine: float
    sine: float


class _Window(NamedTuple):
    """A piece of gap from stream index `begin` on, in PARTS parts of `size` samples.

    means_v: of the parts, V.
    """

    begin: int
    size: int
    means_v: list[float]


class Hum:
    """The hum of one stream of samples."""

    def __init__(self, rate_hz: float) -> None:
        """rate_hz: samples per second."""
        per_hz = 2 * np.pi / rate_hz
        self._coarse = per_hz * FREQUENCIES_HZ, per_hz * FASTER_HZ
        self._fine = per_hz * FINE_HZ
        self._memory = MEMORY_S * rate_hz
        self._windows: deque[_Window] = deque()
        # Of each: sum of its parts' means, V, and of their squares; variance of a part's mean that
        # noise explains, V².
        self._sums, self._squares, self._noises = (deque[float]() for _ in range(3))
        self._tone: _Tone | None = None

    @property
    def heard(self) -> bool:
        """Whether there is hum that is known."""
        return self._tone is not None

    @property
    def decided(self) -> bool:
        """Whether enough of the line was heard to tell."""
        return len(self._windows) >= _LEAST_WINDOWS

    @property
    def moving(self) -> bool:
        """Whether the gaps' level moves by more than noise explains."""
        return self._power() > _BEYOND_NOISE * self._noise()

    def removed(self, volts: Floats, begin: int) -> Floats:
        """The samples without hum, V: the same array if none is known.

        volts: (m,) V, from stream index `begin` on.
        """
        tone = self._tone
        if tone is None:
            return volts
        phase = tone.angle * np.arange(begin - tone.origin, begin - tone.origin + volts.size)
        without: Floats = volts - tone.cosine * np.cos(phase) - tone.sine * np.sin(phase)
        return without

    def learn(self, begin: int, volts: Floats, noise: float) -> None:
        """Take in a quiet window, unless it overlaps one that is known.

        begin: its stream index. volts: (m,) V, with hum. noise: variance of one sample, V².
        """
        windows, size = self._windows, volts.size // PARTS
        if windows and begin < windows[-1].begin + PARTS * windows[-1].size:
            return
        means = [sums(volts[i * size : (i + 1) * size])[0] / size for i in range(PARTS)]
        windows.append(_Window(begin, size, means))
        self._sums.append(in_order(means))
        self._squares.append(in_order(map(operator.mul, means, means)))
        self._noises.append(noise / size)
        while windows[0].begin < begin - self._memory:
            for each in (windows, self._sums, self._squares, self._noises):
                each.popleft()
        self._tone = self._fitted()

    def _fitted(self) -> _Tone | None:
        """The hum that explains the windows; None where it is no hum, or within noise."""
        if not (self.decided and self.moving):
            return None
        level = np.concatenate([window.means_v for window in self._windows])
        level -= level.mean()
        power, noise = self._power(), self._noise()
        origin = self._windows[-1].begin
        place = np.arange(PARTS) + 0.5
        time = np.concatenate(
            [window.begin - origin + window.size * place - 0.5 for window in self._windows]
        )
        is_full = origin - self._windows[0].begin > FULL * self._memory
        for coarse in self._coarse[: 1 + is_full]:
            angle, *_ = self._best(coarse, time, level, noise / power)
            fine = angle + self._fine
            angle, left, cosine, sine = self._best(fine, time, level, noise / power)
            if left <= _LEFT * power + 2 * noise:
                return _Tone(angle, origin, cosine, sine)
        return None

    @staticmethod
    def _best(
        angles: Floats, time: Floats, level: Floats, ridge: float
    ) -> tuple[float, float, float, float]:
        """Least squares of offset and tone for some angles per sample; the best one.

        Returns its angle, the mean square that is left, V², and its cosine and sine, V. ridge: of
        these. Frames may recur in step with the hum, whose gaps then hardly show its amplitude: it
        is taken to be no larger than needed.
        """
        phase = angles[:, None] * time
        terms = np.stack((np.ones_like(phase), np.cos(phase), np.sin(phase)), axis=1)
        products = terms @ terms.transpose(0, 2, 1) + ridge * np.diag([0.0, 1.0, 1.0])
        moments = terms @ level
        found = np.linalg.solve(products, moments[..., None])[..., 0]
        explained = np.einsum("fi,fi->f", found, moments)
        best = int(np.argmax(explained))
        left = float(np.square(level).sum() - explained[best]) / level.size
        return float(angles[best]), left, float(found[best, 1]), float(found[best, 2])

    def _power(self) -> float:
        """Variance of the parts' means, V²."""
        count = PARTS * len(self._windows)
        mean = in_order(self._sums) / count
        return in_order(self._squares) / count - mean * mean

    def _noise(self) -> float:
        """What noise contributes to it, V²: the median over the windows."""
        return sorted(self._noises)[len(self._noises) // 2]


_USUAL = 0.9
"""Share of samples that are no impulses, and of those whose height sets the limit. Chosen: ringing
edges are more than a tenth of a frame's samples, impulses fewer."""
_FARTHER = 6.0
"""Heights beyond this multiple of the usual one are impulses. Derived: a tenth of normal samples
stand off both neighbours by 0.9 deviations or more; 5.5 deviations occur less than once in 10⁷."""


def without_impulses(volts: Floats) -> Floats:
    """The samples with each impulse, of a single sample, at the level of its nearer neighbour.

    Switching loads couple impulses into the line.

    volts: (m,) V. Returns the same array where there is none. An impulse stands off both neighbours
    by far more than most samples of this stretch do. Chips of two or more samples are left as they
    are, and so are the first and the last sample.
    """
    if volts.size < 3:
        return volts
    left, middle, right = volts[:-2], volts[1:-1], volts[2:]
    low, high = np.minimum(left, right), np.maximum(left, right)
    height = np.maximum(middle - high, low - middle)
    usual = int(_USUAL * height.size)
    limit = _FARTHER * max(float(np.partition(height, usual)[usual]), 0.0)
    at = np.flatnonzero(height > limit)
    if not at.size:
        return volts
    cleaned = volts.copy()
    cleaned[at + 1] = np.minimum(np.maximum(middle[at], low[at]), high[at])
    return cleaned
