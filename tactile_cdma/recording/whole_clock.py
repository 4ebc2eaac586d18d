# SPDX-License-Identifier: Apache-2.0

"""Maps device time to host time where the whole recording is known, not only what came before.

A live driver learns the map as packets come, so that its first stamps rest on the first packets,
which may have waited for long. Here a first pass over the bytes notes when packets arrived, and the
second pass, which decodes, stamps its frames by a map fitted to all arrivals.
"""

from array import array
from bisect import bisect
from collections.abc import Callable, Iterable

import numpy as np

from ..base.arrays import Floats
from ..config.skin_config import SkinConfig
from ..driver.clock import RECENT, SURE_INTERVALS, DeviceClock, line_below
from ..driver.pipeline import Pipeline

SPACING_S = 0.25
"""Device time per kept arrival, s; as of DeviceClock. A day takes 5.5 MB."""
REACH = 60
"""Arrivals before and after a knot that place it. Chosen, 15 s either way: long enough for a prompt
packet among late ones, short enough for a crystal that warms up (tested at 2 ppm in 10 min)."""
REAL_TIME = 0.05
"""Largest rate difference of a device that keeps real time. Chosen: 500 × that of two crystals,
as arrivals are late by varying amounts, and below that of any replay worth its option speed."""
HELD_UP_S = 0.3
"""Longest delay of arrivals by a bus, s; chosen. In a short recording it looks like a rate."""


def fitted_clocks(
    config: SkinConfig, reads: Iterable[tuple[bytes, float]]
) -> Callable[[], DeviceClock]:
    """The clocks of a stream, one for each time that the digitizer was reset, as Timeline asks.

    reads: bytes of the stream, and when they were read, s on the host's monotonic clock.
    """
    observed: list[_ObservedClock] = []

    def observing() -> DeviceClock:
        observed.append(_ObservedClock())
        return observed[-1]

    pipeline = Pipeline(config, background=False, clocks=observing, frames=False)
    for data, t_host in reads:
        pipeline.feed(data, t_host)
    clocks = iter([_FittedClock(*clock.knots()) if clock.arrivals else clock for clock in observed])
    # A recording may have grown between the passes, and hold another reset.
    return lambda: next(clocks, None) or DeviceClock()


class _ObservedClock(DeviceClock):
    """Notes the earliest arrivals of the whole stream.

    arrivals: how many are kept.
    """

    def __init__(self) -> None:
        super().__init__()
        self._x_s, self._y_s = array("d"), array("d")  # device and host times
        self._place = -1

    @property
    def arrivals(self) -> int:
        return len(self._x_s)

    def observe(self, t_device: float, t_host: float, backlog: bool = False) -> None:
        super().observe(t_device, t_host, backlog)
        place = int(t_device // SPACING_S)
        if place != self._place or not self._x_s:
            self._place = place
            self._x_s.append(t_device)
            self._y_s.append(t_host)
        elif t_host - t_device < self._y_s[-1] - self._x_s[-1]:
            self._x_s[-1], self._y_s[-1] = t_device, t_host

    def knots(self) -> tuple[list[float], list[float]]:
        """Device times, rising, and their host times, s; between them the map is linear."""
        x, y = np.array(self._x_s), np.array(self._y_s)
        x, first = np.unique(x, return_index=True)
        y = y[first]
        if not _keeps_real_time(x, y):
            return x.tolist(), np.maximum.accumulate(y).tolist()
        last = len(x) - 1
        places = np.linspace(0, last, 1 + -(-last // REACH)).round().astype(int)
        hosts = []
        for place in places:
            near = slice(max(0, place - REACH), place + REACH + 1)
            # Differences to the knot keep the precision over weeks of device time.
            _, offset_s = line_below(x[near] - x[place], y[near] - y[place], SURE_INTERVALS)
            hosts.append(float(y[place]) + offset_s)
        return x[places].tolist(), hosts


class _FittedClock(DeviceClock):
    """Learns as any clock, by which the timeline tells restarts, and stamps by knots."""

    def __init__(self, x_s: list[float], y_s: list[float]) -> None:
        super().__init__()
        self._x_s, self._y_s = x_s, y_s

    @property
    def error_s(self) -> float:
        return 0.0

    def to_host(self, t_device: float) -> float:
        x_s, y_s = self._x_s, self._y_s
        if len(x_s) < 2:
            return y_s[0] + (t_device - x_s[0])
        i = min(max(bisect(x_s, t_device), 1), len(x_s) - 1)  # the knot after it
        rate = (y_s[i] - y_s[i - 1]) / (x_s[i] - x_s[i - 1])
        return y_s[i] + (t_device - x_s[i]) * rate


def _keeps_real_time(x: Floats, y: Floats) -> bool:
    """Whether arrivals half of the stream apart are as far apart on both clocks, mostly.

    They are not where a simulation or a replay runs faster or slower than real time.
    """
    half = len(x) // 2
    if half < RECENT // 2:
        return True
    device_s, host_s = x[half:] - x[: len(x) - half], y[half:] - y[: len(y) - half]
    allowed_s = np.maximum(REAL_TIME * device_s, HELD_UP_S)
    return bool(np.median(np.abs(host_s - device_s) / allowed_s) <= 1)
