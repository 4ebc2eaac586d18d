# SPDX-License-Identifier: Apache-2.0

"""Reads a stream of packets from a file descriptor."""

import os
import select
from typing import Any

from ..base import kernel

NO_FILE = -1
"""Stands for the descriptor of a port that has none."""
READ_SIZE = 65_536
"""Bytes that one read takes at most; chosen well above the 4 kB that a Linux tty gives at once."""


def numpy_read(file: int, timeout_ms: int) -> tuple[bytes, bool]:
    """Return what has arrived, after a wait for a byte; nothing after the time-out.

    Also whether it had been there already, so may have come long before. Raises OSError where
    nothing can be read any more.
    """
    poll = select.poll()
    poll.register(file, select.POLLIN)
    had_waited = bool(poll.poll(0))
    if not had_waited and not poll.poll(timeout_ms):
        return b"", False
    data = os.read(file, READ_SIZE)
    if not data:
        raise OSError("end of file")
    return data, had_waited


def compiled_read(file: int, timeout_ms: int) -> tuple[bytes, bool]:
    """As numpy_read, and waits for the end of a packet: a tty gives large ones in parts."""
    reader = kernel.ffi.new("struct reader *")
    size = kernel.compiled.reader_read(reader, file, timeout_ms)
    if size < 0:
        raise failure_of(reader)
    return bytes(kernel.ffi.buffer(reader.bytes, size)), reader.backlog


def failure_of(reader: Any) -> OSError:
    """Return why the kernel's struct reader could not read."""
    failure = reader.failure
    return OSError("end of file") if failure < 0 else OSError(failure, os.strerror(failure))


read_file = numpy_read if kernel.compiled is None else compiled_read
