# SPDX-License-Identifier: Apache-2.0

"""Writes all that a node of a board needs in one call of avrdude, and reads it back."""

import shlex
import subprocess
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from ..base.errors import NodeMemoryError
from ..config.frame_rate import FAST, FOUR, MCUS, TINY_ON_DATA
from .intel_hex import BLANK, from_hex, to_hex
from .programmer import AVRDUDE

FUSES = ("lfuse", "hfuse", "efuse")
"""By avrdude's names."""
NO_NUMBER = bytes([BLANK]) * 4
"""No record of an EEPROM begins so."""


@dataclass(frozen=True, slots=True)
class Board:
    """Is what avrdude has to know of a board.

    fuses: low, high, extended; none where a boot loader, which keeps its own, writes flash only.
    crystal_mhz: of a board with a boot loader, for the table in its flash.
    """

    mcu: str
    programmer: str
    fuses: tuple[int, ...] = ()
    crystal_mhz: int = 8


BOARDS = {
    "strip": Board("atmega328p", "usbasp -B 10", (0xE2, 0xD1, 0xFD)),
    **dict.fromkeys(("four", FOUR), Board(FOUR, "usbasp -B 10", (0xE2, 0xD1, 0xFD))),
    "fast": Board(FAST, "usbasp -B 10", (0xFD, 0xD1, 0xFD)),
    "attiny85": Board("attiny85", "usbasp -B 10", (0xE2, 0xD5, 0xFF)),
    TINY_ON_DATA: Board(TINY_ON_DATA, "usbasp -B 10", (0xE2, 0xD5, 0xFF)),
    "pro-mini": Board("atmega328p", "arduino -P /dev/ttyUSB0 -b 57600"),
    "pro-mini-four": Board(FOUR, "arduino -P /dev/ttyUSB0 -b 57600"),
    "uno": Board("atmega328p", "arduino -P /dev/ttyACM0 -b 115200", crystal_mhz=16),
    "nano": Board("atmega328p", "arduino -P /dev/ttyUSB0 -b 115200", crystal_mhz=16),
}
"""By name. Fuses: firmware/README.md; -B 10, as a new chip runs at 1 MHz, and 100 kHz suit that."""


@dataclass(frozen=True, slots=True)
class Content:
    """Is what a node is to hold: its flash as Intel HEX, and its EEPROM, None where that stays."""

    flash: str
    eeprom: bytes | None


def command(board: Board, content: Content, programmer: str, folder: Path) -> list[str]:
    """Return the call of avrdude that writes, verifies and reads back files in a folder."""
    writes = [f"{name}:w:0x{byte:02X}:m" for name, byte in zip(FUSES, board.fuses, strict=False)]
    memory = "flash" if content.eeprom is None else "eeprom"
    writes.append(f"flash:w:{folder / 'flash.hex'}:i")
    if content.eeprom is not None:
        writes.append(f"eeprom:w:{folder / 'eeprom.hex'}:i")
    writes.append(f"{memory}:r:{folder / 'back.hex'}:i")
    options = [word for write in writes for word in ("-U", write)]
    return [AVRDUDE, "-c", *shlex.split(programmer), "-p", MCUS[board.mcu].part, *options]


def flash(board: Board, content: Content, programmer: str) -> None:
    """Write a node, and compare what is read back. Raises NodeMemoryError with the likely cause."""
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "flash.hex").write_text(content.flash, encoding="ascii")
        (folder / "eeprom.hex").write_text(to_hex(content.eeprom or b""), encoding="ascii")
        words = command(board, content, programmer, folder)
        try:
            done = subprocess.run(words, check=False, capture_output=True, text=True)
        except OSError as error:
            raise NodeMemoryError(f"{AVRDUDE}: {error.strerror}; apt install avrdude") from None
        if done.returncode:
            told = [line for line in done.stderr.splitlines() if line.strip()]
            raise NodeMemoryError(
                f"avrdude failed with exit code {done.returncode}: is programmer {programmer!r} "
                f"connected, and the node supplied? It said: {' / '.join(told[-4:])}"
            )
        back = from_hex((folder / "back.hex").read_text(encoding="ascii"))
    wanted = from_hex(content.flash) if content.eeprom is None else content.eeprom
    back = back.ljust(len(wanted), bytes([BLANK]))
    # of a flash a boot loader leaves the pages between program and record as they were
    if any(byte not in (BLANK, read) for byte, read in zip(wanted, back, strict=False)):
        raise NodeMemoryError("what was read back is something else: is a contact loose?")
