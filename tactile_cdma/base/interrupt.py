# SPDX-License-Identifier: Apache-2.0

"""Ctrl-C and SIGTERM, for commands that run until they are told to stop."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """Whether to stop, without a lock.

    A threading.Event has one: the handler of a second signal would wait for ever if it came while
    that of the first one held it.
    """

    def __init__(self) -> None:
        self._is_set = False

    def set(self) -> None:
        """Stop."""
        self._is_set = True

    def is_set(self) -> bool:
        """Whether it was told to."""
        return self._is_set


@contextmanager
def stop_event(seconds: float | None) -> Iterator[Stop]:
    """What Ctrl-C, SIGTERM or, after `seconds`, a timer sets."""
    stop = Stop()
    timer = threading.Timer(seconds or 0.0, stop.set)
    if seconds is not None:
        timer.start()
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in SIGNALS}
    try:
        yield stop
    finally:
        timer.cancel()
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def terminable() -> Iterator[None]:
    """SIGTERM interrupts as Ctrl-C does, so that unfinished files are removed."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
