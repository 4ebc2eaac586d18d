# SPDX-License-Identifier: Apache-2.0

"""Makes files of what a node is programmed with, and tells how avrdude writes them.

A node's memory goes into its EEPROM. Boot loaders of Arduinos write flash only: for them an image
has the program and, behind it, memories, at which a node without one in its EEPROM looks. Files are
in Intel HEX, the text in which programmers of microcontrollers take a memory.
"""

import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ..base.errors import NodeMemoryError, SpecError
from ..base.named_file import naming, read_named
from ..base.whole_file import replace_file, replacing
from ..config.frame_rate import MCUS
from ..wire._protocol import NODE_FLASH, NODE_FLASH_END
from .node_memory import Memory, NodeTable, read_memories, read_node_table

HEX, RAW = (".hex", ".eep"), (".bin",)
"""Endings of file names: Intel HEX, and the bare bytes."""
AVRDUDE = "avrdude"
EEPROM, FLASH = "eeprom", "flash"
"""Memories by its names."""
PROGRAMS = Path(__file__).resolve().parents[2] / "firmware" / "build" / "node"
"""Folder to which `make firmware` writes the nodes' programs."""
MOST_BYTES = 1 << 20
"""Largest file read; chosen: Intel HEX of 64 kB takes 180 kB."""
_HEX_DATA, _HEX_END = 0, 1
"""Types of record; others are for memories beyond 64 kB."""
PER_RECORD = 16
"""Data bytes of a line."""
BLANK = 0xFF
"""An erased byte: what is between the records."""


def write_memory(path: Path, data: bytes) -> None:
    """Write a memory in the format of the file name's ending. Raises NodeMemoryError."""
    content = to_hex(data).encode() if _is_hex(path) else data
    with naming(path, NodeMemoryError), replacing(path) as file:
        file.write(content)


def write_image(path: Path, text: str) -> None:
    """Write the Intel HEX of a node's flash. Raises NodeMemoryError."""
    if path.suffix.lower() != HEX[0]:
        raise NodeMemoryError(f"{path}: the name of a flash's Intel HEX must end in {HEX[0]}")
    with naming(path, NodeMemoryError):
        replace_file(path, text)


def node_image(mcu: str, memories: Sequence[bytes], crystal_mhz: int, program: Path | None) -> str:
    """Join a program with memories, the node's or those of nodes 1, 2, …, as Intel HEX.

    program: as program_text takes it, whose errors this raises, too; SpecError for a
    microcontroller without room, or for too many memories.
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
    return to_hex(table, NODE_FLASH, program_text(mcu, program))


def program_text(mcu: str, program: Path | None) -> str:
    """Read a program, that of `make firmware` where none is named, as Intel HEX.

    Raises NodeMemoryError, naming the file, where it is another microcontroller's or no program.
    """
    path = program or PROGRAMS / f"node-{mcu}.hex"
    if program is None and not path.exists():
        raise NodeMemoryError(
            f"{path}: there is none; `make firmware` builds it, or name the program with --image"
        )
    with _reading(path):
        text = read_named(path, MOST_BYTES).decode("latin-1")
        flash = from_hex(text)
        if len(flash) > NODE_FLASH:
            raise NodeMemoryError(
                f"{len(flash)} bytes; a node's program ends before 0x{NODE_FLASH:X}: does it "
                "hold memories already?"
            )
        if f"node-{mcu}\0".encode() not in flash:  # the firmware's BOARD_NAME
            raise NodeMemoryError(f"no program of this firmware for the {mcu}")
    return text


def node_files(directory: Path, nodes: int) -> list[Path]:
    """Name a file for each of so many nodes: node01.hex, … Makes the directory if it is missing.

    Raises NodeMemoryError where it cannot be made.
    """
    with naming(directory, NodeMemoryError):
        directory.mkdir(parents=True, exist_ok=True)
    width = max(2, len(str(nodes)))
    return [directory / f"node{node:0{width}}.hex" for node in range(1, nodes + 1)]


def read_memory(path: Path) -> tuple[list[Memory], NodeTable | None]:
    """Read memories of a node's sensors in a file that write_memory, write_image or avrdude made.

    Of an image those of the first node, and its table. Raises NodeMemoryError, naming the file and
    what is wrong.
    """
    is_hex = _is_hex(path)
    with _reading(path):
        content = read_named(path, MOST_BYTES)
        memory = from_hex(content.decode("latin-1")) if is_hex else content
        if len(memory) <= NODE_FLASH:
            return read_memories(memory), None
        return read_node_table(memory[NODE_FLASH:])


def avrdude(path: Path, mcu: str, programmer: str, memory: str = EEPROM) -> list[str]:
    """Return the command that writes such a file to a node's EEPROM or FLASH, and verifies it.

    programmer: its name, and what else avrdude has to be told of it: "arduino -P /dev/ttyUSB0".
    """
    kind = "i" if _is_hex(path) else "r"
    connected = [AVRDUDE, "-c", *shlex.split(programmer)]
    return [*connected, "-p", MCUS[mcu].part, "-U", f"{memory}:w:{path}:{kind}"]


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Name the file in errors, also in those of what is in it."""
    try:
        yield
    except (OSError, NodeMemoryError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise NodeMemoryError(f"{path}: {reason}") from None


def _is_hex(path: Path) -> bool:
    """Tell whether the name asks for Intel HEX. Raises NodeMemoryError for an unknown ending."""
    ending = path.suffix.lower()
    if ending not in HEX + RAW:
        raise NodeMemoryError(
            f"{path}: unknown ending {ending!r}; {' or '.join(HEX)} for Intel HEX, "
            f"{' '.join(RAW)} for the bare bytes"
        )
    return ending in HEX


def to_hex(data: bytes, address: int = 0, text: str = ":00000001FF") -> str:
    """Return up to 64 kB from an address on as text, after a text that ends before it."""
    *before, end = [line.strip() for line in text.splitlines() if line.strip()]
    places = range(0, len(data), PER_RECORD)
    records = [_record(address + at, data[at : at + PER_RECORD]) for at in places]
    return "\n".join([*before, *records, end, ""])


def from_hex(text: str) -> bytes:
    """Read the memory from address 0 to the last byte that the text gives; gaps are blank.

    Raises NodeMemoryError, naming the line, for anything that is not such a text.
    """
    memory = bytearray()
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        address, kind, data = _parse(line.strip(), number)
        if kind == _HEX_END:
            return bytes(memory)
        if kind != _HEX_DATA:
            raise NodeMemoryError(
                f"line {number}: Intel HEX record of type {kind}; a node's EEPROM takes only "
                f"{_HEX_DATA} and {_HEX_END}: is this another memory?"
            )
        end = address + len(data)
        memory.extend(bytes([BLANK]) * (end - len(memory)))
        memory[address:end] = data
    raise NodeMemoryError("the Intel HEX text has no end record: is it truncated?")


def _record(address: int, data: bytes) -> str:
    body = bytes([len(data), address >> 8, address & 0xFF, _HEX_DATA]) + data
    return f":{(body + bytes([-sum(body) & 0xFF])).hex().upper()}"


def _parse(line: str, number: int) -> tuple[int, int, bytes]:
    """Address, type and data of a record."""
    try:
        record = bytes.fromhex(line.removeprefix(":"))
    except ValueError:
        record = b""
    if not line.startswith(":") or len(record) < 5 or len(record) != record[0] + 5:
        raise NodeMemoryError(f"line {number}: {line[:20]!r} is not an Intel HEX record")
    if sum(record) & 0xFF:
        raise NodeMemoryError(f"line {number}: wrong checksum; the text is damaged")
    return int.from_bytes(record[1:3], "big"), record[3], record[4:-1]
