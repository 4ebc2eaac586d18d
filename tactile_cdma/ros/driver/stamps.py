# SPDX-License-Identifier: Apache-2.0

"""Headers of messages: moments of the host's monotonic clock as ROS time."""

import math
import time

from rclpy.clock import JumpThreshold, TimeJump
from rclpy.node import Node

from ...config.parameters import Values
from ...messages.cdr import Heading

STAMP_JITTER_NS = 1_000_000
"""A stamp that is earlier than the last by less is moved behind it; by more, ROS time stepped back.
Chosen: far above the µs between readings of two clocks, far below a frame period."""
SURE_NS = 50_000
"""Two clocks count as read at the same moment if both readings took less, ns. Chosen: several times
what two readings take."""
TRIES = 5
"""Attempts at that; then the quickest counts."""


class Stamps:
    """Headers of one skin's messages; its frame is the parameter frame_id."""

    def __init__(self, node: Node, live: Values) -> None:
        self._clock, self._live = node.get_clock(), live
        self._last_ns = self._last_clock_ns = 0  # of rising: stamp and ROS time
        self._is_simulated = self._clock.ros_time_is_active
        changes = JumpThreshold(min_forward=None, min_backward=None, on_clock_change=True)
        self._watch = self._clock.create_jump_callback(changes, post_callback=self._note_change)

    def rising(self, t_host: float) -> Heading:
        """Return a heading for a moment, s, of the monotonic clock; each is later than the last."""
        clock_ns, ahead_ns = self._read()
        stamp_ns = _moved(t_host, ahead_ns)
        # Simulated time moves in steps, between which later frames may seem to be earlier ones.
        stands = self._is_simulated and clock_ns >= self._last_clock_ns
        if 0 <= self._last_ns - stamp_ns < (math.inf if stands else STAMP_JITTER_NS):
            stamp_ns = self._last_ns + 1
        self._last_ns, self._last_clock_ns = stamp_ns, clock_ns
        return self._heading(stamp_ns)

    def at(self, t_host: float) -> Heading:
        """Return a heading for a moment, s, of the host's monotonic clock."""
        return self._heading(_moved(t_host, self._read()[1]))

    def now(self) -> Heading:
        return self.at(time.monotonic())

    def _read(self) -> tuple[int, int]:
        """Read ROS time, and by how much it is ahead of the host's monotonic clock, ns.

        Every stamp does, so that stamps follow every step. Where this thread had to wait between
        the two readings, they are repeated.
        """
        found: list[tuple[int, int, int]] = []
        for _ in range(TRIES):
            before_ns = time.monotonic_ns()
            # Unless simulated, ROS time is the system's. Asking the clock takes 50 µs more after a
            # pause of a frame.
            ros_ns = self._clock.now().nanoseconds if self._is_simulated else time.time_ns()
            took_ns = time.monotonic_ns() - before_ns
            found.append((took_ns, ros_ns, ros_ns - before_ns - took_ns // 2))
            if took_ns <= SURE_NS:
                break
        return min(found)[1:]

    def _note_change(self, _: TimeJump) -> None:
        self._is_simulated = self._clock.ros_time_is_active

    def _heading(self, stamp_ns: int) -> Heading:
        return Heading(stamp_ns, str(self._live["frame_id"]))


def _moved(t_host: float, ahead_ns: int) -> int:
    # Simulated time is 0 until its first message, and ROS has no times below 0.
    return max(0, round(t_host * 1e9) + ahead_ns)
