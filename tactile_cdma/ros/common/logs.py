# SPDX-License-Identifier: Apache-2.0

"""Hands the log of the core, which knows no ROS, to ROS's."""

import logging
import os
from pathlib import Path

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
