# SPDX-License-Identifier: Apache-2.0

"""CRC-32, COBS and packets in C, and the generated header.

Against shared vectors, the host's parser and arbitrary bytes.
"""

import ctypes
import json
import zlib
from ctypes import byref, c_bool, c_uint8, c_uint16
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.wire._protocol import PacketType
from tactile_cdma.wire.messages import Configure, FrameLayout, GetInfo, Start, Stop
from tactile_cdma.wire.packets import (
    MAX_PACKET,
    PacketParser,
    PacketWriter,
    cobs_decode,
    cobs_encode,
    wrap,
)
from test.support.core_digitizer import declare
from test.support.examples import examples
from test.support.firmware import CORE, STRICT, need, run
from test.support.programs import run_program

VECTORS = json.loads((CORE.parent / "vectors" / "protocol.json").read_text())
KEPT = 37  # bytes of a payload that the reader keeps
MOST = 20_000  # bytes of the longest thing here
few = examples(60)
data = st.one_of(
    st.binary(max_size=600),
    st.lists(st.sampled_from([b"\0", b"\1" * 253, b"\2" * 254, b"\3" * 255]), max_size=5).map(
        b"".join
    ),
)


class Read(NamedTuple):
    type: int
    sequence: int
    size: int
    payload: bytes


@pytest.fixture(scope="module")
def lib(core: ctypes.CDLL) -> ctypes.CDLL:
    declare(core)
    return core


def cobs_in_ring(lib: ctypes.CDLL, content: bytes, piece: int = MOST, begin: int = 0) -> bytes:
    """COBS and delimiter, encoded in a ring of exactly the largest size needed."""
    size = len(content) + -(-len(content) // 254) + 1
    begin %= size
    ring = (c_uint8 * size)(*[0xEE] * size)
    end = lib.shim_cobs(content, len(content), piece, ring, size, begin)
    wire = bytes(ring)
    if end <= begin:
        return wire[begin:] + wire[:end]
    return wire[begin:end]


def write(
    lib: ctypes.CDLL,
    kind: int,
    sequence: int,
    payload: bytes,
    piece: int = MOST,
    spare: int = 0,
    begin: int = 0,
) -> bytes:
    """A packet's bytes from a writer whose ring exceeds the largest packet by `spare` bytes."""
    raw = 3 + len(payload) + 4
    room = raw + -(-raw // 254) + 1 + spare
    wire = (c_uint8 * (room + 1))()
    size = lib.shim_write(kind, sequence, payload, len(payload), piece, room, wire, begin)
    return bytes(wire[:size])


def read_all(lib: ctypes.CDLL, data: bytes, piece: int = MOST) -> tuple[list[Read], int]:
    """Packets and errors that a reader finds in bytes delivered in pieces."""
    reader, packets = lib.shim_reader_new(), []
    whole, kind, sequence = c_bool(), c_uint8(), c_uint16()
    payload = (c_uint8 * KEPT)()
    for start in range(0, len(data), piece):
        rest = data[start : start + piece]
        while rest:
            rest = rest[lib.shim_read(reader, rest, len(rest), byref(whole)) :]
            if whole:
                size = lib.shim_packet(reader, byref(kind), byref(sequence), payload)
                kept = bytes(payload[: min(size, KEPT)])
                packets.append(Read(kind.value, sequence.value, size, kept))
    errors = lib.shim_reader_errors(reader)
    lib.shim_reader_free(reader)
    return packets, errors


# CRC-32


def test_crc_vectors(lib: ctypes.CDLL) -> None:
    for vector in VECTORS["crc32"]:
        data = bytes.fromhex(vector["data"])
        assert lib.shim_crc32(0, data, len(data)) == vector["crc"]


def test_the_small_crc_is_the_same(tmp_path: Path) -> None:
    library = tmp_path / "small.so"
    flags = ("-O1", "-fPIC", "-shared", "-DCRC32_SMALL")
    run(need("cc"), *STRICT, *flags, CORE / "crc32.c", "-o", library)
    crc32_update = ctypes.CDLL(str(library)).crc32_update
    crc32_update.restype = ctypes.c_uint32
    crc32_update.argtypes = (ctypes.c_uint32, ctypes.c_char_p, ctypes.c_size_t)
    every = bytes(range(256)) * 3
    assert crc32_update(crc32_update(0, every, 100), every[100:], 668) == zlib.crc32(every)


# COBS


def test_cobs_vectors(lib: ctypes.CDLL) -> None:
    for vector in VECTORS["cobs"]:
        content, encoded = bytes.fromhex(vector["data"]), bytes.fromhex(vector["encoded"])
        if content:  # a packet is never empty
            assert cobs_in_ring(lib, content) == encoded + b"\0"
        assert decoded(lib, encoded) == content


@few
@given(data.filter(len), st.integers(1, 300), st.integers(0, 1000))
def test_cobs_is_the_hosts_in_any_pieces_and_anywhere_in_the_ring(
    lib: ctypes.CDLL, content: bytes, piece: int, begin: int
) -> None:
    wire = cobs_in_ring(lib, content, piece, begin)
    assert wire == cobs_encode(content) + b"\0"
    assert decoded(lib, wire[:-1]) == content


@few
@given(st.one_of(data, st.binary(max_size=12)))
def test_what_is_no_cobs_is_told_from_what_is(lib: ctypes.CDLL, content: bytes) -> None:
    encoded = content.replace(b"\0", b"\5")
    try:
        expected = cobs_decode(encoded)
    except ValueError:
        expected = None
    assert decoded(lib, encoded) == expected


def decoded(lib: ctypes.CDLL, encoded: bytes) -> bytes | None:
    out = (c_uint8 * (len(encoded) + 1))()
    size = lib.shim_cobs_decode(encoded, len(encoded), out)
    return None if size < 0 else bytes(out[:size])


# Packets


@pytest.mark.parametrize("vector", VECTORS["packets"], ids=lambda vector: vector["name"])
def test_packet_vectors_both_ways(lib: ctypes.CDLL, vector: dict[str, Any]) -> None:
    wire, body = bytes.fromhex(vector["wire"]), bytes.fromhex(vector["body"])
    payload = body[3:]
    assert write(lib, vector["type"], vector["sequence"], payload) == wire
    packet = Read(vector["type"], vector["sequence"], len(payload), payload[:KEPT])
    assert read_all(lib, wire) == ([packet], 0)


@few
@given(
    st.integers(0, 255),
    st.integers(0, 65_535),
    data,
    st.integers(1, 300),
    st.integers(0, 5),
    st.integers(0, 2000),
)
def test_a_packet_is_the_hosts_wherever_the_ring_wraps(
    lib: ctypes.CDLL, kind: int, sequence: int, payload: bytes, piece: int, spare: int, begin: int
) -> None:
    wire = write(lib, kind, sequence, payload, piece, spare, begin)
    assert wire == wrap(bytes([kind]) + sequence.to_bytes(2, "little") + payload)


def test_a_packet_without_room_is_dropped_whole(lib: ctypes.CDLL) -> None:
    assert write(lib, 2, 0, bytes(500))
    assert write(lib, 2, 0, bytes(500), spare=-1) == b""


LAYOUT = FrameLayout.of(FrameSpec(), 4)
COMMANDS = st.lists(
    st.sampled_from([GetInfo(), Start(), Stop(), Configure(LAYOUT, quiet_uv=90_000)]), max_size=6
)
GARBAGE = st.one_of(
    st.binary(max_size=80),
    st.just(b"\0\0"),
    st.just(PacketWriter(9).encode(Start())[:-3]),
    st.binary(min_size=1, max_size=60).map(lambda body: cobs_encode(body) + b"\0"),
    st.just(b"\7" * 17_000),
)


@few
@given(st.lists(st.tuples(GARBAGE, COMMANDS), max_size=5), st.sampled_from([1, 7, 64, MOST]))
def test_commands_among_garbage_are_found_and_every_other_run_is_one_error(
    lib: ctypes.CDLL, parts: list[tuple[bytes, list[Any]]], piece: int
) -> None:
    stream, writer, sent = b"", PacketWriter(65_533), []
    for garbage, commands in parts:
        stream += garbage + b"\0"
        for command in commands:
            stream += writer.encode(command)
            sent.append((command.TYPE, command.pack()))
    packets, errors = read_all(lib, stream, piece)
    assert [(p.type, p.payload) for p in packets if p.type in set(PacketType)] == sent
    host = PacketParser()
    host.feed(stream)
    seen = host.counters
    too_short = sum(1 for run in stream.split(b"\0") if run and is_short(run))
    assert len(packets) == seen.packets - too_short
    assert errors == seen.crc_errors + seen.framing_errors + seen.resyncs + too_short


def is_short(run: bytes) -> bool:
    """Whether a run has a good CRC, but no room for a header."""
    try:
        raw = cobs_decode(run)
    except ValueError:
        return False
    return 4 <= len(raw) < 7 and zlib.crc32(raw) == 0x2144DF1C


def test_a_body_without_a_whole_header_is_one_error(lib: ctypes.CDLL) -> None:
    assert read_all(lib, wrap(b"") + wrap(b"\x82") + wrap(b"\x82\0")) == ([], 3)


def test_runs_that_are_too_long_are_one_error_and_end_with_the_next_zero(lib: ctypes.CDLL) -> None:
    start = PacketWriter(5).encode(Start())
    for length, errors in ((MAX_PACKET, 1), (100_000, 1)):
        found, counted = read_all(lib, b"\1" * length + b"\0" + start)
        assert ([p.sequence for p in found], counted) == ([5], errors)
    longest = wrap(b"\x99" * (16_401 + 3))
    assert len(longest) == MAX_PACKET
    ((packet,), errors) = read_all(lib, longest)
    assert (packet.type, packet.size, errors) == (0x99, 16_401, 0)
    ((), errors) = read_all(lib, wrap(b"\x99" * (16_402 + 3)))
    assert errors == 1


@few
@given(st.binary(max_size=400), st.integers(0, 7), st.integers(0, 255))
def test_no_changed_byte_gets_past_the_crc(
    lib: ctypes.CDLL, payload: bytes, bit: int, where: int
) -> None:
    wire = bytearray(wrap(b"\x82\0\0" + payload))
    wire[where % (len(wire) - 1)] ^= 1 << bit
    packets, errors = read_all(lib, bytes(wire))
    assert not packets
    assert errors >= 1


# The generated header


@pytest.mark.parametrize(
    ("name", "standard"),
    [
        *(("cc", "c11"), ("cc", "gnu99"), ("clang", "c11")),
        *(("avr-gcc", "gnu99"), ("arm-none-eabi-gcc", "c11")),
    ],
)
def test_header_compiles_by_itself_and_its_assertions_hold(
    name: str, standard: str, tmp_path: Path
) -> None:
    source = tmp_path / "header.c"
    source.write_text(
        '#include "tactile_protocol.h"\n'
        f'_Static_assert(TP_MAX_PACKET == {MAX_PACKET}, "as in Python");\n'
        '_Static_assert(sizeof(struct tp_info) == 66, "as in docs/protocol.md");\n'
        "int unit;\n"
    )
    run(need(name), *STRICT, f"-std={standard}", "-fsyntax-only", source)


def test_an_assertion_would_fail(tmp_path: Path) -> None:
    source = tmp_path / "header.c"
    source.write_text('#include "tactile_protocol.h"\nTP_ASSERT_AT(tp_info, frame, 32);\n')
    result = run_program(need("cc"), *STRICT, "-std=c11", "-fsyntax-only", source)
    assert result.returncode != 0
    assert "tp_info.frame" in result.stderr
