# SPDX-License-Identifier: Apache-2.0

"""A program with any number of subscribers, fast or slow; prints at the end what each received.

python -m torture.load.crowd /skin --participants 5 --each 2 --delay 1.0 --kind pictures
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import threading
import time
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from tactile_cdma.msg import TactileArray

from .message_judge import digest

KINDS = {"arrays": (TactileArray, "tactile"), "pictures": (Image, "heatmap")}
PATIENCE_S = 120.0
"""Time to wait for the first message of every subscriber, s."""
KEEP_ALL = QoSProfile(
    history=HistoryPolicy.KEEP_ALL, depth=0, reliability=ReliabilityPolicy.RELIABLE
)
"""The most demanding subscription."""


class Subscriber(Node):
    """A subscriber. got: digests of arrays, by sequence. count: number of messages."""

    def __init__(self, context: rclpy.Context, topic: str, kind: type, delay_s: float) -> None:
        super().__init__("crowd", context=context, enable_rosout=False)
        self.got: dict[int, int] = {}
        self.count = 0
        self._delay_s = delay_s
        self.create_subscription(kind, topic, self._take, KEEP_ALL)

    def _take(self, message: TactileArray | Image) -> None:
        self.count += 1
        if isinstance(message, TactileArray):
            self.got[message.sequence] = digest(message)
        time.sleep(self._delay_s)


def main() -> int:
    """Subscribe until SIGTERM. Prints `ready` after everyone's first message, JSON at the end."""
    parser = argparse.ArgumentParser(prog="python -m torture.load.crowd", description=__doc__)
    parser.add_argument("skin", help="the driver's node, /skin")
    parser.add_argument("--participants", type=int, default=1)
    parser.add_argument("--each", type=int, default=1, help="subscribers of a participant")
    parser.add_argument("--kind", choices=list(KINDS), default="arrays")
    parser.add_argument("--delay", type=float, default=0.0, help="s that a message takes")
    arguments = parser.parse_args()
    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    kind, topic = KINDS[arguments.kind]
    crowd: list[Subscriber] = []
    parent = os.getppid()  # ends with it, even if it is killed
    for _ in range(arguments.participants):
        context = rclpy.Context()
        rclpy.init(context=context)
        executor = SingleThreadedExecutor(context=context)
        for _ in range(arguments.each):
            node = Subscriber(context, f"{arguments.skin}/{topic}", kind, arguments.delay)
            crowd.append(node)
            executor.add_node(node)
        threading.Thread(target=_spin, args=(executor,), daemon=True).start()
    give_up_s = time.monotonic() + PATIENCE_S
    while not all(member.count for member in crowd):
        if over.wait(0.05) or time.monotonic() > give_up_s:
            return 1
    print("ready", flush=True)
    while not over.wait(1.0) and os.getppid() == parent:
        pass
    print(json.dumps([[member.count, member.got] for member in crowd]), flush=True)
    os._exit(0)  # no orderly shutdown of the middleware: it takes seconds


def _spin(executor: SingleThreadedExecutor) -> None:
    with suppress(ExternalShutdownException):
        executor.spin()


if __name__ == "__main__":
    sys.exit(main())
