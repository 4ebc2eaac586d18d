"""Packets ↔ bytes: the wire protocol between digitizer and host. No I/O; see docs/protocol.md.

A packet travels as COBS(body + CRC-32 of body) + 0x00, with body = type, sequence, payload:

    PacketWriter.encode(packet) → bytes → PacketParser.feed(bytes) → [packet, …]

Both sides of the line use the same two classes: the parser knows the packets of either direction.
Fields are those of firmware/protocol.yaml, from which `_protocol.py` is generated.
"""

from __future__ import annotations

import math
import operator
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from ._protocol import (
    FIELDS,
    FLAG_OVERRUN,
    FLAG_SYNC,
    MAX_GAP,
    MAX_PACKET_US,
    MAX_SAMPLES,
    SAMPLE_XOR,
    VERSION,
    Drive,
    Field,
    PacketType,
    Polarity,
    Result,
    SyncMode,
)
from .errors import SpecError
from .frame import BIPOLAR, UNIPOLAR, FrameSpec

__all__ = [
    "MAX_PACKET",
    "MAX_PACKET_US",
    "MAX_SAMPLES",
    "VERSION",
    "Ack",
    "Command",
    "Configure",
    "Counters",
    "Drive",
    "FrameLayout",
    "GetInfo",
    "Info",
    "OtherVersion",
    "Packet",
    "PacketParser",
    "PacketType",
    "PacketWriter",
    "Polarity",
    "Received",
    "Rejected",
    "Result",
    "Samples",
    "Start",
    "Status",
    "Stop",
    "SyncMode",
    "cobs_decode",
    "cobs_encode",
    "diagnose",
    "wrap",
]

M = TypeVar("M", bound="Message")


@dataclass(frozen=True, slots=True)
class Message:
    """Fields that travel together, in the order of FIELDS[class name].

    Raises SpecError for a value that its field on the wire cannot hold.
    """

    def __post_init__(self) -> None:
        for wire in FIELDS[type(self).__name__]:
            object.__setattr__(self, wire.name, _checked(wire, getattr(self, wire.name)))


@dataclass(frozen=True, slots=True)
class FrameLayout(Message):
    """How the nodes share the line, in the wire's integers.

    Every layout converts to a FrameSpec and back unchanged, and so does every FrameSpec whose
    times are whole nanoseconds and microseconds, but for its amplitude, which doesn't travel.
    """

    nodes: int
    bits: int
    order: int
    chip_ns: int
    frame_period_us: int
    first_row: int
    sign_seed: int
    natural_signs: bool
    drive: Drive
    polarity: Polarity
    samples_per_chip: int

    @classmethod
    def of(cls, spec: FrameSpec, samples_per_chip: int) -> FrameLayout:
        """The layout of a spec. Raises SpecError where the wire's integers cannot express it."""
        return cls(
            nodes=spec.nodes,
            bits=spec.bits,
            order=spec.order,
            chip_ns=_whole("chip_s", spec.chip_s, 10**9, "nanoseconds"),
            frame_period_us=_whole("frame_period_s", spec.frame_period_s, 10**6, "microseconds"),
            first_row=spec.first_row,
            sign_seed=spec.sign_seed or 0,
            natural_signs=spec.sign_seed is None,
            drive=Drive.UNIPOLAR if spec.drive == UNIPOLAR else Drive.BIPOLAR,
            polarity=Polarity(spec.polarity),
            samples_per_chip=samples_per_chip,
        )

    def spec(self, amplitude_v: float | None = None) -> FrameSpec:
        """The FrameSpec of this layout. Raises SpecError for a combination that cannot work."""
        return FrameSpec(
            nodes=self.nodes,
            bits=self.bits,
            order=self.order,
            chip_s=self.chip_ns / 10**9,  # rounds once, as the literal 50e-6 does
            frame_period_s=self.frame_period_us / 10**6,
            first_row=self.first_row,
            sign_seed=None if self.natural_signs else self.sign_seed,
            drive=UNIPOLAR if self.drive == Drive.UNIPOLAR else BIPOLAR,
            polarity=int(self.polarity),
            amplitude_v=amplitude_v,
        )


@dataclass(frozen=True, slots=True)
class Packet(Message):
    """What one packet carries.

    sequence: filled in by the parser. PacketWriter numbers packets itself and ignores it, and it
        doesn't take part in comparisons.
    """

    TYPE: ClassVar[PacketType]
    _: KW_ONLY
    sequence: int = field(default=0, compare=False)

    def payload(self) -> bytes:
        """The bytes after type and sequence."""
        return _WIRE[type(self).__name__].pack(*_values(self))


@dataclass(frozen=True, slots=True, kw_only=True)
class Info(Packet):
    """What the digitizer is and how it is set.

    sample_rate_uhz: rate of Samples.counts, µHz; in integrated mode that is the chip rate.
    volts_per_count: V, rounded to float32; counts are relative to zero_count.
    min_count, max_count: rails of the ADC.
    integrated: Samples carry one mean value per chip, and none in the gap between frames.
    """

    TYPE = PacketType.INFO

    frame: FrameLayout
    sample_rate_uhz: int
    volts_per_count: float
    zero_count: int = 0
    min_count: int = -(2**15)
    max_count: int = 2**15 - 1
    sync_mode: SyncMode = SyncMode.NONE
    integrated: bool = False
    digitizer_id: bytes = bytes(8)
    firmware_major: int = 0
    firmware_minor: int = 0
    version: int = VERSION

    @property
    def sample_rate_hz(self) -> float:
        """Rate of Samples.counts, Hz."""
        return self.sample_rate_uhz / 10**6

    def volts(self, counts: NDArray[np.int16]) -> NDArray[np.float32]:
        """The line in V, float32, of counts of any shape."""
        return (counts.astype(np.float32) - np.float32(self.zero_count)) * np.float32(
            self.volts_per_count
        )


@dataclass(frozen=True, slots=True)
class Samples(Packet):
    """Consecutive samples of the line.

    device_time_us: when the first sample began, on the digitizer's clock.
    first_index: index of the first sample among all samples sent or lost since START.
    counts: (m,) int16, m = 1…MAX_SAMPLES.
    sync: the first sample is the first of a frame.
    overrun: samples were lost just before these.
    """

    TYPE = PacketType.SAMPLES

    device_time_us: int
    first_index: int
    counts: NDArray[np.int16]
    sync: bool = False
    overrun: bool = False

    def __post_init__(self) -> None:
        counts = self.counts
        if counts.ndim != 1 or counts.dtype != _INT16 or not 1 <= counts.size <= MAX_SAMPLES:
            raise SpecError(
                f"counts are {counts.dtype} of shape {counts.shape}; "
                f"a packet takes int16 of shape (1…{MAX_SAMPLES},)"
            )
        if not (0 <= self.device_time_us < 2**64 and 0 <= self.first_index < 2**64):
            raise SpecError(
                f"device_time_us {self.device_time_us} and first_index {self.first_index} "
                "must lie within 0…2⁶⁴−1"
            )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Samples):
            return NotImplemented
        return (
            self.device_time_us == other.device_time_us
            and self.first_index == other.first_index
            and self.sync == other.sync
            and self.overrun == other.overrun
            and np.array_equal(self.counts, other.counts)
        )

    __hash__ = None  # type: ignore[assignment]

    def payload(self) -> bytes:
        flags = FLAG_SYNC * self.sync | FLAG_OVERRUN * self.overrun
        head = _WIRE["Samples"].pack(self.device_time_us, self.first_index, flags)
        return head + (self.counts ^ _SAMPLE_XOR).astype("<i2", copy=False).tobytes()


@dataclass(frozen=True, slots=True)
class Status(Packet):
    """The digitizer's health; counts run since power-up.

    uptime_us: now, on the clock of Samples.device_time_us.
    packets_dropped: numbered but never sent, since the host or the line was too slow.
    """

    TYPE = PacketType.STATUS

    uptime_us: int
    samples_lost: int = 0
    packets_dropped: int = 0
    commands_refused: int = 0
    streaming: bool = False


@dataclass(frozen=True, slots=True)
class Ack(Packet):
    """Answers the command of this type and sequence."""

    TYPE = PacketType.ACK

    command: int
    command_sequence: int
    result: Result = Result.OK


@dataclass(frozen=True, slots=True)
class Command(Packet):
    """Base of what the host sends."""

    def ack(self, result: Result = Result.OK) -> Ack:
        """The digitizer's answer to this command."""
        return Ack(self.TYPE, self.sequence, result)


@dataclass(frozen=True, slots=True)
class GetInfo(Command):
    """Asks for Info."""

    TYPE = PacketType.GET_INFO


@dataclass(frozen=True, slots=True)
class Start(Command):
    """Starts streaming."""

    TYPE = PacketType.START


@dataclass(frozen=True, slots=True)
class Stop(Command):
    """Ends streaming."""

    TYPE = PacketType.STOP


@dataclass(frozen=True, slots=True)
class Configure(Command):
    """Sets the frame layout and the way of sampling."""

    TYPE = PacketType.CONFIGURE

    frame: FrameLayout
    sync_mode: SyncMode = SyncMode.DRIVE
    integrated: bool = False


@dataclass(frozen=True, slots=True)
class OtherVersion:
    """An Info of a protocol version that this parser doesn't speak."""

    version: int
    sequence: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True)
class Rejected:
    """A command that arrived intact but cannot be carried out; `ack` tells its sender why."""

    command: int
    result: Result
    sequence: int = field(default=0, compare=False)

    def ack(self) -> Ack:
        """The digitizer's answer to this command."""
        return Ack(self.command, self.sequence, self.result)


Received: TypeAlias = Packet | OtherVersion | Rejected


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
        kind = _PACKETS.get(type_byte)
        if kind is Samples:
            return self._samples(sequence, payload)
        if kind is Info and payload and payload[0] != VERSION:
            return OtherVersion(payload[0], sequence)
        if kind is None:
            self._count["unknown"] += 1
            reason = Result.UNKNOWN_COMMAND
        elif len(payload) != (wire := _WIRE[kind.__name__]).size:
            self._count["malformed"] += 1
            reason = Result.BAD_LENGTH
        else:
            try:
                return _build(kind, iter(wire.unpack(payload)), sequence=sequence)
            except SpecError:
                self._count["malformed"] += 1
                reason = Result.OUT_OF_RANGE
        return Rejected(type_byte, reason, sequence) if type_byte & _COMMAND_BIT else None

    def _samples(self, sequence: int, payload: bytes) -> Samples | None:
        """Samples, which are nearly all of the traffic."""
        head = _WIRE["Samples"]
        if len(payload) <= head.size or (len(payload) - head.size) % 2:
            self._count["malformed"] += 1
            return None
        device_time_us, first_index, flags = head.unpack_from(payload)
        words = np.frombuffer(payload, "<i2", offset=head.size)
        return Samples(
            device_time_us,
            first_index,
            words ^ _SAMPLE_XOR,
            bool(flags & FLAG_SYNC),
            bool(flags & FLAG_OVERRUN),
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


def diagnose(counters: Counters) -> str | None:
    """What the person at the bench should look at where no packet came; None if one did."""
    if counters.packets:
        return None
    if not counters.bytes:
        return "no bytes: is the digitizer powered and started?"
    if counters.text_bytes > 0.9 * counters.bytes:  # random bytes: 0.38
        return "text received instead of packets; is another program's firmware on this board?"
    return f"{counters.bytes} bytes but no valid packet: wrong baud rate?"


def wrap(body: bytes) -> bytes:
    """A body as it travels: with its CRC, COBS-encoded, delimited."""
    return cobs_encode(body + _CRC.pack(zlib.crc32(body))) + b"\0"


def cobs_encode(data: bytes) -> bytes:
    """Data without any zero byte (Cheshire and Baker 1999, Consistent Overhead Byte Stuffing).

    A zero is imagined after the data; then each run of non-zero bytes, with the zero that ends it,
    becomes a block: its length, counting the zero, and the run. A block of 255 is 254 bytes
    without a zero.
    """
    out = bytearray()
    for run in data.split(b"\0"):
        full = len(run) // 254 * 254
        for start in range(0, full, 254):
            out.append(255)
            out += run[start : start + 254]
        out.append(len(run) - full + 1)
        out += run[full:]
    if run and len(run) == full:  # a full block may end the data without the imagined zero
        del out[-1]
    return bytes(out)


def cobs_decode(data: bytes) -> bytes:
    """The inverse of cobs_encode. Raises ValueError for what is no COBS."""
    decoded, unended = bytearray(data), []
    start, size = 0, len(data)
    while start < size:
        length = data[start]
        decoded[start] = 0  # a block's first byte lies where the zero of the block before it was
        if length == 255:
            unended.append(start + 255)  # where no zero was
        elif not length:
            raise ValueError(f"no COBS: a zero at byte {start} of {size}")
        start += length
    if start != size:
        raise ValueError(f"no COBS: the last block ends at byte {start} of {size}")
    for position in reversed(unended):
        del decoded[position : position + 1]
    return bytes(decoded[1:])


def _codes(name: str) -> str:
    """The struct codes of a message, nested ones written out."""
    return "".join(_codes(wire.code) if wire.code in FIELDS else wire.code for wire in FIELDS[name])


def _values(message: Message) -> Iterator[Any]:
    """Field values in wire order."""
    for wire in FIELDS[type(message).__name__]:
        value = getattr(message, wire.name)
        if isinstance(value, Message):
            yield from _values(value)
        else:
            yield value


def _build(kind: type[M], values: Iterator[Any], **extra: Any) -> M:
    """A message from its field values in wire order: the inverse of _values."""
    fields = {
        wire.name: _build(FrameLayout, values) if wire.code == "FrameLayout" else next(values)
        for wire in FIELDS[kind.__name__]
    }
    return kind(**fields, **extra)


def _checked(wire: Field, value: Any) -> Any:
    """The value as the receiver will see it. Raises SpecError if the field cannot hold it."""
    if wire.code in FIELDS:
        return value
    if wire.code == "f":
        with np.errstate(over="ignore"):
            value = float(np.float32(value))
        good = math.isfinite(value)
    elif wire.code == "8s":
        good = len(value) == 8
    elif isinstance(wire.allowed, range):
        value = operator.index(value)
        good = value in wire.allowed
    else:
        assert wire.allowed is not None, "integers have limits"
        good = value in tuple(wire.allowed) if wire.allowed is not bool else value in (0, 1)
        value = wire.allowed(value) if good else value
    if not good:
        raise SpecError(f"{wire.name} is {value!r}; the wire cannot carry that")
    return value


def _whole(name: str, seconds: float, per_second: int, unit: str) -> int:
    """Seconds as a whole number of units. Raises SpecError where that would change the time."""
    count = round(seconds * per_second)
    if abs(seconds * per_second - count) > 1e-9 * count:  # more than rounding of the float
        raise SpecError(
            f"{name} is {seconds:g} s, but the digitizer takes whole {unit}: {count / per_second:g}"
        )
    return count


_WIRE = {name: struct.Struct("<" + _codes(name)) for name in FIELDS}
_HEADER = _WIRE["Header"]
_CRC = struct.Struct("<I")
_INT16 = np.dtype(np.int16)
_SAMPLE_XOR = np.int16(SAMPLE_XOR)
_PACKETS: dict[int, type[Packet]] = {
    kind.TYPE: kind for kind in (Info, Samples, Status, Ack, GetInfo, Start, Stop, Configure)
}
_COMMAND_BIT = 0x80
_SEQUENCES = 2**16
_MAX_RAW = (
    _HEADER.size
    + max(2 * MAX_SAMPLES + _WIRE["Samples"].size, *(wire.size for wire in _WIRE.values()))
    + _CRC.size
)
_MAX_RUN = _MAX_RAW + -(-_MAX_RAW // 254)
_TEXT = bytes(range(0x20, 0x7F)) + b"\t\r\n"

MAX_PACKET = _MAX_RUN + 1
"""Longest packet on the wire, delimiter included, bytes."""
