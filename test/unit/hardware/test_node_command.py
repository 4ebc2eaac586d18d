# SPDX-License-Identifier: Apache-2.0

"""`tactile-cdma node`: files for nodes' memories, reading them, and avrdude."""

from __future__ import annotations

import shutil
import socket
import threading
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.commands.cli import main
from tactile_cdma.hardware.intel_hex import from_hex, to_hex
from tactile_cdma.hardware.node_memory import node_memory, read_node_memory
from test.support.command_line import Printed, Refused
from test.support.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parents[3]
PARAMS = ["--params", str(ROOT / "config/skin.yaml")]
PROGRAM = bytes(range(200)) + b"node-atmega328p\0"


def test_the_memory_of_a_node_follows_the_parameter_file(tmp_path: Path, printed: Printed) -> None:
    params = tmp_path / "skin.yaml"
    params.write_text(
        "skin:\n  ros__parameters:\n"
        "    {nodes: 30, order: 32, frame_period_ms: 25.0, parity: true, sign_seed: 7,\n"
        "     resync_chips: 32, guard_chips: 2, first_row: 2}\n"
    )
    path = tmp_path / "node05.hex"
    out, err = printed("node", "--params", params, "--node", 5, "-o", path)
    assert f"eeprom:w:{path}:i" in out and "-p m328p" in out
    assert err == ""
    spec = FrameSpec(30, 10, 32, 50e-6, 25e-3, 2, 7, parity=True, resync_chips=32, guard_chips=2)
    assert from_hex(path.read_text()) == node_memory(spec, 5)


def test_options_of_the_node_arrive_in_its_memory(tmp_path: Path, printed: Printed) -> None:
    path = tmp_path / "node.bin"
    options = "--threshold 3 --heartbeat 50 --rest 1000 --no-discipline --mcu attiny85"
    printed("node", "--node", 16, "-o", path, *options.split())
    expected = node_memory(
        FrameSpec(), 16, threshold=3, heartbeat=50, rest=1000, discipline=False, mcu="attiny85"
    )
    assert path.read_bytes() == expected


def test_all_nodes_get_a_file_each(tmp_path: Path, printed: Printed) -> None:
    folder = tmp_path / "new" / "skin"
    printed("node", *PARAMS, "--node", "all", "-o", folder)
    files = sorted(folder.iterdir())
    assert [path.name for path in files] == [f"node{node:02}.hex" for node in range(1, 17)]
    records, rows = zip(*(read_node_memory(from_hex(p.read_text())) for p in files), strict=True)
    assert [record.node for record in records] == list(range(1, 17))
    assert np.array_equal(np.array(rows) @ np.array(rows, dtype=int).T, 20 * np.eye(16))


def test_a_file_tells_what_it_says(tmp_path: Path, printed: Printed) -> None:
    path = tmp_path / "node.eep"
    printed("node", "--node", 5, "--rest", 1020, "-o", path)
    out = printed("node", "--read", path).out
    for words in (
        "5 of 16",
        "5 of order 20, sign +1: -+--++-++----+-+-+++",
        "more than 1 LSB from rest (code 1020)",
        "once in 78 frames, first after 19",
    ):
        assert words in out


def test_program_and_record_are_one_file(tmp_path: Path, printed: Printed) -> None:
    (program := tmp_path / "program.hex").write_text(to_hex(PROGRAM))
    options = [*PARAMS, "--image", program, "--crystal-mhz", 16]
    out = printed("node", "--all", "--hex", tmp_path / "skin", *options).out
    assert f"flash:w:{tmp_path}/skin/node01.hex:i" in out and "-c arduino -P" in out
    for number in (1, 16):
        path = tmp_path / "skin" / f"node{number:02}.hex"
        flash = from_hex(path.read_text())
        assert flash.startswith(PROGRAM) and set(flash[len(PROGRAM) : 0x3000]) == {0xFF}
        assert flash[0x3000:0x3003] == bytes([1, 0, 16])
        assert flash[0x3003:] == node_memory(FrameSpec(scramble=True), number)
        out = printed("node", "--read", path).out
        assert f"{number} of 16\n" in out and "memory, of a node with 16 MHz" in out


def test_an_image_for_any_node_says_so(tmp_path: Path, printed: Printed, refused: Refused) -> None:
    (program := tmp_path / "program.hex").write_text(to_hex(PROGRAM))
    image = tmp_path / "any.hex"
    printed("node", *PARAMS, "--any", "--hex", image, "--image", program)
    out = printed("node", "--read", image).out
    assert "of any node with 8 MHz" in out and "once in 78 frames\n" in out
    assert "1 to 16 of 16: it takes its number when it is pressed" in out
    flash, first = from_hex(image.read_text()), node_memory(FrameSpec(scramble=True), 1)
    for octets, told in (
        ({0x3003 + 2 * len(first): 0}, "memory 3 of 16: this is not a node's memory"),
        (dict(enumerate(first, 0x3003 + len(first))), "memory 2 of 16 is that of node 1"),
        ({0x3000: 17}, "memory 17 of 17: the memory is"),
        ({0x3002: 20}, "it says 16 nodes with 20 MHz"),
        ({0x3001: 255}, "it says 65296 nodes with 8 MHz"),
        (dict.fromkeys(range(0x3000, 0x3003), 0xFF), "a program without a node's memory"),
    ):
        damaged = bytes(octets.get(at, octet) for at, octet in enumerate(flash))
        image.write_text(to_hex(damaged + b"\xff" * 64))
        assert told in refused("node", "--read", image)
    (tmp_path / "any.bin").write_bytes(flash[:0x3001])
    assert "the image is truncated" in refused("node", "--read", str(tmp_path / "any.bin"))
    program.write_text(to_hex(PROGRAM.replace(b"p\0", b"p-fast\0")))
    said = refused("node", *PARAMS, "--any", "--hex", image, "--image", str(program))
    assert "no program of this firmware for the atmega328p" in said


@pytest.mark.parametrize("heartbeat", ["0", "300"])
def test_nodes_too_silent_for_the_driver_are_warned_of(
    tmp_path: Path, printed: Printed, heartbeat: str
) -> None:
    arguments = ["node", "--node", 1, "-o", tmp_path / "a.hex", "--heartbeat", heartbeat]
    assert "is stale to the driver after 3 s" in printed(*arguments).err
    assert printed(*arguments, "--threshold", 0).err == ""  # talks in every frame


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--node 17 -o a.hex", "node is 17; it must lie within 1…16"),
        ("--node 1 -o a.txt", "a.txt: unknown ending '.txt'"),
        ("--node 1 -o no/where.hex", "no/where.hex: No such file"),
        ("--node all -o file", "file: File exists"),
        ("--node 1", "-o is missing"),
        ("--node 1 --hex x.hex --layout x.yaml", "--enumerate PORT writes"),
        ("--enumerate sim:// --hex x.hex", "leave out --hex"),
        ("--node 1 -o a.hex --hex b.hex", "EEPROM or flash, not both"),
        ("--node 1 -o a.hex --crystal-mhz 16", "give --hex instead of -o"),
        ("--node 1 --hex a.hex --mcu attiny85", "no room for a memory there"),
        ("--node 1 --hex a.hex --image file", "file: the Intel HEX text has no end record"),
        ("--node 1 --hex a.hex --image no", "no: No such file"),
        ("--node 1 --hex a.hex --image large", "large: has 1048577 bytes, such files at"),
        ("--node all -o d --programmer usbasp", "--node is all"),
        ("--node 1 -o a.hex --timing gap", "timing is 'gap'"),  # it would hear no pulse
        ("--node 1 -o a.hex --bits 12", "bits is 12"),
        ("--read no.hex", "no.hex: No such file"),
        ("--read blank.bin", "blank.bin: the memory is blank"),
        ("--read file.hex", "file.hex: line 1: 'words' is not an Intel HEX record"),
    ],
)
def test_mistakes_are_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused, arguments: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    Path("file.hex").write_text("words")
    Path("large").write_bytes(bytes(1 + (1 << 20)))
    Path("blank.bin").write_bytes(b"\xff" * 1024)
    before = sorted(Path().iterdir())
    assert message in refused("node", *arguments.split())
    assert sorted(Path().iterdir()) == before


def test_a_missing_avrdude_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Printed
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    path = tmp_path / "a.hex"
    words = "node", "--node", 1, "-o", path, "--programmer", "usbasp"
    assert "apt install avrdude" in printed(*words, code=1).err
    assert path.exists()


ARGUMENTS = {0x41: 1, 0x42: 20, 0x45: 5, 0x55: 2, 0x56: 4}
"""Bytes of the STK500's commands that have any."""


class Stk500:
    """A programmer on a TCP port that speaks STK500, with a microcontroller's EEPROM behind it.

    Only what avrdude asks of it to write an EEPROM. Commands: application note AVR061.
    """

    def __init__(self, signature: bytes) -> None:
        self.signature, self.eeprom, self.address = signature, bytearray(b"\xff" * 1024), 0
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]
        self.thread = threading.Thread(target=self.serve)

    def __enter__(self) -> Stk500:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with socket.create_connection(("127.0.0.1", self.port)):  # where nobody ever called
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
        elif command == 0x56:  # an instruction of the part itself: signature, fuses
            return self.signature[body[2] :][:1] if body[0] == 0x30 else b"\x00"
        elif command in (0x64, 0x74):
            size, memory = int.from_bytes(line.read(2), "big"), line.read(1)
            assert memory == b"E"
            place = slice(self.address, self.address + size)
            if command == 0x74:
                return bytes(self.eeprom[place])
            self.eeprom[place] = line.read(size)
        return b""


def test_avrdude_writes_the_memory_into_a_node(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    if shutil.which("avrdude") is None:
        pytest.skip("no avrdude on this machine; apt install avrdude")
    monkeypatch.setenv("HOME", str(tmp_path))
    path = tmp_path / "node.hex"
    command = ["node", *PARAMS, "--node", "9", "-o", str(path), "--programmer", "stk500v1"]
    with Stk500(signature=bytes.fromhex("1e950f")) as board:
        (tmp_path / ".avrduderc").write_text(f'default_serial = "net:127.0.0.1:{board.port}";')
        assert main(command) == 0, capfd.readouterr().err
    assert read_node_memory(bytes(board.eeprom))[0].node == 9
    with Stk500(signature=bytes.fromhex("1e930b")) as tiny:
        (tmp_path / ".avrduderc").write_text(f'default_serial = "net:127.0.0.1:{tiny.port}";')
        assert main(command) == 1
    assert "avrdude failed with exit code 1" in capfd.readouterr().err
    assert set(tiny.eeprom) == {0xFF}
