# SPDX-License-Identifier: Apache-2.0

"""Pairs every frame of the skin with the joint state nearest in time.

A frame waits for a joint state stamped at or after it, so that no nearer one can still arrive; a
frame with none within 20 ms is dropped. Any topic with a header works, if its stamps increase and
come from the clock of the driver's computer (or one synchronised to it by chrony or PTP).

Start it beside a driver (make run) and whatever publishes /joint_states:
.venv/bin/python examples/fuse_joint_states.py
It prints that it waits, and then, of each pair, both stamps (ns), the greatest pressure (Pa) and
the joints' positions.
"""

from collections import deque
from contextlib import suppress
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from tactile_cdma.msg import TactileArray

TOLERANCE_NS = 20_000_000
QUEUE = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)


def stamp_ns(message: TactileArray | JointState) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


class Fusion(Node):
    def __init__(self) -> None:
        super().__init__("fusion")
        self.frames: deque[TactileArray] = deque(maxlen=100)
        self.joints: deque[JointState] = deque(maxlen=100)
        for kind, topic, queue in (
            (TactileArray, "/skin/tactile", self.frames),
            (JointState, "/joint_states", self.joints),
        ):
            self.create_subscription(kind, topic, lambda m, q=queue: self.take(m, q), QUEUE)
        print("waiting for /skin/tactile and /joint_states …", flush=True)

    def take(self, message: TactileArray | JointState, queue: deque[Any]) -> None:
        queue.append(message)
        while self.frames and self.joints and stamp_ns(self.joints[-1]) >= stamp_ns(self.frames[0]):
            frame = self.frames.popleft()
            if stamp_ns(self.joints[0]) > stamp_ns(frame):
                continue  # from before the first joint state
            nearest = min(self.joints, key=lambda j: abs(stamp_ns(j) - stamp_ns(frame)))
            if abs(stamp_ns(nearest) - stamp_ns(frame)) <= TOLERANCE_NS:
                self.use(frame, nearest)

    def use(self, frame: TactileArray, joints: JointState) -> None:
        peak_pa = np.max(frame.pressure, initial=-np.inf)  # NaN while a taxel has no reading
        print(stamp_ns(frame), stamp_ns(joints), peak_pa, *joints.position, flush=True)


rclpy.init()
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(Fusion())
