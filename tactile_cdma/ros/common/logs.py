# SPDX-License-Identifier: Apache-2.0

"""Hands the log of the core, which knows no ROS, to ROS's."""

import logging

from rclpy.logging import LoggingSeverity, get_logger

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
