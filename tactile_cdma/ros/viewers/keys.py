# SPDX-License-Identifier: Apache-2.0

"""Reads keys from a terminal without waiting for them or for Enter."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from types import TracebackType


class Keys:
    """Within its context stdin, a terminal, delivers keys at once and does not echo them."""

    def __enter__(self) -> Keys:
        self._stdin = sys.stdin.fileno()
        self._before = termios.tcgetattr(self._stdin)
        tty.setcbreak(self._stdin)  # Ctrl-C still interrupts
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        termios.tcsetattr(self._stdin, termios.TCSADRAIN, self._before)

    def read(self) -> str:
        """The keys pressed since the last call."""
        if not select.select([self._stdin], [], [], 0)[0]:
            return ""
        return os.read(self._stdin, 64).decode("ascii", errors="ignore")
