# SPDX-License-Identifier: Apache-2.0

"""Packets ↔ bytes: framing, checksums and numbering. No I/O; see docs/protocol.md.

A packet travels as COBS(body + CRC-32 of body) + 0x00, with body = type, sequence, payload:

    PacketWriter.encode(packet) → bytes → PacketParser.feed(bytes) → [packet, …]

Host and digitizer use the same two classes: the parser knows the packets of either direction.
"""

import struct
import zlib
from dataclasses import dataclass, fields
from typing import Any, Self, TypeAlias

from ..base import kernel
from ._protocol import MAX_SAMPLES, VERSION, Result
from .messages import PACKETS, WIRE, Info, OtherVersion, Packet, Received, Rejected, Samples

SEQUENCES = 2**16
"""Sequence numbers are counted modulo this."""
MAX_REPEATED = 64
"""Packets in a row that are taken for repetitions; one more is a restart of the sender. Chosen."""

SampleBytes: TypeAlias = tuple[int, int, int, bytes]
"""A well-formed packet of samples: device time (µs), first index, flags, and counts (int16)."""
Found: TypeAlias = tuple[int, int, bytes | SampleBytes]
"""Type, sequence and payload of an intact packet; the compiled scanner takes samples apart."""


@dataclass(slots=True)
class Counters:
    """Counts what a parser has seen so far."""

    bytes: int = 0
    packets: int = 0
    """Packets with a correct CRC, including unknown and malformed ones."""
    crc_errors: int = 0
    framing_errors: int = 0
    """Runs of bytes between two delimiters that are not COBS."""
    malformed: int = 0
    """Correct CRC, but a length or a value that the type cannot have."""
    unknown: int = 0
    """Correct CRC, but an unknown type, as of a newer firmware."""
    lost_packets: int = 0
    """Missing from the sequence."""
    jumps: int = 0
    """The sequence went back or far ahead: the sender restarted."""
    repeated_packets: int = 0
    """Received again, or after their successors; commands are not counted. Samples are dropped."""
    resyncs: int = 0
    """Runs without a delimiter that are longer than any packet."""
    text_bytes: int = 0
    """Printable ASCII before the first packet."""

    def __add__(self, other: Self) -> Self:
        return type(self)(*(getattr(self, name) + getattr(other, name) for name in _COUNTERS))


_COUNTERS = tuple(field.name for field in fields(Counters))
_SCANNED = tuple(name for name in _COUNTERS if name != "unknown")


class PacketParser:
    """Finds the packets in a stream of bytes, which may be cut, corrupted or no packets at all.

    scanner: the kernel's, which does it, but for what packets mean (kernel/scanner.h).

    Packets and counters do not depend on how the stream is divided over calls of `feed`.
    At most one packet's bytes are held back. Bytes before the first delimiter may be the rest of a
    packet or line noise, and may count as one framing or CRC error.

    Losses, repetitions and restarts follow from the sequence by the rules of docs/protocol.md, what
    a receiver does. Repeated samples are dropped; other packets of the digitizer are passed on:
    after a reset it sends the same ones as before. A restart is hardly ever taken for repetition,
    since other samples at other times have other CRCs. Commands never count as repeated: every host
    numbers from 0, and many commands have no payload.
    """

    def __init__(self, most_repeated: int = MAX_REPEATED) -> None:
        """most_repeated: 0 where packets are repeated on purpose, as by a recording in a loop."""
        made = kernel.lib.scanner_new(most_repeated)
        self.scanner = kernel.Held(made, kernel.lib.scanner_free)
        self._told = kernel.lib.scanner_tell(made)
        self._refused = Counters()  # what was intact, but cannot be used

    @property
    def counters(self) -> Counters:
        """Return a snapshot of all counters."""
        told = {name: getattr(self._told, name) for name in _SCANNED}
        return Counters(**told) + self._refused

    @property
    def received(self) -> tuple[int, int]:
        """Return the bytes and intact packets so far; cheaper than all counters."""
        return self._told.bytes, self._told.packets

    @property
    def held(self) -> int:
        """Count the bytes of an incomplete packet that are held back."""
        return int(kernel.lib.scanner_held(self.scanner.at))

    def feed(self, data: bytes) -> list[Received]:
        """Return the packets that these bytes complete."""
        library, received, taken = kernel.lib, [], 0
        packet, given = kernel.ffi.new("struct scanner_packet *"), kernel.ffi.from_buffer(data)
        at = kernel.ffi.cast("uint8_t *", given)
        while taken < len(data):
            taken += library.scanner_take(self.scanner.at, at + taken, len(data) - taken, packet)
            if packet.payload:
                received.append(self.interpret(*content_of(packet)))
        library.scanner_tell(self.scanner.at)
        return [packet for packet in received if packet is not None]

    def skip(self) -> None:
        """Note that bytes were left out here: the packet that they are of is lost, not broken."""
        kernel.lib.scanner_skip(self.scanner.at)
        kernel.lib.scanner_tell(self.scanner.at)

    def interpret(
        self, type_byte: int, sequence: int, payload: bytes | SampleBytes
    ) -> Received | None:
        """Make the packet of an intact body; Rejected for a command that cannot be used."""
        if isinstance(payload, tuple):
            return Samples.received(payload, sequence)
        kind = PACKETS.get(type_byte)
        if kind is Info and payload and payload[0] != VERSION:
            return OtherVersion(payload[0], sequence)
        if kind is None:
            self._refused.unknown += 1
            reason = Result.UNKNOWN_COMMAND
        else:
            try:
                return kind.unpack(payload, sequence=sequence)
            except struct.error:
                reason = Result.BAD_LENGTH
            except ValueError:  # SpecError, or half a sample
                reason = Result.OUT_OF_RANGE
            self._refused.malformed += 1
        return Rejected(type_byte, reason, sequence) if type_byte & _COMMAND_BIT else None


def content_of(packet: Any) -> Found:
    """Return what the kernel's struct scanner_packet holds."""
    library, ffi = kernel.lib, kernel.ffi
    samples = library.scanner_samples(packet)
    payload: bytes | SampleBytes
    if samples:
        head, counts = ffi.new("struct tp_samples *"), ffi.new("int16_t[]", samples)
        library.scanner_copy_samples(packet, head, counts)
        payload = head.device_time_us, head.first_index, head.flags, bytes(ffi.buffer(counts))
    else:
        payload = bytes(ffi.buffer(packet.payload, packet.size))
    return packet.type, packet.sequence, payload


class PacketWriter:
    """Numbers packets and turns them into bytes; a sender has one.

    sequence: of the next packet. A sender that drops a packet adds 1, so that the receiver counts
        it as lost.
    """

    def __init__(self, sequence: int = 0) -> None:
        self.sequence = sequence

    def encode(self, packet: Packet) -> bytes:
        """Return the bytes of the next packet, delimiter included."""
        header = _HEADER.pack(packet.TYPE, self.sequence % SEQUENCES)
        self.sequence = (self.sequence + 1) % SEQUENCES
        return wrap(header + packet.pack())


def diagnose(counters: Counters) -> str:
    """Tell the likely cause, for the person at the bench, when no INFO has come."""
    if counters.packets:
        return "packets arrive, but no description of the digitizer (INFO)"
    if not counters.bytes:
        return "no bytes: is the digitizer powered and started?"
    if counters.text_bytes > 0.9 * counters.bytes:  # of random bytes 38 % are printable
        return "text received instead of packets; is another program's firmware on this board?"
    return "bytes arrive but no valid packet: wrong baud rate?"


def wrap(body: bytes) -> bytes:
    """Make a body ready to travel: with its CRC, COBS-encoded, delimited."""
    return cobs_encode(body + _CRC.pack(zlib.crc32(body))) + b"\0"


def cobs_encode(data: bytes) -> bytes:
    """Return the data without zeros: Consistent Overhead Byte Stuffing (Cheshire and Baker 1999).

    With a zero appended, the data is a sequence of runs of non-zero bytes, each ended by a zero.
    A run becomes a block: the run's length with its zero, then the run. Runs of more than 254
    bytes are cut: length 255 stands for 254 bytes and no zero.
    """
    out: list[bytes] = []
    for run in data.split(b"\0"):
        full = len(run) // 254 * 254
        for start in range(0, full, 254):
            out += (b"\xff", run[start : start + 254])
        out += (bytes((len(run) - full + 1,)), run[full:])
    if run and len(run) == full:  # a full block at the end needs no block for the appended zero
        del out[-2:]
    return b"".join(out)


def cobs_decode(data: bytes) -> bytes:
    """Undo cobs_encode. Raises ValueError for anything that is not COBS."""
    if 0 in data:
        raise ValueError(f"no COBS: a zero at byte {data.index(0)} of {len(data)}")
    decoded, start, has_zero = bytearray(), 0, False
    while start < len(data):
        length = data[start]
        has_zero = length < 255
        decoded += data[start + 1 : start + length] + bytes(has_zero)
        start += length
    if start != len(data):
        raise ValueError(f"no COBS: the last block ends at byte {start} of {len(data)}")
    return bytes(decoded[:-1] if has_zero else decoded)  # the last zero was appended


_HEADER = WIRE["Header"]
_CRC = struct.Struct("<I")
_COMMAND_BIT = 0x80
_MAX_RAW = _HEADER.size + WIRE["Samples"].size + 2 * MAX_SAMPLES + _CRC.size
MAX_PACKET = _MAX_RAW + -(-_MAX_RAW // 254) + 1
"""Longest packet on the wire, delimiter included, bytes."""
