# SPDX-License-Identifier: Apache-2.0

"""What callbacks of this process have raised: counted and logged, so that it ends no node."""

import logging
import math
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy._rclpy_pybind11 import InvalidHandle

from ...base.errors import TactileError
from ...base.text import plain_lines

FAILED = "failed callbacks"
"""Their count in /diagnostics."""
COMPLAINT_S = 10.0
"""Least time between two entries in the log of failures at the same place, s; chosen."""
_log = logging.getLogger(__name__)


class Failures:
    """Keeps nodes alive. count: callbacks that have raised."""

    def __init__(self) -> None:
        self.count = 0
        self._told_s: dict[str, float] = {}  # when one was logged, by its place

    def survive(self, call: Callable[[Any], object], entity: Any) -> None:
        """Call with an entity of a node; nothing is raised."""
        try:
            call(entity)
        except Exception as error:
            self.note(_name(entity), error)

    def note(self, name: str, error: Exception) -> None:
        """Count what a callback has raised; log it: in a sentence if foreseen, else with its trace.

        name: of what has called back.
        """
        self.count += 1
        place = str(traceback.extract_tb(error.__traceback__)[-1])
        now_s = time.monotonic()
        if now_s < self._told_s.get(place, -math.inf) + COMPLAINT_S:
            return
        self._told_s[place] = now_s
        if isinstance(error, TactileError):
            _log.warning("%s: %s", name, error)
        else:
            trace = plain_lines("".join(traceback.format_exception(error)))
            _log.error("%s: internal error: %s", name, trace)


def _name(entity: Any) -> str:
    for name in ("topic_name", "srv_name"):
        with suppress(AttributeError, InvalidHandle):  # its own callback may have destroyed it
            return str(getattr(entity, name))
    return type(entity).__name__.lower()


FAILURES = Failures()
"""Failures of this process, which is one node."""
