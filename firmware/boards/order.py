# SPDX-License-Identifier: Apache-2.0

"""Packs what a board house and an assembler take, `make order`: a zip per board, checked.

Gerbers, drill files, parts with their makers' numbers, places in the columns that assemblers ask
for, a drawing of the assembly, and order.txt with what else one has to choose.
"""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from kicad import KicadError, assembly_drawings, check_rules, fabricate, placement
from netlist import Netlist
from panel import STRIP_TABS, TABS, outline_of, panel, reference
from parts_list import FEW, MORE, assembly_csv, checked_numbers
from tactile_cdma.base.whole_file import replace_file

NOT_BOUGHT = {"Sensor", "ISP"}
"""Symbols that are copper of the board."""
PANEL = 4
"""Strips on a panel. Chosen: 63 × 99 mm, of a size that every assembler takes."""
_STRIP = """4 layers, 0.8 mm, ENIG. Parts are on the lower side only. {}-panel is for assemblers
that want rails: 5 mm, fiducials of 1 mm, tooling holes of 2 mm, tabs with holes."""
STRIPS = ("strip", "strip-four", "strip-fast")
"""Boards that there are panels of."""
CHOICES = {
    **{strip: _STRIP.format(strip) for strip in STRIPS},
    "digitizer": "4 layers, 1.6 mm, ENIG. Parts are on the upper side only.",
    "electrodes": "2 layers, 1.6 mm, ENIG, which the sensor touches.",
}
COMMON = """
Tracks and gaps 0.15 mm, holes 0.25 mm, vias covered by the mask; resistors of 1 %.
No V-score: parts are 0.5 mm from the edges.
Soldered by hand: {by_hand}. Pads of sensors, programming and test points stay bare.
"""
Row = Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Order:
    """Is what is open in a board's order: references of parts, and numbers nobody has compared."""

    without_number: set[str]
    unverified: set[str]
    unplaced: set[str]


def pack(folder: Path, board: str, schematic: Netlist, target: Path) -> Order:
    """Write a board's files and their zip; returns what is open. Raises KicadError and OSError."""
    fabricate(folder, board, target)
    assembly_drawings(folder, board, target)
    rows = [*csv.DictReader(io.StringIO(placement(folder, board)))]
    order = open_points(schematic, rows)
    bought = {r for r, c in schematic.components.items() if "MPN" in c.fields}
    replace_file(target / f"{board}-cpl.csv", placement_csv(rows, bought))
    for nodes in (FEW, MORE):
        lines = assembly_csv(folder / f"{board}.kicad_sch", nodes)
        replace_file(target / f"{board}-bom-{nodes}-nodes.csv", lines)
    by_hand = {row["Ref"] for row in rows if row["Package"].startswith("PinHeader")} & bought
    names = ", ".join(sorted(by_hand)) or "nothing"
    text = CHOICES[board] + COMMON.format(by_hand=names)
    replace_file(target / "order.txt", text)
    shutil.make_archive(str(target), "zip", target)
    return order


def pack_panel(folder: Path, strip: str, schematic: Netlist, target: Path) -> str:
    """Write a panel of strips with its files and zip; returns its size. Raises as pack does."""
    layout, name = (folder / f"{strip}.kicad_pcb").read_text(encoding="utf-8"), f"{strip}-panel"
    board = outline_of(layout, TABS.get(strip, STRIP_TABS))
    target.mkdir(parents=True, exist_ok=True)
    replace_file(target / f"{name}.kicad_pcb", panel(layout, board, PANEL))
    shutil.copy(folder / f"{strip}.kicad_pro", target / f"{name}.kicad_pro")
    check_rules(target, name)
    fabricate(target, name, target)
    bought = {
        reference(r, number)
        for r, c in schematic.components.items()
        for number in range(PANEL)
        if "MPN" in c.fields
    }
    rows = [*csv.DictReader(io.StringIO(placement(target, name)))]
    if missing := bought - {row["Ref"] for row in rows}:
        raise KicadError(f"{name}: no place of {', '.join(sorted(missing))}")
    replace_file(target / f"{name}-cpl.csv", placement_csv(rows, bought))
    for nodes in (FEW, MORE):
        lines = assembly_csv(folder / f"{strip}.kicad_sch", nodes, PANEL)
        replace_file(target / f"{name}-bom-{nodes}-nodes.csv", lines)
    shutil.make_archive(str(target), "zip", target)
    width, height = board.size(PANEL)
    return f"panel: {PANEL} strips, {width:.1f} × {height:.1f} mm, in {name}"


def open_points(schematic: Netlist, rows: Iterable[Row]) -> Order:
    """Compare a schematic with KiCad's placement, a row per part."""
    numbers = {r: c.fields["MPN"] for r, c in schematic.components.items() if "MPN" in c.fields}
    parts = {r for r, c in schematic.components.items() if c.symbol not in NOT_BOUGHT}
    placed = {row["Ref"] for row in rows}
    others = {
        c.fields.get(f"MPN{MORE}", numbers.get(r, "")) for r, c in schematic.components.items()
    }
    unverified = {*numbers.values(), *others} - checked_numbers().keys() - {""}
    return Order(parts - numbers.keys(), unverified, numbers.keys() - placed)


def placement_csv(rows: Iterable[Row], bought: set[str]) -> str:
    """Write places in mm and degrees, in the columns of assemblers."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["Designator", "Mid X", "Mid Y", "Layer", "Rotation"])
    for row in rows:
        if row["Ref"] in bought:
            place = [f"{float(row[key]):.4f}" for key in ("PosX", "PosY")]
            side = row["Side"].capitalize()
            writer.writerow([row["Ref"], *place, side, f"{float(row['Rot']) % 360:g}"])
    return out.getvalue()
