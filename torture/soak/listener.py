# SPDX-License-Identifier: Apache-2.0

"""Hears what a driver publishes."""

from __future__ import annotations

import threading
import time
from collections import deque
from types import TracebackType

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image

from tactile_cdma.msg import TactileArray

QUEUE = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT
)
LOOK_S, LOOKS = 0.2, 3


class Listener:
    """A participant of its own: array and diagnostics always, pictures when asked for.

    heard: messages that nobody has taken yet, each with by how many ns the host's real time was
        ahead of its monotonic one then. reports, pictures: how many came. watches: whether the
        heatmap is to be subscribed to.
    """

    def __init__(self, node: str) -> None:
        """node: full name of the driver's."""
        self.heard: deque[tuple[TactileArray, int]] = deque()
        self.reports = self.pictures = 0
        self.watches = False
        self._heatmap = f"{node}/heatmap"
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("soak_listener", context=self._context)
        self._node.create_subscription(TactileArray, f"{node}/tactile", self._take, QUEUE)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnosed, 10)
        self._node.create_timer(LOOK_S, self._look)
        self._picture: Subscription | None = None
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, name="listener")

    def _look(self) -> None:
        """Subscribe to the heatmap, or no longer; in the executor's thread."""
        if self.watches and self._picture is None:
            self._picture = self._node.create_subscription(Image, self._heatmap, self._seen, 2)
        elif not self.watches and self._picture is not None:
            self._node.destroy_subscription(self._picture)
            self._picture = None

    def _take(self, message: TactileArray) -> None:
        self.heard.append((message, ahead_ns()))

    def _seen(self, message: Image) -> None:
        self.pictures += 1

    def _diagnosed(self, message: DiagnosticArray) -> None:
        self.reports += 1

    def __enter__(self) -> Listener:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)


def ahead_ns() -> int:
    """By how much real time is ahead of the monotonic one; the best of some looks at both."""
    looks = []
    for _ in range(LOOKS):
        before_ns, real_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        looks.append((after_ns - before_ns, real_ns - (before_ns + after_ns) // 2))
    return min(looks)[1]
