# SPDX-License-Identifier: Apache-2.0

"""Files to decode offline: oscilloscope captures as CSV, recordings or raw bytes of a port."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..base.arrays import Floats, Floats32
from ..base.errors import CaptureError
from ..base.named_file import naming, open_named, read_named
from .container import RecordingParser
from .recording_file import describe, is_recording, read_chunks, read_pieces, survey

MOST_CSV_BYTES = 256 << 20
"""Largest oscilloscope file, bytes: about ten million samples. Chosen: it is held in memory whole.
Recordings and raw bytes are read piece by piece and may be of any size."""

_HEADER_LINES = 64
"""Most lines before the first two numbers. Chosen: scopes write up to 20 or so."""
_LEAST_SAMPLES = 16
"""Fewest samples of a capture that is worth decoding; chosen."""
_INVALID_V = 1e30
"""V; Keysight scopes write 9.9E+37 for a missing sample."""
_SLACK = 0.75
"""Largest deviation of a time stamp from an even raster, in samples: more means missing samples."""


@dataclass(frozen=True, slots=True)
class ScopeCapture:
    """Unbroken pieces of one evenly sampled recording.

    pieces: (start time in s, (m,) float32 V) each, in the order of the file.
    rate_hz: sampling rate. notes: what was wrong with the file, one sentence each.
    """

    pieces: tuple[tuple[float, Floats32], ...]
    rate_hz: float
    notes: tuple[str, ...]


_TABLES = {b"PK\x03\x04": "NPZ", b"PAR1": "Parquet", b"sequence,device_time_s,": "CSV"}
"""How tables of frames begin."""


def is_text(path: Path) -> bool:
    """Whether a capture is a CSV file rather than raw packets (which end with a zero byte each).

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
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise CaptureError(f"{path}: UTF-16 text; save it as plain CSV")
    return b"\0" not in head


def read_bytes(path: Path) -> Iterator[tuple[bytes, float]]:
    """Bytes of a port, and when they were read, s on the monotonic clock of the recording host.

    From a recording, or from a file of the bytes alone, which has no times: 0 then.
    Raises CaptureError where it cannot be read.
    """
    if is_recording(path):
        description = describe(path)
        for chunk in read_chunks(path, RecordingParser()):
            yield chunk.data, description.t_host(chunk.time_ns)
        return
    for data in read_pieces(path):
        yield data, 0.0


def capture_notes(path: Path) -> tuple[str, ...]:
    """What is wrong with a file that read_bytes reads, one sentence each."""
    return survey(path).notes if is_recording(path) else ()


def read_scope_csv(path: Path) -> ScopeCapture:
    """Read time in s and voltage in V from the first two columns, after any header lines.

    Missing samples and non-numbers split the recording into pieces and are noted. Decimal commas
    are understood where columns are not separated by commas.
    Raises CaptureError, naming the line, where this is not such a file.
    """
    try:
        with naming(path, CaptureError):
            lines = read_named(path, MOST_CSV_BYTES).decode(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise CaptureError(f"{path}: not a text file in UTF-8") from None
    header, delimiter = _header(path, lines)
    body = lines[header:]
    if delimiter != ",":
        body = [line.replace(",", ".") for line in body]
    try:
        table = np.loadtxt(body, delimiter=delimiter, usecols=(0, 1), ndmin=2, comments=None)
    except ValueError:
        bad = next(
            i for i, line in enumerate(body) if line.strip() and not _numbers(line, delimiter)
        )
        raise CaptureError(
            f"{path}: line {header + 1 + bad} is not two numbers, time in s and voltage in V: "
            f"{body[bad][:60]!r}"
        ) from None
    if len(table) < _LEAST_SAMPLES:
        raise CaptureError(f"{path}: only {len(table)} samples; is the file cut short?")
    return _pieces(path, table[:, 0], table[:, 1], header)


def _header(path: Path, lines: list[str]) -> tuple[int, str | None]:
    """Number of lines before the first two numbers, and the delimiter (None: white space)."""
    for number, line in enumerate(lines[:_HEADER_LINES]):
        for delimiter in (",", ";", "\t", None):
            if _numbers(line if delimiter == "," else line.replace(",", "."), delimiter):
                return number, delimiter
    raise CaptureError(
        f"{path}: no line with two numbers (time in s, voltage in V) among the first "
        f"{min(len(lines), _HEADER_LINES)} lines"
    )


def _numbers(line: str, delimiter: str | None) -> bool:
    """Whether a line begins with two numbers."""
    fields = line.split(delimiter)[:2]
    if not all(field.isascii() and "_" not in field for field in fields):
        return False  # Python reads 1_0 and other scripts' digits, numpy does not
    try:
        return len([float(field) for field in fields]) == 2
    except ValueError:
        return False


def _pieces(path: Path, time_s: Floats, volts: Floats, header: int) -> ScopeCapture:
    notes = []
    good = np.isfinite(time_s) & np.isfinite(volts) & (np.abs(volts) < _INVALID_V)
    lines = np.flatnonzero(good) + header + 1
    if not good.all():
        count, first = np.count_nonzero(~good), header + 1 + int(np.argmin(good))
        notes.append(
            f"{count} of {good.size} samples are no numbers (first in line {first}); decoding "
            "what lies between them"
        )
        time_s, volts = time_s[good], volts[good]
    steps = np.diff(time_s)
    if len(steps) < _LEAST_SAMPLES or time_s[-1] <= time_s[0]:
        raise CaptureError(f"{path}: the first column is not a rising time in s")
    # Scopes print time with few digits: steps wobble by the last digit, or are 0 in between.
    step = float(np.median(steps)) or float(steps.mean())
    digit = 0.0 if np.median(steps) else float(steps[steps > 0].min())
    if (steps < -0.5 * step - digit).any():
        line = lines[1:][steps < -0.5 * step - digit][0]
        raise CaptureError(f"{path}: time runs backwards in line {line}")
    jumps = steps > (1 + _SLACK) * step + digit
    missing = jumps & (np.diff(lines) == 1)
    if missing.any():
        notes.append(
            f"samples are missing in {np.count_nonzero(missing)} places (first before line "
            f"{lines[1:][missing][0]}); decoding what lies between them"
        )
    breaks = np.flatnonzero(jumps) + 1
    starts, ends = [0, *breaks], [*breaks, len(volts)]
    longest = max(range(len(starts)), key=lambda i: ends[i] - starts[i])
    first, last = starts[longest], ends[longest] - 1
    if time_s[last] <= time_s[first]:
        raise CaptureError(f"{path}: no two samples follow one another evenly in time")
    rate_hz = (last - first) / float(time_s[last] - time_s[first])
    pieces = tuple(
        (float(time_s[start]), volts[start:end].astype(np.float32))
        for start, end in zip(starts, ends, strict=True)
    )
    return ScopeCapture(pieces, rate_hz, tuple(notes))
