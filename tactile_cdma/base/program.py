# SPDX-License-Identifier: Apache-2.0

"""What every program of this package prints passes here: untrusted text, and output that fails."""

import io
import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from typing import Any, ParamSpec, TextIO, cast

from .errors import TactileError
from .text import escaped, plain

P = ParamSpec("P")
INTERRUPTED = 128 + signal.SIGINT
"""The exit code of Ctrl-C that shells know."""


class Drawn(str):
    """Text with escape sequences of our own, which a terminal is to obey."""

    __slots__ = ()


class _Output:
    """A stream that escapes what is not printable, but for ends of lines and what is Drawn.

    is_needed: False: whether it can be written is nobody's concern, as of messages on stderr.
    """

    def __init__(self, stream: TextIO, is_needed: bool) -> None:
        self._stream = stream
        self._fault = () if is_needed else (OSError,)

    def write(self, text: str) -> int:
        shown = text if isinstance(text, Drawn) else "\n".join(map(escaped, text.split("\n")))
        with suppress(*self._fault):
            self._stream.write(shown)
        return len(text)

    def flush(self) -> None:
        with suppress(*self._fault):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def say(line: str) -> None:
    """Print a line at once, also of text that has several."""
    print(plain(line), flush=True)


def tell(text: object, name: str = "tactile-cdma") -> None:
    """Print a line for people on stderr, which names the program."""
    print(f"{name}: {plain(str(text))}", file=sys.stderr, flush=True)


def program(name: str) -> Callable[[Callable[P, int]], Callable[P, int]]:
    """Make a program of a function that returns an exit code; misuse ends it in one line.

    Its text is escaped, and printed nowhere if stdout is closed. 0 where the reader of its output
    has seen enough, 1 where that cannot be written.
    """

    def decorated(main: Callable[P, int]) -> Callable[P, int]:
        @wraps(main)
        def run(*words: P.args, **named: P.kwargs) -> int:
            before = sys.stdout, sys.stderr
            _open_what_is_closed()
            with open(os.devnull, "w", encoding="utf-8") as nowhere:
                sys.stdout = _output(before[0] or nowhere, is_needed=True)
                sys.stderr = _output(before[1] or nowhere, is_needed=False)
                try:
                    return _exit_code(lambda: main(*words, **named), name)
                finally:
                    sys.stdout, sys.stderr = before

        return run

    return decorated


def _exit_code(run: Callable[[], int], name: str) -> int:
    try:
        try:
            code = run()
        except SystemExit:  # of argparse, which has printed help
            sys.stdout.flush()
            raise
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        code = 0
    except (TactileError, OSError) as error:  # a full disk behind our output, for one
        tell(error, name)
        code = 1
    except KeyboardInterrupt:
        code = INTERRUPTED
    try:
        sys.stdout.flush()
    except OSError:  # discard what cannot be written; Python would try once more when it ends
        with open(os.devnull, "w", encoding="utf-8") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
    return code


def _output(stream: TextIO, is_needed: bool) -> TextIO:
    if isinstance(stream, io.TextIOWrapper):  # a terminal of another alphabet
        stream.reconfigure(errors="backslashreplace")
    return cast(TextIO, _Output(stream, is_needed))


def _open_what_is_closed() -> None:
    """Have no file or port take the number of stdin, stdout or stderr: ROS logs there, say."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
