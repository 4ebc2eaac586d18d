# SPDX-License-Identifier: Apache-2.0

"""Files of a port's bytes, recordings (.skin) above all; see docs/recording.md.

A recording is MAGIC and then records: one that describes it, one for every piece read from the
port, and one that ends it, which describes it again. Each has its own mark, checksum and the
position of its bytes in the stream: of a file that is cut short or damaged, everything intact is
still read, at its time, and the losses are known; and reading may begin anywhere.

It is not MCAP, because the records of MCAP have no marks: of 20,000 pieces, its library (mcap 1.6)
reads 10,001 where one byte in the middle is missing, and this parser 19,999. It also takes 9.0 µs
to write a piece of 1,500 bytes and 9.5 to read it instead of 6.0 and 3.3, and Debian has no package
of it.
"""

from __future__ import annotations

import json
import logging
import math
import secrets
import struct
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from .. import __version__
from ..base.errors import CaptureError
from ..base.named_file import naming, open_named
from ..config.parameters import Value

SUFFIX = ".skin"
MAGIC = b"\x89SKIN\r\n\0"
VERSION = 2
MOST_BYTES = 1 << 20
"""Most bytes that a record holds; larger pieces take several. Chosen: bounds a reader's memory."""

_MARK = b"\xf1SK"
_DESCRIPTION, _CHUNK, _END = b"H", b"D", b"F"
_HEAD = struct.Struct("<3scIIqQ")
"""Mark, kind, identity of the recording, length of what follows, time ns, place in the stream."""
_CRC = struct.Struct("<I")
HEAD_BYTES = _HEAD.size + _CRC.size
"""Bytes of a record before what it holds."""
_MOST = 2**63 - 1
"""Largest time of a description, ns: that of an int64."""
_LEAST_VAIN, _VAIN_PER_BYTE = 16 * MOST_BYTES, 16
"""Budget for false heads of records: so many bytes may be examined in vain in any file, and so many
more per byte of the file. Chosen: a hostile file, full of heads that each claim a megabyte, would
otherwise take hours."""


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
        """Return a chunk's time on the host's monotonic clock, s."""
        return (self.monotonic_ns + time_ns) * 1e-9

    def wall_s(self, t_host: float) -> float:
        """Return Unix time, s, of a moment of the host's monotonic clock."""
        return self.wall_ns * 1e-9 + (t_host - self.monotonic_ns * 1e-9)


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes that were read at once, time_ns after the recording began."""

    time_ns: int
    data: bytes


class RecordingEncoder:
    """Makes the bytes of a recording, in order: begin, any number of chunks, end.

    identity: a random 32-bit number, by which its records are known. Memory does not grow with the
    recording.
    """

    def __init__(self, description: Description, identity: int) -> None:
        self._begun_ns, self._identity = description.monotonic_ns, identity
        self._description = json.dumps(asdict(description) | {"version": VERSION}).encode()
        self._offset = self._time_ns = 0

    def begin(self) -> bytes:
        """Return the first bytes; raises CaptureError for a description too long for a record."""
        if (size := len(self._description)) > MOST_BYTES:
            raise CaptureError(f"{size} bytes of parameters are too many for a recording")
        return MAGIC + self._record(_DESCRIPTION, self._description)

    def chunk(self, data: bytes, t_host: float) -> bytes:
        """Encode a piece of the stream that was read at t_host (monotonic, s)."""
        self._tick(t_host)
        encoded = b""
        for begin in range(0, len(data), MOST_BYTES):
            part = data[begin : begin + MOST_BYTES]
            encoded += self._record(_CHUNK, part)
            self._offset += len(part)
        return encoded

    def end(self, t_host: float) -> bytes:
        self._tick(t_host)
        return self._record(_END, self._description)

    def _tick(self, t_host: float) -> None:
        self._time_ns = max(self._time_ns, round(t_host * 1e9) - self._begun_ns)

    def _record(self, kind: bytes, content: bytes) -> bytes:
        head = _HEAD.pack(_MARK, kind, self._identity, len(content), self._time_ns, self._offset)
        return head + _CRC.pack(zlib.crc32(content, zlib.crc32(head))) + content


class RecordingParser:
    """Finds the chunks in the bytes of a recording that may be damaged or cut short.

    However the bytes are divided over calls of `feed`, the outcome is the same. At most one record
    and one piece of the file are held in memory.

    description, end_ns, the recording's length: None until they are read. identity: that of the
    first record. damaged: places in the file that hold something other than records, not counting
    the end of a file that was cut. lost_bytes: of the stream, missing before the last record that
    was read. chunks, bytes: found. time_ns: that of the last record.
    """

    def __init__(self, identity: int | None = None) -> None:
        """identity: that of the recording where the bytes begin anywhere in it."""
        self.description: Description | None = None
        self.end_ns: int | None = None
        self.identity = identity
        self.damaged = self.lost_bytes = 0
        self.chunks = self.bytes = 0
        self._held = bytearray()
        resumed = identity is not None
        self._expects_magic, self._in_damage = not resumed, resumed
        self._offset: int | None = None if resumed else 0
        self.time_ns = 0
        self._passed = self._vain = 0  # bytes of the file before _held; see _LEAST_VAIN

    @property
    def losses(self) -> tuple[str, ...]:
        """What a recording, parsed to its end, lacks, one sentence each."""
        notes = []
        if self.end_ns is None:
            notes.append(
                "the recording is cut short, or damaged at its end: what came before is there"
            )
        if self.damaged or self.lost_bytes:
            notes.append(
                f"the file is damaged in {self.damaged} places; {self.lost_bytes} bytes of the "
                "port are known to be lost"
            )
        return tuple(notes)

    def feed(self, data: bytes) -> list[Chunk]:
        """Return the chunks that these bytes complete.

        Raises CaptureError where this is a recording of another version.
        """
        self._held += data
        return self._take(at_end=False)

    def finish(self) -> list[Chunk]:
        """Return the last chunks at the end of the file, after a record whose rest is missing."""
        chunks = self._take(at_end=True)
        if self._in_damage and self.end_ns is None:
            self.damaged = max(0, self.damaged - 1)  # this is where the file was cut
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
        """Return the size of the record that begins here, bytes; None: there is none."""
        if len(self._held) - place < HEAD_BYTES:
            return HEAD_BYTES
        _, kind, identity, length, _, _ = _HEAD.unpack_from(self._held, place)
        known = kind in (_DESCRIPTION, _CHUNK, _END) and length <= MOST_BYTES
        ours = self.identity in (None, identity)
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
        if offset < self._offset or time_ns < self.time_ns or self.end_ns is not None:
            return False
        if kind != _CHUNK:
            try:
                self.description = _description(json.loads(content))
            except (ValueError, LookupError, TypeError, RecursionError):
                return False
            self.end_ns = time_ns if kind == _END else None
        self.identity = identity
        self.lost_bytes += offset - self._offset
        self._offset, self.time_ns = offset, time_ns
        if kind == _CHUNK:
            self._offset += length
            self.chunks += 1
            self.bytes += length
            found.append(Chunk(time_ns, content))
        return True


def _description(said: Any) -> Description:
    """Raises CaptureError for another version, LookupError or TypeError for no description."""
    if (version := said["version"]) != VERSION:
        whose = "an older" if version in range(VERSION) else "another"
        raise CaptureError(
            f"a recording of version {version}, made by {whose} version of tactile-cdma; this one "
            f"reads version {VERSION}"
        )
    description = Description(**{field.name: said[field.name] for field in fields(Description)})
    for number in (description.wall_ns, description.monotonic_ns, description.baud):
        if type(number) is not int or not 0 <= number <= _MOST:
            raise TypeError(f"no time or rate: {number}")
    if not isinstance(description.port, str) or not isinstance(description.package_version, str):
        raise TypeError("no names of port and package")
    if not isinstance(description.parameters, dict):
        raise TypeError("no parameters")
    return description


_log = logging.getLogger(__name__)

_READ_BYTES = 1 << 16
_BEGINNING_BYTES = 64 * MOST_BYTES
"""Where the first record begins at the latest, as far as a damaged file is looked through for it:
another kind of file, of any size, is known for what it is within a second."""
_TABLES = {b"PK\x03\x04": "NPZ", b"PAR1": "Parquet", b"sequence,device_time_s,": "CSV"}
"""How tables of frames begin."""
_NO_TEXT = bytes(range(1, 32)).translate(None, b"\t\n\v\f\r\x1a\x1b")
"""Bytes that text does not hold, but raw packets do. Some scopes fill up their text with zeros."""


class Recorder:
    """Writes a recording. Use as a context manager: leaving it ends the recording.

    Every piece is flushed at once: a program that is killed loses nothing of it.
    Raises OSError where the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        port: str,
        baud: int,
        parameters: Mapping[str, Value],
        overwrite: bool = True,
    ) -> None:
        """Create or overwrite the file. parameters: those that were asked for."""
        description = Description(
            wall_ns=time.time_ns(),
            monotonic_ns=time.monotonic_ns(),
            port=port,
            baud=baud,
            parameters=parameters,
            package_version=__version__,
        )
        self._encoder = RecordingEncoder(description, secrets.randbits(32))
        begin = self._encoder.begin()
        # "x" refuses links as well, which may point elsewhere
        self._file = path.open("wb" if overwrite else "xb")
        _log.debug("recording %s to %s", port, path)
        self._put(begin)

    def write(self, data: bytes, t_host: float) -> None:
        """Keep bytes that were read at t_host (monotonic, s)."""
        if data:
            self._put(self._encoder.chunk(data, t_host))

    def close(self) -> None:
        with self._file:
            self._put(self._encoder.end(time.monotonic()))

    def _put(self, encoded: bytes) -> None:
        self._file.write(encoded)
        self._file.flush()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # After an error, such as a full disk, closing may fail as well: the first reason counts.
        with suppress(OSError) if kind else nullcontext():
            self.close()


def is_recording(path: Path) -> bool:
    """Tell whether a file begins or is named as a recording; raises CaptureError if unreadable."""
    with naming(path, CaptureError), open_named(path) as file:
        return file.read(len(MAGIC)) == MAGIC or path.suffix == SUFFIX


def describe(path: Path) -> Description:
    """Return a recording's description of itself; raises CaptureError where it is none."""
    description = _beginning(path).description or _end(path).description
    if description is None:
        raise CaptureError(f"{path}: not a recording of tactile-cdma, or its beginning is damaged")
    return description


def length_ns(path: Path) -> int | None:
    """Return a recording's length, ns; None where its end is missing or damaged."""
    return _end(path).end_ns


def read_chunks(
    path: Path, parser: RecordingParser, begin: int = 0, end: float = math.inf
) -> Iterator[Chunk]:
    """Yield a recording's chunks between positions in the file; the parser, of `seek`, counts.

    Raises CaptureError where the file cannot be read, or is of another version.
    """
    try:
        with open_named(path) as file:
            file.seek(begin)
            while file.tell() < end and (data := file.read(_READ_BYTES)):
                yield from parser.feed(data)
        yield from parser.finish()
        for loss in parser.losses:
            _log.debug("%s: %s", path, loss)
    except OSError as error:
        raise CaptureError(f"{path}: {error.strerror}") from None
    except CaptureError as error:  # of another version
        raise CaptureError(f"{path}: {error}") from None


def seek(path: Path, time_ns: int) -> tuple[RecordingParser, int]:
    """Find a parser and a position in the file for all chunks from a time on, and few before."""
    if (identity := _beginning(path).identity) is None or time_ns <= 0:
        return RecordingParser(), 0
    low, high = 0, path.stat().st_size
    while high - low > MOST_BYTES:
        middle = (low + high) // 2
        first = next(read_chunks(path, RecordingParser(identity), middle), None)
        if first is not None and first.time_ns < time_ns:
            low = middle
        else:
            high = middle
    return RecordingParser(identity if low else None), low


def _beginning(path: Path) -> RecordingParser:
    """Return a parser that has read the beginning of a recording, with a chunk if there is one."""
    parser = RecordingParser()
    next(read_chunks(path, parser, end=_BEGINNING_BYTES), None)
    return parser


def _end(path: Path) -> RecordingParser:
    """Return a parser that has read the end of a recording, if it is one."""
    parser = RecordingParser(_beginning(path).identity)
    size = path.stat().st_size
    for _ in read_chunks(path, parser, max(0, size - HEAD_BYTES - MOST_BYTES)):
        pass
    return parser


def survey(path: Path) -> RecordingParser:
    """Read a recording from beginning to end; raises CaptureError where it is none."""
    describe(path)
    parser = RecordingParser()
    for _ in read_chunks(path, parser):
        pass
    return parser


def is_text(path: Path) -> bool:
    """Tell whether a capture is a scope's text rather than raw packets, which end with zeros.

    Raises CaptureError where it cannot be read, is empty, or is a table that was exported.
    """
    # open_named refuses pipes: a capture is read more than once
    with naming(path, CaptureError), open_named(path) as file:
        head = file.read(65_536)
    if not head:
        raise CaptureError(f"{path}: the file is empty")
    for beginning, kind in _TABLES.items():
        if head.startswith(beginning):
            raise CaptureError(
                f"{path}: {kind}, such as export writes: it holds no samples to decode"
            )
    if head[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" not in head:  # UTF-16 has zeros
        return True
    text = head.replace(b"\0", b"")
    return bool(text) and text.translate(None, _NO_TEXT) == text


def read_bytes(path: Path) -> Iterator[tuple[bytes, float]]:
    """Yield a port's bytes, and when they were read, s on the recording host's monotonic clock.

    From a recording, or from a file of the bytes alone, which has no times: 0 then.
    Raises CaptureError where it cannot be read.
    """
    if is_recording(path):
        description = describe(path)
        for chunk in read_chunks(path, RecordingParser()):
            yield chunk.data, description.t_host(chunk.time_ns)
        return
    with naming(path, CaptureError), open_named(path) as file:
        while data := file.read(_READ_BYTES):
            yield data, 0.0


def capture_notes(path: Path) -> tuple[str, ...]:
    """Return what is wrong with a file that read_bytes reads, one sentence each."""
    return survey(path).losses if is_recording(path) else ()
