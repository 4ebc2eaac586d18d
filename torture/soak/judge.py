# SPDX-License-Identifier: Apache-2.0

"""Holds the messages of a driver that reads a LapDigitizer against the truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.msg import TactileArray
from tactile_cdma.readings.taxels import Status
from tactile_cdma.ros.common.convert import nanoseconds

from ..laps import Stretch
from ..readings import Held

NEAR_S = 50e-6
"""A chip: so much may a frame's device time be off its true one, and is 50 times nearer."""
NEAR_PA = 30.0
"""A third of the least step of a word."""


class Judge:
    """What is to be said of the messages of one driver, in the order of their coming.

    errors_s: of every stamp: by how much it is later than the true middle of its frame.
    wrong: messages with a false word, pressure or time. lost: frames that did not come.
    uncounted: of them, those that the sequence did not tell; and told that were none.
    """

    def __init__(self, told: Stretch, config: SkinConfig, powered_s: float) -> None:
        self._told, self._powered_s = told, powered_s
        self._middle_s = config.spec.frame_s / 2
        self._lsb_v = config.adc.lsb_v
        self._held = Held(config)
        self._last: tuple[int, int] | None = None  # true number, sequence
        self.errors_s: list[float] = []
        self.received = self.wrong = self.lost = self.uncounted = 0

    def judge(self, message: TactileArray, ahead_ns: int) -> None:
        """Hold one message against the truth; see Listener.heard."""
        self.received += 1
        middle_s = message.device_time_us * 1e-6
        start_s = middle_s - self._middle_s
        number = round(start_s * 1e6 / self._told.period_us)
        right = abs(start_s - number * self._told.period_us * 1e-6) < NEAR_S
        if self._last is not None:
            passed = number - self._last[0]
            self._held.miss(self._spoke_between(self._last[0] + 1, number))
            self.lost += passed - 1
            self.uncounted += abs(message.sequence - self._last[1] - passed)
        self._last = (number, message.sequence)
        self.wrong += not (right and self._is_true(message, number % len(self._told)))
        stamp_s = (nanoseconds(message.header.stamp) - ahead_ns) * 1e-9
        self.errors_s.append(stamp_s - (self._powered_s + middle_s))

    def _is_true(self, message: TactileArray, place: int) -> bool:
        active, codes = self._told.active[place], self._told.codes[place]
        self._held.hear(active, codes)
        status = np.frombuffer(message.status, np.uint8)
        spoke = (status & Status.SILENT) == 0
        heard = np.rint(np.frombuffer(message.voltage, np.float32) / self._lsb_v)
        off_pa = np.abs(np.frombuffer(message.pressure, np.float32) - self._held.pressure_pa)
        return bool(
            np.array_equal(spoke, active)
            and np.array_equal(heard[spoke], codes[spoke])
            and (off_pa[~np.isnan(self._held.pressure_pa)] < NEAR_PA).all()
            and not (status & ~np.uint8(Status.SILENT | Status.STALE)).any()
        )

    def _spoke_between(self, first: int, stop: int) -> NDArray[np.bool_]:
        places = np.arange(first, min(stop, first + len(self._told))) % len(self._told)
        return np.asarray(self._told.active[places].any(axis=0))
