# SPDX-License-Identifier: Apache-2.0

"""Grips until 5 kPa, and holds; closes further on slip; stops while it cannot feel.

Start it beside a driver (make run):  .venv/bin/python examples/grip.py
It publishes /gripper/close_mm, /gripper/gripped and /arm/stop, one of each per frame. Without a cue
for slip: --ros-args -p slip_m_s:=1.0e9. docs/programs.md has its limits.
"""

from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import Bool, Float64

from tactile_cdma.ros.client import SkinClient, Touch

GRIP_PA, STEP_MM, SLIP_M_S = 5e3, 0.01, 5e-3
MOST_MM, SILENT_S = 5.0, 0.5


class Grip(Node):
    def __init__(self) -> None:
        super().__init__("grip")
        self.slip_m_s = self.declare_parameter("slip_m_s", SLIP_M_S).value
        self.closing = self.create_publisher(Float64, "/gripper/close_mm", 10)
        self.gripped = self.create_publisher(Bool, "/gripper/gripped", 10)
        self.stop = self.create_publisher(Bool, "/arm/stop", 10)
        self.closed_mm, self.fast_frames = 0.0, 0
        self.skin = SkinClient(self, on_touch=self.feel, silent_after_s=SILENT_S)
        print("waiting for /skin/contacts …", flush=True)

    def feel(self, touch: Touch) -> None:
        if not touch.is_sure:
            self.command(stop=True)  # silent, or blind in part: what is not felt may be crushed
            return
        self.fast_frames = self.fast_frames + 1 if touch.speed_m_s > self.slip_m_s else 0
        slips, grips = self.fast_frames >= 2, touch.pressure_pa >= GRIP_PA
        wanted_mm = self.closed_mm + (STEP_MM if slips or not grips else 0.0)
        self.closed_mm = min(wanted_mm, MOST_MM)
        stop = slips or wanted_mm > MOST_MM
        self.command(stop, gripped=grips and not stop)

    def command(self, stop: bool, gripped: bool = False) -> None:
        self.closing.publish(Float64(data=self.closed_mm))
        self.gripped.publish(Bool(data=gripped))
        self.stop.publish(Bool(data=stop))


rclpy.init()
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(Grip())
