# SPDX-License-Identifier: Apache-2.0

"""Digitizers behind real ttys, and the USB descriptions that a computer would report for them."""

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from serial.tools.list_ports_common import ListPortInfo

from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.pty import Digitizer, serve
from tactile_cdma.wire.messages import Info

from .printing_board import NO_TTY, printing
from .waiting import PATIENCE_S

ALL_PRESSED = SimOptions(scene="all")


class Board(VirtualDigitizer):
    """A virtual digitizer that says it is a board, with this id: for tests of what boards do."""

    def __init__(self, options: SimOptions = ALL_PRESSED, number: str = "E66058388372A432") -> None:
        self._number = bytes.fromhex(number)
        super().__init__(options)

    def info(self) -> Info:
        return replace(super().info(), digitizer_id=self._number)


@contextmanager
def plugged(power_up: Callable[[], Digitizer], link: Path | None = None) -> Iterator[str]:
    """What power_up makes on a pty, served by a thread of its own; the path to open."""
    pytest.importorskip("tty", reason=NO_TTY)
    stop, ready = threading.Event(), threading.Event()
    paths: list[Path] = []

    def on_ready(path: Path) -> None:
        paths.append(path)
        ready.set()

    thread = threading.Thread(target=serve, args=(power_up, link, stop, on_ready))
    thread.start()
    try:
        assert ready.wait(PATIENCE_S)
        yield str(paths[0])
    finally:
        stop.set()
        thread.join()


def board(seed: int, options: str = "scene=all") -> Callable[[], VirtualDigitizer]:
    """A virtual digitizer at power-up; its id tells the seed."""
    return lambda: VirtualDigitizer(SimOptions.from_url(f"sim://?seed={seed}&{options}"))


def board_id(seed: int) -> str:
    return (b"sim\0" + seed.to_bytes(4, "little")).hex().upper()


def usb_port(device: str, serial_number: str | None) -> ListPortInfo:
    """What pyserial's list says of a board of ours; only the kernel's list is made up by tests."""
    port = ListPortInfo(device)
    port.vid, port.pid = 0x1209, 0x0001
    port.serial_number, port.product = serial_number, "Tactile skin digitizer"
    port.apply_usb_info()
    return port


def chattering(content: bytes = b"", period_s: float = 0.05) -> AbstractContextManager[str]:
    """A tty that says the same again and again, or nothing."""
    return printing(lambda _: content, 1 / period_s)
