# SPDX-License-Identifier: Apache-2.0

"""Reads keys from a terminal without waiting for them or for Enter."""

import os
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def typed_keys() -> Iterator[Callable[[], str]]:
    """Have stdin, a terminal, deliver keys at once and not echo them.

    Yields a function that returns the keys pressed since its last call.
    """
    stdin = sys.stdin.fileno()
    before = termios.tcgetattr(stdin)

    def read() -> str:
        if not select.select([stdin], [], [], 0)[0]:
            return ""
        return os.read(stdin, 64).decode("ascii", errors="ignore")

    tty.setcbreak(stdin)  # Ctrl-C still interrupts
    try:
        yield read
    finally:
        termios.tcsetattr(stdin, termios.TCSADRAIN, before)
