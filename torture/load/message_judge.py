# SPDX-License-Identifier: Apache-2.0

"""Holds published TactileArrays against what the nodes of a known digitizer really said."""

from __future__ import annotations

import time
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.msg import TactileArray
from tactile_cdma.readings.calibration import AdcScale, PressureCurve
from tactile_cdma.readings.taxels import Status
from tactile_cdma.ros.common.convert import nanoseconds

from .known_digitizer import KnownDigitizer

WRONG_PA = 0.05
LATE_S = 0.5
"""By how much a stamp may be off, and more where packets were sent late, for want of a processor:
nobody can know better."""


@dataclass
class Tally:
    """What messages came to since the last look.

    received, missing: messages; missing by their sequence. wrong: taxels with another pressure or
    flag than is true, and stamps that are off. uncounted: frames by which sequence and
    truth differ. off_s: the stamp that was farthest off. example: of what is wrong.
    """

    received: int = 0
    missing: int = 0
    wrong: int = 0
    uncounted: int = 0
    off_s: float = 0.0
    example: str = ""


class MessageJudge:
    """Takes every message in turn.

    ahead_s: ROS time minus the host's monotonic clock, s: one for each moment that may be in force.
    newest_ahead_s: what the newest stamp makes of it.
    digests: of the pressures of the messages so far, by sequence.
    """

    def __init__(self, digitizer: KnownDigitizer) -> None:
        self.tally = Tally()
        self.ahead_s = [time.time() - time.monotonic()]
        self.newest_ahead_s = 0.0
        self.digests: dict[int, int] = {}
        self.last_middle_s = 0.0  # host's monotonic
        self._digitizer, self._scale = digitizer, AdcScale()
        self._curve = PressureCurve.two_stage()
        self._last: tuple[int, int, int] | None = None  # epoch, number, sequence

    def take(self, message: TactileArray) -> None:
        """One message came."""
        tally, spec = self.tally, self._digitizer.setup.spec
        self.digests[message.sequence] = digest(message)
        t_middle = message.device_time_us * 1e-6
        middle_s = t_middle + self._digitizer.born_s
        age_s = time.monotonic() - middle_s
        stamp_s = nanoseconds(message.header.stamp) * 1e-9
        self.newest_ahead_s = stamp_s - middle_s
        off_s = min((self.newest_ahead_s - ahead_s for ahead_s in self.ahead_s), key=abs)
        tally.off_s = max(tally.off_s, off_s, key=abs)
        late_s = LATE_S + self._digitizer.lag_s
        tally.wrong += not -LATE_S < off_s < late_s
        status = np.array(message.status, np.uint8)
        tally.wrong += int(np.count_nonzero(status & ~np.uint8(Status.SATURATED)))
        pressure_pa = np.array(message.pressure, np.float32)
        best, where = len(pressure_pa) + 1, None
        for epoch, frame in self._digitizer.frames_at(t_middle - spec.frame_s / 2):
            wrong = self._wrong(pressure_pa, frame.codes)
            if wrong < best:
                best, where = wrong, (epoch, frame.number, message.sequence)
            if not wrong:
                break
        tally.wrong += best
        if tally.wrong and not tally.example:
            tally.example = (
                f"frame {message.sequence}: {best} taxels wrong, flags {status.max()}, its stamp "
                f"off by {off_s * 1e3:.1f} ms, {age_s:.3f} s old"
            )
        self._count(where, message.sequence)
        # Last: whoever waits for them looks at the counts then, and the truth may take long.
        self.last_middle_s = middle_s
        tally.received += 1

    def _wrong(self, pressure_pa: NDArray[np.float32], codes: NDArray[np.int64]) -> int:
        """Taxels whose pressure is not that of these words."""
        true_pa = self._curve.pressure(self._scale.voltage(codes))
        return int(np.count_nonzero(~(np.abs(pressure_pa - true_pa) < WRONG_PA)))

    def _count(self, where: tuple[int, int, int] | None, sequence: int) -> None:
        """Keep account of what is missing, and whether the sequence tells of it."""
        before, self._last = self._last, where
        if before is None:
            return
        missing = sequence - before[2] - 1
        self.tally.missing += max(missing, 0)
        if missing < 0:  # twice, or back
            self.tally.uncounted += 1
        elif where is not None and where[0] == before[0]:
            self.tally.uncounted += abs(where[1] - before[1] - 1 - missing)


def digest(message: TactileArray) -> int:
    """Tells a message's pressures from others."""
    return zlib.crc32(message.pressure.tobytes())
