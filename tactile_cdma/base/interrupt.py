# SPDX-License-Identifier: Apache-2.0

"""Ctrl-C, SIGTERM and SIGHUP, for commands that run until they are told to stop."""

import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

HANG_UP = getattr(signal, "SIGHUP", None)
"""Signal of a terminal that is closed; Windows has none."""
SIGNALS = tuple(filter(None, (signal.SIGINT, signal.SIGTERM, HANG_UP)))
"""Signals that end a command: Ctrl-C, a service manager, a terminal that is closed."""


class Stop:
    """Whether to stop, without a lock.

    A threading.Event has one: the handler of a second signal would wait for ever if it came while
    that of the first one held it.
    """

    def __init__(self) -> None:
        self._is_set = False

    def set(self) -> None:
        self._is_set = True

    def is_set(self) -> bool:
        return self._is_set


_STOPS: list[Stop] = []


def is_told_to_stop() -> bool:
    """Tell whether this process is to end, for work that holds up who looks at the Stop."""
    return any(map(Stop.is_set, _STOPS))


@contextmanager
def stop_event(seconds: float | None) -> Iterator[Stop]:
    """Yield a Stop that one of SIGNALS or, after `seconds`, a timer sets."""
    stop = Stop()
    timer = threading.Timer(seconds or 0.0, stop.set)
    if seconds is not None:
        timer.start()
    with _handling(SIGNALS, lambda *_: stop.set()):
        _STOPS.append(stop)
        try:
            yield stop
        finally:
            _STOPS.remove(stop)
            timer.cancel()


@contextmanager
def terminable() -> Iterator[None]:
    """Let all of SIGNALS interrupt as Ctrl-C does, so that unfinished files are removed."""
    with _handling(SIGNALS[1:], signal.default_int_handler):
        yield


@contextmanager
def _handling(signals: Iterable[int], handler: Callable[..., object]) -> Iterator[None]:
    """Handle signals in the context, but for SIGHUP where nohup has it ignored."""
    taken = [one for one in signals if one != HANG_UP or signal.getsignal(one) != signal.SIG_IGN]
    before = {number: signal.signal(number, handler) for number in taken}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
