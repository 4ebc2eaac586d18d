# SPDX-License-Identifier: Apache-2.0

"""Prints what arrives at one host, a message a line: `listener.py [--body] PATCH…`.

Each line is a Heard as JSON. The arrays of the patches are subscribed to best effort, their
contacts reliably, with a queue that holds all.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile, ReliabilityPolicy

from tactile_cdma.msg import TactileArray, TactileContacts
from tactile_cdma.ros.common.convert import nanoseconds
from tactile_cdma.ros.common.executor import LeanExecutor

DEPTH = 1000
BODY = "/body"
ARRAYS, CONTACTS, BODY_CONTACTS, REPORTS = "tactile", "contacts", "body", "reports"


@dataclass(frozen=True, slots=True)
class Heard:
    """A message. kind: ARRAYS, CONTACTS, BODY_CONTACTS or REPORTS. patch: its node, or the body.

    t_s: of arrival, monotonic, the same on all hosts. age_s: arrival minus stamp, on the listener's
    wall clock. said: of REPORTS, the body's words on each patch. Others: as in the message.
    """

    kind: str
    patch: str
    t_s: float
    sequence: int = 0
    age_s: float = 0.0
    touched: bool = False
    untouched: bool = False
    absent: list[str] = field(default_factory=list)
    said: dict[str, str] = field(default_factory=dict)


def main() -> None:
    """Listen until killed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--body", action="store_true")
    parser.add_argument("patch", nargs="*")
    arguments = parser.parse_args()
    rclpy.init()
    node = rclpy.create_node("listener")
    reliable = QoSProfile(depth=DEPTH)
    best_effort = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
    topics: list[tuple[Any, str, str, QoSProfile, str]] = [
        (kind, f"{patch}/{topic}", patch, qos, topic)
        for patch in arguments.patch
        for kind, topic, qos in (
            (TactileArray, ARRAYS, best_effort),
            (TactileContacts, CONTACTS, reliable),
        )
    ]
    if arguments.body:
        topics.append((TactileContacts, f"{BODY}/{CONTACTS}", BODY, reliable, BODY_CONTACTS))
        node.create_subscription(DiagnosticArray, "/diagnostics", _report, reliable)
    for kind, topic, patch, qos, name in topics:
        node.create_subscription(kind, topic, partial(_take, name, patch), qos)
    executor = LeanExecutor()
    executor.add_node(node)
    while True:
        executor.spin_once()


def _take(kind: str, patch: str, message: Any) -> None:
    age_s = (time.time_ns() - nanoseconds(message.header.stamp)) * 1e-9
    heard = Heard(kind, patch, time.monotonic(), message.sequence, age_s)
    content = asdict(heard)
    if kind != ARRAYS:
        content |= {"touched": message.touched, "untouched": message.untouched}
        content["absent"] = list(message.absent)
    print(json.dumps(content), flush=True)


def _report(message: DiagnosticArray) -> None:
    for status in message.status:
        if status.name == f"{BODY.lstrip('/')}: patches":
            said = {value.key: value.value for value in status.values}
            heard = Heard(REPORTS, BODY, time.monotonic(), said=said)
            print(json.dumps(asdict(heard)), flush=True)


if __name__ == "__main__":
    main()
