# SPDX-License-Identifier: Apache-2.0

"""What oscilloscopes write as CSV: which columns are times and volts, and their samples.

The numbers are found first, as what most lines have in common. The line above them names the
columns, and the lines before tell the sampling interval where no column does.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice, pairwise, product
from pathlib import Path

import numpy as np

from ..base.arrays import Floats, Floats32
from ..base.errors import CaptureError
from ..base.named_file import naming, read_named
from ..base.text import lines_of

MOST_CSV_BYTES = 256 << 20
"""Largest file, bytes: about ten million samples. Chosen: it is held in memory whole."""
MOST_SAMPLES = 1 << 24
"""Most lines of numbers. Chosen: their arrays fit into 1 GB beside the file's text."""

_HEADER_LINES = 64
"""Most lines before the first numbers, and after the last. Chosen: scopes write up to 20 or so."""
_LINE_CHARACTERS = 4096
"""Characters of a line that may name something; chosen."""
_LEAST_SAMPLES = 16
"""Fewest samples of a capture that is worth decoding; chosen."""
_INVALID_V = 1e30
"""V; Keysight scopes write 9.9E+37 for a missing sample."""
_SLACK = 0.75
"""Largest deviation of a time stamp from an even raster, in samples: more means missing samples."""
_RATES_AGREE = 0.02
"""Largest relative difference of a file's two accounts of its rate. Chosen: more than comes of
rounded times, less than the 4 % by which sigrok's times in whole µs are off at 160 kS/s."""

_NUMBER = r"[-+]?(?:\d{1,40}\.?\d{0,40}|\.\d{1,40})(?:[eE][-+]?\d{1,4})?"
_is_number = re.compile(rf"{_NUMBER}|[-+]?(?i:inf(?:inity)?|nan)", re.ASCII).fullmatch
_quantity = re.compile(rf"({_NUMBER}) ?([pnumkKMG]?)(?:[sS]|[hH]z|Sa?/s)?", re.ASCII).fullmatch
"""A number, perhaps with a prefix and a unit; micro is u."""
_PREFIXES = {"p": 1e-12, "n": 1e-9, "u": 1e-6, "m": 1e-3, "": 1.0}
_PREFIXES |= {"k": 1e3, "K": 1e3, "M": 1e6, "G": 1e9}
_unit = re.compile("([pnum]?)(?:ico|ano|illi)?(s|secs?|seconds?|v|volts?)").fullmatch
"""A word of a heading: prefix and unit."""
_COUNTS = {"sequence", "index", "sample", "samples", "point", "points", "n", "nr", "no", "#"}
"""Words of a heading above sample numbers."""
_INTERVALS = r"\b[tx]?inc(rement)?\b|interval|sampl\w* period|(signal|h)resolution|delta"
_RATES = r"sampl\w* ?(rate|frequency)"
_STARTS = (r"\bt0\b|\bx(org|start)\b", "^start$")
"""What scopes call the time between samples, their rate, and the time of the first one."""


@dataclass(frozen=True, slots=True)
class ScopeCapture:
    """Unbroken pieces of one evenly sampled recording.

    pieces: (start time, s; (m,) float32, V) each, in the order of the file.
    rate_hz: of samples. taken: channel, rate and unit, for people. notes: a sentence per fault.
    """

    pieces: tuple[tuple[float, Floats32], ...]
    rate_hz: float
    taken: str
    notes: tuple[str, ...]


def read_scope_csv(
    path: Path, channel: str | None = None, rate_hz: float | None = None
) -> ScopeCapture:
    """Read one channel of a scope's file.

    channel: its heading, words of it, or its number from 1; None: the first. rate_hz: samples/s,
    instead of what the file says. Missing samples and non-numbers split the recording into pieces
    and are noted. Decimal commas are understood where columns are not separated by commas.
    Raises CaptureError, naming the line, where this is not such a file; and where it does not say
    how far its samples are apart, or says it twice and differently.
    """
    table = _Table(path)
    axis, unit_s = table.axis()
    channels = [c for c in table.columns if axis is None or (c > axis and not table.is_time(c))]
    if not channels:
        raise CaptureError(f"{path}: no column of voltages beside the times")
    names = [table.name(column) for column in channels]
    chosen = 0 if channel is None else _chosen(path, channel, names)
    told_s = rate_hz is None and table.told(_INTERVALS)
    told_hz = rate_hz or (1 / told_s if told_s else table.told(_RATES))
    if unit_s is None and not told_hz:
        raise CaptureError(
            f"{path}: no column of rising times in s, and no rate in the header: give --rate"
        )
    values = table.values([channels[chosen]] if axis is None else [axis, channels[chosen]])
    time_s = np.arange(len(values), dtype=float) if axis is None else values[:, 0]
    if unit_s:
        time_s = time_s * unit_s
    elif told_hz:
        time_s = (table.told(*_STARTS) or 0.0) + time_s / told_hz
    volt = table.units(channels[chosen]).get("v")
    with np.errstate(over="ignore"):
        volts = (values[:, -1] * (volt or 1.0)).astype(np.float32)
    del values
    pieces, found_hz, notes = _pieces(path, time_s, volts, table.first)
    if told_hz and not rate_hz and abs(found_hz / told_hz - 1) > _RATES_AGREE:
        raise CaptureError(
            f"{path}: {_si(found_hz)}S/s by its times, {_si(told_hz)}S/s by its header: give the "
            "true rate with --rate"
        )
    if rate_hz:
        first_s, stretch = pieces[0][0], found_hz / rate_hz
        pieces = [(first_s + (start_s - first_s) * stretch, volts) for start_s, volts in pieces]
        found_hz = rate_hz
    name = names[chosen] and f" ({names[chosen]})"
    unit = f"{_si(volt).removeprefix('1 ')}V" if volt else "V, as no unit is named"
    taken = f"channel {chosen + 1} of {len(channels)}{name}, {_si(found_hz)}S/s, {unit}"
    return ScopeCapture(tuple(pieces), found_hz, taken, tuple(notes))


class _Table:
    """The lines of a file, and where its numbers are.

    columns: those that hold numbers. first: number of lines before them.
    """

    def __init__(self, path: Path) -> None:
        """Raises CaptureError where there are no numbers."""
        self._path, self._text, self._point = path, _text(path), ","
        count = sum(1 for _ in lines_of(self._text))
        self._stride = 1 + count // 96
        some = [*self._lines(count // 3, None, self._stride)]  # few, of any file
        delimiters = (",", ";", "\t", None)  # None: white space
        self._delimiter = max(delimiters, key=lambda mark: _fit(some, mark))
        self._point = "," if self._delimiter == "," else "."
        some = [line.replace(",", self._point) for line in some]
        self._sample = [self._fields(line) for line in some if line.strip()]
        self.columns = [
            column
            for column in range(max(map(len, self._sample), default=0))
            if 2 * sum(_numeric(row, [column]) for row in self._sample) > len(self._sample)
        ]
        self._head = [*self._lines(0, _HEADER_LINES)]
        good = [*map(self._is_good, self._head)]
        if not self.columns or True not in good:
            raise CaptureError(
                f"{path}: no lines of numbers (time in s, voltage in V) after at most "
                f"{_HEADER_LINES} others"
            )
        self.first = good.index(True)
        above = map(self._fields, self._head[: self.first])
        self._above = [fields for fields in above if any(fields)]  # spreadsheets pad empty lines
        tail = [*self._lines(max(0, count - _HEADER_LINES), None)]
        last = [self._is_good(line) for line in reversed(tail)]
        self._end = count - (last.index(True) if True in last else 0)
        if self._end - self.first > MOST_SAMPLES:
            raise CaptureError(f"{path}: has more than {MOST_SAMPLES} samples; export fewer")

    def _lines(self, begin: int, end: int | None, step: int = 1) -> Iterator[str]:
        lines = islice(lines_of(self._text), begin, end, step)
        return (line.replace(",", self._point) for line in lines)

    def _fields(self, line: str) -> list[str]:
        return _fields(line, self._delimiter)

    def _is_good(self, line: str) -> bool:
        return _numeric(self._fields(line), self.columns)

    def heading(self, column: int, line: int = -1) -> str:
        """Return what is above a column, in the last line before the numbers or the one before."""
        fields = self._above[line] if len(self._above) >= -line else []
        by_words = self._delimiter is None and len(fields) != len(self._sample[0])
        heading = "" if by_words or len(fields) <= column else fields[column]
        return "" if re.search("[:=]", heading) else heading

    def units(self, column: int) -> dict[str, float]:
        """Return units in a column's heading: of s and v, as far as they are named, in s and V."""
        found = map(_unit, _words(self.heading(column)))
        return {match[2][0]: _PREFIXES[match[1]] for match in found if match}

    def name(self, column: int) -> str:
        """Return a column's heading, with that of the line above where it is nothing but a unit."""
        heading = self.heading(column)
        if all(map(_unit, _words(heading))):
            heading = f"{self.heading(column, -2)} {heading}"
        return heading.strip()

    def is_time(self, column: int) -> bool:
        return "s" in self.units(column) or "time" in _words(self.heading(column))

    def axis(self) -> tuple[int | None, float | None]:
        """Return the column of times and its unit in s; None for a unit if it holds sample numbers.

        The first one whose heading says so, else the first of all if it rises.
        """
        named = [column for column in self.columns if self.is_time(column)]
        axis = named[0] if named else self.columns[0]
        unit_s = self.units(axis).get("s")
        with np.errstate(invalid="ignore"):
            ticks = [float(row[axis]) for row in self._sample if _numeric(row, [axis])]
            steps = np.diff(ticks)
        rises = np.any(steps > 0) and np.mean(steps >= 0) > 0.9
        if not named and (not rises or "v" in self.units(axis) or len(self.columns) == 1):
            return None, None
        counts = (steps == self._stride).all() or _COUNTS & set(_words(self.heading(axis)))
        return axis, None if unit_s is None and counts else unit_s or 1.0

    def told(self, *names: str) -> float | None:
        """Find the number beside or beneath the first of such names in the header, in s or Hz."""
        lines = _beside(self._path) + self._head
        split = (re.split("[,;\t:=]", line[:_LINE_CHARACTERS]) for line in lines)
        rows = [[cell.strip("# ") for cell in cells] for cells in split]
        for name, (cells, beneath) in product(names, pairwise([*rows, []])):
            for i, cell in enumerate(cells):
                if re.search(name, cell, re.IGNORECASE):
                    for match in map(_quantity, (*cells[i + 1 :], *beneath[i : i + 1])):
                        if match:
                            return float(match[1]) * _PREFIXES[match[2]]
        return None

    def values(self, columns: list[int]) -> Floats:
        """Read all numbers of some columns, (m, c) float64."""
        body, mark = self._lines(self.first, self._end), self._delimiter
        try:
            values = np.loadtxt(body, delimiter=mark, usecols=columns, ndmin=2, comments=None)
        except ValueError:
            rows = enumerate(self._lines(self.first, self._end), self.first + 1)
            number, bad = next(
                (number, line)
                for number, line in rows
                if line.strip() and not _numeric(self._fields(line), columns)
            )
            raise CaptureError(
                f"{self._path}: line {number} has no numbers in its columns "
                f"{', '.join(str(column + 1) for column in columns)}: {bad[:60]!r}"
            ) from None
        if len(values) < _LEAST_SAMPLES:
            raise CaptureError(f"{self._path}: only {len(values)} samples; is the file cut short?")
        return values


def _chosen(path: Path, channel: str, names: list[str]) -> int:
    """Find a channel by words of its name, or its number from 1: its index."""
    words = re.compile(rf"(?<![^\W_]){re.escape(channel)}(?![^\W_])", re.IGNORECASE)
    named = [i for i, name in enumerate(names) if words.search(name)]
    if len(named) == 1:
        return named[0]
    if channel.isdecimal() and 1 <= int(channel) <= len(names):
        return int(channel) - 1
    listed = ", ".join(filter(None, names))
    raise CaptureError(f"{path}: no single channel {channel!r} among {len(names)} ({listed})")


def _text(path: Path) -> str:
    """Read a file's text in numpy's letters, without the zeros that some scopes append."""
    with naming(path, CaptureError):
        data = read_named(path, MOST_CSV_BYTES)
    try:
        wide = data[:2] in (b"\xff\xfe", b"\xfe\xff")
        text = data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    for there, here in (("\0", ""), ('"', ""), ("\u221e", "inf"), ("\u00b5", "u"), ("\u03bc", "u")):
        text = text.replace(there, here)
    return text


def _beside(path: Path) -> list[str]:
    """Return the lines of NAME.csv, in which R&S scopes tell what NAME.Wfm.csv holds."""
    beside = path.with_name(re.sub(r"(?i)\.wfm\.csv$", ".csv", path.name))
    if beside == path or not beside.is_file():
        return []
    return [*islice(lines_of(_text(beside)), _HEADER_LINES)]


def _fields(line: str, delimiter: str | None) -> list[str]:
    return [field.strip() for field in line[:_LINE_CHARACTERS].split(delimiter)]


def _words(heading: str) -> list[str]:
    return re.findall(r"[^\W\d_]+|#", heading.casefold().replace("micro", "u"))


def _numeric(fields: list[str], columns: list[int]) -> bool:
    return len(fields) > max(columns, default=len(fields)) and all(
        _is_number(fields[column]) for column in columns
    )


def _fit(lines: list[str], delimiter: str | None) -> tuple[float, int]:
    """Tell how well a delimiter suits: share of numbers in what it separates, and their count."""
    if delimiter != ",":
        lines = [line.replace(",", ".") for line in lines]
    found = [field for line in lines for field in _fields(line, delimiter) if field]
    numbers = sum(map(bool, map(_is_number, found)))
    return numbers / max(1, len(found)), numbers


def _si(value: float) -> str:
    """Return a number with a prefix for its unit, which follows."""
    prefix = next((p for p in ("G", "M", "k", "") if value > 0.9999 * _PREFIXES[p]), "m")
    return f"{value / _PREFIXES[prefix]:.4g} {prefix}"


def _pieces(
    path: Path, time_s: Floats, volts: Floats32, header: int
) -> tuple[list[tuple[float, Floats32]], float, list[str]]:
    """Return pieces, rate_hz and notes of a ScopeCapture. header: lines before the first sample."""
    notes = []
    good = np.isfinite(time_s) & (np.abs(volts) < _INVALID_V)
    lines = np.arange(header + 1, header + 1 + good.size, dtype=np.int32)[good]
    if not good.all():
        count, first = np.count_nonzero(~good), header + 1 + int(np.argmin(good))
        notes.append(
            f"{count} of {good.size} samples are no numbers (first in line {first}); decoding "
            "what lies between them"
        )
        time_s, volts = time_s[good], volts[good]
    steps = np.diff(time_s)
    if len(steps) < _LEAST_SAMPLES or time_s[-1] <= time_s[0]:
        raise CaptureError(f"{path}: the times do not rise")
    # Scopes print time with few digits: steps wobble by the last digit, or are 0 in between.
    median = float(np.median(steps))
    step = median or float(steps.mean())
    digit = 0.0 if median else float(steps[steps > 0].min())
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
    pieces = [
        (float(time_s[start]), volts[start:end]) for start, end in zip(starts, ends, strict=True)
    ]
    return pieces, rate_hz, notes
