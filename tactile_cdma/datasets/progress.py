# SPDX-License-Identifier: Apache-2.0

"""How far long work has come, on standard error: one line on a terminal, few lines in a log."""

from __future__ import annotations

import sys
import time

from ..base.program import Drawn
from ..base.text import escaped

TERMINAL_S, LOG_S = 0.2, 10.0
"""s between two reports; chosen for eyes and for logs."""


class Progress:
    """Reports a fraction of some work now and then; nothing for work shorter than the interval.

    Use as a context manager: leaving it clears the line.
    """

    def __init__(self) -> None:
        self._to_terminal = sys.stderr.isatty()
        self._interval_s = TERMINAL_S if self._to_terminal else LOG_S
        self._due_s = time.monotonic() + self._interval_s

    def at(self, fraction: float, text: str) -> None:
        """Report a fraction of work done, 0 to 1; NaN: unknown. text: what is worked on."""
        if (now_s := time.monotonic()) < self._due_s:
            return
        self._due_s = now_s + self._interval_s
        share = f"{min(max(fraction, 0.0), 1.0):4.0%} " if fraction == fraction else ""
        if self._to_terminal:
            sys.stderr.write(Drawn(f"\r\x1b[K{share}{escaped(text)}"))
            sys.stderr.flush()
        else:
            print(f"{share}{text}", file=sys.stderr, flush=True)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._to_terminal:
            sys.stderr.write(Drawn("\r\x1b[K"))
            sys.stderr.flush()
