# SPDX-License-Identifier: Apache-2.0

"""Asks USB adapters not to hold bytes back, and tells which of them do all the same."""

import os
from contextlib import suppress
from pathlib import Path

import serial

ADAPTERS = Path("/sys/bus/usb-serial/devices")
"""Where Linux has a folder for each; FTDI's driver puts a file latency_timer into it, ms."""
LEAST_MS = 2
"""Latency that is not worth a word, ms; chosen: FTDI's default is 16, its least 1."""


def reduce_latency(port: serial.SerialBase, device: str, adapters: Path = ADAPTERS) -> str:
    """Have bytes handed on as they come; returns a sentence about an adapter that does not.

    device: path of the port, or a URL.
    """
    with suppress(AttributeError, NotImplementedError, OSError, ValueError):
        port.set_low_latency_mode(True)
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
