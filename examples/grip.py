# SPDX-License-Identifier: Apache-2.0

"""Grips until 5 kPa, and holds; closes further on slip; stops while it cannot feel.

Start it beside a driver (make run):  .venv/bin/python examples/grip.py
It publishes /gripper/close_mm, /gripper/gripped and /arm/stop, one of each per frame, and prints
what it begins to do. Without a cue for slip: --ros-args -p slip_m_s:=1.0e9.

Until dead nodes are noticed it closes by stale_after_s × frame rate × STEP_MM, 2.3 mm here: lower
one of them until that is harmless.
"""

import rclpy
from rclpy.node import Node
from std_msgs.msg import Bool, Float64

from tactile_cdma.ros.client import SkinClient, Touch

GRIP_PA, STEP_MM, SLIP_M_S = 5e3, 0.01, 5e-3
MOST_MM, SILENT_S = 5.0, 0.5


class Rule:
    """Says after each frame how far to close, whether it grips, and whether to stop."""

    def __init__(self, slip_m_s: float) -> None:
        self.slip_m_s, self.closed_mm, self.fast_frames = slip_m_s, 0.0, 0

    def decide(self, is_sure: bool, speed_m_s: float, most_pa: float) -> tuple[float, bool, bool]:
        if not is_sure:  # silent, or blind in part: what is not felt may be crushed
            return self.closed_mm, False, True
        self.fast_frames = self.fast_frames + 1 if speed_m_s > self.slip_m_s else 0
        slips, grips = self.fast_frames >= 2, most_pa >= GRIP_PA
        wanted_mm = self.closed_mm + (STEP_MM if slips or not grips else 0.0)
        self.closed_mm = min(wanted_mm, MOST_MM)
        stop = slips or wanted_mm > MOST_MM
        return self.closed_mm, grips and not stop, stop


class Grip(Node):
    def __init__(self) -> None:
        super().__init__("grip")
        self.rule, self.did = Rule(self.declare_parameter("slip_m_s", SLIP_M_S).value), ""
        self.closing = self.create_publisher(Float64, "/gripper/close_mm", 10)
        self.gripped = self.create_publisher(Bool, "/gripper/gripped", 10)
        self.stop = self.create_publisher(Bool, "/arm/stop", 10)
        self.skin = SkinClient(self, on_touch=self.feel, silent_after_s=SILENT_S)
        print("waiting for /skin/contacts …", flush=True)

    def feel(self, touch: Touch) -> None:
        close_mm, grips, stop = self.rule.decide(touch.is_sure, touch.speed_m_s, touch.pressure_pa)
        self.closing.publish(Float64(data=close_mm))
        self.gripped.publish(Bool(data=grips))
        self.stop.publish(Bool(data=stop))
        did = "stops" if stop else "grips" if grips else "closes"
        if did != self.did:
            felt = touch.problem or f"{touch.pressure_pa / 1e3:.1f} kPa"
            print(f"{did}: closed by {close_mm:.2f} mm, {felt}", flush=True)
            self.did = did


if __name__ == "__main__":
    rclpy.init()
    try:
        rclpy.spin(Grip())
    except BaseException as end:  # a signal's: a wait hears of it in many ways
        if rclpy.ok() and not isinstance(end, KeyboardInterrupt):
            raise
