# SPDX-License-Identifier: Apache-2.0

"""Places of the taxels, from ~/info, as numpy arrays; with them, force and centre of every frame.

~/info has what is constant between frames: positions (m) and normals of the taxels in the frame of
the skin, areas (m²), the tare. Every subscriber receives it once, and again after each change; a
frame belongs to the info with the same info_id. The force printed is the resultant in ~/wrench,
plus that of taxels that are not in contact; while a taxel in service has no reading, it is unknown.

Start it beside a driver (make run):  .venv/bin/python examples/taxel_map.py
"""

from contextlib import suppress

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data

from tactile_cdma.msg import TactileArray, TactileSkinInfo

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Places(Node):
    def __init__(self) -> None:
        super().__init__("places")
        self.info_id = None
        self.create_subscription(TactileSkinInfo, "/skin/info", self.learn, LATCHED)
        self.create_subscription(TactileArray, "/skin/tactile", self.feel, qos_profile_sensor_data)
        print("waiting for /skin/info and /skin/tactile …", flush=True)

    def learn(self, info: TactileSkinInfo) -> None:
        if not len(info.positions) == len(info.normals) == len(info.area) > 0:
            return  # of no driver: anybody may publish anything
        self.info_id = info.info_id
        self.positions_m = np.array([(p.x, p.y, p.z) for p in info.positions])
        self.normals = np.array([(n.x, n.y, n.z) for n in info.normals])
        self.areas_m2 = np.array(info.area)

    def feel(self, frame: TactileArray) -> None:
        if frame.info_id != self.info_id:
            return  # its info is still on the way
        if not len(frame.pressure) == len(frame.status) == len(self.areas_m2):
            return
        pressure_pa, masked = np.array(frame.pressure), TactileArray.STATUS_MASKED
        unread = np.isnan(pressure_pa) & (np.array(frame.status) & masked == 0)
        if unread.any():
            print("unknown: no reading of the taxels", *np.flatnonzero(unread), flush=True)
            return
        load_n = np.nan_to_num(pressure_pa) * self.areas_m2  # only masked taxels are NaN
        force_n = -(load_n @ self.normals)
        centre_mm = (
            1e3 * (load_n @ self.positions_m) / load_n.sum() if load_n.any() else [np.nan] * 3
        )
        print(
            "force, N:", *np.round(force_n, 3), "centre, mm:", *np.round(centre_mm, 2), flush=True
        )


rclpy.init()
with suppress(KeyboardInterrupt, ExternalShutdownException):
    rclpy.spin(Places())
