# SPDX-License-Identifier: Apache-2.0

"""Runs when the Python of .venv starts, so that plain `.venv/bin/python` finds everything.

setup_env.py copies this file into the venv; a .pth file there calls start(). That line must sort
before ros_wheels_bootstrapper.pth, which restarts Python once to set LD_LIBRARY_PATH. Another one,
the last, calls end().
"""

import _signal as signal  # `signal` itself takes as long to load as all of Python
import os
import sys

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C while Python starts: no traceback


def start(checkout: str) -> None:
    """Let edits in the checkout count at once, and let ROS find the messages built in this venv."""
    # Before site-packages, where CMake has installed this package too; its __init__.py joins both.
    sys.path.insert(0, checkout)
    _prepend("AMENT_PREFIX_PATH", sys.prefix)

    lib = os.path.join(sys.prefix, "lib")
    if lib in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep):
        return
    # The loader reads LD_LIBRARY_PATH only at process start.
    if os.path.exists(os.path.join(os.path.dirname(__file__), "ros_wheels_bootstrapper.pth")):
        # A parent process from another venv may have left its "done" mark.
        os.environ.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None)
    else:
        _prepend("LD_LIBRARY_PATH", lib)
        os.execv(sys.executable, sys.orig_argv)  # noqa: S606  # itself


def end() -> None:
    """Let Ctrl-C raise KeyboardInterrupt, as usual."""
    if signal.getsignal(signal.SIGINT) == signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _prepend(variable: str, path: str) -> None:
    paths = [p for p in os.environ.get(variable, "").split(os.pathsep) if p and p != path]
    os.environ[variable] = os.pathsep.join([path, *paths])
