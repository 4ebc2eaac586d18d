# SPDX-License-Identifier: Apache-2.0

"""Bounds on what a reader may take: time, and memory beyond what the process has by then."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np

np.eye(128) @ np.eye(128)  # buffers that numpy takes once, 30 MB or so, are no reader's

LONGEST_S, LONGEST_WAIT_S = 20.0, 120.0
"""For one reader and one file: of the processor's time, and on a busy computer's clock."""
AGAIN_S = 1.0
"""What goes on, to clean up, say, is ended again after this time."""
ROOM_BYTES = 1 << 30
"""Memory that a reader may take beyond what the process has by then."""
SHARE, FREE_BYTES = 10, 64 << 20
"""Memory that a reader may take for a file: so many times its size, and that much more."""


class HangError(BaseException):
    """What is raised in a reader that takes too long; none may take it for a file's error."""


def room(path: Path) -> int:
    """Return the bytes that a reader of this file may take."""
    size = path.stat().st_size if path.is_file() else 0
    return min(ROOM_BYTES, SHARE * size + FREE_BYTES)


@contextmanager
def bounded(
    most_bytes: int = ROOM_BYTES, longest_s: float = LONGEST_S, wait_s: float = LONGEST_WAIT_S
) -> Iterator[None]:
    """End what hangs by HangError, and what takes too much memory by MemoryError."""

    def late(*_: object) -> None:
        raise HangError(f"it takes more than {longest_s:g} s, or waits {wait_s:g} s")

    if find_spec("resource") is None:  # on Windows nothing bounds memory
        yield
        return
    import resource

    before = [signal.signal(number, late) for number in (signal.SIGALRM, signal.SIGPROF)]
    limits = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + most_bytes, limits[1]))
    signal.setitimer(signal.ITIMER_REAL, wait_s, AGAIN_S)
    signal.setitimer(signal.ITIMER_PROF, longest_s, AGAIN_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.setitimer(signal.ITIMER_PROF, 0)
        resource.setrlimit(resource.RLIMIT_AS, limits)
        for number, handler in zip((signal.SIGALRM, signal.SIGPROF), before, strict=True):
            signal.signal(number, handler)
