# SPDX-License-Identifier: Apache-2.0

"""`tactile-cdma node`: files for nodes' memories, and reading them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks.paper.scaling import PAIRS, most_nodes
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.hardware.node_memory import node_memory, read_node_memory
from tactile_cdma.hardware.programmer import from_hex, to_hex
from test.support.command_line import Printed, Refused

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


def test_nodes_that_hear_the_data_wire_have_a_record_that_says_so(
    tmp_path: Path, printed: Printed, refused: Refused
) -> None:
    path, wire = tmp_path / "node.bin", ["--sync-wire", "data"]
    printed("node", "--node", 2, "-o", path, *wire)
    record, _ = read_node_memory(path.read_bytes())
    assert (record.node, record.version) == (2, 5)
    assert "sync:      pulses on the data wire\n" in printed("node", "--read", path)[0]
    said = refused("node", "--node", 2, "-o", path, *wire, "--mcu", "attiny85")
    assert "an attiny85 hears sync pulses only on a wire of their own" in said


def test_nodes_are_written_for_the_rate_that_the_driver_is_asked_for(
    tmp_path: Path, printed: Printed
) -> None:
    path = tmp_path / "node.bin"
    skin = ["--nodes", 900, "--scramble", "--rate-hz", 50]
    out, _ = printed("node", "--node", 7, "-o", path, *skin)
    assert "rate_hz 50: chip_us 2.0" in out and "node_kind fast (atmega328p-fast)" in out
    record, _ = read_node_memory(path.read_bytes())
    said = record.chip_ns, record.frame_period_us, record.resync_chips, record.guard_chips
    assert said == (2000, 20_000, 912, 40)


def test_all_nodes_get_a_file_each(tmp_path: Path, printed: Printed) -> None:
    folder = tmp_path / "new" / "skin"
    printed("node", *PARAMS, "--all", "-o", folder)
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
        "more than 1 LSB from what it sent last or from rest (code 1020), which follows",
        "once in 78 frames, first after 19",
    ):
        assert words in out


SPARSE = (
    *("--codes", "sparse", "--nodes", "64", "--order", "32", "--chip-us", "35"),
    *("--frame-period-ms", "20", "--samples-per-chip", "1"),
)


@pytest.mark.parametrize(
    ("options", "repeats", "follow"),
    [
        ((), False, 4688),
        (("--speaks", "change"), False, 0),
        ((), True, 4688),
        (SPARSE, False, 0),
        ((*SPARSE, "--speaks", "rest"), False, 3000),
        (SPARSE, True, 3000),
    ],
)
def test_nodes_speak_by_the_rule_that_the_driver_counts_on(
    tmp_path: Path,
    printed: Printed,
    refused: Refused,
    options: tuple[str, ...],
    repeats: bool,
    follow: int,
) -> None:
    (params := tmp_path / "skin.yaml").write_text(
        f"skin: {{ros__parameters: {{nodes_repeat: {str(repeats).lower()}}}}}\n"
    )
    command = ["node", "--params", params, "--node", 5, "-o", tmp_path / "node.bin", *options]
    printed(*command)
    assert read_node_memory((tmp_path / "node.bin").read_bytes())[0].follow == follow
    if repeats:
        said = refused(*command, "--speaks", "change")
        assert "set nodes_repeat to false" in said


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
        ("--all -o file", "file: File exists"),
        ("--node 1", "-o is missing"),
        ("--node 1 --hex x.hex --layout x.yaml", "--enumerate PORT writes"),
        ("--enumerate sim:// --hex x.hex", "leave out --hex"),
        ("--node 1 -o a.hex --hex b.hex", "EEPROM or flash, not both"),
        ("--node 1 -o a.hex --crystal-mhz 16", "give --hex instead of -o"),
        ("--node 1 --hex a.hex --mcu attiny85", "no room for a memory there"),
        ("--node 1 --hex a.hex --image file", "file: the Intel HEX text has no end record"),
        ("--node 1 --hex a.hex --image no", "no: No such file"),
        ("--node 1 --hex a.hex --image large", "large: has 1048577 bytes; files of this kind"),
        ("--node 1 -o d.hex --programmer usbasp", "--flash, which is missing"),
        ("--node 1 --flash", "--flash needs --board"),
        ("--node 1 --flash --board uno --mcu attiny85", "no -o, --hex, --crystal-mhz, --mcu"),
        ("--any --flash --board attiny85 --image file", "no room for a memory there"),
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


DRIFT = 0.1
"""Largest error of a chip's place at the end of a bit, chips: `make bench-timing` loses nothing."""


def test_boards_read_as_many_nodes_as_the_document_says() -> None:
    """The document's table has the pairs of boards in the order of PAIRS, and a sparse one last."""
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    table = page.partition("| nodes | node, digitizer | limit |")[2].partition("\n\n")[0]
    rows = [re.findall(r"[\d,]+", row.split("|")[1]) for row in table.splitlines()[2:-1]]
    told = [int(number.replace(",", "")) for row in rows for number in row]
    assert told == [most_nodes(pair) for pair in PAIRS.values()]


@pytest.mark.parametrize(("order", "ppm"), [(1024, 49), (4096, 12)])
def test_crystals_are_as_accurate_as_the_document_says(order: int, ppm: int) -> None:
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert f"{ppm} ppm at {order:,}" in " ".join(page.split())
    assert round(1e6 * DRIFT / 2 / order) == ppm  # digitizer and node may be off either way


def test_a_node_of_four_sensors_gets_the_memories_of_four_taxels(
    tmp_path: Path, printed: Printed, refused: Refused
) -> None:
    options = [*PARAMS, "--mcu", "atmega328p-four"]
    printed("node", *options, "--all", "-o", tmp_path)
    files = sorted(tmp_path.glob("node*.hex"))
    assert len(files) == 4
    spec = SkinConfig.of(read_file(ROOT / "config/skin.yaml")).spec
    for first, path in zip((1, 5, 9, 13), files, strict=True):
        of_four = [node_memory(spec, first + sensor) for sensor in range(4)]
        assert from_hex(path.read_text()) == b"".join(of_four)
    flash, program = tmp_path / "flash.hex", tmp_path / "program.hex"
    program.write_text(to_hex(b"node-atmega328p-four\0"))
    printed("node", *options, "--node", 2, "--hex", flash, "--image", program)
    for path in (files[1], flash):
        out = printed("node", "--read", path).out
        assert "5 to 8 of 16, a sensor each\n" in out
        assert re.findall(r"(?m)^(?:code|… of (\d)): +row (\d+) of order 20", out) == [
            *(("", "5"), ("6", "6"), ("7", "7"), ("8", "8"))
        ]
    alone = tmp_path / "alone.bin"  # behind it what an EEPROM had: of another node
    alone.write_bytes(node_memory(spec, 5) + node_memory(spec, 7))
    assert "5 of 16\n" in printed("node", "--read", alone).out
    alone.write_bytes(from_hex(files[1].read_text())[:-1] + b"?")
    assert "the memory is damaged" in refused("node", "--read", alone)
    one = tmp_path / "one.hex"
    said = refused("node", *options, "--node", 5, "-o", one)
    assert "node is 5; it must lie within 1…4" in said
    said = refused("node", *options, "--any", "--hex", one)
    assert "takes no number by pressing" in said
    said = refused("node", *options, "--nodes", 14, "--node", 1, "-o", one)
    assert "set nodes to a multiple of 4" in said
