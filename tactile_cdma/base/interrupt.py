# SPDX-License-Identifier: Apache-2.0

"""Ctrl-C, SIGTERM and SIGHUP, for commands that run until they are told to stop."""

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""SIGHUP: the terminal has gone, as when a connection by ssh breaks."""


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
    """What Ctrl-C, SIGTERM, SIGHUP (but under nohup) or, after `seconds`, a timer sets."""
    stop = Stop()
    timer = threading.Timer(seconds or 0.0, stop.set)
    if seconds is not None:
        timer.start()
    try:
        with _handled(SIGNALS, lambda *_: stop.set()):
            yield stop
    finally:
        timer.cancel()


@contextmanager
def terminable() -> Iterator[None]:
    """SIGTERM and SIGHUP interrupt as Ctrl-C does, so that unfinished files are removed."""
    with _handled((signal.SIGTERM, signal.SIGHUP), signal.default_int_handler):
        yield


@contextmanager
def _handled(
    numbers: Iterable[signal.Signals], handler: Callable[[int, FrameType | None], object]
) -> Iterator[None]:
    """Signals have this handler; but not SIGHUP where it is ignored, as nohup wants it."""
    before = {number: signal.getsignal(number) for number in numbers}
    if before.get(signal.SIGHUP) == signal.SIG_IGN:
        del before[signal.SIGHUP]
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)
