"""Files to decode offline: oscilloscope captures as CSV, raw captures of the serial bytes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .errors import CaptureError

_HEADER_LINES = 64
_INVALID_V = 1e30
"""Keysight writes 9.9E+37 for a sample that it does not have."""
_SLACK = 0.75
"""Largest deviation of a time stamp from an even raster, in samples: more means missing samples."""


@dataclass(frozen=True, slots=True)
class ScopeCapture:
    """Unbroken pieces of one evenly sampled recording.

    pieces: (start time in s, (m,) float32 V) each, in the order of the file.
    rate_hz: sampling rate. notes: what was wrong with the file, one sentence each.
    """

    pieces: tuple[tuple[float, NDArray[np.float32]], ...]
    rate_hz: float
    notes: tuple[str, ...]


def is_text(path: Path) -> bool:
    """Whether a capture is a CSV file rather than raw packets (which end with a zero byte each).

    Raises CaptureError where it cannot be read or is empty.
    """
    try:
        with path.open("rb") as file:
            head = file.read(65_536)
    except OSError as error:
        raise CaptureError(f"{path}: {error.strerror}") from None
    if not head:
        raise CaptureError(f"{path}: the file is empty")
    return b"\0" not in head


def read_scope_csv(path: Path) -> ScopeCapture:
    """Read time in s and voltage in V from the first two columns, after any header lines.

    Missing samples and non-numbers split the recording into pieces and are noted.
    Raises CaptureError, naming the line, where this is not such a file.
    """
    header, delimiter = _header(path)
    try:
        table = np.loadtxt(
            path,
            delimiter=delimiter,
            skiprows=header,
            usecols=(0, 1),
            ndmin=2,
            encoding="utf-8-sig",
            comments=None,
        )
    except (ValueError, UnicodeDecodeError) as error:
        raise CaptureError(
            f"{path}: not two columns of numbers after {header} header lines: {error}"
        ) from None
    if len(table) < 16:
        raise CaptureError(f"{path}: only {len(table)} samples; is the file cut short?")
    return _pieces(path, table[:, 0], table[:, 1], header)


def _header(path: Path) -> tuple[int, str | None]:
    """Number of lines before the first two numbers, and the delimiter (None: white space)."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            lines = [line.strip() for line in islice(file, _HEADER_LINES)]
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureError(f"{path}: {error}") from None
    for number, line in enumerate(lines):
        for delimiter in (",", ";", "\t", None):
            fields = line.split(delimiter)
            if len(fields) >= 2 and all(_is_number(field) for field in fields[:2]):
                return number, delimiter
    raise CaptureError(
        f"{path}: no line with two numbers (time in s, voltage in V) among the first "
        f"{len(lines)} lines"
    )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _pieces(
    path: Path, time_s: NDArray[np.float64], volts: NDArray[np.float64], header: int
) -> ScopeCapture:
    notes = []
    good = np.isfinite(time_s) & np.isfinite(volts) & (np.abs(volts) < _INVALID_V)
    lines = np.arange(header + 1, header + 1 + len(good))
    if not good.all():
        notes.append(
            f"{np.count_nonzero(~good)} samples are no numbers (first in line {lines[~good][0]}); "
            "decoding what lies between them"
        )
        time_s, volts, lines = time_s[good], volts[good], lines[good]
    steps = np.diff(time_s)
    if len(steps) < 16 or not (step := float(np.median(steps))) > 0:
        raise CaptureError(f"{path}: the first column is no rising time in s")
    if (steps < -step / 2).any():
        line = lines[1:][steps < -step / 2][0]
        raise CaptureError(f"{path}: time runs backwards in line {line}")
    # Scopes print time with few digits: single steps wobble by the last digit, gaps stay.
    breaks = np.flatnonzero(steps > (1 + _SLACK) * step) + 1
    starts, ends = [0, *breaks], [*breaks, len(volts)]
    longest = max(range(len(starts)), key=lambda i: ends[i] - starts[i])
    first, last = starts[longest], ends[longest] - 1
    if last == first:
        raise CaptureError(f"{path}: no two samples follow one another evenly in time")
    rate_hz = (last - first) / float(time_s[last] - time_s[first])
    if len(breaks):
        notes.append(
            f"samples are missing in {len(breaks)} places (first before line {lines[breaks[0]]}); "
            "decoding what lies between them"
        )
    pieces = tuple(
        (float(time_s[start]), volts[start:end].astype(np.float32))
        for start, end in zip(starts, ends, strict=True)
    )
    return ScopeCapture(pieces, rate_hz, tuple(notes))
