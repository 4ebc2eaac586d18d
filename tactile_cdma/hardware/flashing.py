# SPDX-License-Identifier: Apache-2.0

"""Writes all that each node of a board needs in one call of avrdude, and reads it back."""

import shlex
import subprocess
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from ..base.errors import NodeMemoryError
from ..base.named_file import naming
from ..config.frame_rate import FAST, FOUR, MCUS, TINY_ON_DATA
from .programmer import AVRDUDE, BLANK, from_hex, node_image, program_text, to_hex

FUSES = ("lfuse", "hfuse", "efuse")
"""By avrdude's names."""
NO_NUMBER = bytes([BLANK]) * 4
"""No record of an EEPROM begins so."""
ANY_NODE = "any node"
"""Name of one without a number, of which there may be any number."""
OK = "ok, read back"
KEYS = "(Enter; s: leave it out; q: end) "


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


def contents(
    board: Board, memories: Mapping[str, list[bytes]], program: Path | None
) -> dict[str, Content]:
    """Return what each node is to hold, by its name; several memories: it has no number yet.

    A boot loader writes flash only, where a number goes before an older one in the EEPROM.
    """
    made = {}
    for name, theirs in memories.items():
        if board.fuses and len(theirs) == 1:
            made[name] = Content(program_text(board.mcu, program), theirs[0])
        else:
            image = node_image(board.mcu, theirs, board.crystal_mhz, program)
            made[name] = Content(image, NO_NUMBER if board.fuses else None)
    return made


def run(
    name: str, nodes: Mapping[str, Content], programmer: str | None, log: Path, dry: bool
) -> int:
    """Write nodes with a person at the terminal; returns the exit code, 1 where some are left.

    One without a number is written until the person ends. log: gets a line for every attempt. dry:
    only the commands are told.
    """
    board, written = BOARDS[name], []
    programmer = programmer or board.programmer
    if dry:
        for node, content in nodes.items():
            print(f"{node}:", shlex.join(command(board, content, programmer, Path(node))))
        return 0
    todo = [*nodes]
    while todo:
        node = todo[0]
        if (key := _answer(f"{node}: connect the {name} {KEYS}")) == "q":
            break
        if key != "s":
            try:
                flash(board, nodes[node], programmer)
                result = OK
            except NodeMemoryError as error:
                result = str(error)
            print(f"{node}: {result}", flush=True)
            with naming(log, NodeMemoryError), log.open("a", encoding="utf-8") as file:
                file.write(f"{time.strftime('%Y-%m-%dT%H:%M:%S%z')} {name} {node}: {result}\n")
            if result == OK:
                written.append(node)
            if result != OK or node == ANY_NODE:
                continue
        del todo[0]
    left = [node for node in nodes if node not in written]
    print(f"flashed={len(written)} left={len(left)} log={log}")
    return int(bool(left))


def _answer(question: str) -> str:
    try:
        return input(question).strip().lower()
    except EOFError:
        return "q"
