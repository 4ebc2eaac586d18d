# SPDX-License-Identifier: Apache-2.0

"""Learns the mains' hum from the line's gaps, and removes it.

Between frames the line carries nothing but its offset and disturbances. If its level moves there by
more than noise explains, and a sine of 45…65 Hz explains most of that, it is hum, and the sine
tells what it adds to the frames between.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from ..base.arrays import Floats

FREQUENCIES_HZ = np.arange(45.0, 65.1, 0.5)
"""Hum that is looked for: mains of 50 and 60 Hz, and what small generators make of them."""
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


class Hum:
    """The hum of one stream of samples."""

    def __init__(self, rate_hz: float) -> None:
        """rate_hz: samples per second."""
        self._angles = 2 * np.pi / rate_hz * FREQUENCIES_HZ
        self._memory = MEMORY_S * rate_hz
        self._windows: deque[tuple[int, int, Floats, float]] = deque()
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
        level, noise = self._levels()
        return bool(np.square(level).mean() > _BEYOND_NOISE * noise)

    def removed(self, volts: Floats, begin: int) -> Floats:
        """The samples from stream index `begin` on without hum, V: the same array if none is known."""
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
        size = volts.size // PARTS
        if self._windows and begin < self._windows[-1][0] + PARTS * self._windows[-1][1]:
            return
        means = volts[: PARTS * size].reshape(PARTS, size).mean(axis=1)
        self._windows.append((begin, size, means, noise / size))
        while self._windows[0][0] < begin - self._memory:
            self._windows.popleft()
        self._tone = self._fitted()

    def _fitted(self) -> _Tone | None:
        """The hum that explains the windows; None where it is no hum, or within noise."""
        if not (self.decided and self.moving):
            return None
        level, noise = self._levels()
        power = float(np.square(level).mean())
        origin = self._windows[-1][0]
        place = np.arange(PARTS) + 0.5
        time = np.concatenate(
            [begin - origin + size * place - 0.5 for begin, size, *_ in self._windows]
        )
        phase = self._angles[:, None] * time
        terms = np.stack((np.ones_like(phase), np.cos(phase), np.sin(phase)), axis=1)
        products = terms @ terms.transpose(0, 2, 1)
        # Frames may recur in step with the hum, whose gaps then hardly show its amplitude: it is
        # taken to be no larger than needed.
        products += noise / power * np.diag([0.0, 1.0, 1.0])
        moments = terms @ level
        found = np.linalg.solve(products, moments[..., None])[..., 0]
        left = level.size * power - np.einsum("fi,fi->f", found, moments)
        best = int(np.argmin(left))
        if left[best] / level.size > _LEFT * power + 2 * noise:
            return None
        _, cosine, sine = found[best].tolist()
        return _Tone(float(self._angles[best]), origin, cosine, sine)

    def _levels(self) -> tuple[Floats, float]:
        """Means of all windows' parts about their mean, V, and the variance of their noise, V²."""
        level = np.concatenate([means for _, _, means, _ in self._windows])
        noise = float(np.median([noise for *_, noise in self._windows]))
        return level - level.mean(), noise
