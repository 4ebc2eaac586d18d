# SPDX-License-Identifier: Apache-2.0

"""Runs one node as a process: until a signal comes, and then to its end in order."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ...base.errors import TactileError


def run_node(make: Callable[[], Node], program: str) -> int:
    """Run the node that is made until SIGINT or SIGTERM; returns the exit code.

    Arguments of ROS, or parameters, with which there can be no node are one line of text.
    """
    # Signals only wake the main thread, so that everything ends in order: the executor, the
    # node with all it has, and the ROS context last. Not by an Event: the handler may come while
    # this thread holds the Event's lock, and would wait for it for ever.
    signals: SimpleQueue[int] = SimpleQueue()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: signals.put(number))
    try:
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
        node = make()
    except (RCLError, UnknownROSArgsError, TactileError) as error:
        unknown = "unknown arguments: " if isinstance(error, UnknownROSArgsError) else ""
        print(f"{program}: {unknown}{error}", file=sys.stderr)
        rclpy.try_shutdown()
        return 1
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    stop = threading.Event()

    def spin() -> None:
        while not stop.is_set():
            executor.spin_once()

    spinning = threading.Thread(target=spin, name="executor")
    spinning.start()
    asked_to_end = False
    while not asked_to_end and spinning.is_alive():
        with suppress(Empty):
            asked_to_end = bool(signals.get(timeout=0.5))
    stop.set()
    executor.wake()
    spinning.join()
    executor.shutdown()  # not while it spins: rclpy would trip over what is gone
    node.destroy_node()
    rclpy.try_shutdown()
    return 0 if asked_to_end else 1
