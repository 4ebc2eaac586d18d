# SPDX-License-Identifier: Apache-2.0

"""The newest frame of a topic: whether it is of now, and whether of one driver alone."""

import math
import time
from collections.abc import Mapping
from contextlib import suppress

from rclpy._rclpy_pybind11 import InvalidHandle
from rclpy.clock import Clock
from rclpy.node import Node

AHEAD_S = 0.5
"""A frame whose stamp lies farther in the future, s, was never measured. Chosen above the steps of
a simulated /clock, which a receiver may hear later than the driver."""
RIVALS_S = 2.0
"""Two drivers of one name count as two until for so long, s, all messages were of one. Chosen: DDS
remembers a driver that was killed for 20 s, and one that thins its frames sends some meanwhile."""
COUNT_S = 0.1
"""Interval at which it is counted who publishes, s; chosen: 0.1 ms for a patch, far below DDS's."""


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

    def forget(self) -> None:
        """Start over, as if no frame had come."""
        self._heard_s = -math.inf

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


class Rivals:
    """Tells whether more than one driver publishes a topic, so that nothing is to be concluded.

    topic: its full name.
    """

    def __init__(self, node: Node, topic: str) -> None:
        self.topic, self._node = topic, node
        self._number, self._count, self._looked_s = 0, 0, -math.inf
        self._since_s = math.inf  # when two were last heard, or first seen

    def hear(self, about: Mapping[str, int | None]) -> None:
        """Take note of a message. about: what the middleware knows of it."""
        number = about.get("publication_sequence_number")
        if number is None or number <= self._number:  # each driver counts its own messages
            self._since_s, self._looked_s = time.monotonic(), -math.inf
        self._number = number or 0

    @property
    def count(self) -> int:
        """Count those that publish and were heard lately, as far as can be told."""
        if (now_s := time.monotonic()) - self._looked_s > COUNT_S:
            self._looked_s, self._count = now_s, 0
            with suppress(InvalidHandle):  # the node was destroyed: nobody is seen any more
                self._count = int(self._node.count_publishers(self.topic))
        if self._count < 2:
            self._since_s = math.inf
            return self._count
        self._since_s = min(self._since_s, now_s)
        return self._count if now_s - self._since_s <= RIVALS_S else 1

    @property
    def problem(self) -> str:
        """Say what to do about more than one; empty if there is none."""
        if (count := self.count) < 2:
            return ""
        return f"{count} drivers publish {self.topic}: end one, or set another ROS_DOMAIN_ID"
