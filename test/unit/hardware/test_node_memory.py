# SPDX-License-Identifier: Apache-2.0

"""A node's EEPROM: contents read back as written; settings that a node cannot use are refused."""

import shutil
import struct
import subprocess
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import NodeMemoryError, SpecError
from tactile_cdma.code.codes import scrambler_state, smallest_order
from tactile_cdma.code.frame import MEASURING_S, FrameSpec
from tactile_cdma.config.frame_rate import FAST, FOUR, MCUS
from tactile_cdma.hardware.node_memory import (
    CHANGE,
    REST,
    describe_memories,
    hearing_data,
    node_memory,
    read_node_memory,
)
from tactile_cdma.hardware.programmer import from_hex, to_hex
from tactile_cdma.wire._protocol import FIELDS, NODE_LEARN_REST, SyncWire
from tactile_cdma.wire.messages import WIRE

EEPROM = {"atmega328p": 1024, FAST: 1024, FOUR: 1024, "attiny85": 512, "attiny85-data": 512}
"""Bytes, by the data sheets."""
SPEC = FrameSpec()
MEMORY = node_memory(SPEC, 5)
SPARSE = {"codes": "sparse", "nodes": 256, "order": 48, "frame_period_s": 30e-3}
NAMES = [field.name for field in FIELDS["NodeRecord"]]


@st.composite
def specs(draw: st.DrawFn) -> FrameSpec:
    """What nodes can do, in all its variety."""
    nodes, first_row = draw(st.integers(1, 200)), draw(st.integers(0, 3))
    order = smallest_order(draw(st.integers(nodes + first_row, 400)))
    bits, parity = draw(st.integers(8, 10)), draw(st.booleans())
    chip_s = draw(st.integers(40_000, 100_000)) / 1e9
    resync = draw(st.sampled_from([0, 16, 32]))
    seed = draw(st.one_of(st.none(), st.integers(0, 2**32 - 1)))
    span = 1.3 * (bits + 1) * order * chip_s
    return FrameSpec(
        nodes=nodes,
        bits=bits,
        order=order,
        chip_s=chip_s,
        frame_period_s=(int(span * 1e6) + draw(st.integers(2_000, 50_000))) / 1e6,
        first_row=first_row,
        sign_seed=seed,
        scramble=seed is not None and order >= 4 and draw(st.booleans()),
        parity=parity,
        resync_chips=resync,
        guard_chips=3 if resync else 0,
    )


@given(specs(), st.data())
def test_what_is_written_reads_back(spec: FrameSpec, data: st.DataObject) -> None:
    node = data.draw(st.integers(1, spec.nodes))
    rest = data.draw(st.one_of(st.none(), st.integers(0, 2**spec.bits - 1)))
    threshold = data.draw(st.integers(0, 2**spec.bits - 1))
    heartbeat = data.draw(st.integers(0, 65_535))
    discipline = data.draw(st.booleans())
    memory = node_memory(
        spec, node, threshold=threshold, heartbeat=heartbeat, rest=rest, discipline=discipline
    )
    blank = bytes([0xFF]) * (EEPROM["atmega328p"] - len(memory))
    record, chips = read_node_memory(from_hex(to_hex(memory + blank)))
    assert np.array_equal(chips, spec.node_rows[node - 1])
    assert chips.dtype == np.int8
    assert record.row == spec.rows[node - 1] and record.sign == spec.signs[node - 1]
    assert (record.node, record.nodes, record.bits) == (node, spec.nodes, spec.bits)
    assert (record.parity, record.order) == (spec.parity, spec.order)
    assert record.chip_ns / 10**9 == spec.chip_s
    assert record.frame_period_us / 10**6 == spec.frame_period_s
    assert (record.resync_chips, record.guard_chips) == (spec.resync_chips, spec.guard_chips)
    assert record.scramble == (scrambler_state(spec.sign_seed) if spec.scramble else 0)
    assert record.rest == (NODE_LEARN_REST if rest is None else rest)
    assert (record.threshold, record.heartbeat) == (threshold, heartbeat)
    assert record.discipline == discipline


@pytest.mark.parametrize(
    ("nodes", "order", "node", "number", "octets"),
    [(256, 48, 256, 140, "8c081062c8a986bdec"), (4000, 912, 1, 2455, "9739e2e8db8c04293bde3bd6")],
)
def test_a_sparse_code_is_its_first_octets(
    nodes: int, order: int, node: int, number: int, octets: str
) -> None:
    """Those of docs/protocol.md."""
    memory = node_memory(
        FrameSpec(**{**SPARSE, "nodes": nodes, "order": order, "frame_period_s": 0.5}), node
    )
    record, chips = read_node_memory(memory)
    assert (record.row, record.digits) == (number, len(octets) // 2)
    assert memory[43:-4].hex() == octets and record.follow == 0
    assert np.packbits(chips < 0, bitorder="little").tobytes().hex() == octets
    assert (
        f"sparse, of {record.digits} digits, number {number} of order {order}"
        in describe_memories([(record, chips)])
    )


def test_the_bytes_lie_where_the_document_says() -> None:
    chips = SPEC.node_rows[4]
    filled = [*chips[-4:], *chips]
    packed = bytes(
        sum(1 << bit for bit, chip in enumerate(filled[start : start + 8]) if chip > 0)
        for start in range(0, len(filled), 8)
    )
    head = b"TCTN" + struct.pack(
        "<BHHHBbBBHIIHBIBHHHHH",
        *(4, 5, 16, 5, 0, SPEC.signs[4], 10, 0, 20, 50_000, 12_800, 0, 0, 0, 1, 65_535, 1, 4688),
        *(78, 19),
    )
    assert len(head) == 43
    crc = zlib.crc32(head + packed)
    assert head + packed + struct.pack("<I", crc) == MEMORY


@pytest.mark.parametrize(("nodes", "heartbeat"), [(16, 78), (16, 16), (7, 100), (30, 8), (5, 0)])
def test_heartbeats_take_turns_and_all_come_within_one_period(nodes: int, heartbeat: int) -> None:
    spec = FrameSpec(nodes=nodes, order=32, frame_period_s=20e-3)
    turns = [
        read_node_memory(node_memory(spec, node, heartbeat=heartbeat))[0].turn
        for node in range(1, nodes + 1)
    ]
    assert turns == sorted(turns)
    assert all(0 <= turn < max(1, heartbeat) for turn in turns)
    at_once = max(turns.count(turn) for turn in turns)
    assert at_once == (-(-nodes // heartbeat) if heartbeat else nodes)


@pytest.mark.parametrize(
    ("frame_period_s", "heartbeat"), [(12.8e-3, 78), (40e-3, 25), (0.6, 2), (2.0, 1), (10.0, 1)]
)
def test_heartbeat_is_a_second_unless_told_otherwise(frame_period_s: float, heartbeat: int) -> None:
    """So that nodes of a slow skin are not stale to the driver between two of them."""
    spec = FrameSpec(frame_period_s=frame_period_s)
    assert read_node_memory(node_memory(spec, 16))[0].heartbeat == heartbeat


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ({}, {"node": 0}, "node is 0; it must lie within 1…16"),
        ({}, {"node": 17}, "node is 17; it must lie within 1…16"),
        ({}, {"threshold": -1}, "threshold is -1; it must lie within 0…1023: codes have 10 bits"),
        ({}, {"threshold": 1024}, "threshold is 1024"),
        ({}, {"heartbeat": 65_536}, "heartbeat is 65536; it must lie within 0…65535"),
        ({}, {"rest": 1024}, "rest is 1024; it must lie within 0…1023: codes have 10 bits"),
        ({}, {"mcu": "z80"}, "mcu is 'z80'; it must be one of atmega328p, atmega328p-fast"),
        (SPARSE, {"mcu": "attiny85"}, "attiny85, with 8 kB of flash, has no sparse codes: take"),
        (
            {**SPARSE, "chip_s": 1.75e-6, "resync_chips": 48, "guard_chips": 50},
            {"mcu": FAST},
            "chip_us is 1.75; an atmega328p-fast makes sparse codes of chips from 2 µs on",
        ),
        ({**SPARSE, "resync_chips": 48, "guard_chips": 3}, {}, "codes without restarts: set"),
        ({**SPARSE, "bits": 12, "frame_period_s": 40e-3}, {}, "bits is 12; it must lie within 8"),
        ({"bits": 11}, {}, "bits is 11; it must lie within 8…10: a node's converter has 10 bits"),
        ({"order": 4160, "frame_period_s": 5.0}, {}, "order is 4160; it must lie within 1…4096"),
        ({"chip_s": 19e-6}, {}, "chip_us is 19; it must lie within 35…1000"),
        ({"chip_s": 50.0001e-6}, {}, "whole nanoseconds"),
        ({"frame_period_s": 11.0}, {}, "frame_period_ms is 11000; it must lie within 1…10000"),
        (
            {"frame_period_s": 10.999e-3},
            {},
            "to measure in it: frame_period_ms must be at least 11",
        ),
        (
            {"order": 1032, "frame_period_s": 3.0},
            {"mcu": "attiny85"},
            "order is 1032; it must lie within 1…1024: the attiny85 holds no longer code row",
        ),
        (
            {"order": 32, "frame_period_s": 0.1, "resync_chips": 32, "guard_chips": 1},
            {"mcu": "attiny85"},
            "guard_chips is 1, but to start anew within the frame a node takes at least 2 of 50 µs",
        ),
        (
            {"chip_s": 35e-6, "resync_chips": 32, "guard_chips": 2},
            {},
            "guard_chips is 2, but to start anew within the frame a node takes at least 3",
        ),
        ({"chip_s": 2e-6}, {}, "35…1000: the atmega328p runs at 8 MHz; an atmega328p-fast makes"),
        ({}, {"mcu": FAST}, "0.5…16: the atmega328p-fast runs at 8 MHz; an atmega328p makes such"),
        ({"chip_s": 2.1e-6}, {"mcu": FAST}, "whole cycles, in steps of 0.25 µs: 2 or 2.25"),
        (
            {"chip_s": 1e-6, "scramble": True},
            {"mcu": FAST},
            "chip_us is 1; an atmega328p-fast that scrambles takes 1.75 or more, and 0.5 if it ",
        ),
        (
            {"chip_s": 2e-6, "order": 1, "nodes": 1, "first_row": 0},
            {"mcu": FAST},
            "sends chips in octets, and fills the first one up in pairs: set order to an even",
        ),
        (
            {"chip_s": 2e-6, "order": 912, "nodes": 900, "frame_period_s": 0.02},
            {"mcu": FAST},
            "starts anew at every bit: set resync_chips to 912 and guard_chips to 40 or more in",
        ),
        (
            {"chip_s": 2e-6, "order": 20, "resync_chips": 20, "guard_chips": 39},
            {"mcu": FAST},
            "guard_chips is 39, but to start anew within the frame a node takes at least 40",
        ),
    ],
)
def test_what_a_node_cannot_do_is_refused_by_name(
    changes: dict, options: dict, message: str
) -> None:
    spec = FrameSpec(**{"nodes": 16, **changes})
    with pytest.raises(SpecError) as error:
        node_memory(spec, **{"node": 1, **options})
    assert message in str(error.value)


def test_long_rows_are_shortened_where_they_are_printed() -> None:
    spec = FrameSpec(nodes=16, order=68, frame_period_s=0.1)
    record, chips = read_node_memory(node_memory(spec, 3))
    begin = "".join("+" if chip > 0 else "-" for chip in spec.node_rows[2][:64])
    assert f": {begin} and 4 more\n" in describe_memories([(record, chips)])
    record, chips = read_node_memory(node_memory(replace(spec, order=64), 3))
    assert " more\n" not in describe_memories([(record, chips)])


def test_the_limits_themselves_are_allowed() -> None:
    tightest = FrameSpec(frame_period_s=FrameSpec().frame_s + MEASURING_S)
    assert read_node_memory(node_memory(tightest, 16))[0].frame_period_us == 11_000
    longest = FrameSpec(nodes=4095, order=4096, chip_s=35e-6, frame_period_s=1.5)
    assert node_memory(FrameSpec(chip_s=35e-6, resync_chips=32, guard_chips=3), 1)
    memory = node_memory(longest, 4095, threshold=1023, heartbeat=65_535, rest=1023)
    assert len(memory) == 559
    assert read_node_memory(memory)[0].turn == 4094 * 65_535 // 4095


@pytest.mark.parametrize(
    ("bits", "period_ms", "follow"),
    [(10, 12.8, 4688), (9, 20.0, 24_000), (10, 10_000.0, 6), (8, 100.0, 38_400), (8, 3.0, 65_535)],
)
def test_rests_follow_as_fast_whatever_the_frames(bits: int, period_ms: float, follow: int) -> None:
    """By 1 LSB of 10 bits in a minute, of 8 in 64, as far as 16 bits count frames."""
    spec = FrameSpec(nodes=2, order=4, bits=bits, frame_period_s=period_ms * 1e-3)
    assert read_node_memory(node_memory(spec, 1, speaks=REST))[0].follow == follow
    assert read_node_memory(node_memory(spec, 1, speaks=CHANGE))[0].follow == 0


@pytest.mark.parametrize("mcu", MCUS)
def test_the_longest_row_fits_the_eeprom(mcu: str) -> None:
    board = MCUS[mcu]
    restarts = {"resync_chips": board.order, "guard_chips": 5} if board.bits_restart else {}
    chip_s = min(50_000, board.longest_chip_ns) / 1e9
    spec = FrameSpec(order=board.order, chip_s=chip_s, frame_period_s=5.0, **restarts)
    assert board.sensors * len(node_memory(spec, 1, mcu=mcu)) <= EEPROM[mcu]


def with_field(name: str, value: int, *, seal: bool = True) -> bytes:
    """The memory with one field of its record changed, by default with the CRC to match."""
    values = list(WIRE["NodeRecord"].unpack_from(MEMORY))
    values[NAMES.index(name)] = value
    body = WIRE["NodeRecord"].pack(*values) + MEMORY[WIRE["NodeRecord"].size : -4]
    return body + (zlib.crc32(body).to_bytes(4, "little") if seal else MEMORY[-4:])


@pytest.mark.parametrize(
    ("memory", "message"),
    [
        (b"", "is blank"),
        (bytes([0xFF]) * 1024, "is blank"),
        (MEMORY[:35], "35 bytes are not a node's memory; its record takes 43"),
        (MEMORY[:-1], "is truncated: a code of 20 chips takes 50 bytes, there are 49"),
        (with_field("magic", 0x12345678), "begins with 0x12345678, not 0x4E544354"),
        (with_field("version", 1), "a record of version 1; known are 4"),
        (with_field("order", 4000), "is truncated: a code of 4000 chips takes 547 bytes"),
        (with_field("row", 6, seal=False), "is damaged"),
        (with_field("bits", 11), "not for this firmware: bits is 11"),
        (with_field("sign", 0), "not for this firmware: sign is 0"),
        (with_field("chip_ns", 1), "not for this firmware: chip_ns is 1"),
    ],
)
def test_reading_names_what_is_wrong(memory: bytes, message: str) -> None:
    with pytest.raises(NodeMemoryError) as error:
        read_node_memory(memory)
    assert message in str(error.value)


@given(st.integers(0, 8 * len(MEMORY) - 1))
def test_no_flipped_bit_gets_through(bit: int) -> None:
    damaged = bytearray(MEMORY)
    damaged[bit // 8] ^= 1 << bit % 8
    with pytest.raises(NodeMemoryError):
        read_node_memory(bytes(damaged))


@given(st.binary(max_size=80))
def test_any_bytes_are_an_answer(data: bytes) -> None:
    with pytest.raises(NodeMemoryError):
        read_node_memory(data)


@given(st.binary(min_size=1, max_size=1024))
def test_hex_is_read_back(data: bytes) -> None:
    assert from_hex(to_hex(data)) == data


def test_binutils_read_the_hex_in_the_same_way(tmp_path: Path) -> None:
    objcopy = shutil.which("objcopy")
    if objcopy is None:
        pytest.skip("no objcopy on this machine; apt install binutils")
    (tmp_path / "node.hex").write_text(to_hex(MEMORY))
    formats = ("-I", "ihex", "-O", "binary")
    subprocess.run([objcopy, *formats, "node.hex", "node.bin"], cwd=tmp_path, check=True)
    assert (tmp_path / "node.bin").read_bytes() == MEMORY


def test_gaps_in_the_hex_are_blank() -> None:
    assert from_hex(":01000300AB51\n:00000001FF\n") == b"\xff\xff\xff\xab"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no end record"),
        (to_hex(MEMORY).replace(":00000001FF", ""), "no end record"),
        (to_hex(MEMORY).replace("54", "55", 1), "line 1: wrong checksum"),
        ("#!/bin/sh\n", "line 1: '#!/bin/sh' is not an Intel HEX record"),
        (":0100\n", "line 1: ':0100' is not an Intel HEX record"),
        (":020000040001F9\n:00000001FF\n", "line 1: Intel HEX record of type 4"),
    ],
)
def test_broken_hex_is_named(text: str, message: str) -> None:
    with pytest.raises(NodeMemoryError) as error:
        from_hex(text)
    assert message in str(error.value)


def test_a_memory_says_that_sync_pulses_come_on_the_data_wire() -> None:
    """By its version, which a program that cannot hear them there refuses."""
    record, chips = read_node_memory(hearing_data(MEMORY, "atmega328p"))
    usual, same = read_node_memory(MEMORY)
    assert (usual.version, usual.sync_wire) == (4, SyncWire.OWN)
    assert (record.version, record.sync_wire) == (5, SyncWire.DATA)
    assert replace(record, version=4) == usual
    assert np.array_equal(chips, same)


@pytest.mark.parametrize("mcu", ["attiny85", "atmega328p-fast"])
def test_nodes_that_hear_no_data_wire_are_refused(mcu: str) -> None:
    with pytest.raises(SpecError, match=rf"sync_wire is data, but an {mcu} hears"):
        hearing_data(MEMORY, mcu)
