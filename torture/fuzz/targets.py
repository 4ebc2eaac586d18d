# SPDX-License-Identifier: Apache-2.0

"""All targets by name; those of short texts that users give, URLs and ids, are defined here."""

from __future__ import annotations

from collections.abc import Callable

from tactile_cdma.base.errors import ParameterError, PortError, SpecError, TactileError
from tactile_cdma.replay.player import ReplayOptions
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.discovery import SerialPort, find_usb
from tactile_cdma.wire.identity import parse_id, shown_id

from ..files import readers
from . import files, streams
from .target import Target

PORTS = (SerialPort("/dev/ttyACM0", "a board", "E661"), SerialPort("/dev/ttyACM1", "twin", "77"))


def read_url(options: type[SimOptions | ReplayOptions], scheme: str) -> Callable[[bytes], object]:
    """Read the options of a simulated skin, or of a replay."""
    return lambda data: options.from_url(scheme + data.decode(errors="replace"))


def read_names(data: bytes) -> None:
    """Read a digitizer's id or a USB serial number."""
    text = data.decode(errors="replace")
    try:
        digitizer_id = parse_id(text)
        assert parse_id(shown_id(digitizer_id)) == digitizer_id, "shown as another one"
    except ParameterError:
        find_usb("usb://" + text, PORTS)


SIM = {
    "scene": b"scene=hand&noise=0.02&dead=3,17&seed=1",
    "frame": b"nodes=9&bits=12&order=16&chip_us=20&timing=gap&stretch=0.05",
    "layout": b"layout=/nowhere.yaml&speed=0",
}
REPLAY = {"file": b"touch.skin?speed=2&loop=1&start=0.5&end=9", "home": b"~/a%20b.skin"}
NAMES = {"id": b"0xE6:60:58:38:83:72:A4:32", "usb": b"e661", "twice": b"77"}
TEXTS = (
    Target("sim", read_url(SimOptions, "sim://?"), lambda: SIM, (SpecError,), 256),
    Target("replay", read_url(ReplayOptions, "replay://"), lambda: REPLAY, (SpecError,), 256),
    Target("names", read_names, lambda: NAMES, (PortError, TactileError), 128),
)
GROUPS = {
    "mutated bytes and packets of a port": streams.TARGETS,
    "mutated files": (*files.TARGETS, *readers.TARGETS),
    "mutated URLs and ids": TEXTS,
}
TARGETS = {target.name: target for group in GROUPS.values() for target in group}
