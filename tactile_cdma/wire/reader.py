# SPDX-License-Identifier: Apache-2.0

"""Reads a stream of packets from a file descriptor."""

import os
import select

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


# The kernel's waits for the end of a packet: a tty gives large ones in parts.
read_file = kernel.either("read_packets", numpy_read)
