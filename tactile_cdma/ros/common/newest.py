# SPDX-License-Identifier: Apache-2.0

"""The newest frame of a topic, as receivers know it, and whether it is of now by its stamp."""

import math
import time

from rclpy.clock import Clock

AHEAD_S = 0.5
"""A frame whose stamp lies farther in the future, s, was never measured. Chosen above the steps of
a simulated /clock, which a receiver may hear later than the driver."""


class Newest:
    """Knows the newest frame of a topic, and passes over what is not of now.

    A frame is of now while neither its arrival nor its stamp is more than stale_after_s ago. Its
    stamp may be off by its stamp_uncertainty (counted up to stale_after_s: infinite is no licence)
    and by clocks_apart_s, the difference between the computers' clocks.

    refused: why the last message was passed over; empty if it was not.
    """

    def __init__(self, clock: Clock, stale_after_s: float, clocks_apart_s: float = 0.0) -> None:
        self._clock, self._stale_after_s, self._apart_s = clock, stale_after_s, clocks_apart_s
        self._heard_s, self._stamp_ns, self._frame = -math.inf, 0, (-1, -1)
        self._slack_s = clocks_apart_s
        self.refused = ""

    @property
    def silent_s(self) -> float:
        """Time since the frame came, or since its stamp if that is longer; infinite without one."""
        old_s = self._age_s(self._stamp_ns) - self._slack_s
        return max(time.monotonic() - self._heard_s, old_s)

    @property
    def is_of_now(self) -> bool:
        return self.silent_s <= self._stale_after_s and not self._is_to_come

    def take(self, stamp_ns: int, frame: tuple[int, int], uncertainty_s: float) -> bool:
        """Take a message that has just come; returns False where it is passed over.

        frame: its info_id and sequence.
        """
        slack_s = self._apart_s + min(self._stale_after_s, uncertainty_s)
        age_s = self._age_s(stamp_ns)
        # A last frame that is yet to come says that the clock was set back: nothing is before it.
        repeats = frame == self._frame or (stamp_ns <= self._stamp_ns and not self._is_to_come)
        if not -AHEAD_S - slack_s <= age_s <= self._stale_after_s + slack_s:
            self.refused = (
                f"its stamps are {age_s:+.1f} s off this computer's time: is use_sim_time the same "
                "for both, do their clocks agree, or is a computer or network too busy?"
            )
        elif repeats:
            self.refused = f"frame {frame[1]} comes again, or after a later one"
        else:
            self._heard_s, self._stamp_ns, self._frame = time.monotonic(), stamp_ns, frame
            self._slack_s, self.refused = slack_s, ""
        return not self.refused

    @property
    def _is_to_come(self) -> bool:
        return self._age_s(self._stamp_ns) < -AHEAD_S - self._slack_s

    def _age_s(self, stamp_ns: int) -> float:
        return float(self._clock.now().nanoseconds - stamp_ns) * 1e-9
