# SPDX-License-Identifier: Apache-2.0

"""Publishes simulated time on /clock, with steps."""

from __future__ import annotations

import threading
import time

from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from tactile_cdma.messages.cdr import Heading
from tactile_cdma.ros.common.convert import header

from .loaded_skin import LoadedSkin
from .message_judge import real_time_ahead_s

BEGIN_S = 1_000_000.0
TICK_S = 2e-3
STEP_FRAMES = 20
"""Frames to judge after a step."""


class SimulatedTime:
    """A clock that runs at the rate of the host's, from BEGIN_S on.

    Use as a context manager, within which the driver uses this time.
    """

    def __init__(self, skin: LoadedSkin) -> None:
        self._skin, self._stop = skin, threading.Event()
        self._ahead_s = BEGIN_S - time.monotonic()
        self._publisher = skin.node.create_publisher(Clock, "/clock", QoSProfile(depth=1))
        self._thread = threading.Thread(target=self._run)

    def step(self, step_s: float) -> int:
        """Set the clock; returns how many later frames were stamped by the old time."""
        judge, before_s = self._skin.judge, self._ahead_s
        after_s = before_s + step_s
        judge.ahead_s = [before_s, after_s]
        begin = judge.tally.frames
        self._ahead_s = after_s
        self._skin.waits_for(lambda: abs(judge.newest_ahead_s - after_s) < abs(step_s) / 2)
        late = judge.tally.frames - begin
        judge.ahead_s = [after_s]
        self._skin.streams_on(STEP_FRAMES)
        return late

    def __enter__(self) -> SimulatedTime:
        self._thread.start()
        self._use(True, self._ahead_s)
        return self

    def __exit__(self, *_: object) -> None:
        self._use(False, real_time_ahead_s())
        self._skin.judge.ahead_s = []
        self._stop.set()
        self._thread.join()

    def _use(self, simulated: bool, ahead_s: float) -> None:
        """Set use_sim_time, and wait until the driver's stamps follow."""
        judge, node = self._skin.judge, self._skin.node
        client = node.create_client(SetParameters, f"{self._skin.name}/set_parameters")
        self._skin.waits_for(client.service_is_ready)
        # The last one: the driver has not heard /clock yet.
        judge.ahead_s = [*(judge.ahead_s or [real_time_ahead_s()]), ahead_s, -time.monotonic()]
        value = Parameter("use_sim_time", value=simulated).to_parameter_msg()
        client.call_async(SetParameters.Request(parameters=[value]))
        self._skin.waits_for(lambda: abs(judge.newest_ahead_s - ahead_s) < 1)
        judge.ahead_s = [ahead_s]

    def _run(self) -> None:
        while not self._stop.wait(TICK_S):
            now_ns = round((time.monotonic() + self._ahead_s) * 1e9)
            self._publisher.publish(Clock(clock=header(Heading(now_ns, "")).stamp))
