# SPDX-License-Identifier: Apache-2.0

"""The core's log reaches ROS's, once, and only what is to be known unless all is asked for."""

import logging
from collections.abc import Iterator

import pytest
from rclpy.logging import LoggingSeverity, set_logger_level

from tactile_cdma.ros.common.logs import CORE, forward_logs

NAME = f"{CORE}.readings.of_a_test"


@pytest.fixture
def core() -> Iterator[logging.Logger]:
    core = logging.getLogger(CORE)
    handlers, level = core.handlers[:], core.level
    yield core
    core.handlers[:] = handlers
    core.setLevel(level)
    set_logger_level(CORE, LoggingSeverity.UNSET)


def said(capfd: pytest.CaptureFixture[str]) -> list[str]:
    log = logging.getLogger(NAME)
    log.debug("a path changed")
    log.info("a file was found")
    log.warning("something is %s", "odd")
    log.error("something is wrong")
    return [line for line in capfd.readouterr().err.splitlines() if f"[{NAME}]: " in line]


def test_warnings_and_errors_are_forwarded_once(
    core: logging.Logger, capfd: pytest.CaptureFixture[str]
) -> None:
    forward_logs()
    forward_logs()
    warning, error = said(capfd)
    assert warning.startswith("[WARN] ") and warning.endswith(f"[{NAME}]: something is odd")
    assert error.startswith("[ERROR] ") and error.endswith(f"[{NAME}]: something is wrong")


def test_all_is_forwarded_where_ros_wants_it(
    core: logging.Logger, capfd: pytest.CaptureFixture[str]
) -> None:
    set_logger_level(CORE, LoggingSeverity.DEBUG)
    forward_logs()
    assert [line.partition("]")[0] for line in said(capfd)] == [
        "[DEBUG",
        "[INFO",
        "[WARN",
        "[ERROR",
    ]
    set_logger_level(CORE, LoggingSeverity.ERROR)
    forward_logs()
    (error,) = said(capfd)
    assert "wrong" in error
