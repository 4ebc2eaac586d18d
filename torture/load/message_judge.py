# SPDX-License-Identifier: Apache-2.0

"""Compares published TactileArrays with what the nodes of a KnownDigitizer really sent."""

from __future__ import annotations

import time
import zlib
from collections import deque
from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.msg import TactileArray
from tactile_cdma.readings.status import Status
from tactile_cdma.ros.common.convert import nanoseconds
from test.support.oracle import Held

from ..outcome import Tally
from .known_digitizer import Known, KnownDigitizer

NEAR_S = 50e-6
"""Tolerance of a frame's device time: one chip. Measured errors are below 1 µs."""
LATE_S = 0.5
"""Tolerance of a stamp, in addition to the digitizer's own lag, and to the longest that the driver
had to wait for a processor between two messages: a packet that was sent or read late for lack of
processor time cannot be told from a clock that is off."""
WAIT_WINDOW_S = 30.0
"""s that such a wait may be in the driver's estimate of the clock."""
LOOKS = 3
"""Readings of the two clocks; the pair closest together counts."""


class MessageJudge:
    """Takes every message of one driver, in order.

    A message is wrong if a word, pressure, flag, device time or stamp of it is.

    tally: since it was replaced last. digests: of the pressures of all messages, by sequence.
    ahead_s: ROS time minus the host's monotonic clock, s, one entry for each clock that may be in
    force; empty: the host's real time. newest_ahead_s: the same by the newest stamp.
    last_middle_s: host's monotonic time of the middle of the newest frame. waited_s: the time that
    the driver has waited for a processor, s.
    """

    def __init__(self, digitizer: KnownDigitizer, near_pa: float, flags: Status) -> None:
        """near_pa: tolerance of a pressure. flags: those that taxels may have besides SILENT."""
        config = SkinConfig.of({})
        self.tally = Tally()
        self.ahead_s: list[float] = []
        self.newest_ahead_s = self.last_middle_s = 0.0
        self.digests: dict[int, int] = {}
        self.waited_s: Callable[[], float] = lambda: 0.0
        self._waits: deque[tuple[float, float]] = deque([(0.0, 0.0)])  # when, for how long by then
        self._digitizer, self._near_pa = digitizer, near_pa
        self._never = ~np.uint8(flags | Status.SILENT)
        self._middle_s, self._lsb_v = config.spec.frame_s / 2, config.adc.lsb_v
        self._held = Held(config)
        self._last: tuple[Known | None, int] | None = None  # true frame, sequence

    def take(self, message: TactileArray) -> None:
        """Judge the next message."""
        tally, t_middle = self.tally, message.device_time_us * 1e-6
        self.digests[message.sequence] = digest(message)
        middle_s = t_middle + self._digitizer.born_s
        self.newest_ahead_s = nanoseconds(message.header.stamp) * 1e-9 - middle_s
        ahead_s = self.ahead_s or [real_time_ahead_s()]
        off_s = min((self.newest_ahead_s - ahead for ahead in ahead_s), key=abs)
        tally.stamp_errors_s.append(off_s - self._digitizer.least_lag_s)
        known, wrong = self._best(message, t_middle - self._middle_s)
        self._count(known, message.sequence)
        if known is not None:
            self._held.hear(known.frame.active, known.frame.codes)
        if wrong or not -LATE_S < off_s < LATE_S + self.excused_s():
            tally.wrong_values += 1
            age_s = time.monotonic() - middle_s
            tally.example = tally.example or (
                f"frame {message.sequence}: {wrong} taxels wrong, flags {max(message.status)}, "
                f"stamp off by {off_s * 1e3:.1f} ms, {age_s:.3f} s old"
            )
        # Last, because whoever waits for these two reads the counts next.
        self.last_middle_s = middle_s
        tally.frames += 1

    def excused_s(self) -> float:
        """Delay of the digitizer, and the driver's longest wait between two messages, lately, s."""
        now_s = time.monotonic()
        self._waits.append((now_s, self.waited_s()))
        while self._waits[1][0] < now_s - WAIT_WINDOW_S:
            self._waits.popleft()
        waits_s = (after - before for (_, before), (_, after) in pairwise(self._waits))
        return self._digitizer.lag_s + max(waits_s)

    def _best(self, message: TactileArray, t_start: float) -> tuple[Known | None, int]:
        """The true frame that fits best, and how many taxels differ: all if there is none."""
        best: tuple[Known | None, int] = (None, len(message.status))
        for known in self._digitizer.frames_at(t_start):
            near = abs(known.start_s - t_start) < NEAR_S
            wrong = np.count_nonzero(self._wrong(message, known)) if near else len(message.status)
            if best[0] is None or wrong < best[1]:
                best = known, int(wrong)
            if not wrong:
                break
        return best

    def _wrong(self, message: TactileArray, known: Known) -> NDArray[np.bool_]:
        """(n,) bool: taxels whose word, pressure or flags are not those of a true frame."""
        active, codes = known.frame.active, known.frame.codes
        status = np.frombuffer(message.status, np.uint8)
        heard = np.rint(np.frombuffer(message.voltage, np.float32) / self._lsb_v)
        true_pa = self._expected_pa(known)
        near = np.abs(np.frombuffer(message.pressure, np.float32) - true_pa) < self._near_pa
        return np.asarray(
            (((status & Status.SILENT) == 0) != active)
            | ((status & self._never) != 0)
            | (active & (heard != codes))
            | ~(near | np.isnan(true_pa))
        )

    def _expected_pa(self, known: Known) -> NDArray[np.float64]:
        """(n,) Pa after a true frame; NaN for nodes whose last word may have been lost."""
        expected_pa = self._held.after(known.frame.active, known.frame.codes)
        expected_pa[self._missed(known) & ~known.frame.active] = np.nan
        return expected_pa

    def _missed(self, known: Known | None) -> NDArray[np.bool_]:
        """(n,) bool: nodes that may have spoken between the last message and this one."""
        before = self._last[0] if self._last is not None else None
        if known is None or _lost(before, known) is None:
            return np.ones_like(self._held.pressure_pa, bool)
        assert before is not None
        return self._digitizer.spoke(known.epoch, before.frame.number + 1, known.frame.number)

    def _count(self, known: Known | None, sequence: int) -> None:
        """Add up the frames lost before this one, and whether the sequence tells of them."""
        self._held.miss(self._missed(known))
        last, self._last = self._last, (known, sequence)
        if last is None:
            return
        told = sequence - last[1] - 1
        lost = told if (counted := _lost(last[0], known)) is None else counted
        self.tally.lost += max(lost, 0)
        # A sequence that repeats or goes back is one loss that nobody can number.
        self.tally.uncounted_losses += 1 if told < 0 else abs(lost - told)


def _lost(before: Known | None, known: Known | None) -> int | None:
    """Frames between two of the same epoch; None if they are not."""
    if before is None or known is None or known.epoch != before.epoch:
        return None
    return known.frame.number - before.frame.number - 1


def digest(message: TactileArray) -> int:
    """A checksum of a message's pressures."""
    return zlib.crc32(message.pressure.tobytes())


def real_time_ahead_s() -> float:
    """The host's real time minus its monotonic one, s."""
    looks = []
    for _ in range(LOOKS):
        before_ns, real_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        looks.append((after_ns - before_ns, real_ns - (before_ns + after_ns) // 2))
    return min(looks)[1] * 1e-9
