# SPDX-License-Identifier: Apache-2.0

"""~/points as a structured numpy array: where the skin is pressed, in its own frame.

The cloud is drawn from the latest frame, at most visual_rate_hz times a second; a control loop uses
~/tactile. Taxels without a reading are left out, so that nothing is NaN; points["taxel"] tells
which are there. docs/topics.md has the fields.

Start it beside a driver (make run):  .venv/bin/python examples/points_to_numpy.py
It prints the pressed points, and their mean place weighted by pressure (mm).
"""

from contextlib import suppress

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from tactile_cdma.views.cloud import POINT

PRESSED_PA = 1e3


class Points(Node):
    def __init__(self) -> None:
        super().__init__("points")
        self.create_subscription(PointCloud2, "/skin/points", self.take, 2)
        print("waiting for /skin/points …", flush=True)

    def take(self, cloud: PointCloud2) -> None:
        if len(cloud.data) % POINT.itemsize:
            return  # of no driver: anybody may publish anything
        points = np.frombuffer(cloud.data, POINT)
        pressed = points[points["pressure"] > PRESSED_PA]
        places_mm = 1e3 * np.stack([pressed["x"], pressed["y"], pressed["z"]], axis=1)
        load = pressed["pressure"] / pressed["pressure"].sum() if pressed.size else pressed["x"]
        print(len(pressed), "of", len(points), *np.round(load @ places_mm, 2), flush=True)


rclpy.init()
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(Points())
