# SPDX-License-Identifier: Apache-2.0

"""Calls a service: takes the skin's present reading as zero.

Does the same as ros2 service call /skin/tare tactile_cdma/srv/Tare, for .venv, which has no ros2.
It waits for up to WAIT_S until nothing touches the skin; the simulated demo rests 5 s in every 20.
It prints the pressure subtracted, or which taxels were moving or loaded all the time. --force takes
a load for the rest, too, as the first tare under a cover needs it: be sure that nothing touches.

Start it beside a driver (make run):  .venv/bin/python examples/tare.py
"""

import sys

import rclpy

from tactile_cdma.srv import Tare

WAIT_S = 25.0

rclpy.init()
node = rclpy.create_node("tare_client")
client = node.create_client(Tare, "/skin/tare")
print("waiting for /skin/tare …", flush=True)
if not client.wait_for_service(10):
    sys.exit("no /skin/tare: is the driver running, and does its node have that name?")
force = "--force" in sys.argv
if not force:
    print("waiting until nothing touches the skin …", flush=True)
answer = client.call_async(Tare.Request(wait=WAIT_S, force=force))
rclpy.spin_until_future_complete(node, answer)
print(answer.result().message)
