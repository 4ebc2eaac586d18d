# SPDX-License-Identifier: Apache-2.0

"""text://: lines of numbers, as most boards print them; docs/programs.md."""

import re

import numpy as np

from ..base.arrays import Floats
from ..base.errors import SpecError
from ..base.text import plain, suggestion
from ..config.parameters import Parameter
from .serial_source import SerialSource
from .taxel_source import TaxelFrame

LONGEST_LINE = 1 << 17
"""Bytes; chosen: 8,192 numbers of 16 characters."""
CHECK_FACTOR = 31
"""Factor of the check: check · 31 + number. Odd, so that no change of one number is lost in it."""
WRAPS_S = 60.0
"""s; a 32-bit time that seems to go back has passed its end if it went on by less. Chosen: a board
that was reset began below, and lines that stop for longer are another beginning."""
PER_SECOND = {"us": 10**6, "ms": 10**3, "s": 1}
"""Columns of time, and their units in a second."""
BEFORE, AFTER = ("index", *PER_SECOND, "skip"), ("check", "skip")
OPTIONS = (
    Parameter("before", "", "columns before the taxels: index, us, ms, s, skip"),
    Parameter("after", "", "columns after them: check, skip"),
    Parameter("volts", 0.0, "the numbers are volts, of this full scale; 0: codes", "V", (0.0, 1e3)),
)
_NUMBER = rb"(?:[A-Za-z_]\w*[:=])?(?:[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|nan|NaN|NAN)"
_LINE = re.compile(rb"\s*%s(?:[\s,;|]+%s)*[\s,;|]*" % (_NUMBER, _NUMBER))
_TOKEN = re.compile(rb"(?:[A-Za-z_]\w*[:=])?([^\s,;|]+)")
_ENDS = re.compile(rb"[\r\n]+")


class TextLines(SerialSource):
    """Makes a frame of every line that is whole; others are left out, and `problem` says why.

    bits: None, the parameter says. problem: of the last line; None where that was a frame.
    """

    BAUD = 115_200
    bits: int | None = None

    def __init__(self, url: str) -> None:
        super().__init__(url, OPTIONS)
        self._before = _columns("before", self.options["before"], BEFORE)
        self._after = _columns("after", self.options["after"], AFTER)
        self.full_scale_v = self.options["volts"] or None
        if self.full_scale_v and "check" in self._after:
            raise SpecError("option after has a check, which takes whole numbers: leave out volts")
        self._rest = b""
        self._is_begun = False  # what comes before the first end of a line is the rest of one
        self._made, self._time_s, self._ticks = -1, 0.0, -1

    def feed(self, data: bytes, t_host: float, nodes: int | None) -> list[TaxelFrame]:
        *lines, rest = _ENDS.split(self._rest + data)
        # A line's end may be cut between two characters, which makes an empty line.
        self._rest = rest if len(rest) <= LONGEST_LINE else b""
        if len(rest) > LONGEST_LINE:
            self._is_begun = False
            self.problem = f"no line ends within {LONGEST_LINE} bytes: is baud right?"
        if lines and not self._is_begun:
            self._is_begun = True
            del lines[0]
        frames = [self._frame(line, t_host, nodes) for line in lines if line.strip()]
        return [frame for frame in frames if frame is not None]

    def _frame(self, line: bytes, t_host: float, nodes: int | None) -> TaxelFrame | None:
        """Return the frame of a line; None, with the reason noted, where it is none."""
        if not _LINE.fullmatch(line):
            shown = plain(line[:60].decode("ascii", "replace"))
            self.problem = f"text comes in place of numbers: {shown!r}; is baud right?"
            return None
        self._made += 1  # a line that is damaged is a frame that is lost
        tokens = _TOKEN.findall(line)
        first, beyond = len(self._before), len(tokens) - len(self._after)
        taxels = beyond - first
        if taxels < 1 or (nodes is not None and taxels != nodes):
            self.problem = self._miscounted(len(tokens), nodes)
            return None
        numbers = np.array(list(map(float, tokens)))
        if np.isnan(numbers[:first]).any() or np.isnan(numbers[beyond:]).any():
            self.problem = "a column beside the taxels has no number"
            return None
        if "check" in self._after and (wrong := self._check(numbers)):
            self.problem = wrong
            return None
        self.problem = None
        before = dict(zip(self._before, numbers[:first].tolist(), strict=True))
        number = int(before.get("index", self._made))
        return TaxelFrame(numbers[first:beyond], t_host, self._time(before), number)

    def _miscounted(self, count: int, nodes: int | None) -> str:
        """Tell that a line has another count of numbers, and what they may be."""
        aside = len(self._before) + len(self._after)
        wanted = f"nodes is {nodes}" + (f", and {aside} columns are none" if aside else "")
        hint = ""
        if not aside and nodes is not None and count > nodes:
            hint = "; is one an index, a time (before=index, us, ms, s) or a check (after=check)?"
        return f"lines of {count} numbers come, but {wanted}{hint}"

    def _check(self, numbers: Floats) -> str | None:
        """Tell what is wrong with a line by its check; None: nothing."""
        place = len(numbers) - len(self._after) + self._after.index("check")
        before = numbers[:place]
        if not (np.isfinite(before).all() and (before == np.floor(before)).all()):
            return "numbers that are not whole come, of which there is no check"
        # The highest power first, modulo 2³² as the sum.
        powers = np.uint32(CHECK_FACTOR) ** np.arange(place - 1, -1, -1, dtype=np.uint32)
        check = int((before.astype(np.int64).astype(np.uint32) * powers).sum(dtype=np.uint32))
        if check == numbers[place]:
            return None
        return f"the check of a line is {numbers[place]:.0f}, but its numbers have {check}"

    def _time(self, before: dict[str, float]) -> float | None:
        """Return the sensor's time, s, which goes on where 32 bits of it end."""
        unit = next((name for name in before if name in PER_SECOND), None)
        if unit is None or unit == "s":
            return before.get("s")
        per_second, ticks = PER_SECOND[unit], int(before[unit])
        passed = (ticks - self._ticks) % (1 << 32)
        goes_on = self._ticks >= 0 and passed < WRAPS_S * per_second
        self._time_s = self._time_s + passed / per_second if goes_on else ticks / per_second
        self._ticks = ticks
        return self._time_s


def _columns(name: str, text: str, known: tuple[str, ...]) -> list[str]:
    """Read names of columns; raises SpecError for an unknown one, or two of a kind."""
    columns = text.split(",") if text else []
    for column in columns:
        if column not in known:
            hint = suggestion(column, known, f"columns: {', '.join(known)}")
            raise SpecError(f"option {name} has no column {column!r}{hint}")
        if column != "skip" and columns.count(column) > 1:
            raise SpecError(f"option {name} has the column {column} twice")
    if len({*columns} & {*PER_SECOND}) > 1:
        raise SpecError(f"option {name} has two columns of time: {text}")
    return columns
