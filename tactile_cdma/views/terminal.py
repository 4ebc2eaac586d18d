# SPDX-License-Identifier: Apache-2.0

"""A skin drawn in characters: picture, colour scale, history, lists. Text from arrays, no I/O.

No line is longer than it may be, whatever the terminal's size; only the picture and the scale hold
escape sequences, and each of their lines ends with a reset.
"""

from __future__ import annotations

import math
import textwrap
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..readings.taxels import Status
from .heatmap import NO_TAXEL_RGB, colours

_RESET = "\x1b[0m"
_SHADES = " .:-=+*#%@"
"""Light to heavy, where there are no colours."""
_BARS = "▁▂▃▄▅▆▇█"
_LABEL = 7
"""Width of a taxel with its value and two marks, in characters."""
_STATUS_LINES = 3
_MARKS = (
    (Status.SATURATED, "!", "saturated"),
    (Status.LOW_SNR, "?", "low SNR"),
    (Status.WEAK, "w", "weak"),
    (Status.FAULTY, "x", "faulty"),
    (Status.STALE, "-", "stale"),
)


class Numbers(Enum):
    """What a taxel is called: its index in all arrays, or its node's number."""

    TAXELS = "taxels"
    NODES = "nodes"


@dataclass(frozen=True, slots=True)
class Look:
    """How it is drawn.

    max_pa: top of the scale, Pa. numbers: shown in the picture; None: none. coloured: else by
    shades. unicode: else only ASCII.
    """

    max_pa: float
    numbers: Numbers | None = None
    coloured: bool = True
    unicode: bool = True


@dataclass(frozen=True, eq=False, slots=True)
class Reading:
    """One frame of a skin of t taxels.

    pressure_pa: (t,) float32, Pa, NaN: no valid reading. status: (t,) uint8, bits of Status.
    raster: (h, w) int32, as Layout.raster. nodes: (t,) int32, 1-based, 0: none.
    """

    pressure_pa: NDArray[np.float32]
    status: NDArray[np.uint8]
    raster: NDArray[np.int32]
    nodes: NDArray[np.int32]

    @property
    def in_service(self) -> NDArray[np.bool_]:
        """(t,) taxels with a node that the layout does not mask."""
        return np.asarray(self.status & Status.MASKED == 0)


def screen(
    reading: Reading, look: Look, title: str, notes: Sequence[str], columns: int, lines: int
) -> list[str]:
    """Title, picture and notes in at most so many columns and lines.

    notes: the most important first; where there is little room the others are left out.
    """
    kept = [_cut(note, columns) for note in notes[: max(0, (lines - 1) // 2)]]
    drawn = picture(reading, look, max(1, columns), max(1, lines - len(kept) - 2))
    gap = [""] if len(drawn) + len(kept) + 2 <= lines else []
    return [_cut(title, columns), *drawn, *gap, *kept][: max(0, lines)]


def _cut(line: str, columns: int) -> str:
    """Cut to a width; what holds escape sequences was made to fit."""
    return line if "\x1b" in line else line[: max(0, columns)]


# ---- the picture --------------------------------------------------------------------------------


def picture(reading: Reading, look: Look, columns: int, lines: int) -> list[str]:
    """The unrolled skin in at most so many columns and lines, taxels with labels if they fit.

    Of a skin with more cells than there is room each character is the greatest around.
    """
    raster = pooled(reading, columns, lines)
    tall, wide = _cell_size(reading, raster, columns, lines)
    drawn = [_runs(row.repeat(wide)) for row in raster for _ in range(tall)]
    parts: dict[int, list[tuple[int, int, int]]] = defaultdict(list)
    for line, runs in enumerate(drawn):
        for taxel, begin, end in runs:
            parts[taxel].append((line, begin, end - begin))
    labels: dict[tuple[int, int], str] = {}
    for taxel, places in parts.items():
        if taxel >= 0:
            labels |= _labels(reading, look, taxel, places)
    brush = _Brush(reading, look)
    return [
        brush.line([(t, labels.get((line, begin), ""), end - begin) for t, begin, end in runs])
        for line, runs in enumerate(drawn)
    ]


def pooled(reading: Reading, columns: int, lines: int) -> NDArray[np.int32]:
    """(≤ lines, ≤ columns) the raster, or of each block of its cells the taxel pressed most."""
    height, width = reading.raster.shape
    down, right = -(-height // max(1, lines)), -(-width // max(1, columns))
    rows, cells = -(-height // down), -(-width // right)
    padding = ((0, rows * down - height), (0, cells * right - width))
    raster = np.pad(reading.raster, padding, constant_values=-1)
    blocks = raster.reshape(rows, down, cells, right).swapaxes(1, 2).reshape(rows, cells, -1)
    # A taxel without a reading covers less than any reading, and more than no taxel.
    rank = np.append(np.nan_to_num(reading.pressure_pa, nan=-1e30), -np.inf)
    most = rank[blocks].argmax(axis=2)[..., None]
    return np.asarray(np.take_along_axis(blocks, most, axis=2)[..., 0])


def _cell_size(
    reading: Reading, raster: NDArray[np.int32], columns: int, lines: int
) -> tuple[int, int]:
    """Lines and columns of a cell: as large as fits, twice as wide as tall, wide enough to read."""
    rows, cells = raster.shape
    covered = raster[raster >= 0]
    per_taxel = math.sqrt(len(covered) / max(1, len(np.unique(covered)))) or 1.0
    tall = max(1, min(lines // rows, columns // (2 * cells)))
    wide = max(1, min(columns // cells, max(2 * tall, math.ceil(_LABEL / per_taxel))))
    return tall, wide


def _runs(line: NDArray[np.int32]) -> list[tuple[int, int, int]]:
    """Taxel, begin and end of each stretch of a line."""
    edges = [0, *(np.flatnonzero(np.diff(line)) + 1).tolist(), len(line)]
    return [(int(line[begin]), begin, end) for begin, end in pairwise(edges)]


def _labels(
    reading: Reading, look: Look, taxel: int, places: list[tuple[int, int, int]]
) -> dict[tuple[int, int], str]:
    """What stands where in a taxel's stretches: its number in the first, its value amid them."""
    values = _value_labels(float(reading.pressure_pa[taxel]), int(reading.status[taxel]))
    wanted = [(places[len(places) // 2], values)]
    if look.numbers:
        number = str(reading.nodes[taxel] if look.numbers is Numbers.NODES else taxel)
        wanted = [(places[0], [number, ""])] + (wanted if len(places) > 1 else [])
    return {
        (line, begin): next(label for label in labels if len(label) <= width)
        for (line, begin, width), labels in wanted
    }


def _value_labels(pressure_pa: float, status: int) -> list[str]:
    """A taxel's value in kPa with its marks, long to short."""
    if status & Status.MASKED:
        return [""]
    marks = "".join(mark for flag, mark, _ in _MARKS if status & flag)
    if math.isnan(pressure_pa):
        return [marks.center(2, "-"), marks[:1] or "-", ""]
    return [f"{pressure_pa / 1e3:.1f}{marks}", f"{pressure_pa / 1e3:.0f}{marks}", marks[:1], ""]


class _Brush:
    """Paints stretches of a line in the colour, or the shade, of a taxel."""

    def __init__(self, reading: Reading, look: Look) -> None:
        self._coloured = look.coloured
        paint = np.vstack([colours(reading.pressure_pa, look.max_pa), [NO_TAXEL_RGB]])
        self._paint = paint.tolist()
        self._shade = [*_shades(reading.pressure_pa / look.max_pa), " "]

    def line(self, stretches: list[tuple[int, str, int]]) -> str:
        """Taxel (−1: none), label and width of each stretch; labels stand amid them."""
        if not self._coloured:
            return "".join(label.center(wide, self._shade[t]) for t, label, wide in stretches)
        painted = (_ink(*self._paint[t]) + label.center(wide) for t, label, wide in stretches)
        return "".join(painted) + _RESET


def _ink(red: int, green: int, blue: int) -> str:
    """The sequence for text on a colour."""
    ink = "30" if red * 0.3 + green * 0.6 + blue * 0.1 > 110 else "97"
    return f"\x1b[{ink};48;2;{red};{green};{blue}m"


def _shades(share: NDArray[np.floating]) -> list[str]:
    level = np.clip(np.nan_to_num(share) * len(_SHADES), 0, len(_SHADES) - 1).astype(int)
    return [_SHADES[i] for i in level]


# ---- lines about it -----------------------------------------------------------------------------


def scale(look: Look, columns: int) -> str:
    """The colours from 0 to the top, with numbers; nothing where it does not fit."""
    before, after = "0 ", f" {look.max_pa / 1e3:g} kPa"
    width = min(32, columns - len(before) - len(after))
    if width < 4:
        return ""
    share = (np.arange(width) + 0.5) / width
    if not look.coloured:
        return f"{before}{''.join(_shades(share))}{after}"
    paint = colours((share * look.max_pa).astype(np.float32), look.max_pa).tolist()
    return before + "".join(f"{_ink(*rgb)} " for rgb in paint) + _RESET + after


def sparkline(values: NDArray[np.floating], unicode: bool) -> str:
    """A character per value, from 0 to the greatest; a space where it is NaN."""
    bars = _BARS if unicode else _SHADES[1:]
    top = float(np.fmax.reduce(values, initial=0.0)) or 1.0
    level = np.clip(np.nan_to_num(values) / top * len(bars), 0, len(bars) - 1).astype(int)
    return "".join(
        " " if math.isnan(v) else bars[i] for v, i in zip(values.tolist(), level, strict=True)
    )


def status_lines(reading: Reading, look: Look, columns: int) -> list[str]:
    """What the statuses are, with the numbers of the taxels, or nodes, behind each."""
    numbers = reading.nodes if look.numbers is Numbers.NODES else np.arange(len(reading.nodes))
    in_service = reading.in_service
    silent = in_service & (reading.status & Status.SILENT > 0)
    items = [f"speaking {np.count_nonzero(in_service & ~silent)}"]
    for flag, mark, word in (*_MARKS, (Status.SILENT, "", "silent")):
        has = in_service & (reading.status & flag > 0)
        if has.any():
            items.append(f"{word}{mark and ' ' + mark}: {ranges(numbers[has])}")
    masked = ~in_service & (reading.nodes > 0)
    if masked.any():
        items.append(f"masked: {ranges(numbers[masked])}")
    text = f"{(look.numbers or Numbers.TAXELS).value}   " + "   ".join(items)
    return textwrap.wrap(
        text, max(8, columns), max_lines=_STATUS_LINES, placeholder=" …" if look.unicode else " .."
    )


def ranges(numbers: NDArray[np.integer]) -> str:
    """Whole numbers for people: 1-3, 7."""
    values = np.unique(numbers)
    breaks = np.flatnonzero(np.diff(values) > 1)
    first = values[np.concatenate([[0], breaks + 1])]
    last = values[np.concatenate([breaks, [len(values) - 1]])]
    return ", ".join(
        f"{a}" if a == b else f"{a}-{b}" for a, b in zip(first.tolist(), last.tolist(), strict=True)
    )
