# SPDX-License-Identifier: Apache-2.0

"""Compares every frame of a day with the laps that were sent, and its stamp with the true time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import TactileFrame
from tactile_cdma.readings.status import Status
from test.support.oracle import Held

from .laps import Stretch

NEAR_S = 2e-6
"""Tolerance of a frame's device time: two ticks of 1 µs, for rounding."""
NEAR_PA = 1.0
"""Tolerance of a pressure, for rounding; adjacent words are 98 Pa apart or more."""
SETTLED_S = 3.0
"""Device time after which the clock estimate must be good."""
LATEST_S, BIN_S = 10e-3, 1e-6
"""Range and bins of the histogram of stamp errors; larger ones are in the last bin."""


class Lap(NamedTuple):
    """A stretch that was sent: number of its first frame, and device time of that, µs."""

    stretch: Stretch
    first: int
    begin_us: int


class DayJudge:
    """Takes every lap before its first frame, and every frame once, in order.

    host_at: host time, s, of device time, s; None: stamps are not judged.
    wrong: frames with a false word, pressure, flag or time. frames: published ones.
    uncounted: frames whose sequence is not the number of frames before. worst_s: largest error of
    a stamp.
    """

    def __init__(self, config: SkinConfig, host_at: Callable[[float], float] | None) -> None:
        self._host_at = host_at
        self._held = Held(config)
        self._laps: deque[Lap] = deque()
        self._first: tuple[int, float] | None = None  # sequence and device time
        self._bins = np.zeros(int(LATEST_S / BIN_S) + 1, np.int64)  # of stamps' errors
        self.frames = self.wrong = self.uncounted = 0
        self.worst_s = 0.0

    def told(self, lap: Lap) -> None:
        """Note the lap that is sent next."""
        self._laps.append(lap)

    def judge(self, frame: TactileFrame) -> None:
        """Judge the next frame."""
        number, self.frames = self.frames, self.frames + 1
        while len(self._laps) > 1 and number >= self._laps[1].first:
            self._laps.popleft()
        lap = self._laps[0]
        place = number - lap.first
        start_s = (lap.begin_us + place * lap.stretch.period_us) * 1e-6
        if self._first is None:
            self._first = frame.sequence, frame.t_middle
        self.uncounted += frame.sequence - self._first[0] != number
        right = abs(frame.t_start - start_s) < NEAR_S and self._is_true(frame, lap.stretch, place)
        self.wrong += not right
        if self._host_at is not None and frame.t_middle - self._first[1] > SETTLED_S:
            self._stamped(frame)

    def _is_true(self, frame: TactileFrame, stretch: Stretch, place: int) -> bool:
        active, codes = stretch.active[place], stretch.codes[place]
        words, readings = frame.words, frame.readings
        if active.any():
            self._held.hear(active, codes)
        silent = np.where(active, 0, Status.SILENT)
        off_pa = np.abs(readings.pressure_pa - self._held.pressure_pa)
        known = ~np.isnan(self._held.pressure_pa)
        return bool(
            np.array_equal(words.active, active)
            and np.array_equal(words.codes[active], codes[active])
            and (off_pa[known] < NEAR_PA).all()
            and np.isnan(readings.pressure_pa[~known]).all()
            and np.array_equal(readings.status[known], silent[known])
        )

    def _stamped(self, frame: TactileFrame) -> None:
        assert self._host_at is not None
        error_s = abs(frame.t_host - self._host_at(frame.t_middle))
        self._bins[min(int(error_s / BIN_S), self._bins.size - 1)] += 1
        self.worst_s = max(self.worst_s, error_s)

    def stamps_beyond(self, error_s: float) -> int:
        """Number of stamps with at least this error."""
        return int(self._bins[int(error_s / BIN_S) :].sum())

    def stamp_error_s(self, share: float) -> float:
        """Quantile of the stamp errors, s."""
        upto = np.cumsum(self._bins)
        return float(np.searchsorted(upto, share * upto[-1]) * BIN_S)
