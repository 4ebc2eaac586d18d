# SPDX-License-Identifier: Apache-2.0

"""CSV files of loads: columns whose headings carry their units, every row with its line."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base.errors import CalibrationError

MOST_BYTES = 256 << 20
MOST = 1e30
"""No number of a table is larger, in any unit."""
KINDS: dict[str, dict[str, float]] = {
    "node": {"": 1.0},
    "time": {"s": 1.0, "ms": 1e-3},
    "pressure": {"pa": 1.0, "hpa": 1e2, "kpa": 1e3, "mpa": 1e6, "mbar": 1e2, "bar": 1e5},
    "voltage": {"v": 1.0, "mv": 1e-3},
    "force": {"n": 1.0},
}
"""Quantities by the beginning of a column's heading, and the factors of their units."""
_HEADINGS = [
    f"{kind}_{unit}".rstrip("_") for kind, units in KINDS.items() for unit in units
]  # all there can be
_SHOWN = 40
_AROUND = '" \t'
"""What may stand around a cell: spreadsheets like quotes."""
_EMPTY = _AROUND + ",;"


@dataclass(frozen=True, eq=False)
class Table:
    """Columns by quantity in SI units, (m,) float64 each; line: (m,) int64, in the file.

    headings: of each quantity, as the file has it. factors: SI units that one of the file's is.
    """

    path: Path
    columns: dict[str, NDArray[np.float64]]
    headings: dict[str, str]
    factors: dict[str, float]
    line: NDArray[np.int64]

    def refusal(self, cause: str, row: int | None = None) -> CalibrationError:
        """The error to raise for this file, or one row of it."""
        where = "" if row is None else f"line {self.line[row]}: "
        return CalibrationError(f"{self.path}: {where}{cause}")


def read_table(path: Path, area_m2: float | None = None) -> Table:
    """Read a CSV of loads: a heading, then numbers; lines that begin with # are left out.

    Separators are commas, semicolons or tabs; decimal commas are understood where columns are not
    separated by commas. Quotes around cells and rows without any number count for nothing.
    area_m2: that a force was spread over, which makes it a pressure.
    Raises CalibrationError, naming file, line and column.
    """
    lines = _text(path).splitlines()
    used = [
        (number, line)
        for number, line in enumerate(lines, 1)
        if line.strip(_EMPTY) and not line.lstrip(_EMPTY).startswith("#")
    ]
    if not used:
        raise CalibrationError(f"{path}: the file is empty")
    first, heading = used.pop(0)
    separator = max(",;\t", key=heading.count)
    headings = _headings(path, first, _cells(heading, separator))
    rows = [_numbers(path, number, line, separator, headings) for number, line in used]
    if not rows:
        raise CalibrationError(f"{path}: there is a heading, but no numbers below it")
    values = np.array(rows).T
    factors = {kind: KINDS[kind][_unit(name)] for kind, name in headings.items()}
    columns = {kind: column * factors[kind] for kind, column in zip(headings, values, strict=True)}
    table = Table(path, columns, headings, factors, np.array([number for number, _ in used]))
    return _with_pressure(table, area_m2)


def _text(path: Path) -> str:
    """All of a file; size and kind are not asked for first, for a pipe has none to tell."""
    try:
        with path.open("rb") as file:
            raw = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise CalibrationError(f"{path}: {error.strerror}") from None
    if len(raw) > MOST_BYTES:
        raise CalibrationError(f"{path}: more than {MOST_BYTES >> 20} MB; is this a table?")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise CalibrationError(f"{path}: not a text file in UTF-8") from None


def _cells(line: str, separator: str) -> list[str]:
    return [cell.strip(_AROUND) for cell in line.split(separator)]


def _headings(path: Path, line: int, cells: list[str]) -> dict[str, str]:
    """Headings by quantity, in their order."""
    found: dict[str, str] = {}
    for cell in cells:
        name = cell.lower()
        kind = name.split("_")[0]
        if kind not in KINDS or _unit(name) not in KINDS[kind]:
            raise CalibrationError(f"{path}: line {line}: {_unknown(cell, name, kind)}")
        if kind in found:
            raise CalibrationError(f"{path}: line {line}: there are two columns of {kind}")
        found[kind] = name
    return found


def _unknown(cell: str, name: str, kind: str) -> str:
    cell, name = cell[:_SHOWN], name[:_SHOWN]
    try:
        float(cell.replace(",", "."))
        return (
            f"{cell} where a heading should be; name quantities and units in the first line, "
            "as in node,pressure_kpa,voltage_v"
        )
    except ValueError:
        pass
    if kind in KINDS:
        units = ", ".join(f"{kind}_{unit}".rstrip("_") for unit in KINDS[kind])
        return f"column {cell!r} has no unit that is known; use {units}"
    close = difflib.get_close_matches(name, _HEADINGS, n=1, cutoff=0.8)
    hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(_HEADINGS)}"
    return f"unknown column {cell!r}; {hint}"


def _unit(heading: str) -> str:
    return heading.partition("_")[2]


def _numbers(
    path: Path, number: int, line: str, separator: str, headings: dict[str, str]
) -> list[float]:
    cells = _cells(line, separator)
    if len(cells) != len(headings):
        raise CalibrationError(
            f"{path}: line {number} has {len(cells)} columns, the heading has {len(headings)}"
        )
    values = []
    for cell, heading in zip(cells, headings.values(), strict=True):
        try:
            value = float(cell if separator == "," else cell.replace(",", "."))
        except ValueError:
            value = np.nan
        if not abs(value) < MOST:  # NaN is not, either
            raise CalibrationError(
                f"{path}: line {number}: {cell[:_SHOWN]!r} is no number for {heading}"
            )
        values.append(value)
    return values


def _with_pressure(table: Table, area_m2: float | None) -> Table:
    """Force over area is pressure."""
    if "force" not in table.columns:
        return table
    if "pressure" in table.columns:
        raise table.refusal("there are both force and pressure; which of the two is meant?")
    if area_m2 is None:
        raise table.refusal("forces become pressures by the area they act on: give --area-mm2")
    return Table(
        table.path,
        table.columns | {"pressure": table.columns["force"] / area_m2},
        table.headings | {"pressure": table.headings["force"]},
        table.factors | {"pressure": 1 / area_m2},
        table.line,
    )
