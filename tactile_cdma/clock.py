# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The digitizer's clock seen from the host."""

from __future__ import annotations

import numpy as np

MAX_RATE_ERROR = 1e-3
"""Largest believable rate difference of two crystal clocks; a steeper fit is jitter of the bus."""
SURE_INTERVALS = 40
"""Kept observations from which a rate is told to people: 1 ms of jitter is 55 ppm then."""
RECENT = 8
SLOW_S = 0.5
"""A device is no clock but a slow replay or emulation if the last RECENT observations are later by
so much than earlier ones: crystals come to 0.03 s in 30 s, and a stalled bus recovers sooner. They
must have taken longer than on the device, too: a host that was held up reads them all at once."""
HELD_UP_S = 0.02
"""Later than any drift explains: something was held up then, which tells nothing of the rate."""


class DeviceClock:
    """Maps device time to host time, both in s, from the arrival times of packets.

    A packet arrives late, never early, and by a varying amount: so the line of device time against
    host time is fitted by least squares to the earliest arrival of every interval, then lowered
    until no observation lies below it.

    A device slower than real time, as a replay at half the speed, is followed at its own pace: else
    its frames would be stamped ever farther in the past.
    """

    def __init__(self, interval_s: float = 0.25, intervals: int = 120) -> None:
        """interval_s: device time covered by one kept observation; `intervals` of them are kept."""
        self._interval_s = interval_s
        self._interval = -1
        # Kept observations, in any order: the newest takes the place of the oldest.
        self._device, self._host = np.zeros(intervals), np.zeros(intervals)
        self._count = 0
        self._lead_s = 0.0  # host minus device time of the newest
        self._rate = 1.0
        self._origin = (0.0, 0.0)
        self._fitted = True

    def observe(self, t_device: float, t_host: float) -> None:
        """A packet that left the device at t_device was read at t_host."""
        interval = int(t_device // self._interval_s)
        if not self._count or interval != self._interval:
            self._interval = interval
            self._count += 1
        elif t_host - t_device >= self._lead_s:
            return
        newest = (self._count - 1) % self._device.size
        self._device[newest], self._host[newest] = t_device, t_host
        self._lead_s = t_host - t_device
        self._fitted = False

    @property
    def drift_ppm(self) -> float:
        """By how much the device's clock is faster than the host's; NaN until that is known."""
        return (1 / self._rate - 1) * 1e6 if self._count >= SURE_INTERVALS else np.nan

    def to_host(self, t_device: float) -> float:
        """Host time of a moment of device time."""
        if not self._fitted:
            self._fit()
        return self._origin[1] + (t_device - self._origin[0]) * self._rate

    def _fit(self) -> None:
        kept = min(self._count, self._device.size)
        device, host = float(self._device[0]), float(self._host[0])
        # Differences to one observation keep the precision over weeks of device time.
        x, y = self._device[:kept] - device, self._host[:kept] - host
        rate, limit = 1.0, 1 + MAX_RATE_ERROR
        newest = (self._count - 1 - np.arange(min(kept, RECENT))) % self._device.size
        late = y - x - np.min(y - x)
        if np.min(late[newest]) > SLOW_S and np.ptp(y[newest]) >= np.ptp(x[newest]):
            x, y, limit = x[newest], y[newest], np.inf
        else:
            in_time = late <= HELD_UP_S + MAX_RATE_ERROR * np.ptp(x)
            x, y = x[in_time], y[in_time]
        if x.size >= RECENT:
            spread = x - x.sum() / x.size
            rate = float(spread @ y / (spread @ spread))
            rate = min(max(rate, 1 - MAX_RATE_ERROR), limit)
        self._fitted = True
        self._rate, self._origin = rate, (device, host + float((y - rate * x).min()))
