# SPDX-License-Identifier: Apache-2.0

"""Stamps messages with moments of the host's monotonic clock, in ROS time."""

from __future__ import annotations

import time

from rclpy.node import Node
from std_msgs.msg import Header

from ...config.parameters import Values
from ..common import convert

STAMP_JITTER_NS = 1_000_000
SURE_NS = 50_000
"""Two clocks that were read within so long were read at once."""
TRIES = 5


class Stamps:
    """Headers of one skin's messages; its frame is the parameter frame_id."""

    def __init__(self, node: Node, live: Values) -> None:
        self._clock, self._live = node.get_clock(), live
        self._last_ns = 0

    def rising(self, t_host: float) -> Header:
        """A header for a moment, s, of the host's monotonic clock; each is later than the last."""
        stamp_ns = self._ros_ns(t_host)
        # Two clocks are read for that, some µs apart: stamps rise all the same.
        if 0 <= self._last_ns - stamp_ns < STAMP_JITTER_NS:
            stamp_ns = self._last_ns + 1
        self._last_ns = stamp_ns
        return self._header(stamp_ns)

    def at(self, t_host: float) -> Header:
        """A header for a moment, s, of the host's monotonic clock."""
        return self._header(self._ros_ns(t_host))

    def now(self) -> Header:
        """A header for this moment."""
        return self.at(time.monotonic())

    def _ros_ns(self, t_host: float) -> int:
        # Simulated time is 0 until somebody tells it, and ROS takes no time before that.
        return max(0, round(t_host * 1e9) + self._ahead_ns())

    def _ahead_ns(self) -> int:
        """ROS time minus the host's monotonic clock, now: it follows every step of ROS time.

        On a busy computer this thread may have to wait between the readings of the two; then they
        are read again.
        """
        found: list[tuple[int, int]] = []
        while len(found) < TRIES and (not found or found[-1][0] > SURE_NS):
            before_ns = time.monotonic_ns()
            ros_ns = int(self._clock.now().nanoseconds)
            took_ns = time.monotonic_ns() - before_ns
            found.append((took_ns, ros_ns - before_ns - took_ns // 2))
        return min(found)[1]

    def _header(self, stamp_ns: int) -> Header:
        return Header(stamp=convert.stamp(stamp_ns), frame_id=str(self._live["frame_id"]))
