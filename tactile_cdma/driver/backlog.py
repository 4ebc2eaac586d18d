# SPDX-License-Identifier: Apache-2.0

"""Decides when to discard buffered input, so that the newest frames are published."""

import math

LATE_S, LATE_PERIODS = 0.25, 2.0
"""s, frame periods; a frame read later than their sum after its middle is late. Chosen: below
clock.SLOW_S, from which on late packets could be taken for those of a slow device."""
PATIENCE_S = 1.0
"""s for which a driver that was held up may catch up without losing anything; chosen."""


class Backlog:
    """Tells a driver that is too slow from one that was held up for a moment.

    If bytes wait at every look for PATIENCE_S, and the frames in them are late, the driver does not
    catch up by reading alone.
    """

    def __init__(self, period_s: float) -> None:
        """period_s: of the frames."""
        self._late_s = LATE_S + LATE_PERIODS * period_s
        self._since_s = math.inf

    def observe(self, waiting_bytes: int, age_s: float, now_s: float) -> bool:
        """Note a look at the port; returns whether to discard what waits there.

        age_s: of the newest frame when it was read.
        """
        if not waiting_bytes or age_s <= self._late_s:
            self._since_s = math.inf
            return False
        self._since_s = min(self._since_s, now_s)
        if now_s - self._since_s < PATIENCE_S:
            return False
        self._since_s = math.inf
        return True
