# SPDX-License-Identifier: Apache-2.0

"""Points to calibrate from: known pressures on nodes and the voltages measured there."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools, Floats, Indices
from ..base.text import listed
from ..readings.calibration import MOST_PA
from .load_table import KIND_OF, UNITS, Table, read_table

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

    node, line: (m,) int64, from 1 on; the line is that of the file `source`. pressure_pa,
    voltage_v: (m,) float64.
    """

    node: NDArray[np.int64]
    pressure_pa: Floats
    voltage_v: Floats
    line: NDArray[np.int64]
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
        raise table.refusal(
            f"the largest load is {size} {largest_pa:g} Pa: is {heading} the right unit? "
            + _likely(table, largest_pa)
        )
    return np.maximum(pressure_pa, 0.0)


def _likely(table: Table, largest_pa: float) -> str:
    """Name the unit in which the largest load would be a usual one."""
    kind, ours = KIND_OF[table.units["pressure"]], table.units["pressure"]
    in_pa = {unit: largest_pa * one / UNITS[kind][ours] for unit, one in UNITS[kind].items()}
    unit = min(in_pa, key=lambda unit: abs(math.log(max(in_pa[unit], 1e-9) / USUAL_PA)))
    area = ", and is --area-mm2 right?" if kind == "force" else ""
    would_be = f"{in_pa[unit] / 1e3:.4g} kPa"
    return f"In {kind}_{unit} it would be {would_be}: then name the column so{area}"


def node_numbers(table: Table, nodes: int) -> NDArray[np.int64]:
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
