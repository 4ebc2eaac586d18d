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

"""Hears a driver that reads a LapDigitizer, and holds every message against the truth."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from types import TracebackType
from typing import NamedTuple

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image

from tactile_cdma.msg import TactileArray
from tactile_cdma.ros.convert import nanoseconds
from tactile_cdma.skin_config import SkinConfig
from tactile_cdma.taxels import Status

from .laps import Held, Stretch

QUEUE = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT
)
NEAR_S = 50e-6
"""A chip: so much may a frame's device time be off its true one, and is 50 times nearer."""
NEAR_PA = 30.0
"""A third of the least step of a word."""


class Heard(NamedTuple):
    """A message, and by how much the host's real time was ahead of its monotonic one then."""

    message: TactileArray
    ahead_ns: int


class Judge:
    """What is to be said of the messages of one driver, in the order of their coming.

    errors_s: of every stamp: by how much it is later than the true middle of its frame.
    wrong: messages with a false word, pressure or time. lost: frames that did not come.
    uncounted: of them, those that the sequence did not tell; and told that were none.
    """

    def __init__(self, told: Stretch, config: SkinConfig, powered_s: float) -> None:
        self._told, self._powered_s = told, powered_s
        self._middle_s = config.spec.frame_s / 2
        self._lsb_v = config.adc.lsb_v
        self._held = Held(config)
        self._last: tuple[int, int] | None = None  # true number, sequence
        self.errors_s: list[float] = []
        self.received = self.wrong = self.lost = self.uncounted = 0

    def judge(self, heard: Heard) -> None:
        """Hold one message against the truth."""
        message = heard.message
        self.received += 1
        middle_s = message.device_time_us * 1e-6
        start_s = middle_s - self._middle_s
        number = round(start_s * 1e6 / self._told.period_us)
        right = abs(start_s - number * self._told.period_us * 1e-6) < NEAR_S
        if self._last is not None:
            passed = number - self._last[0]
            self._held.miss(self._spoke_between(self._last[0] + 1, number))
            self.lost += passed - 1
            self.uncounted += abs(message.sequence - self._last[1] - passed)
        self._last = (number, message.sequence)
        self.wrong += not (right and self._is_true(message, number % len(self._told)))
        stamp_s = (nanoseconds(message.header.stamp) - heard.ahead_ns) * 1e-9
        self.errors_s.append(stamp_s - (self._powered_s + middle_s))

    def _is_true(self, message: TactileArray, place: int) -> bool:
        active, codes = self._told.active[place], self._told.codes[place]
        self._held.hear(active, codes)
        status = np.frombuffer(message.status, np.uint8)
        spoke = (status & Status.SILENT) == 0
        heard = np.rint(np.frombuffer(message.voltage, np.float32) / self._lsb_v)
        off_pa = np.abs(np.frombuffer(message.pressure, np.float32) - self._held.pressure_pa)
        return bool(
            np.array_equal(spoke, active)
            and np.array_equal(heard[spoke], codes[spoke])
            and (off_pa[~np.isnan(self._held.pressure_pa)] < NEAR_PA).all()
            and not (status & ~np.uint8(Status.SILENT | Status.STALE)).any()
        )

    def _spoke_between(self, first: int, stop: int) -> NDArray[np.bool_]:
        places = np.arange(first, min(stop, first + len(self._told))) % len(self._told)
        return np.asarray(self._told.active[places].any(axis=0))


class Listener:
    """A participant of its own: array and diagnostics always, pictures when asked for.

    heard: messages that were not judged yet. levels: of the entries of /diagnostics, how often.
    """

    def __init__(self) -> None:
        self.heard: deque[Heard] = deque()
        self.reports = self.pictures = 0
        self.complaints: Counter[str] = Counter()
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("soak_listener", context=self._context)
        self._node.create_subscription(TactileArray, "/skin/tactile", self._take, QUEUE)
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnosed, 10)
        self._picture: Subscription | None = None
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, name="listener")

    def watch_pictures(self, wanted: bool) -> None:
        """Subscribe to the heatmap, or no longer."""
        if wanted and self._picture is None:
            self._picture = self._node.create_subscription(Image, "/skin/heatmap", self._seen, 2)
        elif not wanted and self._picture is not None:
            self._node.destroy_subscription(self._picture)
            self._picture = None

    def _take(self, message: TactileArray) -> None:
        self.heard.append(Heard(message, time.time_ns() - time.monotonic_ns()))

    def _seen(self, message: Image) -> None:
        self.pictures += 1

    def _diagnosed(self, message: DiagnosticArray) -> None:
        self.reports += 1
        for status in message.status:
            if status.level != DiagnosticStatus.OK:
                self.complaints[status.message] += 1

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
