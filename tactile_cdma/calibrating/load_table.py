# SPDX-License-Identifier: Apache-2.0

"""Reads CSV files of loads: headings carry the units, errors name file and line."""

import re
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats
from ..base.errors import CalibrationError
from ..base.table_rows import table_rows, words
from ..base.text import suggestion

MOST_BYTES = 1 << 24
"""Size of a table, bytes; chosen: ten minutes of a reference at 1 kHz take 12 MB."""
MOST = 1e30
"""Bound of all numbers; chosen: no unit's factor makes an infinity of it."""
GRAM_N = 9.80665e-3
"""Weight of a gram, N, by which gauges show forces."""
UNITS: dict[str, dict[str, float]] = {
    "node": {"": 1.0},
    "time": {"s": 1.0, "ms": 1e-3},
    "pressure": {
        **{"pa": 1.0, "hpa": 1e2, "kpa": 1e3, "mpa": 1e6, "mbar": 1e2, "bar": 1e5},
        "psi": 6894.757,
    },
    "voltage": {"v": 1.0, "mv": 1e-3},
    "force": {"n": 1.0, "g": GRAM_N, "kg": 1e3 * GRAM_N, "gf": GRAM_N, "kgf": 1e3 * GRAM_N},
}
"""Units of every quantity, each with the number of SI units in one of them."""
KIND_OF = {unit: kind for kind, units in UNITS.items() for unit in units if unit}
_MEANT = {
    **dict.fromkeys(("node", "sensor", "taxel", "cell"), ("node",)),
    **dict.fromkeys(("time", "timestamp", "t"), ("time",)),
    **dict.fromkeys(("voltage", "volts", "volt", "vout", "output"), ("voltage",)),
    **dict.fromkeys(("force", "weight", "mass"), ("force",)),
    "pressure": ("pressure",),
    "load": ("force", "pressure"),
}
"""Quantities that a heading without a unit may mean, by its words."""
_SHOWN = 40
"""Characters of a cell that messages quote."""


@dataclass(frozen=True, eq=False)
class LoadFile:
    """What was read from a file. line: (m,) int64, of its m rows."""

    path: Path
    line: NDArray[np.int64]

    def refusal(self, cause: str, row: int | None = None) -> CalibrationError:
        """Return the error to raise for this file, or for one row of it."""
        where = "" if row is None else f"line {self.line[row]}: "
        return CalibrationError(f"{self.path}: {where}{cause}")


@dataclass(frozen=True, eq=False)
class Table(LoadFile):
    """Columns by quantity in SI units, (m,) float64 each.

    headings: as the file has them. units: in small letters. factors: a unit of the file in SI's.
    """

    columns: dict[str, Floats]
    headings: dict[str, str]
    units: dict[str, str]
    factors: dict[str, float]

    def require(self, hint: str, *headings: str) -> None:
        """Raise CalibrationError unless all quantities are there. headings: an example of each."""
        for heading in headings:
            if heading.split("_")[0] not in self.columns:
                raise self.refusal(f"there is no column {heading}{hint}")


def read_table(path: Path, area_m2: float | None = None, units: Sequence[str] = ()) -> Table:
    """Read a CSV of loads, as table_rows does: a heading, then numbers.

    A heading's last word that is a unit says what its column is: "Applied load [kg]", force_n.
    units: of columns whose headings have none.

    area_m2: that a force was spread over, which makes it a pressure.
    Raises CalibrationError, naming file, line and column.
    """
    table = table_rows(path, MOST_BYTES, CalibrationError, KIND_OF)
    number, cells = next(table)
    rows, lines = array("d"), array("q")
    try:
        headings, found = _headings(cells, units)
        for number, cells in table:
            rows.extend(_numbers(cells, headings))
            lines.append(number)
    except ValueError as error:
        raise CalibrationError(f"{path}: line {number}: {error}") from None
    if not rows:
        raise CalibrationError(f"{path}: there is a heading, but no numbers below it")
    factors = {kind: UNITS[kind][unit] for kind, unit in found.items()}
    columns = dict(zip(headings, np.reshape(rows, (-1, len(headings))).T, strict=True))
    if "force" in headings:
        if "pressure" in headings:
            raise CalibrationError(f"{path}: it has both force and pressure: which is meant?")
        if area_m2 is None:
            raise CalibrationError(f"{path}: forces need the area they act on: give --area-mm2")
        headings["pressure"], columns["pressure"] = headings["force"], columns["force"]
        found["pressure"] = found["force"]
        factors["pressure"] = factors["force"] / area_m2
    columns = {kind: column * factors[kind] for kind, column in columns.items()}
    return Table(path, np.array(lines), columns, headings, found, factors)


def _headings(cells: list[str], units: Sequence[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Return headings and units by quantity, in their order; raises ValueError."""
    headings, found = dict[str, str](), dict[str, str]()
    for cell in cells:
        kind, unit = _meaning(cell, units)
        if kind in headings:
            raise ValueError(f"there are two columns of {kind}")
        headings[kind], found[kind] = cell, unit
    return headings, found


def _meaning(cell: str, units: Sequence[str]) -> tuple[str, str]:
    """Return the quantity and unit of a column; raises ValueError."""
    said = words(cell)
    if unit := next((word for word in reversed(said) if word in KIND_OF), ""):
        return KIND_OF[unit], unit
    meant = [kind for word in said for kind in _MEANT.get(word, ())]
    if "node" in meant:
        return "node", ""
    if fitting := [unit for unit in map(str.lower, units) if KIND_OF.get(unit) in meant]:
        return KIND_OF[fitting[0]], fitting[0]
    known = [f"{kind}_{unit}".rstrip("_") for kind, each in UNITS.items() for unit in each]
    cell = cell[:_SHOWN]
    if meant:
        named = ", ".join(name for name in known if name.startswith(tuple(meant)))
        raise ValueError(
            f"column {cell!r} has no unit that is known; name it as in {named}, or give --units"
        )
    if re.fullmatch(r"[-+\d.,eE]+", cell):
        raise ValueError(
            f"{cell} where a heading should be; name quantities and units in the first line, "
            "as in node,pressure_kpa,voltage_v"
        )
    otherwise = f"known are {', '.join(known)}; delete what is none of these"
    hint = suggestion(cell, known, otherwise, alike=0.8)
    raise ValueError(f"unknown column {cell!r}{hint}")


def _numbers(cells: list[str], headings: dict[str, str]) -> list[float]:
    """Read a row; raises ValueError."""
    if len(cells) != len(headings):
        hint = "; with decimal commas, separate columns by semicolons" * (
            len(cells) > len(headings)
        )
        raise ValueError(f"{len(cells)} columns, the heading has {len(headings)}{hint}")
    values = []
    for cell, heading in zip(cells, headings.values(), strict=True):
        try:
            values.append(float(cell))
        except ValueError:
            values.append(np.nan)
        if not abs(values[-1]) < MOST:  # NaN is not, either
            raise ValueError(f"{cell[:_SHOWN]!r} is not a number for {heading}")
    return values
