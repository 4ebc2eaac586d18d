# SPDX-License-Identifier: Apache-2.0

"""Environment of every test: its own ROS domain and home, no deadlines, default signals."""

import os
import signal
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Never

import pytest
from hypothesis import settings

from test.support.domains import own_domain
from test.support.workers import pytest_xdist_make_scheduler

__all__ = [  # hooks
    *("pytest_collection_modifyitems", "pytest_sessionfinish", "pytest_testnodedown"),
    "pytest_xdist_make_scheduler",
]

# Workers share the cores: more threads of matrix products would only wait for each other. Before
# numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROS = Path(__file__).parent / "ros"
LONGEST_ID = 80


# How long an example takes says more about the machine than about the code.
settings.register_profile("any machine", deadline=None)
settings.register_profile("quick", deadline=None, max_examples=15)  # make check
settings.load_profile("any machine")


def pytest_configure(config: pytest.Config) -> None:
    # Before anything imports rclpy; child processes inherit it.
    os.environ["ROS_DOMAIN_ID"] = str(own_domain())
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    # Messages assert their fields' types, as those of a plain colcon build do in C.
    os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
    home = TemporaryDirectory(prefix="ros-home-")
    os.environ["ROS_HOME"] = home.name  # drivers keep tare and drift there
    config.add_cleanup(home.cleanup)
    # Tests interrupt their child processes, which a shell's background job, or nohup, would have
    # ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(signal, "SIGHUP"):  # not on Windows
        signal.signal(signal.SIGHUP, signal.SIG_DFL)


def pytest_make_parametrize_id(val: object) -> str | None:
    """Megabytes of bytes as a parameter are not its name, which goes to every worker."""
    is_long = isinstance(val, bytes | str) and len(val) > LONGEST_ID
    return f"{val[:8]!r}-{len(val)}" if is_long else None


def pytest_collect_directory(path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Tests of ROS are told of as skipped where there is none."""
    without = path == ROS and find_spec("rclpy") is None
    return Left.from_parent(parent, path=path) if without else None


class Left(pytest.Dir):
    """A folder whose tests cannot run here."""

    def collect(self) -> Never:
        pytest.skip("ROS 2 (rclpy) is not installed", allow_module_level=True)
