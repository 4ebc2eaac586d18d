# SPDX-License-Identifier: Apache-2.0

"""Stamps follow every change of ROS time and keep the intervals between frames."""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import islice, pairwise, repeat

import pytest
import rclpy
from rclpy.parameter import Parameter
from rclpy.time import Time

from tactile_cdma.ros.driver.stamps import STAMP_JITTER_NS, SURE_NS, TRIES, Stamps

HOUR_NS = 3600 * 10**9


class Computer:
    """Its two clocks, and a node as far as Stamps knows one. Every reading takes 1 µs.

    ros_time_is_active: ROS time is a clock of its own, not the system's.
    step_ns: ROS time minus the monotonic clock. waits_ns: what comes between two readings.
    """

    def __init__(self, ros_time_is_active: bool) -> None:
        self.ros_time_is_active = ros_time_is_active
        self.step_ns = 1_700_000_000 * 10**9
        self.waits_ns: Iterator[int] = repeat(0)
        self._now_ns = 5 * 10**9

    def monotonic_ns(self) -> int:
        self._now_ns += 1000
        return self._now_ns

    def get_clock(self) -> Computer:
        return self

    def create_jump_callback(self, *_: object, **__: object) -> None:
        """ROS time stays what it is."""

    def time_ns(self) -> int:
        read_ns = self.monotonic_ns()
        self._now_ns += next(self.waits_ns)
        return read_ns + self.step_ns

    def now(self) -> Time:
        return Time(nanoseconds=self.time_ns())


@pytest.fixture(params=[False, True], ids=["system", "simulated"])
def computer(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Computer:
    computer = Computer(request.param)
    monkeypatch.setattr("tactile_cdma.ros.driver.stamps.time", computer)
    return computer


def stamps_ns(computer: Computer, *moments_s: float) -> Iterator[int]:
    stamps = Stamps(computer, {"frame_id": "skin"})
    return (stamps.rising(moment_s).stamp_ns for moment_s in moments_s)


@pytest.mark.parametrize("step_ns", [2 * 10**9, -2 * 10**9, HOUR_NS, -HOUR_NS])
def test_the_next_stamp_is_of_the_new_time(computer: Computer, step_ns: int) -> None:
    """And all are as far apart as their moments are."""
    moments_s = [4.0 + 12.8e-3 * number for number in range(10)]
    coming = stamps_ns(computer, *moments_s)
    moments_ns = [round(moment_s * 1e9) + computer.step_ns for moment_s in moments_s]
    assert list(islice(coming, 5)) == pytest.approx(moments_ns[:5], abs=SURE_NS)
    computer.step_ns += step_ns
    assert [ns - step_ns for ns in coming] == pytest.approx(moments_ns[5:], abs=SURE_NS)


def test_steps_back_by_less_than_their_jitter_are_not_seen(computer: Computer) -> None:
    coming = stamps_ns(computer, 4.0, 4.0)
    first = next(coming)
    computer.step_ns -= STAMP_JITTER_NS // 2
    assert next(coming) == first + 1


@pytest.mark.parametrize(("rate_hz", "speed"), [(40, 1.0), (10, 1.0), (100, 0.5), (2, 3.0)])
def test_stamps_rise_though_simulated_time_moves_in_steps(
    monkeypatch: pytest.MonkeyPatch, rate_hz: int, speed: float
) -> None:
    """Frames are stamped 7 to 11 ms after their middle, 12.8 ms apart, by a /clock in steps."""
    computer, moments_s = Computer(True), [5.0 + 12.8e-3 * number for number in range(1, 1000)]
    monkeypatch.setattr("tactile_cdma.ros.driver.stamps.time", computer)
    back_ns = 0

    def now() -> Time:
        steps = computer.monotonic_ns() * rate_hz // 10**9
        return Time(nanoseconds=10**12 + round(steps / rate_hz * speed * 1e9) - back_ns)

    computer.now = now  # type: ignore[method-assign]
    stamps, found = Stamps(computer, {"frame_id": "skin"}), []
    for number, moment_s in enumerate(moments_s):
        computer._now_ns = round((moment_s + 7e-3 + 4e-3 * (number * 7919 % 101) / 101) * 1e9)
        back_ns = 10**9 * (number >= 500)
        found.append(stamps.rising(moment_s).stamp_ns)
    later = [b > a for a, b in pairwise(found)]
    assert [number for number, is_later in enumerate(later, 1) if not is_later] == [500]
    assert max(abs(ns - now().nanoseconds) for ns in found[-5:]) < 10**9 * speed / rate_hz + 10**8


def test_a_thread_that_is_held_up_between_two_clocks_stamps_right(computer: Computer) -> None:
    """At all readings but the last one that is tried it has to wait for 5 ms."""
    computer.waits_ns = iter([5_000_000] * (TRIES - 1) + [0])
    [stamp_ns] = stamps_ns(computer, 4.0)
    assert stamp_ns == pytest.approx(4 * 10**9 + computer.step_ns, abs=SURE_NS)


def test_stamps_follow_a_change_to_simulated_time_and_back() -> None:
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("clocks", context=context)
    stamps = Stamps(node, {"frame_id": "skin"})
    for is_simulated in (False, True, False):
        node.set_parameters([Parameter("use_sim_time", value=is_simulated)])
        # Without a message on /clock, simulated time is 0.
        now_ns = 0 if is_simulated else time.time_ns()
        assert stamps.now().stamp_ns == pytest.approx(now_ns, abs=10**9)
    node.destroy_node()
    rclpy.shutdown(context=context)
