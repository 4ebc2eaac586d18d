# SPDX-License-Identifier: Apache-2.0

"""A node's limits, and its memory as the firmware's core reads it."""

import ctypes
import json
import re

from tactile_cdma.wire.messages import WIRE
from test.support.firmware import FIRMWARE

READER = ctypes.CFUNCTYPE(ctypes.c_uint8, ctypes.c_uint16)
GOOD, BLANK, CORRUPT, INVALID, UNFIT = range(5)
"""The enum node_memory_fault."""
EEPROM_BYTES = 1024


class Limits(ctypes.Structure):
    """The struct node_limits."""

    _fields_ = (
        ("order", ctypes.c_uint16),
        ("chip_ns", ctypes.c_uint16),
        ("scrambled_chip_ns", ctypes.c_uint16),
        ("sparse_chip_ns", ctypes.c_uint16),
        ("longest_chip_ns", ctypes.c_uint32),
        ("chip_step_ns", ctypes.c_uint16),
        ("bits_restart", ctypes.c_bool),
        ("measuring_us", ctypes.c_uint16),
        ("restart_us", ctypes.c_uint16),
        ("hears_own", ctypes.c_bool),
        ("hears_data", ctypes.c_bool),
    )


def limits(mcu: str) -> Limits:
    """What a node's sources say, which no compiler for the host takes."""
    node, (part, *of) = FIRMWARE / "node", mcu.split("-")
    kinds = {f"NODE_{kind.upper()}" for kind in of}
    board = _chosen((node / f"{part}.h").read_text(), kinds)
    names = "|".join(name.upper() for name, *_ in Limits._fields_)
    values = dict(re.findall(rf"#define BOARD_({names}) (\d+|true|false)", board))
    assert len(values) == len(Limits._fields_)
    return Limits(**{name.lower(): json.loads(value) for name, value in values.items()})


def _chosen(text: str, defined: set[str]) -> str:
    """Lines of a header that are compiled, where its choices are by what is defined."""
    chosen, lines = [True], []
    for line in text.splitlines():
        word, *rest = line.split(maxsplit=1) or [""]
        if word in ("#if", "#ifdef", "#ifndef"):
            chosen.append(word == "#ifndef" or rest[0].split()[0] in defined)
        elif word == "#else":
            chosen[-1] = not chosen[-1]
        elif word == "#endif":
            chosen.pop()
        elif all(chosen):
            lines.append(line)
    return "\n".join(lines)


def load(core: ctypes.CDLL, memory: bytes, board: Limits) -> tuple[int, bytes, bytes]:
    """What the firmware finds: its fault, and the bytes of record and row."""
    eeprom = memory + b"\xff" * (EEPROM_BYTES - len(memory))
    record = ctypes.create_string_buffer(WIRE["NodeRecord"].size)
    row = ctypes.create_string_buffer((board.order + 7) // 8)
    fault = core.node_memory_load(record, row, ctypes.byref(board), READER(eeprom.__getitem__))
    return fault, record.raw, row.raw
