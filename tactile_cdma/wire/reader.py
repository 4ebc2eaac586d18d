# SPDX-License-Identifier: Apache-2.0

"""Reads a stream of packets from a file descriptor."""

import os
from typing import Any

from ..base import kernel

NO_FILE = -1
"""Stands for the descriptor of a port that has none."""
READ_SIZE = 65_536
"""Bytes that one read takes at most; chosen well above the 4 kB that a Linux tty gives at once."""


def read_file(file: int, timeout_ms: int) -> tuple[bytes, bool]:
    """Read what has arrived, up to a packet's end if that comes in time; none after the time-out.

    Also whether it had been there already, so may have come long before. Raises OSError where
    nothing can be read any more.
    """
    reader = kernel.ffi.new("struct reader *")
    size = kernel.lib.reader_read(reader, file, timeout_ms)
    if size < 0:
        raise failure_of(reader)
    return bytes(kernel.ffi.buffer(reader.bytes, size)), reader.backlog


def failure_of(reader: Any) -> OSError:
    """Return why the kernel's struct reader could not read."""
    failure = reader.failure
    return OSError("end of file") if failure < 0 else OSError(failure, os.strerror(failure))
