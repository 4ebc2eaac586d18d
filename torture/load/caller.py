# SPDX-License-Identifier: Apache-2.0

"""Calls a skin's services as fast as they are answered, as a program; says how many were.

python -m torture.load.caller /skin --seconds 5
"""

from __future__ import annotations

import argparse
import sys
import time
from itertools import cycle
from typing import Any

import rclpy
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.parameter import Parameter

PATIENCE_S = 30.0
AT_ONCE = 8


def main() -> int:
    """Call for so long; `asked=… answered=… refused=…` at the end."""
    parser = argparse.ArgumentParser(prog="python -m torture.load.caller", description=__doc__)
    parser.add_argument("skin", help="the driver's node, /skin")
    parser.add_argument("--seconds", type=float, required=True)
    arguments = parser.parse_args()
    rclpy.init()
    node = rclpy.create_node("caller")
    rates = cycle([-1.0, 10.0, 30.0])  # the first one is to be refused
    clients = {
        kind: node.create_client(kind, f"{arguments.skin}/{name}")
        for kind, name in (
            (SetParameters, "set_parameters"),
            (GetParameters, "get_parameters"),
            (ListParameters, "list_parameters"),
            (GetState, "get_state"),
        )
    }
    for client in clients.values():
        client.wait_for_service(PATIENCE_S)
    asked = answered = refused = 0
    turns, end_s = cycle(clients.items()), time.monotonic() + arguments.seconds
    while time.monotonic() < end_s:
        calls = []
        for _ in range(AT_ONCE):
            kind, client = next(turns)
            calls.append(client.call_async(_request(kind, next(rates))))
        asked += AT_ONCE
        give_up_s = time.monotonic() + PATIENCE_S
        while not all(call.done() for call in calls) and time.monotonic() < give_up_s:
            rclpy.spin_once(node, timeout_sec=0.1)
        answers = [call.result() for call in calls if call.done()]
        answered += len(answers)
        refused += sum(
            not result.successful
            for answer in answers
            if isinstance(answer, SetParameters.Response)
            for result in answer.results
        )
    node.destroy_node()
    rclpy.shutdown()
    print(f"asked={asked} answered={answered} refused={refused}")
    return 0


def _request(kind: Any, rate_hz: float) -> Any:
    if kind is SetParameters:
        value = Parameter("visual_rate_hz", value=rate_hz).to_parameter_msg()
        return SetParameters.Request(parameters=[value])
    if kind is GetParameters:
        return GetParameters.Request(names=["port", "threshold"])
    return kind.Request()


if __name__ == "__main__":
    sys.exit(main())
