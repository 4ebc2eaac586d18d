# SPDX-License-Identifier: Apache-2.0

"""A board that prints lines of numbers on a pty, and the sums that its sketch would print."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

CHECK = 1 << 32
NO_TTY = "Windows has no pseudo-terminals"


def check_of(numbers: list[int]) -> int:
    """The check of examples/arduino_text, written as there."""
    check = 0
    for number in numbers:
        check = (check * 31 + number) % CHECK
    return check


def checked(numbers: list[int]) -> bytes:
    return ",".join(map(str, [*numbers, check_of(numbers)])).encode() + b"\r\n"


@contextmanager
def printing(line: Callable[[int], bytes], rate_hz: float = 100.0) -> Iterator[str]:
    """Print line(0), line(1) … at this rate; yields the device's path."""
    tty = pytest.importorskip("tty", reason=NO_TTY)
    host, device = os.openpty()
    tty.setraw(device)
    stop = threading.Event()

    def run() -> None:
        began_s, made = time.monotonic(), 0
        while not stop.wait(max(0.0, began_s + made / rate_hz - time.monotonic())):
            data = line(made)
            while data and not stop.is_set():
                data = data[os.write(host, data) :]
            made += 1

    os.set_blocking(host, True)
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield os.ttyname(device)
    finally:
        stop.set()
        os.set_blocking(host, False)
        os.close(device)  # ends a write that nobody reads
        thread.join()
        os.close(host)
