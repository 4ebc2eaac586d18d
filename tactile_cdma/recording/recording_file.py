# SPDX-License-Identifier: Apache-2.0

"""Files of a port's bytes, recordings above all: written as bytes arrive, read piece by piece."""

from __future__ import annotations

import logging
import math
import secrets
import time
from collections.abc import Iterator, Mapping
from contextlib import nullcontext, suppress
from pathlib import Path

from .. import __version__
from ..base.errors import CaptureError
from ..base.named_file import naming, open_named
from ..config.parameters import Value
from .container import (
    HEAD_BYTES,
    MAGIC,
    MOST_BYTES,
    SUFFIX,
    Chunk,
    Description,
    RecordingEncoder,
    RecordingParser,
)

_log = logging.getLogger(__name__)

_READ_BYTES = 1 << 16
_BEGINNING_BYTES = 64 * MOST_BYTES
"""Where the first record begins at the latest: another kind of file is known within a second."""
_TABLES = {b"PK\x03\x04": "NPZ", b"PAR1": "Parquet", b"sequence,device_time_s,": "CSV"}
"""How tables of frames begin."""
_NO_TEXT = bytes(range(1, 32)).translate(None, b"\t\n\v\f\r\x1a\x1b")
"""Bytes that text does not hold, but raw packets do. Some scopes fill up their text with zeros."""


class Recorder:
    """Writes a recording, in a context that ends it. Raises OSError.

    Every piece is flushed at once: a program that is killed loses nothing of it.
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


def read_pieces(path: Path) -> Iterator[bytes]:
    """Yield the bytes of a file, piece by piece; raises CaptureError."""
    with naming(path, CaptureError), open_named(path) as file:
        while data := file.read(_READ_BYTES):
            yield data


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
    """Tell whether a capture is text; CaptureError: unreadable, empty, or an exported table."""
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
    """Yield a port's bytes, and when read, monotonic s (0 of raw bytes); raises CaptureError."""
    if is_recording(path):
        description = describe(path)
        for chunk in read_chunks(path, RecordingParser()):
            yield chunk.data, description.t_host(chunk.time_ns)
        return
    for data in read_pieces(path):
        yield data, 0.0


def capture_notes(path: Path) -> tuple[str, ...]:
    """Return what is wrong with a file that read_bytes reads, one sentence each."""
    return survey(path).losses if is_recording(path) else ()
