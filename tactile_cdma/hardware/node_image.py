# SPDX-License-Identifier: Apache-2.0

"""A node's whole flash: the program, and memories for where nothing can write the EEPROM.

Boot loaders of Arduinos write flash only. Without a valid record in its EEPROM a node looks here.
"""

from collections.abc import Sequence
from pathlib import Path

from ..base.errors import NodeMemoryError, SpecError
from ..base.named_file import naming, read_named
from ..wire._protocol import NODE_FLASH, NODE_FLASH_END
from .intel_hex import from_hex, joined_hex
from .node_memory import MCUS, NodeTable

PROGRAMS = Path(__file__).resolve().parents[2] / "firmware" / "build" / "node"
"""Where `make firmware` puts the nodes' programs."""
MOST_BYTES = 1 << 18
"""Largest program file read; chosen: Intel HEX of 32 kB takes 90 kB."""


def node_image(mcu: str, memories: Sequence[bytes], crystal_mhz: int, program: Path | None) -> str:
    """Intel HEX of a microcontroller's program, and of memories: the node's, or of nodes 1, 2, ….

    program: its Intel HEX; None: that of `make firmware`. Raises SpecError for a microcontroller
    without room, or for too many memories; NodeMemoryError, naming the file, for another program.
    """
    if not MCUS[mcu].flash_table:
        raise SpecError(
            f"the {mcu}, with 8 kB of flash, has no room for a memory there: write its EEPROM (-o "
            "FILE --programmer NAME)"
        )
    table = NodeTable(len(memories), crystal_mhz).pack() + b"".join(memories)
    if (end := NODE_FLASH + len(table)) > NODE_FLASH_END:
        room = (NODE_FLASH_END - NODE_FLASH) // len(memories[0])
        raise SpecError(
            f"{len(memories)} memories of {len(memories[0])} bytes end at 0x{end:X} of the flash, "
            f"which is free up to 0x{NODE_FLASH_END:X}: one image takes up to {room} such nodes"
        )
    path = program or PROGRAMS / f"node-{mcu}.hex"
    if program is None and not path.exists():
        raise NodeMemoryError(
            f"{path}: there is none; `make firmware` builds it, or name the program with --image"
        )
    with naming(path, NodeMemoryError):
        text = read_named(path, MOST_BYTES).decode("latin-1")
    try:
        flash = from_hex(text)
    except NodeMemoryError as error:
        raise NodeMemoryError(f"{path}: {error}") from None
    if len(flash) > NODE_FLASH:
        raise NodeMemoryError(
            f"{path}: {len(flash)} bytes; a node's program ends before 0x{NODE_FLASH:X}: has it "
            "memories already?"
        )
    if f"node-{mcu}\0".encode() not in flash:  # the firmware's BOARD_NAME
        raise NodeMemoryError(f"{path}: no program of this firmware for the {mcu}")
    return joined_hex(text, table, NODE_FLASH)
