# SPDX-License-Identifier: Apache-2.0

"""Runs a node as a process until a signal comes, and then ends everything in order."""

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Generic, TypeVar

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from ...base.errors import TactileError
from ...base.interrupt import stop_event
from ...base.named_file import existing
from ...config.arguments import params_of
from ...config.parameters import read_sections
from .executor import LeanExecutor
from .logs import CORE, forward_logs, log_fault

WAKE_S = 0.1
"""Longest time, s, after which a program notices that it is told to end; chosen."""
PATIENCE_S = 10.0
"""Longest wait for a first message; chosen: discovery on a busy computer takes seconds."""
N = TypeVar("N", bound=Node)


def run_node(make: Callable[[], N], program: str) -> int:
    """Run a driver's or a body's node until a signal comes; returns the exit code.

    make: creates it. Arguments of ROS, or parameters, that make this impossible are reported in
    one line.
    """
    with ExitStack() as life:
        try:
            for path in params_of(sys.argv):
                existing(path)  # rcl's own words for it are hard to understand
            node = life.enter_context(running(make))
        except (RCLError, UnknownROSArgsError, TactileError) as error:
            unknown = "unknown arguments: " if isinstance(error, UnknownROSArgsError) else ""
            print(f"{program}: {unknown}{error}", file=sys.stderr)
            return 1
        node.spin()
    return 0


class Running(Generic[N]):
    """A node that its program spins itself, between other work."""

    def __init__(self, node: N, told_to_end: Callable[[], bool]) -> None:
        self.node = node
        self.executor = LeanExecutor()
        self.executor.add_node(node)
        self._told_to_end = told_to_end

    def spin(self, seconds: float = math.inf) -> bool:
        """Serve the node for some time, s; returns whether to go on, False once told to end."""
        end_s = time.monotonic() + seconds
        while not self._told_to_end() and (left_s := end_s - time.monotonic()) > 0:
            self.executor.spin_once(min(left_s, WAKE_S))
        return not self._told_to_end()


@contextmanager
def running(make: Callable[[], N]) -> Iterator[Running[N]]:
    """Yield a node for as long as the context lasts; raises what rcl, or the node, does not take.

    Signals (see stop_event) tell it to end; they raise nothing, as that could come amid the
    conversion of a message. Everything ends in order: the executor, the node with all it has, and
    the ROS context last.
    """
    with stop_event(None) as stop, ExitStack() as ends:
        ends.callback(rclpy.try_shutdown)
        fault = log_fault()
        to_terminal = ["--ros-args", "--disable-external-lib-logs"] if fault else []
        try:
            words = [*sys.argv, *to_terminal]
            rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
        except RCLError:
            for path in params_of(sys.argv):
                read_sections(path, None)  # rcl's own words for a file that is none are hard, too
            raise
        forward_logs()
        if fault:
            get_logger(CORE).warning(f"no log file, only this: {fault}; ROS_LOG_DIR names a folder")
        node = make()
        ends.callback(node.destroy_node)
        program = Running(node, stop.is_set)
        ends.callback(program.executor.shutdown)
        yield program
