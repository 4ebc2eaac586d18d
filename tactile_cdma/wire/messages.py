# SPDX-License-Identifier: Apache-2.0

"""The messages of either direction, and how each is packed into bytes and unpacked.

Fields are those of firmware/protocol.yaml, from which `_protocol.py` is generated.
"""

import math
import operator
import re
import struct
from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar, Self, TypeAlias

import numpy as np

from ..base.arrays import Counts, Floats32
from ..base.errors import SpecError
from ..code.frame import ORTHOGONAL, SPARSE, FrameSpec
from ._protocol import (
    FIELDS,
    FLAG_ASKED,
    FLAG_OVERRUN,
    FLAG_SYNC,
    MAX_SAMPLES,
    PACKED_BITS,
    PACKED_MOST_STEP,
    SAMPLE_XOR,
    TURN_SHIFT,
    VERSION,
    Drive,
    Field,
    PacketType,
    Polarity,
    Result,
    Scene,
    Signs,
    SyncMode,
    SyncWire,
)


@dataclass(frozen=True, slots=True)
class Message:
    """Fields that travel together; FIELDS[class name] has their order and limits on the wire.

    Raises SpecError for a value that its field on the wire cannot hold.
    """

    def __post_init__(self) -> None:
        for wire in FIELDS[type(self).__name__]:
            object.__setattr__(self, wire.name, _checked(wire, getattr(self, wire.name)))

    def pack(self) -> bytes:
        """Return the bytes on the wire. A last field with a default is absent where it has it."""
        name = type(self).__name__
        return WIRE[name].pack(*self._values()).removesuffix(_ABSENT[name])

    @classmethod
    def unpack(cls, data: bytes, **extra: int) -> Self:
        """Undo pack; extra: fields that are not on the wire.

        Raises struct.error for a wrong length, ValueError for a wrong value.
        """
        wire, absent = WIRE[cls.__name__], _ABSENT[cls.__name__]
        whole = data + absent if len(data) + len(absent) == wire.size else data
        return cls._of(iter(wire.unpack(whole)), **extra)

    def _values(self) -> Iterator[Any]:
        """Return the field values in wire order, those of nested messages among them."""
        for wire in FIELDS[type(self).__name__]:
            value = getattr(self, wire.name)
            if isinstance(value, Message):
                yield from value._values()
            else:
                yield value

    @classmethod
    def _of(cls, values: Iterator[Any], **extra: Any) -> Self:
        fields = {
            wire.name: FrameLayout._of(values) if wire.code == "FrameLayout" else next(values)
            for wire in FIELDS[cls.__name__]
        }
        return cls(**fields, **extra)


@dataclass(frozen=True, slots=True)
class FrameLayout(Message):
    """Tells how the nodes share the line, in the wire's integers.

    A layout converts to a FrameSpec and back unchanged. So does a FrameSpec whose times are whole
    nanoseconds and microseconds, except for its amplitude, which is not sent.
    """

    nodes: int
    bits: int
    order: int
    chip_ns: int
    frame_period_us: int
    first_row: int
    sign_seed: int
    signs: Signs
    drive: Drive
    polarity: Polarity
    samples_per_chip: int
    parity: bool = False
    resync_chips: int = 0
    guard_chips: int = 0

    @classmethod
    def of(cls, spec: FrameSpec, samples_per_chip: int) -> Self:
        """Make a spec's layout. Raises SpecError where the wire's integers cannot express it."""
        seeded = Signs.NATURAL if spec.sign_seed is None else Signs.SEEDED
        return cls(
            chip_ns=_whole("chip_s", spec.chip_s, 10**9, "nanoseconds"),
            frame_period_us=_whole("frame_period_s", spec.frame_period_s, 10**6, "microseconds"),
            sign_seed=spec.sign_seed or 0,
            signs=Signs.SPARSE if spec.sparse else Signs.SCRAMBLED if spec.scramble else seeded,
            drive=Drive[spec.drive.upper()],
            polarity=Polarity(spec.polarity),
            samples_per_chip=samples_per_chip,
            **{name: getattr(spec, name) for name in _AS_IN_SPEC},
        )

    def spec(self, amplitude_v: float | None = None) -> FrameSpec:
        """Make this layout's FrameSpec. Raises SpecError for a combination that cannot work."""
        return FrameSpec(
            chip_s=self.chip_ns / 10**9,  # rounds once, as the literal 50e-6 does
            frame_period_s=self.frame_period_us / 10**6,
            sign_seed=None if self.signs == Signs.NATURAL else self.sign_seed,
            scramble=self.signs in (Signs.SCRAMBLED, Signs.SPARSE),
            codes=SPARSE if self.signs == Signs.SPARSE else ORTHOGONAL,
            drive=self.drive.name.lower(),
            polarity=int(self.polarity),
            amplitude_v=amplitude_v,
            **{name: getattr(self, name) for name in _AS_IN_SPEC},
        )


@dataclass(frozen=True, slots=True)
class Packet(Message):
    """Holds what one packet carries.

    TYPE: the first byte of its body; see PACKETS. sequence: filled in by the parser. PacketWriter
    ignores it, and so do comparisons.
    """

    TYPE: ClassVar[PacketType]
    _: KW_ONLY
    sequence: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Info(Packet):
    """Tells what the digitizer is and how it is set.

    sample_rate_uhz: rate of Samples.counts, µHz; in integrated mode that is the chip rate.
    volts_per_count: V, rounded to float32; counts are relative to zero_count.
    min_count, max_count: smallest and largest reading of the ADC.
    integrated: Samples carry one mean value per chip, and none in the gap between frames.
    quiet_uv: see Configure; 0 where the digitizer never sends Quiet.
    """

    frame: FrameLayout
    sample_rate_uhz: int
    volts_per_count: float
    zero_count: int = 0
    min_count: int = -(2**15)
    max_count: int = 2**15 - 1
    sync_mode: SyncMode = SyncMode.NONE
    integrated: bool = False
    quiet_uv: int = 0
    sync_wire: SyncWire = SyncWire.OWN
    digitizer_id: bytes = bytes(8)
    firmware_major: int = 0
    firmware_minor: int = 0
    version: int = VERSION

    @property
    def sample_rate_hz(self) -> float:
        """Return the rate of Samples.counts, Hz."""
        return self.sample_rate_uhz / 10**6

    def volts(self, counts: Counts) -> Floats32:
        """Convert counts (m,) to the line in V, (m,) float32."""
        volts = counts.astype(np.float32)
        volts -= np.float32(self.zero_count)
        volts *= np.float32(self.volts_per_count)
        return volts


@dataclass(frozen=True, slots=True)
class Stretch(Packet):
    """Consecutive samples of the line: each of them (Samples), or their sums (Quiet).

    device_time_us: when the first sample was taken, on the digitizer's clock.
    first_index: index of the first sample among all samples sent or lost since START.
    sync: the first sample is the first of a frame.
    overrun: samples were lost just before these.
    asked: it is one in which all nodes whose turn it is speak.
    turn: whose the frame is that begins with the first sample: number of groups + that of the
        group; 0: of all nodes.
    """

    device_time_us: int
    first_index: int
    sync: bool = field(default=False, kw_only=True)
    overrun: bool = field(default=False, kw_only=True)
    asked: bool = field(default=False, kw_only=True)
    turn: int = field(default=0, kw_only=True)

    def __post_init__(self) -> None:
        if not (0 <= self.device_time_us < 2**64 and 0 <= self.first_index < 2**64):
            raise SpecError(
                f"device_time_us {self.device_time_us} and first_index {self.first_index} "
                "must lie within 0…2⁶⁴−1"
            )

    @property
    def flags(self) -> int:
        marks = FLAG_SYNC * self.sync | FLAG_OVERRUN * self.overrun | FLAG_ASKED * self.asked
        return marks | self.turn << TURN_SHIFT

    @classmethod
    def _of(cls, values: Iterator[Any], **extra: Any) -> Self:
        time_us, index, flags, *content = values
        return cls(time_us, index, *content, **_MARKS[flags], **extra)


@dataclass(frozen=True, slots=True, eq=False)
class Samples(Stretch):
    """Consecutive samples one by one.

    counts: (m,) int16, m = 1…MAX_SAMPLES.
    """

    counts: Counts

    def __post_init__(self) -> None:
        Stretch.__post_init__(self)
        counts = self.counts
        if counts.ndim != 1 or counts.dtype != _INT16 or not 1 <= counts.size <= MAX_SAMPLES:
            raise SpecError(
                f"counts are {counts.dtype} of shape {counts.shape}; "
                f"a packet takes int16 of shape (1…{MAX_SAMPLES},)"
            )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Samples):
            return NotImplemented
        mine, its = ((one.device_time_us, one.first_index, one.flags) for one in (self, other))
        return mine == its and np.array_equal(self.counts, other.counts)

    def pack(self) -> bytes:
        words = (self.counts ^ _SAMPLE_MASK).astype(_WORD, copy=False)
        return Stretch.pack(self) + words.tobytes()

    @classmethod
    def unpack(cls, data: bytes, **extra: int) -> Self:
        """Raise SpecError: the compiled scanner takes samples apart, see received.

        What comes here is malformed.
        """
        raise SpecError(f"{len(data)} bytes are no samples")

    @classmethod
    def received(cls, content: tuple[int, int, int, bytes], sequence: int) -> Self:
        """Make a packet of what the compiled scanner took apart. counts: int16, as in memory."""
        *marked, counts = content
        return cls._of(iter((*marked, np.frombuffer(counts, _INT16))), sequence=sequence)


@dataclass(frozen=True, slots=True, eq=False)
class Packed(Samples):
    """Samples on their way in 12 bits each; who receives it gets Samples.

    base: count of value 0. step: counts from one value to the next; base + 4095 · step fits int16.
    Raises SpecError for counts that are not among these.
    """

    base: int = field(default=0, kw_only=True)
    step: int = field(default=1, kw_only=True)

    def __post_init__(self) -> None:
        Samples.__post_init__(self)
        most_base = 2**15 - 1 - _MOST_PACKED * self.step
        if not (1 <= self.step <= PACKED_MOST_STEP and -(2**15) <= self.base <= most_base):
            raise SpecError(
                f"packed samples of base {self.base} and step {self.step}: a step is "
                f"1…{PACKED_MOST_STEP}, and all counts must fit 16 bits"
            )
        values, odd = np.divmod(self.counts.astype(np.int32) - self.base, self.step)
        if odd.any() or values.min() < 0 or values.max() > _MOST_PACKED:
            raise SpecError(
                f"counts from {self.counts.min()} to {self.counts.max()} are not within "
                f"{self.base}…{self.base + _MOST_PACKED * self.step} in steps of {self.step}"
            )

    def pack(self) -> bytes:
        """Put values below 4096 into bytes, two in three; unused bits of the last byte are 0."""
        values = ((self.counts.astype(np.int32) - self.base) // self.step) ^ _PACKED_MASK
        odd = values.size % 2
        low, high = np.append(values, np.zeros(odd, np.int32)).reshape(-1, 2).T
        packed = np.stack((low & 255, low >> 8 | (high & 15) << 4, high >> 4), axis=1)
        content = packed.astype(np.uint8).tobytes()[: packed.size - odd]
        return WIRE["Packed"].pack(*self._values()) + content


@dataclass(frozen=True, slots=True)
class Quiet(Stretch):
    """Consecutive samples, all within quiet_uv of each other: a whole frame's, or some of a gap.

    count: number of samples, at least 1. sum, sum_of_squares: of their counts, exact.
    Raises SpecError where no samples have such sums.
    """

    count: int
    sum: int
    sum_of_squares: int

    def __post_init__(self) -> None:
        Stretch.__post_init__(self)
        if not (
            1 <= self.count < 2**32
            and self.sum_of_squares < 2**64
            and self.sum**2 <= self.count * self.sum_of_squares
        ):
            raise SpecError(
                f"no samples that the wire can carry are {self.count} with sum {self.sum} and "
                f"sum of squares {self.sum_of_squares}"
            )

    @classmethod
    def of(cls, device_time_us: int, first_index: int, counts: Counts, **marks: bool) -> Self:
        """Make the packet that replaces these samples, (m,) int16. marks: sync, overrun."""
        wide = counts.astype(np.int64)  # sums stay below 2⁶³ for 2³² samples of 16 bits
        total, squares = int(wide.sum()), int(np.einsum("i,i->", wide, wide))
        return cls(device_time_us, first_index, counts.size, total, squares, **marks)

    @property
    def mean(self) -> float:
        return self.sum / self.count

    @property
    def variance(self) -> float:
        return (self.count * self.sum_of_squares - self.sum**2) / self.count**2


@dataclass(frozen=True, slots=True)
class Status(Packet):
    """The digitizer's health; counts run since power-up.

    uptime_us: now, on the clock of Samples.device_time_us.
    packets_dropped: numbered but never sent, because host or line were too slow.
    """

    uptime_us: int
    samples_lost: int = 0
    packets_dropped: int = 0
    commands_refused: int = 0
    command_errors: int = 0
    sync_faults: int = 0
    streaming: bool = False


@dataclass(frozen=True, slots=True)
class Ack(Packet):
    """Answers the command of this type and sequence."""

    command: int
    command_sequence: int
    result: Result = Result.OK


@dataclass(frozen=True, slots=True)
class Command(Packet):
    """Base of what the host sends; those without content add nothing to it."""

    def ack(self, result: Result = Result.OK) -> Ack:
        return Ack(self.TYPE, self.sequence, result)


class GetInfo(Command):
    """Asks for Info."""


class Start(Command):
    """Starts streaming."""


class Stop(Command):
    """Ends streaming."""


@dataclass(frozen=True, slots=True)
class Configure(Command):
    """Sets the frame layout and the way of sampling.

    quiet_uv: µV; a frame, or a part of the gap, in which no two samples differ by more is sent as
        Quiet. 0: never. driver/digitizer.py computes a safe value.
    """

    frame: FrameLayout
    sync_mode: SyncMode = SyncMode.DRIVE
    integrated: bool = False
    quiet_uv: int = 0
    sync_wire: SyncWire = SyncWire.OWN


class Pack(Command):
    """Asks for Packed in place of Samples, until the next Configure."""


@dataclass(frozen=True, slots=True)
class Touch(Command):
    """Has a demonstrator touched; other digitizers do not know it.

    node: counted from 1; 0: all. code: its ADC word from the next frame on, with Scene.HOST only.
    """

    scene: Scene
    node: int = 0
    code: int = 0


class Bootsel(Command):
    """Has the board restart as a USB drive that takes a new image."""


@dataclass(frozen=True, slots=True)
class Groups(Command):
    """Divides the nodes into 2^log2_groups groups, which transmit by turns; 0: all at once."""

    log2_groups: int


@dataclass(frozen=True, slots=True)
class Ask(Command):
    """Has every node say its word in the next frame, or by turns in the next 2^log2_groups."""

    log2_groups: int = 0


@dataclass(frozen=True, slots=True)
class Number(Command):
    """Has a node that is pressed take a number, or (forget) the nodes of a number lose it.

    number: 0: none; with forget: all nodes lose theirs.
    """

    number: int
    forget: bool = False


@dataclass(frozen=True, slots=True)
class OtherVersion:
    """An Info of another protocol version; its text is for people."""

    version: int
    sequence: int = field(default=0, compare=False)

    def __str__(self) -> str:
        return (
            f"the digitizer speaks protocol version {self.version}, this driver speaks {VERSION}: "
            "update whichever is older"
        )


@dataclass(frozen=True, slots=True)
class Rejected:
    """A command that arrived intact but cannot be carried out; `ack` answers with the reason."""

    command: int
    result: Result
    sequence: int = field(default=0, compare=False)

    def ack(self) -> Ack:
        return Ack(self.command, self.sequence, self.result)


Received: TypeAlias = Packet | OtherVersion | Rejected


def _codes(name: str) -> str:
    """Return the struct codes of a message and of those nested in it."""
    return "".join(_codes(wire.code) if wire.code in FIELDS else wire.code for wire in FIELDS[name])


def _checked(wire: Field, value: Any) -> Any:
    """Return a value as the receiver will see it. Raises SpecError if the field cannot hold it."""
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
    """Convert seconds to whole units. Raises SpecError if rounding would change the time."""
    count = round(seconds * per_second)
    if abs(seconds * per_second - count) > 1e-9 * count:  # more than float64 rounds
        raise SpecError(
            f"{name} is {seconds:g} s, but the digitizer takes whole {unit}: {count / per_second:g}"
        )
    return count


WIRE = {name: struct.Struct("<" + _codes(name)) for name in FIELDS}
"""Layout of every message's bytes; of Samples, of what comes before the samples."""
_ABSENT = {
    name: b"".join(
        struct.pack("<" + wire.code, wire.default)
        for wire in FIELDS[name]
        if wire.default is not None
    )
    for name in FIELDS
}
"""What a message ends with where that is left out."""
PACKETS: dict[int, type[Packet]] = {
    PacketType[re.sub("(?<=[a-z])(?=[A-Z])", "_", kind.__name__).upper()]: kind
    for kind in (
        *(Info, Samples, Packed, Quiet, Status, Ack, GetInfo, Start, Stop, Configure),
        *(Pack, Touch, Bootsel, Groups, Number, Ask),
    )
}
"""Packets by the first byte of their body: the PacketType that has the name of the class."""
for _type, _kind in PACKETS.items():
    _kind.TYPE = PacketType(_type)
_AS_IN_SPEC = ("nodes", "bits", "order", "first_row", "parity", "resync_chips", "guard_chips")
"""Fields of FrameLayout that are those of FrameSpec."""
_FLAGS = {"sync": FLAG_SYNC, "overrun": FLAG_OVERRUN, "asked": FLAG_ASKED}
_MARKS: list[dict[str, Any]] = [
    {name: bool(flags & bit) for name, bit in _FLAGS.items()} | {"turn": flags >> TURN_SHIFT}
    for flags in range(256)
]
"""The marks of a stretch by its flags."""
_SAMPLE_MASK = np.int16(SAMPLE_XOR)
_MOST_PACKED = 2**PACKED_BITS - 1
_PACKED_MASK = SAMPLE_XOR & _MOST_PACKED
_INT16 = np.dtype(np.int16)
_WORD = np.dtype("<i2")
