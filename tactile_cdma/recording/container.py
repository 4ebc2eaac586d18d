# SPDX-License-Identifier: Apache-2.0

"""The container of a port's recorded bytes (.skin): records ↔ bytes. No I/O; see docs/recording.md.

A recording is MAGIC and then records: one that describes it, one for every piece read from the
port, and one that ends it, with an index and a checksum:

    RecordingEncoder → bytes → RecordingParser.feed(bytes) → [Chunk, …]

Every record has its own checksum and the position of its bytes in the stream. So from a file that
is cut short or damaged, everything intact is still read, at its time, and the losses are known.
"""

import hashlib
import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from ..base.errors import CaptureError
from ..config.parameters import Value

SUFFIX = ".skin"
MAGIC = b"\x89SKIN\r\n\0"
VERSION = 1
MOST_BYTES = 1 << 20
"""Most bytes that a record holds; larger pieces take several. Chosen: bounds a reader's memory."""
INDEX_S = 1.0
"""Distance of two entries of the index, at first, s; chosen."""
MOST_ENTRIES = 2048
"""Most entries of the index; of a full one every second is dropped. Chosen: 34 min at INDEX_S."""

_MARK = b"\xf1SK"
_DESCRIPTION, _CHUNK, _END = b"H", b"D", b"F"
_HEAD = struct.Struct("<3scIIqQ")
"""Mark, kind, identity of the recording, length of what follows, time ns, place in the stream."""
_CRC = struct.Struct("<I")
HEAD_BYTES = _HEAD.size + _CRC.size
"""Bytes of a record before what it holds."""
_MOST = 2**63 - 1
"""Largest time, ns, and largest position, bytes: those of an int64."""
_LEAST_VAIN, _VAIN_PER_BYTE = 16 * MOST_BYTES, 16
"""Budget for false heads of records: so many bytes may be examined in vain in any file, and so many
more per byte of the file. Chosen: a hostile file, full of heads that each claim a megabyte, would
otherwise take hours."""
POSITION = struct.Struct("<Q")
"""The last bytes of a recording: where the record that ends it begins."""


@dataclass(frozen=True, slots=True)
class Description:
    """A recording's description of itself.

    wall_ns, monotonic_ns: the host's clocks when it began, ns: Unix time and the monotonic clock.
    parameters: those that were asked for.
    """

    wall_ns: int
    monotonic_ns: int
    port: str
    baud: int
    parameters: Mapping[str, Value]
    package_version: str

    def t_host(self, time_ns: int) -> float:
        """A chunk's time on the host's monotonic clock, s."""
        return (self.monotonic_ns + time_ns) * 1e-9

    def wall_s(self, t_host: float) -> float:
        """Unix time, s, of a moment of the host's monotonic clock."""
        return self.wall_ns * 1e-9 + (t_host - self.monotonic_ns * 1e-9)


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes that were read at once, time_ns after the recording began."""

    time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class EndRecord:
    """What the last record says.

    description: that of the recording, again. time_ns: length of the recording, ns. position: where
    the record begins in the file. sha256: of the file up to there. index: (time ns, position of a
    chunk's record) in rising order.
    """

    description: Description
    time_ns: int
    position: int
    sha256: str
    index: tuple[tuple[int, int], ...]

    def position_of(self, time_ns: int) -> int | None:
        """Where to begin reading for everything recorded from a time on; None: the beginning."""
        before = [position for time, position in self.index if time <= time_ns]
        return before[-1] if before else None


class RecordingEncoder:
    """Makes the bytes of a recording, in order: begin, any number of chunks, end.

    identity: a random 32-bit number, by which records are known as this recording's. Memory does
    not grow with the recording.
    """

    def __init__(self, description: Description, identity: int) -> None:
        self._begun_ns, self._identity = description.monotonic_ns, identity
        self._content = asdict(description) | {"version": VERSION}
        self._position = self._offset = self._time_ns = 0
        self._digest = hashlib.sha256()
        self._index: list[tuple[int, int]] = []
        self._interval_ns = round(INDEX_S * 1e9)

    def begin(self) -> bytes:
        """The first bytes; raises CaptureError for a description that is too long for a record."""
        text = json.dumps(self._content).encode()
        if 2 * len(text) > MOST_BYTES:
            raise CaptureError(f"{len(text)} bytes of parameters are too many for a recording")
        return self._count(MAGIC + self._record(_DESCRIPTION, text))

    def chunk(self, data: bytes, t_host: float) -> bytes:
        """A piece of the stream, read at t_host (monotonic, s)."""
        self._tick(t_host)
        encoded = b""
        for begin in range(0, len(data), MOST_BYTES):
            self._note()
            part = data[begin : begin + MOST_BYTES]
            record = self._record(_CHUNK, part)
            self._offset += len(part)
            encoded += self._count(record)
        return encoded

    def end(self, t_host: float) -> bytes:
        self._tick(t_host)
        content = {
            "description": self._content,
            "sha256": self._digest.hexdigest(),
            "index": self._index,
        }
        position = POSITION.pack(self._position)
        return self._record(_END, json.dumps(content).encode() + position)

    def _tick(self, t_host: float) -> None:
        self._time_ns = max(self._time_ns, round(t_host * 1e9) - self._begun_ns)

    def _note(self) -> None:
        """An entry of the index, where one is due."""
        if self._index and self._time_ns - self._index[-1][0] < self._interval_ns:
            return
        self._index.append((self._time_ns, self._position))
        if len(self._index) > MOST_ENTRIES:
            del self._index[1::2]
            self._interval_ns *= 2

    def _record(self, kind: bytes, content: bytes) -> bytes:
        head = _HEAD.pack(_MARK, kind, self._identity, len(content), self._time_ns, self._offset)
        return head + _CRC.pack(zlib.crc32(content, zlib.crc32(head))) + content

    def _count(self, encoded: bytes) -> bytes:
        self._position += len(encoded)
        self._digest.update(encoded)
        return encoded


class RecordingParser:
    """Finds the chunks in the bytes of a recording that may be damaged or cut short.

    However the bytes are divided over calls of `feed`, the outcome is the same. At most one record
    and one piece of the file are held in memory.

    description, end: None until they are read. damaged: places in the file that hold something
    other than records, not counting the end of a file that was cut. lost_bytes: of the stream,
    missing before the last record that was read. chunks, bytes: found.
    """

    def __init__(self, resumed: bool = False) -> None:
        """resumed: the bytes begin with a record in the middle of the file."""
        self.description: Description | None = None
        self.end: EndRecord | None = None
        self.damaged = self.lost_bytes = 0
        self.chunks = self.bytes = 0
        self._held = bytearray()
        self._expects_magic = not resumed
        self._in_damage = False
        self._identity: int | None = None
        self._offset: int | None = None if resumed else 0
        self._time_ns = 0
        self._passed = self._vain = 0  # bytes of the file before _held; see _LEAST_VAIN

    def feed(self, data: bytes) -> list[Chunk]:
        """The chunks that these bytes complete.

        Raises CaptureError where this is a recording of another version.
        """
        self._held += data
        return self._take(at_end=False)

    def finish(self) -> list[Chunk]:
        """At the end of the file: chunks after a record whose rest is missing."""
        chunks = self._take(at_end=True)
        if self._in_damage and self.end is None:
            self.damaged -= 1  # this is where the file was cut
        return chunks

    def _take(self, at_end: bool) -> list[Chunk]:
        found: list[Chunk] = []
        held, place = self._held, 0
        if self._expects_magic:
            if len(held) < len(MAGIC) and not at_end:
                return found
            self._expects_magic = False
            place = len(MAGIC) if held.startswith(MAGIC) else 0
        while place < len(held):
            begin = held.find(_MARK, place)
            if begin < 0:  # the last bytes may begin a mark
                begin = len(held) if at_end else max(place, len(held) - len(_MARK) + 1)
            self._skip(begin - place)
            place = begin
            worth_trying = self._vain <= _LEAST_VAIN + _VAIN_PER_BYTE * (self._passed + place)
            size = self._size(place) if worth_trying else None
            if size is not None and place + size > len(held):
                if not at_end:
                    break
                size = None
            if size is not None and self._accept(bytes(held[place : place + size]), found):
                place += size
                self._in_damage = False
            elif place < len(held):
                self._vain += size or 0
                self._skip(1)
                place += 1
        self._passed += place
        del held[:place]
        return found

    def _size(self, place: int) -> int | None:
        """Size of the record that begins here, bytes; None: there is none."""
        if len(self._held) - place < HEAD_BYTES:
            return HEAD_BYTES
        _, kind, identity, length, _, _ = _HEAD.unpack_from(self._held, place)
        known = kind in (_DESCRIPTION, _CHUNK, _END) and length <= MOST_BYTES
        ours = self._identity in (None, identity)
        return HEAD_BYTES + length if known and ours else None

    def _skip(self, count: int) -> None:
        if count and not self._in_damage:
            self._in_damage = True
            self.damaged += 1

    def _accept(self, record: bytes, found: list[Chunk]) -> bool:
        """Read a record; False where it is damaged or not at its place."""
        head, content = record[: _HEAD.size], record[HEAD_BYTES:]
        (crc,) = _CRC.unpack_from(record, _HEAD.size)
        if zlib.crc32(content, zlib.crc32(head)) != crc:
            return False
        _, kind, identity, length, time_ns, offset = _HEAD.unpack(head)
        if self._offset is None:
            self._offset = offset
        if offset < self._offset or time_ns < self._time_ns or self.end:
            return False
        if kind != _CHUNK and not self._understood(kind, time_ns, content):
            return False
        self._identity = identity
        self.lost_bytes += offset - self._offset
        self._offset, self._time_ns = offset, time_ns
        if kind == _CHUNK:
            self._offset += length
            self.chunks += 1
            self.bytes += length
            found.append(Chunk(time_ns, content))
        return True

    def _understood(self, kind: bytes, time_ns: int, content: bytes) -> bool:
        """Read a description or an end; False where the content is neither."""
        try:
            if kind == _DESCRIPTION:
                self.description = _description(json.loads(content))
                return True
            (position,) = POSITION.unpack(content[-POSITION.size :])
            said = json.loads(content[: -POSITION.size])
            index = tuple((_count(time), _count(place)) for time, place in said["index"])
            description = _description(said["description"])
            self.end = EndRecord(description, time_ns, position, str(said["sha256"]), index)
            self.description = self.description or description
        except (ValueError, LookupError, TypeError, RecursionError, struct.error):
            return False
        return True


def losses(parser: RecordingParser) -> tuple[str, ...]:
    """What a recording, parsed to its end, lacks, one sentence each."""
    notes = []
    if parser.end is None:
        notes.append("the recording is cut short, or damaged at its end: what came before is there")
    if parser.damaged or parser.lost_bytes:
        notes.append(
            f"the file is damaged in {parser.damaged} places; {parser.lost_bytes} bytes of the "
            "port are known to be lost"
        )
    return tuple(notes)


def _description(said: Any) -> Description:
    """Raises CaptureError for another version, LookupError or TypeError for no description."""
    if said["version"] != VERSION:
        raise CaptureError(
            f"a recording of version {said['version']}, but this program reads version {VERSION}"
        )
    description = Description(**{field.name: said[field.name] for field in fields(Description)})
    for number in (description.wall_ns, description.monotonic_ns, description.baud):
        _count(number)
    if not isinstance(description.port, str) or not isinstance(description.package_version, str):
        raise TypeError("no names of port and package")
    if not isinstance(description.parameters, dict):
        raise TypeError("no parameters")
    return description


def _count(said: Any) -> int:
    """A time in ns, or a place in the file; raises TypeError for anything else."""
    if type(said) is not int or not 0 <= said <= _MOST:
        raise TypeError(f"no time or place: {said}")
    return said
