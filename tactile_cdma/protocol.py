"""Packets ↔ bytes: the wire protocol between digitizer and host. No I/O; see docs/protocol.md.

A packet travels as COBS(body + CRC-32 of body) + 0x00, with body = type, sequence, payload:

    PacketWriter.encode(packet) → bytes → PacketParser.feed(bytes) → [packet, …]

Both sides of the line use the same two classes: the parser knows the packets of either direction.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from dataclasses import dataclass

import numpy as np

from ._protocol import FLAG_CALLED, FLAG_OVERRUN, FLAG_SYNC, MAX_GAP, MAX_SAMPLES, VERSION, Result
from .cobs import cobs_decode, cobs_encode
from .errors import SpecError
from .messages import (
    PACKETS,
    SAMPLE_MASK,
    WIRE,
    Info,
    OtherVersion,
    Packet,
    Received,
    Rejected,
    Samples,
    build,
)


@dataclass(frozen=True, slots=True)
class Counters:
    """What a parser has seen since it was made."""

    bytes: int = 0
    packets: int = 0
    """With a good CRC, the unknown and the malformed among them."""
    crc_errors: int = 0
    framing_errors: int = 0
    """Bytes between two delimiters that are no COBS."""
    malformed: int = 0
    """Good CRC, but a length or a value that the type cannot have."""
    unknown: int = 0
    """Good CRC, but a type of a newer firmware."""
    lost_packets: int = 0
    """Missing from the sequence, for whatever reason."""
    jumps: int = 0
    """The sequence went back or far ahead: a digitizer that restarted, or a repeated packet."""
    resyncs: int = 0
    """Runs longer than any packet without a delimiter."""
    text_bytes: int = 0
    """Printable ASCII, of all bytes."""


class PacketParser:
    """Finds the packets in a stream of bytes that may be cut, corrupted or something else.

    However the stream is divided over calls of `feed`, packets and counters come out the same.
    At most one packet's bytes are held back. Bytes before the first delimiter may be the rest of a
    packet, or line noise, and so may count as one framing or CRC error.

    The sequence tells what was lost: a gap of up to MAX_GAP packets is a loss of that many.
    Anything else, that is a step back (0xFFFF → 0 is none) or a step further ahead, counts as one
    jump and no loss, and counting goes on from there: that is what a digitizer that restarts looks
    like. A packet that comes twice is passed on twice, as a step back; a serial line doesn't do
    that, and the consumer of Samples sees it in first_index, which also tells exactly how many
    samples any of this has cost.
    """

    def __init__(self) -> None:
        self._partial = b""  # begins after the last delimiter
        self._skipping = False  # within a run that is too long for a packet
        self._expected: int | None = None
        self._count: Counter[str] = Counter()

    @property
    def counters(self) -> Counters:
        """A snapshot of what was seen so far."""
        return Counters(**self._count)

    def feed(self, data: bytes) -> list[Received]:
        """The packets that these bytes complete."""
        self._count["bytes"] += len(data)
        self._count["text_bytes"] += len(data) - len(data.translate(None, _TEXT))
        *runs, partial = (self._partial + data).split(b"\0")
        if self._skipping and runs:
            del runs[0]
            self._skipping = False
        if not self._skipping and len(partial) > _MAX_RUN:
            self._count["resyncs"] += 1
            self._skipping = True
        self._partial = b"" if self._skipping else partial
        packets = (self._parse(run) for run in runs if run)
        return [packet for packet in packets if packet is not None]

    def _parse(self, run: bytes) -> Received | None:
        """The packet between two delimiters, if it is one."""
        if len(run) > _MAX_RUN:
            self._count["resyncs"] += 1
            return None
        try:
            raw = cobs_decode(run)
        except ValueError:
            self._count["framing_errors"] += 1
            return None
        body = raw[: -_CRC.size]
        if len(raw) < _CRC.size or zlib.crc32(body) != _CRC.unpack_from(raw, len(body))[0]:
            self._count["crc_errors"] += 1
            return None
        self._count["packets"] += 1
        if len(body) < _HEADER.size:
            self._count["malformed"] += 1
            return None
        type_byte, sequence = _HEADER.unpack_from(body)
        self._follow(sequence)
        return self._interpret(type_byte, sequence, body[_HEADER.size :])

    def _follow(self, sequence: int) -> None:
        """Keep account of the sequence, by the rule that the class describes."""
        if self._expected is not None and sequence != self._expected:
            gap = (sequence - self._expected) % _SEQUENCES
            if gap <= MAX_GAP:
                self._count["lost_packets"] += gap
            else:
                self._count["jumps"] += 1
        self._expected = (sequence + 1) % _SEQUENCES

    def _interpret(self, type_byte: int, sequence: int, payload: bytes) -> Received | None:
        """The packet of an intact body; of the unusable ones only commands need an answer."""
        kind = PACKETS.get(type_byte)
        if kind is Samples:
            return self._samples(sequence, payload)
        if kind is Info and payload and payload[0] != VERSION:
            return OtherVersion(payload[0], sequence)
        if kind is None:
            self._count["unknown"] += 1
            reason = Result.UNKNOWN_COMMAND
        elif len(payload) != (wire := WIRE[kind.__name__]).size:
            self._count["malformed"] += 1
            reason = Result.BAD_LENGTH
        else:
            try:
                return build(kind, iter(wire.unpack(payload)), sequence=sequence)
            except SpecError:
                self._count["malformed"] += 1
                reason = Result.OUT_OF_RANGE
        return Rejected(type_byte, reason, sequence) if type_byte & _COMMAND_BIT else None

    def _samples(self, sequence: int, payload: bytes) -> Samples | None:
        """Samples, which are nearly all of the traffic."""
        head = WIRE["Samples"]
        if len(payload) <= head.size or (len(payload) - head.size) % 2:
            self._count["malformed"] += 1
            return None
        device_time_us, first_index, flags = head.unpack_from(payload)
        words = np.frombuffer(payload, "<i2", offset=head.size)
        return Samples(
            device_time_us,
            first_index,
            words ^ SAMPLE_MASK,
            bool(flags & FLAG_SYNC),
            bool(flags & FLAG_OVERRUN),
            bool(flags & FLAG_CALLED),
            sequence=sequence,
        )


class PacketWriter:
    """Numbers packets and turns them into bytes; a sender has one.

    sequence: of the next packet. A sender that has to drop a packet adds 1, so that the receiver
        learns of it.
    """

    def __init__(self, sequence: int = 0) -> None:
        self.sequence = sequence

    def encode(self, packet: Packet) -> bytes:
        """The bytes of the next packet, delimiter included."""
        header = _HEADER.pack(packet.TYPE, self.sequence % _SEQUENCES)
        self.sequence = (self.sequence + 1) % _SEQUENCES
        return wrap(header + packet.payload())


def diagnose(counters: Counters) -> str:
    """What the person at the bench should look at where no INFO came."""
    if counters.packets:
        return "packets arrive, but no description of the digitizer (INFO)"
    if not counters.bytes:
        return "no bytes: is the digitizer powered and started?"
    if counters.text_bytes > 0.9 * counters.bytes:  # random bytes: 0.38
        return "text received instead of packets; is another program's firmware on this board?"
    return "bytes arrive but no valid packet: wrong baud rate?"


def wrap(body: bytes) -> bytes:
    """A body as it travels: with its CRC, COBS-encoded, delimited."""
    return cobs_encode(body + _CRC.pack(zlib.crc32(body))) + b"\0"


_HEADER = WIRE["Header"]
_CRC = struct.Struct("<I")
_COMMAND_BIT = 0x80
_SEQUENCES = 2**16
_MAX_RAW = (
    _HEADER.size
    + max(2 * MAX_SAMPLES + WIRE["Samples"].size, *(wire.size for wire in WIRE.values()))
    + _CRC.size
)
_MAX_RUN = _MAX_RAW + -(-_MAX_RAW // 254)
_TEXT = bytes(range(0x20, 0x7F)) + b"\t\r\n"

MAX_PACKET = _MAX_RUN + 1
"""Longest packet on the wire, delimiter included, bytes."""
