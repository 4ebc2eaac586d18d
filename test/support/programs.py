# SPDX-License-Identifier: Apache-2.0

"""Programs as a user starts them."""

import os
import re
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

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


@contextmanager
def started(command: Sequence[str | Path], **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A program that does not outlive the context, whatever happens; options: of Popen."""
    with subprocess.Popen(command, **{"text": True, **options}) as process:
        try:
            yield process
        finally:
            process.kill()


def on_a_terminal(
    command: Sequence[str | Path], *steps: tuple[str, bytes | Callable[[], object]], **given: str
) -> str:
    """What a program writes to a terminal until it ends.

    steps: a pattern to wait for in all that was written, and what is typed or done then. given:
    variables of its environment.
    """
    fcntl, termios = pytest.importorskip("fcntl"), pytest.importorskip("termios")
    master, terminal = os.openpty()
    options: dict[str, Any] = {
        "start_new_session": True,
        "preexec_fn": lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # so that Ctrl-C is a signal
        "env": {**os.environ, **given},
    }
    shown, deadline = b"", time.monotonic() + PATIENCE_S
    with (
        open(master, "r+b", buffering=0) as screen,
        started(command, stdin=terminal, stdout=terminal, **options) as program,
    ):
        os.close(terminal)
        for pattern, then in steps:
            while not re.search(pattern, shown.decode(errors="ignore")):
                assert time.monotonic() < deadline, shown[-2000:]
                if select.select([screen], [], [], 0.1)[0]:
                    shown += screen.read(65_536)
            screen.write(then) if isinstance(then, bytes) else then()
        with suppress(OSError):  # the terminal's end of file
            while select.select([screen], [], [], PATIENCE_S)[0]:
                shown += screen.read(65_536)
        assert program.wait(PATIENCE_S) == 0, f"{program.returncode}: {shown[-2000:]!r}"
    return shown.decode()
