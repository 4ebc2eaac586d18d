# SPDX-License-Identifier: Apache-2.0

"""Packets ↔ bytes: round trips, chunking, corruption, sequence numbers, the shared vectors."""

import json
import struct
import zlib
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.codes import code_book, row_signs
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.wire import messages as message_types
from tactile_cdma.wire._protocol import (
    FIELDS,
    MAX_GAP,
    MAX_SAMPLES,
    PACKED_MOST_STEP,
    VERSION,
    Field,
    PacketType,
    Result,
    SyncMode,
)
from tactile_cdma.wire.messages import (
    Ack,
    Configure,
    FrameLayout,
    GetInfo,
    Info,
    OtherVersion,
    Pack,
    Packed,
    Packet,
    Quiet,
    Received,
    Rejected,
    Samples,
    Start,
    Status,
    Stop,
)
from tactile_cdma.wire.packets import (
    MAX_PACKET,
    MAX_REPEATED,
    Counters,
    PacketParser,
    PacketWriter,
    cobs_decode,
    cobs_encode,
    diagnose,
    wrap,
)
from test.support.independent_line import row_sign

VECTORS = Path(__file__).parents[3] / "firmware" / "vectors"
PROTOCOL = json.loads((VECTORS / "protocol.json").read_text())
CODES = json.loads((VECTORS / "codes.json").read_text())
LAYOUT = FrameLayout.of(FrameSpec(), samples_per_chip=8)
INFO = Info(frame=LAYOUT, sample_rate_uhz=160_000_000_000, volts_per_count=1e-3)


def values(wire: Field) -> st.SearchStrategy[Any]:
    """Everything that a field may hold."""
    if wire.code == "FrameLayout":
        return messages(FrameLayout)
    if wire.code == "f":
        return st.floats(width=32, allow_nan=False, allow_infinity=False)
    if wire.code == "8s":
        return st.binary(min_size=8, max_size=8)
    if isinstance(wire.allowed, range):
        return st.integers(wire.allowed.start, wire.allowed.stop - 1)
    return st.sampled_from([False, True] if wire.allowed is bool else list(wire.allowed))


def messages(kind: type) -> st.SearchStrategy[Any]:
    given_fields = {wire.name: values(wire) for wire in FIELDS[kind.__name__]}
    if kind is Info:
        given_fields["version"] = st.just(VERSION)
    return st.builds(kind, **given_fields)


COUNTS = st.lists(st.integers(-(2**15), 2**15 - 1), min_size=1, max_size=600)
CONTENT = (
    *2 * (st.integers(0, 2**64 - 1),),
    COUNTS.map(lambda counts: np.array(counts, dtype=np.int16)),
)
FLAGS = {name: st.booleans() for name in ("sync", "overrun")}
SAMPLES, QUIET = (st.builds(kind, *CONTENT, **FLAGS) for kind in (Samples, Quiet.of))
FIXED = (Info, Status, Ack, GetInfo, Start, Stop, Configure, Pack)
PACKETS = st.one_of(SAMPLES, QUIET, *(messages(kind) for kind in FIXED))


@st.composite
def packed(draw: st.DrawFn) -> Packed:
    """Samples to be sent in 12 bits each, of any base and step."""
    step = draw(st.integers(1, PACKED_MOST_STEP))
    base = draw(st.integers(-(2**15), 2**15 - 1 - 4095 * step))
    values = draw(st.lists(st.integers(0, 4095), min_size=1, max_size=300))
    counts = (base + step * np.array(values)).astype(np.int16)
    return Packed(draw(st.integers(0, 2**64 - 1)), 7, counts, sync=True, base=base, step=step)


def parse(data: bytes) -> tuple[list[Received], Counters]:
    parser = PacketParser()
    return parser.feed(data), parser.counters


def samples(size: int = 4, index: int = 0) -> Samples:
    return Samples(1000, index, np.arange(size, dtype=np.int16))


# Packets


@given(st.integers(0, 2**16 - 1), st.lists(PACKETS, max_size=5))
def test_what_is_encoded_is_parsed(first: int, packets: list[Packet]) -> None:
    writer = PacketWriter(first)
    received, counters = parse(b"".join(map(writer.encode, packets)))
    assert received == packets
    numbers = [(first + i) % 2**16 for i in range(len(packets))]
    assert [packet.sequence for packet in received] == numbers
    assert [repr(a) for a in map(plain, received)] == [repr(a) for a in map(plain, packets)]
    assert counters == Counters(bytes=counters.bytes, packets=len(packets))


@given(packed())
def test_packed_samples_arrive_as_samples_in_fewer_bytes(packet: Packed) -> None:
    wire = PacketWriter(5).encode(packet)
    received, counters = parse(wire)
    assert received == [packet]
    assert type(received[0]) is Samples
    assert not counters.malformed
    assert np.array_equal(received[0].counts, packet.counts)
    size = packet.counts.size
    assert len(wire) <= 29 + (3 * size + 1) // 2 + size // 160 + 1


def test_two_packed_values_fill_three_bytes() -> None:
    """Written out by docs/protocol.md: 0xABC and 0x123, then 0x456 alone, each XOR 0x555."""
    counts = np.array([0xABC, 0x123, 0x456], np.int16)
    payload = Packed(0, 0, counts).pack()
    assert payload[17:20] == bytes([0, 0, 1])
    assert payload[20:] == bytes([0xE9, 0x6F, 0x47, 0x03, 0x01])


@pytest.mark.parametrize(
    ("counts", "base", "step"),
    [([-1], 0, 1), ([4096], 0, 1), ([9], 0, 8), ([0], 2**15 - 4095, 1), ([0], 0, 9), ([0], 0, 0)],
)
def test_counts_beyond_12_bits_are_refused(counts: list[int], base: int, step: int) -> None:
    with pytest.raises(SpecError):
        Packed(0, 0, np.array(counts, np.int16), base=base, step=step)


def plain(packet: Received) -> dict[str, Any]:
    """Fields by name: their repr shows types, which comparison ignores."""
    return {name: value for name, value in asdict(packet).items() if name != "sequence"}


@pytest.mark.parametrize("kind", [FrameLayout, *FIXED])
def test_classes_have_the_fields_of_the_definition(kind: type) -> None:
    names = {field.name for field in fields(kind)} - {"sequence"}
    assert names == {wire.name for wire in FIELDS[kind.__name__]}


def test_sizes_are_those_of_the_document() -> None:
    packets = INFO, Status(0), Ack(0, 0), Quiet(0, 0, 1, 0, 0), Stop(), Configure(LAYOUT)
    assert [len(PacketWriter().encode(each)) for each in packets] == [74, 38, 13, 46, 9, 45]


def test_values_that_the_wire_cannot_carry_are_refused() -> None:
    int16 = np.zeros(1, dtype=np.int16)
    for make in (
        lambda: Status(-1),
        lambda: Status(2**64),
        lambda: Ack(256, 0),
        lambda: Ack(1, 0, 6),  # type: ignore[arg-type]
        lambda: Configure(LAYOUT, 3),  # type: ignore[arg-type]
        lambda: Configure(LAYOUT, SyncMode.NONE, 2),  # type: ignore[arg-type]
        lambda: Info(frame=LAYOUT, sample_rate_uhz=0, volts_per_count=1),
        lambda: Info(frame=LAYOUT, sample_rate_uhz=1, volts_per_count=1e39),
        lambda: Info(frame=LAYOUT, sample_rate_uhz=1, volts_per_count=1, digitizer_id=b"short"),
        lambda: Samples(0, 0, int16[:0]),
        lambda: Samples(0, 0, np.zeros(MAX_SAMPLES + 1, dtype=np.int16)),
        lambda: Samples(0, 0, np.zeros(3)),
        lambda: Samples(-1, 0, int16),
        lambda: Samples(0, 2**64, int16),
        lambda: Quiet(-1, 0, 1, 0, 0),
        lambda: Quiet(0, 0, 0, 0, 0),
        lambda: Quiet(0, 0, 2**32, 0, 0),
        lambda: Quiet(0, 0, 2, 3, 4),  # 1 and 2 have squares of 5
    ):
        with pytest.raises(SpecError):
            make()


def test_volts_are_relative_to_the_zero_count() -> None:
    info = Info(frame=LAYOUT, sample_rate_uhz=1, volts_per_count=0.5, zero_count=-30_000)
    volts = info.volts(np.array([-30_000, -29_999, 32_767], dtype=np.int16))
    assert volts.tolist() == [0, 0.5, 31_383.5]
    assert volts.dtype == np.float32


@given(COUNTS)
def test_quiet_has_mean_and_variance_of_its_samples(values: list[int]) -> None:
    quiet = Quiet.of(0, 0, np.array(values, dtype=np.int16))
    assert quiet.count == len(values)
    assert quiet.mean == pytest.approx(np.mean(values))
    assert quiet.variance == pytest.approx(np.var(values), rel=1e-9)


# Layouts


@given(
    st.fixed_dictionaries(
        {
            "nodes": st.integers(1, 300),
            "bits": st.integers(8, 16),
            "sign_seed": st.none() | st.integers(0, 2**32 - 1),
            "drive": st.sampled_from(["bipolar", "unipolar"]),
            "polarity": st.sampled_from([1, -1]),
        }
    ),
    *(st.integers(10, 10**6), st.integers(1, 2**32 - 1), st.integers(1, 65_535)),
)
def test_specs_and_layouts_convert_exactly(
    asked: dict[str, Any], chip_ns: int, spare_us: int, samples_per_chip: int
) -> None:
    order = FrameSpec(asked["nodes"], chip_s=1e-8, frame_period_s=1.0).order
    period_us = min(2**32 - 1, asked["bits"] * order * chip_ns // 1000 + 1 + spare_us)
    spec = FrameSpec(**asked, chip_s=chip_ns / 1e9, frame_period_s=period_us / 1e6)
    layout = FrameLayout.of(spec, samples_per_chip)
    assert (layout.chip_ns, layout.frame_period_us) == (chip_ns, period_us)
    assert layout.spec(spec.amplitude_v) == spec
    assert FrameLayout.of(layout.spec(), samples_per_chip) == layout


@pytest.mark.parametrize("chip_s", [50e-6, 50 * 1e-6, 0.00005, 5e-05 * (1 + 1e-15)])
def test_rounding_of_floats_doesnt_move_a_chip(chip_s: float) -> None:
    assert FrameLayout.of(FrameSpec(chip_s=chip_s), 1).chip_ns == 50_000


@pytest.mark.parametrize(
    ("name", "spec"),
    [
        ("chip_s", FrameSpec(chip_s=12.5e-9)),
        ("frame_period_s", FrameSpec(frame_period_s=12.8e-3 + 1e-7)),
        ("frame_period_us", FrameSpec(frame_period_s=5000)),
        ("nodes", FrameSpec(nodes=65_536, first_row=0, chip_s=1e-8)),
    ],
)
def test_specs_beyond_the_wire_are_refused_by_name(name: str, spec: FrameSpec) -> None:
    with pytest.raises(SpecError, match=name):
        FrameLayout.of(spec, 1)


# Framing


def cobs_by_definition(data: bytes) -> bytes:
    """Byte by byte, as in Cheshire and Baker's listing."""
    out, block = b"", b""
    pending = True
    for byte in data:
        pending = True
        if byte:
            block += bytes([byte])
            if len(block) < 254:
                continue
            out, block, pending = out + b"\xff" + block, b"", False
        else:
            out, block = out + bytes([len(block) + 1]) + block, b""
    return out + bytes([len(block) + 1]) + block if pending else out


BYTES = st.binary(max_size=50) | st.lists(
    st.sampled_from([b"\0", b"\1", b"\xff" * 253, b"\x55" * 254, b"\7" * 255]), max_size=8
).map(b"".join)


@given(BYTES)
def test_cobs_is_what_its_authors_defined(data: bytes) -> None:
    encoded = cobs_encode(data)
    assert encoded == cobs_by_definition(data)
    assert 0 not in encoded
    assert len(encoded) <= len(data) + max(1, -(-len(data) // 254))
    assert cobs_decode(encoded) == data
    # A final full block may have its zero.
    assert cobs_decode(b"\xff" + b"\7" * 254 + b"\1") == b"\7" * 254


@pytest.mark.parametrize("data", [b"\2", b"\3\1", b"\0", b"\1\0", b"\xff" + b"\1" * 253])
def test_cobs_refuses_what_it_cannot_have_made(data: bytes) -> None:
    with pytest.raises(ValueError, match="no COBS"):
        cobs_decode(data)


# The stream


def test_no_flipped_bit_yields_a_false_packet() -> None:
    writer = PacketWriter(65_534)
    packets = [Start(), samples(300), INFO, Status(7)]
    wires = [writer.encode(packet) for packet in packets]
    before, target, after = wires[0], wires[1], wires[2] + wires[3]
    for bit in range(8 * len(target)):
        corrupt = bytearray(target)
        corrupt[bit // 8] ^= 1 << bit % 8
        received, counters = parse(before + bytes(corrupt) + after)
        # Without its delimiter a packet takes the next one with it.
        lost = 2 if bit // 8 == len(target) - 1 else 1
        assert received == [packets[0], *packets[1 + lost :]]
        assert counters.lost_packets == lost
        assert counters.crc_errors + counters.framing_errors >= 1


@given(st.data())
def test_cut_out_or_overwritten_bytes_yield_no_false_packet(data: st.DataObject) -> None:
    packets = [samples(30, index=30 * i) for i in range(8)]
    stream = b"".join(map(PacketWriter().encode, packets))
    first = data.draw(st.integers(0, len(stream)))
    length = data.draw(st.integers(0, len(stream) - first))
    instead = data.draw(st.binary(max_size=60))
    received, counters = parse(stream[:first] + instead + stream[first + length :])
    survivors = [packets.index(packet) for packet in received]
    assert survivors == sorted(set(survivors))
    if survivors:
        assert counters.lost_packets == survivors[-1] - survivors[0] + 1 - len(survivors)


def test_noise_is_no_packet() -> None:
    noise = np.random.default_rng(5).integers(0, 256, 200_000, dtype=np.uint8).tobytes()
    received, counters = parse(noise)
    assert not received
    assert counters.packets == 0
    assert counters.framing_errors + counters.crc_errors + counters.resyncs > 500
    assert "wrong baud rate" in str(diagnose(counters))


def test_a_run_without_delimiter_is_dropped_once_and_in_bounded_memory() -> None:
    parser = PacketParser()
    for _ in range(1000):
        assert not parser.feed(b"\xaa" * 1000)
        assert parser.held < MAX_PACKET
    assert parser.counters.resyncs == 1
    wire = PacketWriter().encode(Start())
    assert parser.feed(b"\0" + wire) == [Start()]
    assert parser.counters == Counters(bytes=1_000_010, packets=1, resyncs=1, text_bytes=0)


@pytest.mark.parametrize("step", [1, 10_000])
def test_the_longest_packet_passes_and_nothing_longer(step: int) -> None:
    def feed(data: bytes) -> tuple[list[Received], Counters]:
        parser = PacketParser()
        parts = [data[i : i + step] for i in range(0, len(data), step)]
        return [packet for part in parts for packet in parser.feed(part)], parser.counters

    full = 0x0101010101010101  # no zero byte, so that no block is short
    longest = Samples(full, full, np.full(MAX_SAMPLES, 1, dtype=np.int16), sync=True)
    wire = PacketWriter(0x0101).encode(longest)
    assert len(wire) == MAX_PACKET
    assert feed(wire)[0] == [longest]
    assert feed(b"\x01" * (MAX_PACKET - 1) + b"\0")[1].resyncs == 0
    assert feed(b"\x01" * MAX_PACKET + b"\0")[1].resyncs == 1


def test_counters_are_a_snapshot() -> None:
    parser = PacketParser()
    before = parser.counters
    parser.feed(PacketWriter().encode(Stop()))
    assert (before.packets, parser.counters.packets) == (0, 1)


# Bodies with a correct CRC that this version cannot use


def body(type_byte: int, payload: bytes, sequence: int = 0) -> bytes:
    return wrap(struct.pack("<BH", type_byte, sequence) + payload)


def test_unknown_types_are_counted_and_passed_over() -> None:
    received, counters = parse(body(0x7F, b"later") + body(PacketType.START, b"", 1))
    assert received == [Start()]
    assert (counters.packets, counters.unknown, counters.lost_packets) == (2, 1, 0)


def test_commands_that_cannot_be_obeyed_can_be_answered() -> None:
    configure = Configure(LAYOUT).pack()
    received, counters = parse(
        body(0xC0, b"", 7)
        + body(PacketType.STOP, b"\0", 8)
        + body(PacketType.CONFIGURE, configure[:-1], 9)
        + body(PacketType.CONFIGURE, configure[:-5] + b"\2" + configure[-4:], 10)
        + body(PacketType.CONFIGURE, b"\0\0" + configure[2:], 11)
    )
    assert [packet.ack() for packet in received if isinstance(packet, Rejected)] == [
        Ack(0xC0, 7, Result.UNKNOWN_COMMAND),
        Ack(PacketType.STOP, 8, Result.BAD_LENGTH),
        Ack(PacketType.CONFIGURE, 9, Result.BAD_LENGTH),
        Ack(PacketType.CONFIGURE, 10, Result.OUT_OF_RANGE),
        Ack(PacketType.CONFIGURE, 11, Result.OUT_OF_RANGE),
    ]
    assert (counters.unknown, counters.malformed) == (1, 4)


def test_an_ack_names_the_command_that_arrived() -> None:
    writer = PacketWriter(300)
    (command,), _ = parse(writer.encode(Configure(LAYOUT)))
    assert isinstance(command, Configure)
    assert command.ack(Result.BUSY) == Ack(PacketType.CONFIGURE, 300, Result.BUSY)


@pytest.mark.parametrize(
    "wire",
    [
        *map(wrap, (b"", b"\1", b"\1\0")),  # without a whole header
        body(PacketType.INFO, INFO.pack() + b"\0\0"),
        body(PacketType.INFO, b""),
        body(PacketType.STATUS, b""),
        body(PacketType.ACK, b"\x81\0\0\x06"),
        body(PacketType.SAMPLES, b""),
        body(PacketType.SAMPLES, bytes(17)),
        body(PacketType.SAMPLES, bytes(20)),
        body(PacketType.PACKED, b""),
        body(PacketType.PACKED, bytes(19) + b"\1"),
        body(PacketType.PACKED, bytes(19) + b"\1" + bytes(4)),
        body(PacketType.PACKED, bytes(19) + b"\0" + bytes(3)),
        body(PacketType.PACKED, bytes(19) + b"\x09" + bytes(3)),
        body(PacketType.PACKED, bytes(17) + b"\xff\x7f\1" + bytes(3)),
        body(PacketType.PACKED, bytes(19) + b"\1" + bytes(3 * (MAX_SAMPLES // 2) + 2)),
        body(PacketType.QUIET, bytes(37)),
        body(PacketType.QUIET, bytes(17) + b"\1\0\0\0\2" + bytes(15)),
        body(PacketType.QUIET, bytes(36)),
    ],
)
def test_packets_of_wrong_length_or_value_are_malformed(wire: bytes) -> None:
    received, counters = parse(wire)
    assert not received
    assert (counters.packets, counters.malformed) == (1, 1)


@given(st.integers(0, 255).filter(lambda v: v != VERSION), st.binary(max_size=200))
def test_an_info_of_another_version_tells_its_version(version: int, rest: bytes) -> None:
    received, counters = parse(body(PacketType.INFO, bytes([version]) + rest))
    assert received == [OtherVersion(version)]
    assert counters.malformed == 0


def test_unknown_flags_are_ignored() -> None:
    payload = samples().pack()
    received, _ = parse(body(PacketType.SAMPLES, payload[:16] + b"\xfe" + payload[17:]))
    assert isinstance(received[0], Samples)
    assert (received[0].sync, received[0].overrun) == (False, True)


# Sequence


def lost_and_jumps(*sequences: int) -> tuple[int, int]:
    counters = parse(b"".join(body(PacketType.STOP, b"", s) for s in sequences))[1]
    assert counters.packets == len(sequences)
    return counters.lost_packets, counters.jumps


def test_losses_and_restarts_follow_from_the_sequence() -> None:
    assert lost_and_jumps(40_000) == (0, 0)  # the first packet shows no loss
    assert lost_and_jumps(65_534, 65_535, 0, 1) == (0, 0)
    assert lost_and_jumps(5, 7, 10) == (3, 0)
    assert lost_and_jumps(65_534, 2) == (3, 0)
    assert lost_and_jumps(0, 1 + MAX_GAP) == (MAX_GAP, 0)
    assert lost_and_jumps(0, 2 + MAX_GAP, 3 + MAX_GAP) == (0, 1)
    assert lost_and_jumps(40_000, 0, 1, 2) == lost_and_jumps(30, 0, 1, 2) == (0, 1)


@given(st.data())
def test_what_is_skipped_is_lost_and_not_broken(data: st.DataObject) -> None:
    """Bytes are skipped from within one packet to within a later one; cut packets are lost."""
    writer = PacketWriter()
    sent = [writer.encode(Stop()) for _ in range(8)]
    ends = np.cumsum([len(packet) for packet in sent])
    wire = b"".join(sent)
    begin = data.draw(st.integers(int(ends[0]), int(ends[3])))
    resumed = data.draw(st.integers(begin, int(ends[4])))
    parser = PacketParser()
    packets = parser.feed(wire[:begin])
    parser.skip()
    packets += parser.feed(wire[resumed:])
    seen = parser.counters
    assert (seen.framing_errors, seen.crc_errors, seen.resyncs, seen.jumps) == (0, 0, 0, 0)
    assert len(packets) + seen.lost_packets == len(sent)


def test_commands_that_come_again_are_passed_on_again() -> None:
    """Every host numbers them from 0, and most have no payload that could differ."""
    assert lost_and_jumps(5, 6, 6, 7) == (0, 1)
    assert lost_and_jumps(5, 7, 6, 8) == (2, 1)
    assert len(parse(body(PacketType.START, b"", 2) * 3)[0]) == 3


def numbered(*sequences: int, uptime_us: int = 0) -> bytes:
    """Samples with these sequence numbers; uptime_us makes those of two digitizers differ."""
    counts = np.zeros(1, np.int16)
    return b"".join(PacketWriter(s).encode(Samples(uptime_us + s, 0, counts)) for s in sequences)


@given(
    st.permutations(range(24)), st.lists(st.integers(0, 23), max_size=24), st.integers(0, 65_535)
)
def test_each_packet_is_passed_on_once_in_order(
    order: list[int], again: list[int], first: int
) -> None:
    arrived = [24, *(25 + number for number in order), *(25 + number for number in again), 49]
    sequences = [(first + number) % 2**16 for number in arrived]
    received, counters = parse(numbered(*sequences))
    newest = [n for place, n in enumerate(arrived) if n > max(arrived[:place], default=0)]
    assert [packet.sequence for packet in received] == [(first + n) % 2**16 for n in newest]
    assert counters.repeated_packets == len(arrived) - len(newest)
    assert counters.lost_packets == 26 - len(newest)
    assert counters.jumps == 0


def test_repetitions_of_long_ago_are_known_and_restarts_are_none() -> None:
    wires = [numbered(s) for s in range(9_000)]
    parser = PacketParser()
    assert len(parser.feed(b"".join(wires))) == 9_000
    assert parser.feed(wires[7] + wires[8_999] + b"".join(wires[20:50])) == []
    counters = parser.counters
    assert (counters.repeated_packets, counters.lost_packets, counters.jumps) == (32, 0, 0)
    received, counters = parse(numbered(*range(100)) + numbered(*range(50), uptime_us=1))
    assert len(received) == 150
    assert (counters.repeated_packets, counters.lost_packets, counters.jumps) == (0, 0, 1)
    greeting = [PacketWriter(s).encode(Status(0)) for s in range(2)]
    parser = PacketParser()
    parser.feed(b"".join(greeting) + numbered(*range(2, 90)))
    assert [packet.sequence for packet in parser.feed(b"".join(greeting))] == [0, 1]
    assert len(parser.feed(numbered(*range(2, 90), uptime_us=1))) == 88
    counters = parser.counters
    assert (counters.repeated_packets, counters.lost_packets, counters.jumps) == (2, 0, 1)


def test_repetition_may_be_intended_and_is_believed_after_a_while() -> None:
    parser = PacketParser(most_repeated=0)
    assert len(parser.feed(numbered(*range(20)) * 3)) == 60
    assert (parser.counters.repeated_packets, parser.counters.jumps) == (0, 2)
    received, counters = parse(numbered(*range(200)) * 2)
    assert len(received) == 400 - MAX_REPEATED
    assert (counters.repeated_packets, counters.jumps) == (MAX_REPEATED, 1)


# Diagnosis


def test_diagnosis_names_the_likely_cause() -> None:
    assert "powered" in str(diagnose(Counters()))
    assert "text" in str(diagnose(parse(b"Hello from the bootloader\r\n> ")[1]))
    assert "baud" in str(diagnose(parse(bytes(range(128, 256)) * 3)[1]))
    assert "baud" in str(diagnose(parse(bytes(100))[1]))
    assert "no description" in diagnose(parse(PacketWriter().encode(samples()))[1])
    booted = parse(b"boot ok\r\n\0" + PacketWriter().encode(samples()))[1]
    assert "no description" in diagnose(booted)


# Vectors, shared with the firmware


def from_json(kind: type[Any], members: dict[str, Any]) -> Any:
    converted = dict(members)
    for name, value in members.items():
        match name:
            case "frame":
                converted[name] = from_json(FrameLayout, value)
            case "counts":
                converted[name] = np.array(value, dtype=np.int16)
            case "digitizer_id":
                converted[name] = bytes.fromhex(value)
    return kind(**converted)


@pytest.mark.parametrize("vector", PROTOCOL["packets"], ids=lambda vector: vector["name"])
def test_packet_vectors(vector: dict[str, Any]) -> None:
    packet = from_json(getattr(message_types, vector["packet"]), vector["fields"])
    wire, content = bytes.fromhex(vector["wire"]), bytes.fromhex(vector["body"])
    assert PacketWriter(vector["sequence"]).encode(packet) == wire
    assert parse(wire)[0] == [packet]
    assert content[0] == vector["type"] == packet.TYPE
    assert wire == cobs_by_definition(content + struct.pack("<I", zlib.crc32(content))) + b"\0"


def test_cobs_crc_and_the_documents_example() -> None:
    for vector in PROTOCOL["cobs"]:
        assert cobs_by_definition(bytes.fromhex(vector["data"])).hex() == vector["encoded"]
    assert {v["data"]: v["crc"] for v in PROTOCOL["crc32"]}[b"123456789".hex()] == 0xCBF43926
    # Built by hand, from docs/protocol.md alone.
    content = b"\x02" + struct.pack("<HQQB", 7, 1_000_000, 4096, 1)
    content += struct.pack("<4H", *((count & 0xFFFF) ^ 0x5555 for count in (0, 1, -1, 300)))
    wire = cobs_by_definition(content + struct.pack("<I", zlib.crc32(content))) + b"\0"
    assert wire.hex() in [vector["wire"] for vector in PROTOCOL["packets"]]
    document = (VECTORS.parents[1] / "docs" / "protocol.md").read_text(encoding="utf-8")
    assert wire.hex() in "".join(document.partition("on the wire:\n")[2].split())


def test_code_vectors() -> None:
    for vector in CODES["rows"]:
        (chips,) = code_book(vector["order"]).rows([vector["row"]])
        assert "".join("-+"[int(chip > 0)] for chip in chips) == vector["chips"]
    for vector in CODES["signs"]:
        assert [row_sign(row, vector["seed"]) for row in CODES["sign_rows"]] == [
            {"+": 1, "-": -1}[sign] for sign in vector["signs"]
        ]


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 65_535), min_size=1, max_size=20))
def test_row_signs_follow_the_documents_formula(seed: int, rows: list[int]) -> None:
    assert row_signs(np.array(rows), seed).tolist() == [row_sign(row, seed) for row in rows]
