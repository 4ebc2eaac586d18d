# SPDX-License-Identifier: Apache-2.0

"""Intel HEX, the text in which programmers of microcontrollers take a memory."""

from ..base.errors import NodeMemoryError

DATA, END = 0, 1
"""Types of record; others are for memories beyond 64 kB."""
PER_RECORD = 16
"""Data bytes of a line."""
BLANK = 0xFF
"""An erased byte: what is between the records."""


def to_hex(data: bytes, address: int = 0, text: str = ":00000001FF") -> str:
    """Return up to 64 kB from an address on as text, after a text that ends before it."""
    *before, end = [line.strip() for line in text.splitlines() if line.strip()]
    records = [
        _record(address + at, data[at : at + PER_RECORD]) for at in range(0, len(data), PER_RECORD)
    ]
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
        if kind == END:
            return bytes(memory)
        if kind != DATA:
            raise NodeMemoryError(
                f"line {number}: Intel HEX record of type {kind}; a node's EEPROM takes only "
                f"{DATA} and {END}: is this another memory?"
            )
        end = address + len(data)
        memory.extend(bytes([BLANK]) * (end - len(memory)))
        memory[address:end] = data
    raise NodeMemoryError("the Intel HEX text has no end record: is it truncated?")


def _record(address: int, data: bytes) -> str:
    body = bytes([len(data), address >> 8, address & 0xFF, DATA]) + data
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
