"""What ends a command that runs until it is told to stop."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def stop_event(seconds: float | None) -> Iterator[threading.Event]:
    """An event that Ctrl-C, SIGTERM or the end of a time span sets."""
    stop = threading.Event()
    timer = threading.Timer(seconds or 0.0, stop.set)
    if seconds is not None:
        timer.start()
    before = {
        number: signal.signal(number, lambda *_: stop.set())
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield stop
    finally:
        timer.cancel()
        for number, handler in before.items():
            signal.signal(number, handler)
