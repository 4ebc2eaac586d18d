"""Runs one node as a process: until a signal comes, and then to its end in order."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ..errors import TactileError


def run_node(make: Callable[[], Node], program: str) -> int:
    """Run the node that is made until SIGINT or SIGTERM; returns the exit code.

    Arguments of ROS, or parameters, with which there can be no node are one line of text.
    """
    # Signals only wake the main thread, so that everything ends in order: the executor, the
    # node with all it has, and the ROS context last.
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
        node = make()
    except (RCLError, UnknownROSArgsError, InvalidTopicNameException, TactileError) as error:
        print(f"{program}: {error}", file=sys.stderr)
        rclpy.try_shutdown()
        return 1
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin() -> None:
        while not stop.is_set():
            executor.spin_once()

    spinning = threading.Thread(target=spin, name="executor")
    spinning.start()
    while not stop.wait(0.5) and spinning.is_alive():
        pass
    crashed = not stop.is_set()
    stop.set()
    executor.wake()
    spinning.join()
    executor.shutdown()  # not while it spins: rclpy would trip over what is gone
    node.destroy_node()
    rclpy.try_shutdown()
    return int(crashed)
