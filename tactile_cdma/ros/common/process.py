# SPDX-License-Identifier: Apache-2.0

"""Runs a node as a process, or in a thread of a program, and ends everything in order."""

import atexit
import faulthandler
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Generic, TypeVar

import rclpy
from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
from rclpy.context import Context
from rclpy.exceptions import NameValidationException
from rclpy.logging import LoggingSeverity, get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from ...base.errors import ParameterError
from ...base.interrupt import stop_event
from ...base.named_file import existing
from ...config.arguments import params_of
from ...config.parameters import read_sections
from .executor import LeanExecutor

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


CORE = "tactile_cdma"
"""Logger of the core: each module has one below it, named as the module."""


class _ToRos(logging.Handler):
    """Logs with ROS under the same name; ROS's levels are the same numbers."""

    def emit(self, record: logging.LogRecord) -> None:
        severity = LoggingSeverity(min(record.levelno // 10 * 10, LoggingSeverity.FATAL))
        get_logger(record.name).log(self.format(record), severity)


def forward_logs() -> None:
    """Let ROS's log have the core's warnings and errors; with --log-level debug, everything."""
    core = logging.getLogger(CORE)
    if not any(isinstance(handler, _ToRos) for handler in core.handlers):
        core.addHandler(_ToRos())
    wants_all = get_logger(CORE).get_effective_level() <= LoggingSeverity.DEBUG
    core.setLevel(logging.DEBUG if wants_all else logging.WARNING)


def log_fault() -> str:
    """Tell why ROS can write no log file, without which it would not begin; empty if it can."""
    home = os.environ.get("HOME", "")
    text = os.environ.get("ROS_LOG_DIR") or f"{os.environ.get('ROS_HOME') or '~/.ros'}/log"
    if text.startswith("~") and not home:
        return "HOME is not set"
    folder = Path(text.replace("~", home, 1) if text.startswith("~") else text)  # as rcl does
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        return f"{folder}: {error.strerror}"
    return "" if os.access(folder, os.W_OK | os.X_OK) else f"{folder}: not writable"


QUIET = {"enable_rosout": False, "start_parameter_services": False}


@cache
def _kept(process: int) -> tuple[Context, Node]:
    """Return the ROS context of this process's nodes here, and the hidden one that keeps it.

    Its DDS participant lasts until the interpreter ends, as others come and go: Fast DDS 2.14 may
    hang, with Python's lock, where it ends a participant that is told of others' topics.
    """
    context = Context()
    context.init()
    node = Node(f"_tactile_cdma_{process}", context=context, **QUIET)
    atexit.register(context.try_shutdown)
    atexit.register(node.destroy_node)
    return context, node


def _context() -> Context:
    """Return a context that works, a new one where somebody has shut the last down."""
    if not _kept(os.getpid())[0].ok():
        _kept.cache_clear()
    return _kept(os.getpid())[0]


class Background:
    """A node served from start() to close(), which may come twice, in a ROS context of our own.

    The program may use rclpy besides, or not. All ends in order, at the latest when the interpreter
    does: the thread, the executor that it spins, the node, the context. If somebody else, such as
    rclpy at a signal, shuts the context down, the thread ends by itself.
    """

    def __init__(self, name: str) -> None:
        with ExitStack() as ends:
            self._context = _context()
            self.node = Node(name, context=self._context, **QUIET)
            ends.callback(self.node.destroy_node)
            self._executor = LeanExecutor(self._context)
            ends.callback(self._executor.shutdown)
            self._executor.add_node(self.node)
            self._ends = ends.pop_all()
        self._is_told_to_end = False
        self._thread = threading.Thread(target=self._serve, name=name, daemon=True)

    def start(self) -> None:
        self._thread.start()
        atexit.register(self.close)

    @property
    def is_served(self) -> bool:
        """Tell whether anything can still come."""
        return self._thread.is_alive() and self._context.ok()

    def close(self) -> None:
        """End everything; Ctrl-C meanwhile leaves the rest to the next call."""
        self._is_told_to_end = True
        if self._thread.ident is not None:
            self._thread.join()
        self._ends.close()
        atexit.unregister(self.close)

    def _serve(self) -> None:
        while not self._is_told_to_end and self._context.ok():
            try:
                self._executor.spin_once(WAKE_S)
            except Exception:
                if self._context.ok():  # else it was shut down amid a call
                    raise
