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

"""Stamps of messages: moments of the host's monotonic clock in ROS time."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")

from rclpy.clock import Clock, ClockType
from rclpy.time import Time

from tactile_cdma.ros.convert import nanoseconds
from tactile_cdma.ros.stamps import Stamps

pytestmark = pytest.mark.ros


class InterruptedClock(Clock):
    """On a host that does something else for 20 ms, once, just as the clock is read."""

    def __new__(cls) -> InterruptedClock:
        clock = super().__new__(cls, clock_type=ClockType.SYSTEM_TIME)
        clock.interruptions = 1
        return clock

    def now(self) -> Time:
        if self.interruptions:
            self.interruptions -= 1
            time.sleep(0.02)
        return super().now()


def test_a_host_that_is_busy_between_two_clocks_moves_no_stamp() -> None:
    node = SimpleNamespace(get_clock=InterruptedClock)
    stamps = Stamps(node, {"frame_id": "skin"})  # type: ignore[arg-type]
    t_host, real_ns = time.monotonic(), time.time_ns()
    assert nanoseconds(stamps.at(t_host).stamp) == pytest.approx(real_ns, abs=15e6)
