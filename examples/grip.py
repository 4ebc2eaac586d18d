# SPDX-License-Identifier: Apache-2.0

"""Grips until 5 kPa, and holds; closes further on slip; stops while it cannot feel.

The gripper closes a little with every frame until a contact reaches 5 kPa, and then holds. While an
object slips, it closes further and the arm is told to stop. It closes only while it can feel: where
a taxel in service has no reading, messages stop, or the fingers have travelled MOST_MM, it holds,
tells the arm to stop, and claims no grip. docs/programs.md has its limits.

Start it beside a driver (make run):  .venv/bin/python examples/grip.py
It publishes /gripper/close_mm, /gripper/gripped and /arm/stop, one of each per frame. Without a cue
for slip: --ros-args -p slip_m_s:=1.0e9
"""

import math
import time
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import Bool, Float64

from tactile_cdma.msg import TactileContacts

GRIP_PA, STEP_MM, SLIP_M_S, SETTLED_S = 5e3, 0.01, 5e-3, 0.3
MOST_MM, SILENT_S = 5.0, 0.5


class Grip(Node):
    def __init__(self) -> None:
        super().__init__("grip")
        self.slip_m_s = self.declare_parameter("slip_m_s", SLIP_M_S).value
        self.closing = self.create_publisher(Float64, "/gripper/close_mm", 10)
        self.gripped = self.create_publisher(Bool, "/gripper/gripped", 10)
        self.stop = self.create_publisher(Bool, "/arm/stop", 10)
        self.closed_mm, self.fast_frames, self.heard_s = 0.0, 0, -math.inf
        self.create_subscription(TactileContacts, "/skin/contacts", self.feel, 10)
        self.create_timer(SILENT_S / 2, self.watch)
        print("waiting for /skin/contacts …", flush=True)

    def watch(self) -> None:
        if time.monotonic() - self.heard_s > SILENT_S:
            self.command(stop=True)  # no skin

    def feel(self, message: TactileContacts) -> None:
        self.heard_s = time.monotonic()
        if not 0 < message.taxels_in_service == message.taxels_valid:
            self.command(stop=True)  # blind, if only in part: what is not felt may be crushed
            return
        felt_pa = max((contact.pressure_max for contact in message.contacts), default=0.0)
        speeds = [
            math.hypot(contact.velocity.x, contact.velocity.y, contact.velocity.z)
            for contact in message.contacts
            if contact.age > SETTLED_S
        ]
        self.fast_frames = self.fast_frames + 1 if max(speeds, default=0.0) > self.slip_m_s else 0
        slips = self.fast_frames >= 2
        wanted_mm = self.closed_mm + (STEP_MM if felt_pa < GRIP_PA or slips else 0.0)
        self.closed_mm = min(wanted_mm, MOST_MM)
        stop = slips or wanted_mm > MOST_MM
        self.command(stop, gripped=felt_pa >= GRIP_PA and not stop)

    def command(self, stop: bool, gripped: bool = False) -> None:
        self.closing.publish(Float64(data=self.closed_mm))
        self.gripped.publish(Bool(data=gripped))
        self.stop.publish(Bool(data=stop))


rclpy.init()
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(Grip())
