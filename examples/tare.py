# SPDX-License-Identifier: Apache-2.0

"""Calls a service: takes the skin's present reading as zero.

Does the same as ros2 service call /skin/tare tactile_cdma/srv/Tare, for .venv, which has no ros2.
It prints the pressure subtracted, or which taxels were moving or loaded.

Start it beside a driver (make run):  .venv/bin/python examples/tare.py
"""

import sys

import rclpy

from tactile_cdma.srv import Tare

rclpy.init()
node = rclpy.create_node("tare_client")
client = node.create_client(Tare, "/skin/tare")
print("waiting for /skin/tare …", flush=True)
if not client.wait_for_service(10):
    sys.exit("no /skin/tare: is the driver running, and does its node have that name?")
answer = client.call_async(Tare.Request(force=False))
rclpy.spin_until_future_complete(node, answer)
print(answer.result().message)
