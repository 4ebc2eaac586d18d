# SPDX-License-Identifier: Apache-2.0

"""Runs a node as a process until a signal comes, and then ends everything in order."""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from queue import Empty, SimpleQueue
from typing import Generic, TypeVar

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ...base.errors import TactileError
from ...base.interrupt import stop_event
from ...base.named_file import existing
from ...config.arguments import params_of
from ...config.parameters import read_sections
from .executor import LeanExecutor
from .logs import forward_logs

WAKE_S = 0.1
"""Longest time, s, after which a program without messages notices that it is told to end."""
PATIENCE_S = 10.0
"""Longest wait for a first message; chosen: discovery on a busy computer takes seconds."""
N = TypeVar("N", bound=Node)


def run_node(make: Callable[[], Node], program: str) -> int:
    """Run a driver's or a body's node until SIGINT or SIGTERM; returns the exit code.

    make: creates it. Arguments of ROS, or parameters, that make this impossible are reported in
    one line.
    """
    # Signals only wake the main thread, so that everything ends in order: the executor, the
    # node with all it has, and the ROS context last. Not by an Event: the handler may run while
    # this thread holds the Event's lock, and would wait for it for ever.
    signals: SimpleQueue[int] = SimpleQueue()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: signals.put(number))
    try:
        for path in params_of(sys.argv):
            existing(path)  # rcl's own words for it are hard to understand
        try:
            rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
        except RCLError:
            for path in params_of(sys.argv):
                read_sections(path, None)  # so are these, of a file that is none
            raise
        forward_logs()
        node = make()
    except (RCLError, UnknownROSArgsError, TactileError) as error:
        unknown = "unknown arguments: " if isinstance(error, UnknownROSArgsError) else ""
        print(f"{program}: {unknown}{error}", file=sys.stderr)
        rclpy.try_shutdown()
        return 1
    executor = LeanExecutor()
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


class Viewing(Generic[N]):
    """A node that its program spins itself, between other work."""

    def __init__(self, node: N, told_to_end: Callable[[], bool]) -> None:
        self.node = node
        self.executor = LeanExecutor()
        self.executor.add_node(node)
        self._told_to_end = told_to_end

    def spin(self, seconds: float = math.inf) -> bool:
        """Receive for some time, s; returns whether to go on, False once told to end."""
        end_s = time.monotonic() + seconds
        while not self._told_to_end() and (left_s := end_s - time.monotonic()) > 0:
            self.executor.spin_once(min(left_s, WAKE_S))
        return not self._told_to_end()


@contextmanager
def viewing(make: Callable[[], N], seconds: float | None = None) -> Iterator[Viewing[N]]:
    """A node for as long as the context lasts.

    SIGINT, SIGTERM and the end of the time, s, tell it to end; they raise nothing, as that could
    come amid the conversion of a message.
    """
    with stop_event(seconds) as stop:
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
        forward_logs()
        try:
            running = Viewing(make(), stop.is_set)
            yield running
            running.executor.shutdown()
            running.node.destroy_node()
        finally:
            rclpy.try_shutdown()
