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

"""Stamps follow ROS time, whatever it does, and keep the distances of the moments they are of."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS 2 (rclpy) is not installed")

from rclpy.time import Time  # noqa: E402

from tactile_cdma.ros.convert import nanoseconds  # noqa: E402
from tactile_cdma.ros.stamps import STAMP_JITTER_NS, TRIES, Stamps  # noqa: E402

pytestmark = pytest.mark.ros
HOUR_NS = 3600 * 10**9


class SteppedTime:
    """A node, as far as Stamps knows one, whose ROS time is Unix time plus what it is told."""

    def __init__(self) -> None:
        self.step_ns = 0
        self.waits_s: Callable[[], float] = lambda: 0.0

    def get_clock(self) -> SteppedTime:
        return self

    def now(self) -> Time:
        now_ns = time.time_ns() + self.step_ns
        time.sleep(self.waits_s())
        return Time(nanoseconds=now_ns)


@pytest.mark.parametrize("step_ns", [2 * 10**9, -2 * 10**9, HOUR_NS, -HOUR_NS])
def test_the_next_stamp_is_of_the_new_time(step_ns: int) -> None:
    """And those after it are as far apart as their moments are."""
    clock = SteppedTime()
    stamps, begin_s, period_s = Stamps(clock, {"frame_id": "skin"}), time.monotonic(), 12.8e-3

    def stamp_ns(number: int) -> int:
        return nanoseconds(stamps.rising(begin_s + number * period_s).stamp)

    before = [stamp_ns(number) for number in range(5)]
    clock.step_ns = step_ns
    after = [stamp_ns(number) for number in range(5, 10)]
    apart = [round(number * period_s * 1e9) for number in range(5)]
    assert [ns - before[0] for ns in before] == pytest.approx(apart, abs=STAMP_JITTER_NS)
    assert [ns - after[0] for ns in after] == pytest.approx(apart, abs=STAMP_JITTER_NS)
    moved = after[0] - before[0] - round(5 * period_s * 1e9)
    assert moved == pytest.approx(step_ns, abs=STAMP_JITTER_NS)


def test_steps_back_by_less_than_their_jitter_are_not_seen() -> None:
    clock = SteppedTime()
    stamps, now_s = Stamps(clock, {"frame_id": "skin"}), time.monotonic()
    first = nanoseconds(stamps.rising(now_s).stamp)
    clock.step_ns = -STAMP_JITTER_NS // 2
    assert nanoseconds(stamps.rising(now_s).stamp) == first + 1


def test_a_thread_that_is_held_up_between_two_clocks_stamps_right() -> None:
    """All readings but the last one that is tried take 5 ms."""
    clock = SteppedTime()
    waits_s = iter([5e-3] * (TRIES - 1) + [0.0])
    clock.waits_s = lambda: next(waits_s)
    now_s, unix_ns = time.monotonic(), time.time_ns()
    stamp_ns = nanoseconds(Stamps(clock, {"frame_id": "skin"}).at(now_s).stamp)
    assert stamp_ns == pytest.approx(unix_ns, abs=1_000_000)
