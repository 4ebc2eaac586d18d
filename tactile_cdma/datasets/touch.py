# SPDX-License-Identifier: Apache-2.0

"""A patch's frames at the ticks of another clock: its last samples, or the last one."""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from ..base.arrays import Bools, Floats32
from ..base.errors import ParameterError
from ..readings.status import is_in_service
from .samples import NANO, Completeness, PatchInfo, SkinFrame

WINDOW, LAST = "window", "last"
MODES = (WINDOW, LAST)
HOLD, ZERO, DROP, KEEP = "hold", "zero", "drop", "keep"
POLICIES = (HOLD, ZERO, DROP)
"""What may stand in place of NaN; KEEP: nothing does, where a format and its readers allow it."""
MOST_UNCERTAIN_S = 0.05
"""s; a frame whose stamp may be off by more has no valid readings, because it may be of another
tick. Chosen: as long as a tick at 20 per second, and above what an idle computer delays."""
MOST_SLOTS = 1000
"""Samples of a patch per tick; chosen: 12 s of frames that come every 12.8 ms."""


def slots(patch: PatchInfo, fps: float, mode: str) -> int:
    """Tell the most samples of a patch in one tick; raises ParameterError above MOST_SLOTS."""
    if mode != WINDOW or math.isnan(patch.frame_period_s):
        return 1
    count = max(1, math.ceil(1 / (fps * patch.frame_period_s) - 1e-9))
    if count > MOST_SLOTS:
        raise ParameterError(
            f"{count} frames of {patch.name} per row, {patch.frame_period_s:g} s apart; at most "
            f"{MOST_SLOTS} are kept: ask for more rows per s, or for --samples last"
        )
    return count


@dataclass(frozen=True, slots=True, eq=False)
class Touch:
    """A patch at one tick.

    pressure_pa: (slots, t) float32 for WINDOW, the newest last, else (t,); NaN only with KEEP.
    valid: of the same shape, bool: there was a certain reading; none of a patch that stopped.
    age_s: (slots,) or (1,) float32, how long before the tick each was measured. complete: every
    taxel in service is valid.
    """

    pressure_pa: Floats32
    valid: Bools
    age_s: Floats32
    complete: bool


class TouchStream:
    """Takes a patch's frames in the order of their stamps; gives what is known of it at a tick.

    completeness: of all frames that were taken.
    """

    def __init__(self, taxels: int, slots: int, mode: str, policy: str) -> None:
        self._slots, self._mode, self._policy = slots, mode, policy
        self.completeness = Completeness()
        self._held_pa = np.zeros(taxels, dtype=np.float32)  # last valid readings, or 0
        self._wanted = np.ones(taxels, dtype=bool)
        # By frame: stamp, ns; which readings are valid; the last valid ones then, Pa.
        self._window: deque[tuple[int, Bools, Floats32]] = deque(maxlen=slots)

    def take(self, stamp_ns: int, frame: SkinFrame) -> None:
        valid = frame.valid & (not frame.stamp_uncertainty_s > MOST_UNCERTAIN_S)  # NaN: unknown
        self._held_pa = np.where(valid, frame.pressure_pa, self._held_pa)
        self._wanted = is_in_service(frame.status)
        self.completeness.take(frame)
        if not self._window:  # the first frame, also after a stop: before it nothing was read
            self._window.extend([(stamp_ns, np.zeros_like(valid), self._held_pa)] * self._slots)
        self._window.append((stamp_ns, valid, self._held_pa))

    def restart(self) -> None:
        """Begin the window anew after a stop: what was before that is not of the present."""
        self._window.clear()

    def at(self, tick_ns: int, has_stopped: bool = False) -> Touch:
        """Return the patch at a tick that is later than all frames taken; at least one must be.

        has_stopped: the newest frame is too old for the present, so that nothing is valid.
        """
        stamps_ns, valids, filled = zip(*self._window, strict=True)
        ages_s = np.array([(tick_ns - stamp_ns) / NANO for stamp_ns in stamps_ns], np.float32)
        valid, pressure_pa = np.array(valids) & (not has_stopped), np.array(filled)
        if self._mode == LAST:
            valid, pressure_pa = valid[-1], pressure_pa[-1]
        if self._policy == ZERO:
            pressure_pa = np.where(valid, pressure_pa, np.float32(0))
        elif self._policy == KEEP:
            pressure_pa = np.where(valid, pressure_pa, np.float32(np.nan))
        return Touch(pressure_pa, valid, ages_s, bool(valid[..., self._wanted].all()))
