# SPDX-License-Identifier: Apache-2.0

"""Programs as a user starts them."""

import subprocess
import sys
from pathlib import Path
from typing import Any

from test.support.waiting import PATIENCE_S


def run_program(*command: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a program to its end, with nothing to read; give its exit code and what it printed.

    options: of subprocess.run.
    """
    given: dict[str, Any] = {"capture_output": True, "text": True, "timeout": PATIENCE_S} | options
    return subprocess.run(command, stdin=subprocess.DEVNULL, **given)


def run_python(*words: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """The same of this Python, to which the words are given."""
    return run_program(sys.executable, *words, **options)
