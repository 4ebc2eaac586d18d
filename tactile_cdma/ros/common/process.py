# SPDX-License-Identifier: Apache-2.0

"""Runs a node as a process until a signal comes, and then ends everything in order."""

import faulthandler
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Generic, TypeVar

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.exceptions import NameValidationException
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from ...base.errors import ParameterError
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
END_S = 10.0
"""Longest time that the end of a node and of its ROS context may take, s; chosen: launch kills by
then, too. Fast DDS 2.14 may wait for ever for itself where it ends a participant that is told of
others' topics (3 of 4 processes within 200 ends each, of several that begin and end at once); it
holds Python's lock meanwhile, so that no signal is heard."""
N = TypeVar("N", bound=Node)


def run_node(make: Callable[[], N]) -> int:
    """Run a driver's or a body's node until a signal comes; returns the exit code.

    make: creates it. Raises ParameterError for arguments or parameters that make it impossible.
    """
    for path in params_of(sys.argv):
        existing(path)  # rcl's own words for it are hard to understand
    with running(make) as node:
        node.spin()
    return 0


def own_words() -> list[str]:
    """Return the arguments that are not for ROS; raises ParameterError for what that cannot be."""
    try:
        return list(remove_ros_args(sys.argv)[1:])
    except RCLError as error:
        raise ParameterError(str(error)) from None


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
    """Yield a node for as long as the context lasts; raises what the node does not take.

    Signals (see stop_event) tell it to end; they raise nothing, as that could come amid the
    conversion of a message. Everything ends in order: the executor, the node with all it has, and
    the ROS context last; the process exits with 1 where that takes longer than END_S. What rcl does
    not take is a ParameterError.
    """
    with stop_event(None) as stop, ExitStack() as ends:
        ends.callback(faulthandler.cancel_dump_traceback_later)
        ends.callback(rclpy.try_shutdown)
        fault = log_fault()
        to_terminal = ["--ros-args", "--disable-external-lib-logs"] if fault else []
        try:
            words = [*sys.argv, *to_terminal]
            rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
        except RCLError as error:
            for path in params_of(sys.argv):
                read_sections(path, None)  # rcl's own words for a file that is none are hard, too
            raise ParameterError(str(error)) from None
        except UnknownROSArgsError as error:
            raise ParameterError(f"unknown arguments: {error}") from None
        forward_logs()
        if fault:
            get_logger(CORE).warning(f"no log file is written: {fault}; ROS_LOG_DIR names a folder")
        try:
            node = make()
        except NameValidationException as error:
            raise ParameterError(" ".join(str(error).split()[:-1])) from None
        except RCLError as error:
            raise ParameterError(str(error)) from None
        ends.callback(node.destroy_node)
        program = Running(node, stop.is_set)
        ends.callback(program.executor.shutdown)
        ends.callback(faulthandler.dump_traceback_later, END_S, exit=True, file=2)
        yield program
