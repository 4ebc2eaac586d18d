# SPDX-License-Identifier: Apache-2.0

"""A node that a thread of its own serves, for programs that are no nodes themselves."""

import atexit
import os
import threading
from contextlib import ExitStack
from functools import cache

from rclpy.context import Context
from rclpy.node import Node

from .executor import LeanExecutor
from .process import WAKE_S

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
