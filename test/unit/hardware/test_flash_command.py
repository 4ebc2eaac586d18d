# SPDX-License-Identifier: Apache-2.0

"""`tactile-cdma node --flash`: avrdude writes fuses, program and record into emulated nodes."""

from __future__ import annotations

import builtins
import re
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import pytest

from tactile_cdma.hardware.node_memory import read_memories, read_node_table
from tactile_cdma.hardware.programmer import to_hex
from test.support.command_line import Printed
from test.support.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parents[3]
WIRED = ["--params", str(ROOT / "config/wired_skin.yaml")]
PROGRAM = bytes(range(200)) + b"node-atmega328p\0node-atmega328p-four\0"
MEGA, TINY = bytes.fromhex("1e950f"), bytes.fromhex("1e930b")
ARGUMENTS = {0x41: 1, 0x42: 20, 0x45: 5, 0x55: 2, 0x56: 4}
"""Bytes of the STK500's commands that have any."""
WRITES = {0xA0: "lfuse", 0xA8: "hfuse", 0xA4: "efuse"}
READS = {(0x50, 0x00): "lfuse", (0x58, 0x08): "hfuse", (0x50, 0x08): "efuse"}
"""Instructions of an ATmega328P, data sheet, table 28-19, for its fuses."""


class Stk500:
    """A programmer on a TCP port that speaks STK500, with a new microcontroller behind it.

    Commands: application note AVR061. refuses: bytes of the EEPROM do not stay.
    """

    def __init__(self, signature: bytes, refuses: bool = False) -> None:
        self.signature, self.address, self.refuses = signature, 0, refuses
        self.memories = {b"E": bytearray(b"\xff" * 1024), b"F": bytearray(b"\xff" * 32768)}
        self.fuses = {"lfuse": 0x62, "hfuse": 0xD9, "efuse": 0xFF}
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]
        self.thread = threading.Thread(target=self.serve, daemon=True)

    def __enter__(self) -> Stk500:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        socket.create_connection(("127.0.0.1", self.port)).close()  # where nobody ever called
        self.thread.join(PATIENCE_S)
        self.socket.close()

    def serve(self) -> None:
        connection, _ = self.socket.accept()
        with connection, connection.makefile("rwb") as line:
            while command := line.read(1):
                answer = self.answer(command[0], line)
                assert line.read(1) == b" "
                line.write(b"\x14" + answer + b"\x10")
                line.flush()

    def answer(self, command: int, line: BinaryIO) -> bytes:
        body = line.read(ARGUMENTS.get(command, 0))
        if command == 0x41:  # a parameter: versions and voltages, of no consequence
            return b"\x02"
        if command == 0x55:
            self.address = int.from_bytes(body, "little")
        elif command == 0x56:
            return self.instruct(body)
        elif command in (0x64, 0x74):
            size, name = int.from_bytes(line.read(2), "big"), line.read(1)
            at = self.address * (2 if name == b"F" else 1)
            if command == 0x74:
                return bytes(self.memories[name][at : at + size])
            told = line.read(size)
            self.memories[name][at : at + size] = bytes(size) if self.refuses else told
        return b""

    def instruct(self, body: bytes) -> bytes:
        """Obey an instruction of the part itself: signature, fuses, erasure."""
        if body[0] == 0x30:
            return self.signature[body[2] :][:1]
        if body[0] == 0xAC and body[1] in WRITES:
            self.fuses[WRITES[body[1]]] = body[3]
        if body[:2] == b"\xac\x80":
            self.memories[b"F"][:] = b"\xff" * 32768
        return bytes([self.fuses.get(READS.get((body[0], body[1]), ""), 0)])


Bench = Callable[[Stk500], list[str]]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """Say what is put on the bench; returns the words of a command that flashes it."""
    if shutil.which("avrdude") is None:
        pytest.skip("no avrdude on this machine; apt install avrdude")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "program.hex").write_text(to_hex(PROGRAM))

    def command(node: Stk500) -> list[str]:
        (tmp_path / ".avrduderc").write_text(f'default_serial = "net:127.0.0.1:{node.port}";')
        return ["node", "--flash", "--programmer", "stk500v1", "--image", "program.hex", *WIRED]

    yield command


def typing(monkeypatch: pytest.MonkeyPatch, *lines: str) -> list[str]:
    """Have a person type lines; returns what is asked."""
    asked: list[str] = []
    left = list(lines)

    def answer(question: str) -> str:
        asked.append(question)
        if not left:
            raise EOFError
        return left.pop(0)

    monkeypatch.setattr(builtins, "input", answer)
    return asked


@pytest.mark.parametrize(("board", "number", "taxels"), [("strip", 9, [9]), ("four", 3, [9, 12])])
def test_a_node_of_a_strip_gets_fuses_program_and_number(
    board: str,
    number: int,
    taxels: list[int],
    bench: Bench,
    monkeypatch: pytest.MonkeyPatch,
    printed: Printed,
) -> None:
    """Its own oscillator: the strips have no crystal, and one that waits for it is lost."""
    typing(monkeypatch, "")
    with Stk500(MEGA) as node:
        out = printed(*bench(node), "--board", board, "--node", number).out
    assert f"node {number}: ok, read back" in out and "flashed=1 left=0 log=flash.log" in out
    assert (node.fuses["lfuse"], node.fuses["hfuse"]) == (0xE2, 0xD1)
    assert node.fuses["efuse"] & 7 == 5, "reset below 2.7 V; of the other bits there are none"
    assert node.memories[b"F"].startswith(PROGRAM)
    (first, _), *further = read_memories(bytes(node.memories[b"E"]))
    assert [first.node, *(record.node for record, _ in further[-1:])] == taxels
    told = rf"\S+ {board} node {number}: ok, read back\n"
    assert re.fullmatch(told, Path("flash.log").read_text())


def test_a_boot_loader_gets_program_and_number_in_flash(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
    typing(monkeypatch, "")
    with Stk500(MEGA) as node:
        node.memories[b"F"][0x2000:0x2100] = bytes(0x100)  # of an older and longer program
        printed(*bench(node), "--board", "uno", "--node", 3)
    assert node.fuses == {"lfuse": 0x62, "hfuse": 0xD9, "efuse": 0xFF}, "it keeps its own"
    assert set(node.memories[b"E"]) == {0xFF}
    [(record, _)], table = read_node_table(bytes(node.memories[b"F"][0x3000:0x3100]))
    assert (record.node, table.crystal_mhz) == (3, 16)


def test_one_after_the_other_with_mistakes(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
    """A wrong chip, one whose contact is bad, one left out: each is told, and asked for again."""
    asked = typing(monkeypatch, "", "s", "q")
    with Stk500(TINY) as tiny:
        out = printed(*bench(tiny), "--board", "strip", "--all", code=1).out
    assert "node 1: avrdude failed with exit code 1" in out and "flashed=0 left=16" in out
    assert [question.split(":")[0] for question in asked] == ["node 1", "node 1", "node 2"]
    assert tiny.fuses["lfuse"] == 0x62, "nothing was written into another chip"
    typing(monkeypatch, "")
    with Stk500(MEGA, refuses=True) as node:
        out = printed(*bench(node), "--board", "strip", "--node", 1, code=1).out
    assert "flashed=0 left=1" in out
    assert len(Path("flash.log").read_text().splitlines()) == 2


def test_nodes_without_numbers_until_the_person_ends(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
    """An older number in the EEPROM is cleared."""
    typing(monkeypatch, "", "q")
    with Stk500(MEGA) as node:
        node.memories[b"E"][:8] = b"\x51TC older"[:8]
        out = printed(*bench(node), "--board", "strip", "--any").out
    assert "any node: ok, read back" in out
    assert node.memories[b"E"][:4] == b"\xff" * 4
    assert read_node_table(bytes(node.memories[b"F"][0x3000:0x4000]))[1].count == 16


def test_a_dry_run_tells_the_commands_and_touches_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "program.hex").write_text(to_hex(PROGRAM))
    words = ["node", "--flash", "--dry-run", "--image", "program.hex", *WIRED, "--all"]
    out = printed(*words, "--board", "strip").out.splitlines()
    assert out[0].startswith("node 1: avrdude -c usbasp -B 10 -p m328p -U lfuse:w:0xE2:m")
    assert out[15].startswith("node 16: ") and len(out) == 16
    out = printed(*words, "--board", "pro-mini").out.splitlines()
    assert "-c arduino -P /dev/ttyUSB0 -b 57600" in out[0] and "fuse" not in out[0]
    assert [path.name for path in tmp_path.iterdir()] == ["program.hex"]


def test_a_missing_avrdude_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "program.hex").write_text(to_hex(PROGRAM))
    typing(monkeypatch, "")
    words = ["node", "--flash", "--image", "program.hex", *WIRED, "--node", "1", "--board", "strip"]
    assert "apt install avrdude" in printed(*words, code=1).out
