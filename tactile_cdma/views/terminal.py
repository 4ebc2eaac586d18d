# SPDX-License-Identifier: Apache-2.0

"""A skin drawn in characters: picture, colour scale, history, lists. Text from arrays, no I/O.

No line exceeds the given width, whatever the terminal's size. Only the picture and the scale
contain escape sequences, and each of their lines ends with a reset.
"""

import math
import textwrap
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats32
from ..base.program import Drawn
from ..base.text import escaped
from ..readings.status import Status, is_certain, is_in_service
from .heatmap import GAMMA, NO_TAXEL_RGB, colours, shares

_RESET = "\x1b[0m"
_SHADES = " .:-=+*#%@"
"""Light to heavy, for terminals without colours."""
_NO_READING = "/"
"""Shade of a taxel without a reading, which none of the others is."""
_BARS = "▁▂▃▄▅▆▇█"
TOUCH_PA = 1e3
"""Pressure, Pa, above which a character that several taxels share shows it even if one of them has
no reading; below it the missing reading is shown. The default of contact_kpa."""
_LABEL = 7
"""Characters of a taxel's value with two marks, as 140.0?w."""
_STATUS_LINES = 3
"""Most lines for the lists of nodes by status; chosen: the picture needs the room."""
_MARKS = (
    (Status.SATURATED, "!", "saturated"),
    (Status.LOW_SNR, "?", "uncertain"),
    (Status.WEAK, "w", "weak"),
    (Status.FAULTY, "x", "faulty"),
    (Status.STALE, "-", "stale"),
)


class Numbers(Enum):
    """Says how taxels are numbered: by index in all arrays, or by node."""

    TAXELS = "taxels"
    NODES = "nodes"


@dataclass(frozen=True, slots=True)
class Look:
    """Drawing options.

    max_pa: top of the scale, Pa. numbers: shown in the picture; None: none.
    coloured: False: by shades. unicode: False: ASCII only.
    """

    max_pa: float
    numbers: Numbers | None = None
    coloured: bool = True
    unicode: bool = True


@dataclass(frozen=True, eq=False, slots=True)
class Reading:
    """One frame of a skin of t taxels.

    pressure_pa: (t,) float32, Pa, NaN: no valid reading. status: (t,) uint8, bits of Status.
    raster: (h, w) int32, as Layout.raster. nodes: (t,) int32, 1-based; 0: none.
    """

    pressure_pa: Floats32
    status: NDArray[np.uint8]
    raster: NDArray[np.int32]
    nodes: NDArray[np.int32]


def screen(
    reading: Reading, look: Look, title: str, notes: Sequence[str], columns: int, lines: int
) -> list[str]:
    """Lay out title, picture and notes within the given columns and lines.

    notes: the most important first; the last ones are dropped if there is little room.
    """
    kept = [_cut(note, columns) for note in notes[: max(0, (lines - 1) // 2)]]
    drawn = picture(reading, look, max(1, columns), max(1, lines - len(kept) - 2))
    gap = [""] if len(drawn) + len(kept) + 2 <= lines else []
    return [_cut(title, columns), *drawn, *gap, *kept][: max(0, lines)]


def _cut(line: str, columns: int) -> str:
    """Cut a line to a width; what is drawn fits already."""
    return line if isinstance(line, Drawn) else escaped(line)[: max(0, columns)]


# ---- the picture --------------------------------------------------------------------------------


def picture(reading: Reading, look: Look, columns: int, lines: int) -> list[Drawn]:
    """Draw the unrolled skin within the given columns and lines, with labels where they fit.

    If there are more cells than characters, each character shows the highest pressure around.
    """
    raster = pooled(reading, columns, lines)
    # Cells are large, twice as wide as high, with room for labels.
    rows, cells = raster.shape
    covered = raster[raster >= 0]
    per_taxel = math.sqrt(len(covered) / max(1, len(np.unique(covered)))) or 1.0
    tall = max(1, min(lines // rows, columns // (2 * cells)))
    wide = max(1, min(columns // cells, max(2 * tall, math.ceil(_LABEL / per_taxel))))
    drawn = [_runs(row.repeat(wide)) for row in raster for _ in range(tall)]
    parts: dict[int, list[tuple[int, int, int]]] = defaultdict(list)
    for line, runs in enumerate(drawn):
        for taxel, begin, end in runs:
            parts[taxel].append((line, begin, end - begin))
    labels: dict[tuple[int, int], str] = {}
    for taxel, places in parts.items():
        if taxel >= 0:
            labels |= _labels(reading, look, taxel, places)
    rgb = colours(reading.pressure_pa, look.max_pa, ~is_certain(reading.status))
    paint = [*rgb.tolist(), NO_TAXEL_RGB]
    up, unread = shares(reading.pressure_pa, look.max_pa), np.isnan(reading.pressure_pa).tolist()
    shades = [
        _NO_READING if is_unread else shade
        for shade, is_unread in zip(_shades(up), unread, strict=True)
    ]
    shades.append(" ")

    def stretch(taxel: int, label: str, width: int) -> str:
        if look.coloured:
            return _ink(*paint[taxel]) + label.center(width)
        return label.center(width, shades[taxel])

    return [
        Drawn(
            "".join(
                stretch(t, labels.get((line, begin), ""), end - begin) for t, begin, end in runs
            )
            + (_RESET if look.coloured else "")
        )
        for line, runs in enumerate(drawn)
    ]


def pooled(reading: Reading, columns: int, lines: int) -> NDArray[np.int32]:
    """Shrink the raster to (≤ lines, ≤ columns): of each block of cells the most pressed taxel.

    Unless a taxel of a block reads more than TOUCH_PA, one without a reading stands for the block.
    """
    height, width = reading.raster.shape
    down, right = -(-height // max(1, lines)), -(-width // max(1, columns))
    rows, cells = -(-height // down), -(-width // right)
    padding = ((0, rows * down - height), (0, cells * right - width))
    raster = np.pad(reading.raster, padding, constant_values=-1)
    blocks = raster.reshape(rows, down, cells, right).swapaxes(1, 2).reshape(rows, cells, -1)
    # A masked taxel ranks below any reading and above no taxel.
    unread_pa = np.where(is_in_service(reading.status), TOUCH_PA, -1e30)
    pressure_pa = np.where(np.isnan(reading.pressure_pa), unread_pa, reading.pressure_pa)
    rank = np.append(pressure_pa, -np.inf)
    most = rank[blocks].argmax(axis=2)[..., None]
    return np.asarray(np.take_along_axis(blocks, most, axis=2)[..., 0])


def _runs(line: NDArray[np.int32]) -> list[tuple[int, int, int]]:
    """Yield taxel, begin and end of each run of equal cells in a line."""
    edges = [0, *(np.flatnonzero(np.diff(line)) + 1).tolist(), len(line)]
    return [(int(line[begin]), begin, end) for begin, end in pairwise(edges)]


def _labels(
    reading: Reading, look: Look, taxel: int, places: list[tuple[int, int, int]]
) -> dict[tuple[int, int], str]:
    """Place labels by line and column: a taxel's number in its first run, its value in mid-run."""
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
    """Show a taxel's value in kPa with its marks, from long to short."""
    if status & Status.MASKED:
        return [""]
    marks = "".join(mark for flag, mark, _ in _MARKS if status & flag)
    if math.isnan(pressure_pa):
        return [marks.center(2, "-"), marks[:1] or "-", ""]
    return [f"{pressure_pa / 1e3:.1f}{marks}", f"{pressure_pa / 1e3:.0f}{marks}", marks[:1], ""]


def _ink(red: int, green: int, blue: int) -> str:
    ink = "30" if red * 0.3 + green * 0.6 + blue * 0.1 > 110 else "97"
    return f"\x1b[{ink};48;2;{red};{green};{blue}m"


def _shades(share: NDArray[np.floating], shades: str = _SHADES) -> list[str]:
    """Shade each share of the scale (0…1) by a character, light to heavy; the lightest for NaN."""
    level = np.clip(np.nan_to_num(share) * len(shades), 0, len(shades) - 1).astype(int)
    return [shades[i] for i in level]


# ---- lines around it ----------------------------------------------------------------------------


def scale(look: Look, columns: int) -> Drawn:
    """Draw the colour scale with numbers at its ends and its middle, and the skin's axes.

    Empty if it does not fit.
    """
    marks = [f"{share ** (1 / GAMMA) * look.max_pa / 1e3:.3g}" for share in (0.0, 0.5, 1.0)]
    marks[2] += " kPa   x→ y↑" if look.unicode else " kPa"
    half = min(16, (columns - len("".join(marks)) - 4) // 2)
    if half < 2:
        return Drawn()
    share = ((np.arange(2 * half) + 0.5) / (2 * half)).astype(np.float32)
    paint = colours(share ** np.float32(1 / GAMMA) * look.max_pa, look.max_pa).tolist()
    drawn = [f"{_ink(*rgb)} " for rgb in paint] if look.coloured else _shades(share)
    reset = _RESET if look.coloured else ""
    low, high = ("".join(part) + reset for part in (drawn[:half], drawn[half:]))
    return Drawn(f"{marks[0]} {low} {marks[1]} {high} {marks[2]}")


def sparkline(values: NDArray[np.floating], unicode: bool) -> str:
    """Draw each value as a character, scaled from 0 to the maximum; a space for NaN."""
    bars = _BARS if unicode else _SHADES[1:]
    top = float(np.fmax.reduce(values, initial=0.0)) or 1.0
    drawn = zip(values.tolist(), _shades(values / top, bars), strict=True)
    return "".join(" " if math.isnan(value) else bar for value, bar in drawn)


def status_lines(reading: Reading, look: Look, columns: int) -> list[str]:
    """List the statuses that occur, each with the numbers of its taxels or nodes."""
    numbers = reading.nodes if look.numbers is Numbers.NODES else np.arange(len(reading.nodes))
    in_service = is_in_service(reading.status)
    silent = in_service & (reading.status & Status.SILENT > 0)
    items = [f"speaking {np.count_nonzero(in_service & ~silent)}"]
    held = (Status.UNHEARD, "", "unheard"), (Status.SILENT, "", "silent")
    for flag, mark, word in (*_MARKS, *held):
        has = in_service & (reading.status & flag == flag)
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
    """Show whole numbers as ranges: 1-3, 7."""
    values = np.unique(numbers)
    runs = np.split(values, np.flatnonzero(np.diff(values) > 1) + 1)
    return ", ".join(f"{r[0]}" if len(r) == 1 else f"{r[0]}-{r[-1]}" for r in runs if len(r))
