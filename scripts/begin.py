# SPDX-License-Identifier: Apache-2.0

"""Begins the programs beside it; tells in one line where this Python cannot run them.

No program itself. Old Pythons, too, have to be able to read it.
"""

import os
import re
import signal
import sys
from importlib import import_module

LEAST_PYTHON = (3, 11)

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C during the imports: no traceback
if os.getpid() == 1:  # of a container: Linux ends process 1 only by signals that it handles
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: os._exit(128 + number))


def main_of(module):
    """Import a module's main, or end the program with the reason why that cannot be."""
    try:
        if sys.version_info < LEAST_PYTHON:
            raise ImportError("3.11 is the oldest that will do")
        return import_module(module).main
    except ImportError as error:
        sys.exit(f"{os.path.basename(sys.argv[0])}: {_wrong_python(error)}")


def _wrong_python(error):
    present = f"{sys.version_info[0]}.{sys.version_info[1]}"
    reason = str(error).strip().split("\n")[0]
    text = f"cannot run by {sys.executable} (Python {present}): {reason}; "
    sourced = re.findall(r"/python(\d\.\d+)/", os.environ.get("PYTHONPATH", ""))
    if sourced and present not in sourced:
        return (
            f"{text}the ROS 2 that is sourced has Python {sourced[0]}: take the other one off PATH "
            "(conda deactivate)"
        )
    return (
        f"{text}source the setup.bash of ROS 2 and of the workspace, and let no other Python be "
        "first on PATH; tactile-cdma doctor tells what is missing"
    )
