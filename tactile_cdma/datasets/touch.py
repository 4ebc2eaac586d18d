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
HOLD, ZERO, DROP = "hold", "zero", "drop"
POLICIES = (HOLD, ZERO, DROP)
MOST_UNCERTAIN_S = 0.05
"""s; a frame whose stamp may be off by more has no valid readings, because it may be of another
tick. Chosen: as long as a tick at 20 per second, and above what an idle computer delays."""
MOST_SLOTS = 1000
"""Samples of a patch per tick; chosen: 12 s of frames that come every 12.8 ms."""


def slots(patch: PatchInfo, fps: float, mode: str) -> int:
    """How many samples of a patch one tick holds: with WINDOW, the most that an interval can.

    Raises ParameterError for more than MOST_SLOTS.
    """
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

    pressure_pa: (slots, t) float32 for WINDOW, the newest last, else (t,), without NaN.
    valid: of the same shape, bool: there was a certain reading; none of a patch that stopped.
    age_s: (slots,) or (1,) float32, how long before the tick each was measured. complete: every
    taxel in service is valid.
    """

    pressure_pa: Floats32
    valid: Bools
    age_s: Floats32
    complete: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    """filled_pa: each taxel's last valid reading, or 0."""

    stamp_ns: int
    valid: Bools
    filled_pa: Floats32


class TouchStream:
    """Takes a patch's frames in the order of their stamps; gives what is known of it at a tick.

    completeness: of all frames that were taken.
    """

    def __init__(self, taxels: int, slots: int, mode: str, policy: str) -> None:
        self._slots, self._mode, self._policy = slots, mode, policy
        self.completeness = Completeness()
        self._held = np.zeros(taxels, dtype=np.float32)
        self._wanted = np.ones(taxels, dtype=bool)
        self._window: deque[_Sample] = deque(maxlen=slots)

    def take(self, stamp_ns: int, frame: SkinFrame) -> None:
        valid = frame.valid & (not frame.stamp_uncertainty_s > MOST_UNCERTAIN_S)  # NaN: unknown
        self._held = np.where(valid, frame.pressure_pa, self._held)
        self._wanted = is_in_service(frame.status)
        self.completeness.take(frame)
        self._window.append(_Sample(stamp_ns, valid, self._held))

    def restart(self) -> None:
        """Begin the window anew after a stop: what was before that is not of the present."""
        self._window.clear()

    def at(self, tick_ns: int, has_stopped: bool = False) -> Touch:
        """The patch at a tick that is later than all frames taken; at least one must be.

        has_stopped: the newest frame is too old for the present, so that nothing is valid.
        """
        samples = list(self._window)
        ages_s = np.array([(tick_ns - sample.stamp_ns) / NANO for sample in samples])
        filled = np.array([sample.filled_pa for sample in samples])
        valid = np.array([sample.valid for sample in samples])
        valid &= not has_stopped
        if self._mode == WINDOW and (missing := self._slots - len(samples)):
            # Before the first frame, or the first one after a stop: nothing was read.
            ages_s = np.concatenate([ages_s[:1].repeat(missing), ages_s])
            filled = np.concatenate([filled[:1].repeat(missing, axis=0), filled])
            valid = np.concatenate([np.zeros((missing, filled.shape[1]), dtype=bool), valid])
        if self._mode == LAST:
            filled, valid = filled[-1], valid[-1]
        if self._policy == ZERO:
            filled = np.where(valid, filled, np.float32(0))
        complete = bool(valid[..., self._wanted].all())
        return Touch(filled.astype(np.float32), valid, ages_s.astype(np.float32), complete)
