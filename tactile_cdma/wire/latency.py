# SPDX-License-Identifier: Apache-2.0

"""Which USB adapters hold bytes back, although they were asked not to."""

import os
from pathlib import Path

ADAPTERS = Path("/sys/bus/usb-serial/devices")
"""Where Linux has a folder for each; FTDI's driver puts a file latency_timer into it, ms."""
LEAST_MS = 2
"""Latency that is not worth a word, ms; chosen: FTDI's default is 16, its least 1."""


def held_back(device: str, adapters: Path = ADAPTERS) -> str:
    """A sentence about the adapter of an open port if it holds bytes back, else nothing.

    device: path of the port, or a URL.
    """
    timer = adapters / os.path.basename(os.path.realpath(device)) / "latency_timer"
    try:
        held_ms = int(timer.read_text("ascii"))
    except (OSError, ValueError):  # an adapter, or a port, without one
        return ""
    if held_ms <= LEAST_MS:
        return ""
    return (
        f"its USB adapter holds bytes back for up to {held_ms} ms, and that could not be changed: "
        f"echo 1 | sudo tee {timer}"
    )
