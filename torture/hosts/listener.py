# SPDX-License-Identifier: Apache-2.0

"""Prints what arrives at one host, a message a line: `listener.py [--body] PATCH…`.

Each line is a Heard as JSON. The arrays of the patches are subscribed to best effort, their
contacts and the body's reliably, with queues that hold all.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict
from functools import partial
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile, ReliabilityPolicy

from tactile_cdma.msg import TactileArray, TactileContacts
from tactile_cdma.ros.common.convert import nanoseconds
from tactile_cdma.ros.common.executor import LeanExecutor

from .judge import ARRAYS, BODY, BODY_CONTACTS, CONTACTS, REPORTS, Heard

DEPTH = 1000


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
    for patch in arguments.patch:
        for kind, topic, qos in (
            (TactileArray, ARRAYS, best_effort),
            (TactileContacts, CONTACTS, reliable),
        ):
            take = partial(_take, topic, patch)
            node.create_subscription(kind, f"{patch}/{topic}", take, qos)
    if arguments.body:
        take = partial(_take, BODY_CONTACTS, BODY)
        node.create_subscription(TactileContacts, f"{BODY}/contacts", take, reliable)
        node.create_subscription(DiagnosticArray, "/diagnostics", _report, reliable)
    executor = LeanExecutor()
    executor.add_node(node)
    while True:
        executor.spin_once()


def _take(kind: str, patch: str, message: Any, info: dict[str, int]) -> None:
    now_ns, now_s, sent_ns = time.time_ns(), time.monotonic(), info["source_timestamp"]
    heard = Heard(
        kind,
        patch,
        sent_s=now_s - (now_ns - sent_ns) * 1e-9,
        sent_ns=sent_ns,
        sequence=message.sequence,
        age_s=(now_ns - nanoseconds(message.header.stamp)) * 1e-9,
        touched=kind != ARRAYS and message.touched,
        untouched=kind != ARRAYS and message.untouched,
        absent=[] if kind == ARRAYS else list(message.absent),
    )
    print(json.dumps(asdict(heard)), flush=True)


def _report(message: DiagnosticArray) -> None:
    for status in message.status:
        if status.name == f"{BODY.lstrip('/')}: patches":
            said = {value.key: value.value for value in status.values}
            heard = Heard(REPORTS, BODY, sent_s=time.monotonic(), said=said)
            print(json.dumps(asdict(heard)), flush=True)


if __name__ == "__main__":
    main()
