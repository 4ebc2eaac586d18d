# SPDX-License-Identifier: Apache-2.0

"""Models of a host's clock against a digitizer's, and of the delays of USB."""

from __future__ import annotations

import math

import numpy as np

MOST_CRYSTAL = 100e-6
WARMING, WARMING_S = 10e-6, 1200.0
"""Chosen: a crystal that warms up with its robot; its error changes by 10 ppm, time constant s."""
DAILY, DAY_S = 5e-6, 86_400.0
AIR, AIR_S = 1e-6, 1800.0
"""Chosen: amplitude and period, s, of what follows the room's air conditioning."""
FRAME_S = 1e-3
"""Full-speed USB transfers at whole ms of the host's clock."""
FASTEST_S, SLOWEST_S = 50e-6, 200e-6
"""Chosen: delay from there until a driver has read, between."""
LATE, LATE_S = 1e-3, 0.02
"""Chosen: share of late reads, and their mean additional delay, s."""
STALL_S = (0.5, 10.0)
STALL_EVERY_S = (60.0, 540.0)
"""Chosen: length of stalls, s, and time between them, s; after one all bytes come at once."""


class HostClock:
    """The host's monotonic time as a function of device time, s."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._begin_s = rng.uniform(0, 1e5)
        self.crystal = rng.uniform(-MOST_CRYSTAL, MOST_CRYSTAL)

    def at(self, t_s: float) -> float:
        """The integral of 1 + the crystals' difference."""
        error_s = self.crystal * t_s
        error_s += WARMING * (t_s - WARMING_S * -math.expm1(-t_s / WARMING_S))
        for swing, period_s in ((DAILY, DAY_S), (AIR, AIR_S)):
            omega = 2 * math.pi / period_s
            error_s += swing * (1 - math.cos(omega * t_s)) / omega
        return self._begin_s + t_s + error_s


class UsbLine:
    """When bytes that were sent are read, in order. late, stalls: number of each."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._last_s = 0.0
        self._stall_s: tuple[float, float] | None = None  # the next one's beginning and end
        self.late = self.stalls = 0

    def read_at(self, sent_s: float) -> float:
        """Host time, s, at which bytes sent at this host time are read."""
        read_s = math.ceil(sent_s / FRAME_S) * FRAME_S + self._rng.uniform(FASTEST_S, SLOWEST_S)
        if self._rng.random() < LATE:
            read_s += self._rng.exponential(LATE_S)
            self.late += 1
        if self._stall_s is None:
            self._stall_s = self._next_stall(sent_s)
        begin_s, end_s = self._stall_s
        if read_s >= end_s:
            self._stall_s = self._next_stall(end_s)
            self.stalls += 1
        elif read_s > begin_s:
            read_s = end_s
        self._last_s = max(self._last_s, read_s)
        return self._last_s

    def _next_stall(self, after_s: float) -> tuple[float, float]:
        begin_s = after_s + self._rng.uniform(*STALL_EVERY_S)
        return begin_s, begin_s + self._rng.uniform(*STALL_S)
