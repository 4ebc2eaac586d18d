# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Stamps messages with moments of the host's monotonic clock, in ROS time."""

from __future__ import annotations

import time

from rclpy.node import Node
from std_msgs.msg import Header

from ..parameters import Values
from . import convert

STAMP_JITTER_NS = 1_000_000
TOGETHER_NS, TRIES = 100_000, 10
"""Two clocks that are read within so long are read at once; it is tried so often."""


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
        before_ns = time.monotonic_ns()
        for _ in range(TRIES):  # a busy host may do something else between two clocks
            now_ns, after_ns = int(self._clock.now().nanoseconds), time.monotonic_ns()
            if after_ns - before_ns < TOGETHER_NS:
                break
            before_ns = after_ns
        # Simulated time is 0 until somebody tells it, and ROS takes no time before that.
        return max(0, now_ns - (after_ns - round(t_host * 1e9)))

    def _header(self, stamp_ns: int) -> Header:
        return Header(stamp=convert.stamp(stamp_ns), frame_id=str(self._live["frame_id"]))
