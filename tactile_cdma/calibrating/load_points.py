# SPDX-License-Identifier: Apache-2.0

"""Points to calibrate from, of CSV files: known pressures on nodes, and the voltages there.

Headings carry the units, errors name file and line.
"""

import math
import re
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Self

import numpy as np

from ..base.arrays import Bools, Floats, Indices, Int64s
from ..base.errors import CalibrationError
from ..base.table_rows import table_rows, words
from ..base.text import listed, suggestion
from ..readings.calibration import MOST_PA

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
    line: Int64s

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
    units: of columns whose headings have none. area_m2: that forces act on, which makes them
    pressures. Raises CalibrationError, naming file, line and column.
    """
    table = table_rows(path, MOST_BYTES, CalibrationError, KIND_OF)
    number, cells = next(table)
    rows, lines = array("d"), array("q")
    headings, found = dict[str, str](), dict[str, str]()
    try:
        for cell in cells:
            kind, unit = _meaning(cell, units)
            if kind in headings:
                raise ValueError(f"there are two columns of {kind}")
            headings[kind], found[kind] = cell, unit
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


HEADING = "node,pressure_kpa,voltage_v"
PLAUSIBLE_PA = (200.0, MOST_PA)
"""Limits of the largest load, Pa: outside of them its unit is taken to be wrong. The lower one is
chosen: two counts of the paper's sensor."""
USUAL_PA = 1e5
"""Largest load of most calibrations, Pa, by which the right unit is guessed; chosen."""
NOISE = 0.01
"""How far below 0 an unloaded reference may read, as a share of the largest load; chosen."""
_CHANGE = 0.005
"""Change of a load, as a share of the largest, that is none; chosen: a reference's noise."""


@dataclass(frozen=True, eq=False)
class LoadPoints:
    """m points in the order in which they were taken.

    node, line: (m,) int64, from 1 on; the line is that of the file `source`.
    pressure_pa, voltage_v: (m,) float64.
    """

    node: Int64s
    pressure_pa: Floats
    voltage_v: Floats
    line: Int64s
    source: str

    def __len__(self) -> int:
        return len(self.node)

    def by_node(self, nodes: int) -> dict[int, Indices]:
        """Return the rows of each of the nodes 1…nodes, in the order in which they were taken."""
        order = np.argsort(self.node, kind="stable")
        ends = np.searchsorted(self.node[order], np.arange(1, nodes + 2))
        return {node + 1: order[begin:end] for node, (begin, end) in enumerate(pairwise(ends))}

    def of_rows(self, rows: Bools) -> Self:
        """Return some of the points; rows: (m,) bool."""
        columns = ("node", "pressure_pa", "voltage_v", "line")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})

    def lines(self, rows: Indices | Bools) -> str:
        """Tell where points come from, in words: "lines 3, 5, 9"."""
        return listed(sorted(set(self.line[rows].tolist())), "line")


def read_points(
    path: Path,
    nodes: int,
    vref_v: float,
    area_m2: float | None = None,
    units: Sequence[str] = (),
    node: int | None = None,
) -> LoadPoints:
    """Read points from a CSV with the columns node, pressure (or force, with area_m2) and voltage.

    units: see read_table. node: of a table without this column.
    Raises CalibrationError, naming file, line and likely cause, for unknown nodes, negative
    pressures, voltages outside the converter's range, swapped columns and wrong units.
    """
    table = read_table(path, area_m2, units)
    if node is not None and "node" not in table.columns:
        table.columns["node"] = np.full(len(table.line), float(node))
    hint = "" if "node" in table.columns else ": if one node was loaded, give --node"
    hint = " (with times instead, give --capture)" if "time" in table.columns else hint
    table.require(hint, *HEADING.split(","))
    voltage_v, unit = table.columns["voltage"], table.units["voltage"]
    _check_swapped(table, vref_v)
    pressure_pa = pressures(table)
    outside = (voltage_v < 0) | (voltage_v > vref_v)
    if outside.any():
        row = int(np.argmax(outside))
        millivolts = unit == "v" and voltage_v[row] > 10 * vref_v
        raise table.refusal(
            f"{voltage_v[row]:g} V; a node measures 0…{vref_v:g} V"
            + (": are these mV? Name the column voltage_mv" if millivolts else ""),
            row,
        )
    if unit == "mv" and voltage_v.max() * 1e3 <= vref_v:
        raise table.refusal(
            f"the largest voltage is {voltage_v.max() * 1e3:g} mV: are these V? "
            "Name the column voltage_v"
        )
    return LoadPoints(node_numbers(table, nodes), pressure_pa, voltage_v, table.line, path.name)


def directions(pressure_pa: Floats) -> Floats:
    """Tell how loads (m,) of one node were reached, in their order: 1 from below, −1 from above.

    A load that is held keeps the direction that it came from; 0 for the first.
    """
    least_pa = _CHANGE * pressure_pa.max(initial=0.0)
    change_pa = np.diff(pressure_pa, prepend=pressure_pa[:1])
    direction = np.sign(np.where(np.abs(change_pa) > least_pa, change_pa, 0.0))
    moved = np.maximum.accumulate(np.where(direction != 0, np.arange(len(direction)), 0))
    return np.asarray(direction[moved])


def _check_swapped(table: Table, vref_v: float) -> None:
    """Raise CalibrationError where pressures stand under voltage and voltages under pressure."""
    voltage_v = table.columns["voltage"]
    pressure = table.columns["pressure"] / table.factors["pressure"]
    within = (pressure >= 0) & (pressure <= vref_v)
    if within.all() and voltage_v.max() > vref_v and voltage_v.min() >= 0:
        raise table.refusal(
            f"all of {table.headings['pressure']} lies within 0…{vref_v:g}, "
            f"{table.headings['voltage']} reaches {voltage_v.max():g}: are the columns swapped?"
        )


def pressures(table: Table) -> Floats:
    """Return the column pressure, Pa; noise of an unloaded reference below 0 becomes 0.

    Raises CalibrationError for pressures that are negative or in another unit than the heading's.
    """
    pressure_pa, heading = table.columns["pressure"], table.headings["pressure"]
    largest_pa = float(pressure_pa.max())
    lowest = int(np.argmin(pressure_pa))
    if pressure_pa[lowest] < -NOISE * max(largest_pa, 0.0):
        raise table.refusal(
            f"{heading} is {pressure_pa[lowest] / table.factors['pressure']:g}; loads are "
            "pressures above ambient, 0 or more",
            lowest,
        )
    if largest_pa <= 0:
        raise table.refusal(f"{heading} is never above 0: a curve needs loads")
    if not PLAUSIBLE_PA[0] <= largest_pa <= PLAUSIBLE_PA[1]:
        size = "only" if largest_pa < PLAUSIBLE_PA[0] else "as much as"
        kind, ours = KIND_OF[table.units["pressure"]], table.units["pressure"]
        in_pa = {unit: largest_pa * one / UNITS[kind][ours] for unit, one in UNITS[kind].items()}
        # The unit in which it would be a usual one.
        unit = min(in_pa, key=lambda unit: abs(math.log(max(in_pa[unit], 1e-9) / USUAL_PA)))
        area = ", and is --area-mm2 right?" if kind == "force" else ""
        raise table.refusal(
            f"the largest load is {size} {largest_pa:g} Pa: is {heading} the right unit? In "
            f"{kind}_{unit} it would be {in_pa[unit] / 1e3:.4g} kPa: then name the column so{area}"
        )
    return np.maximum(pressure_pa, 0.0)


def node_numbers(table: Table, nodes: int) -> Int64s:
    """Return the column node as integers; raises CalibrationError for those the skin has not."""
    column = table.columns["node"]
    wrong = (column != np.floor(column)) | (column < 1) | (column > nodes)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise table.refusal(f"node {column[row]:g}; the skin has nodes 1…{nodes}", row)
    return column.astype(np.int64)


def point_lines(nodes: list[int], pressure_pa: float, voltage_v: Floats) -> str:
    """Write lines of a CSV below HEADING: voltages (n,) of nodes under one load, without NaN."""
    return "".join(
        f"{node},{pressure_pa / 1e3:.9g},{volts:.6f}\n"
        for node, volts in zip(nodes, voltage_v.tolist(), strict=True)
        if np.isfinite(volts)
    )
