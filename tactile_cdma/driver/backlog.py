# SPDX-License-Identifier: Apache-2.0

"""Newest data wins: when a driver that was left behind is to skip what waits for it."""

from __future__ import annotations

import math

LATE_S, LATE_PERIODS = 0.25, 2.0
"""A frame that is read later than their sum after its middle is late."""
PATIENCE_S = 1.0
"""A driver that was held up may try for so long to make up for it, and loses nothing if it can."""


class Backlog:
    """Tells a driver that stays behind from one that was held up for a moment.

    Where bytes wait at every look, and the frames that are made of them are late, for PATIENCE_S,
    reading faster is what the driver cannot do: only leaving something out brings it back.
    """

    def __init__(self, period_s: float) -> None:
        """period_s: of the frames."""
        self._late_s = LATE_S + LATE_PERIODS * period_s
        self._since_s = math.inf

    def is_hopeless(self, waiting_bytes: int, age_s: float, now_s: float) -> bool:
        """Whether to skip what waits. age_s: of the newest frame when it was read."""
        if not waiting_bytes or age_s <= self._late_s:
            self._since_s = math.inf
            return False
        self._since_s = min(self._since_s, now_s)
        if now_s - self._since_s < PATIENCE_S:
            return False
        self._since_s = math.inf
        return True
