# SPDX-License-Identifier: Apache-2.0

"""Subscribes to ~/tactile, and prints the hardest pressed taxel twice a second.

Shows the QoS that a reliable subscriber would miss (sensor data, best effort), and what to do with
taxels that have no reading: they are NaN, never 0.

Start it beside a driver (make run):  .venv/bin/python examples/subscribe.py
"""

from contextlib import suppress

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from tactile_cdma.msg import TactileArray


class Subscriber(Node):
    def __init__(self) -> None:
        super().__init__("subscriber")
        self.latest = None
        self.create_subscription(TactileArray, "/skin/tactile", self.take, qos_profile_sensor_data)
        self.create_timer(0.5, self.show)

    def take(self, frame: TactileArray) -> None:
        if len(frame.pressure) == len(frame.status) > 0:  # anybody may publish anything
            self.latest = frame

    def show(self) -> None:
        frame, self.latest = self.latest, None
        if frame is None:
            print("no frame", flush=True)
            return
        pressure_pa, status = np.array(frame.pressure), np.array(frame.status)
        masked = status & TactileArray.STATUS_MASKED != 0  # out of service by the layout
        unread = int((np.isnan(pressure_pa) & ~masked).sum())
        if np.isnan(pressure_pa).all():
            print("no taxel has a reading", flush=True)
            return
        peak = int(np.nanargmax(pressure_pa))
        print(
            f"frame {frame.sequence}: taxel {peak} has {pressure_pa[peak]:.0f} Pa, "
            f"{unread} without a reading",
            flush=True,
        )


rclpy.init()
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(Subscriber())
