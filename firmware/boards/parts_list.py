# SPDX-License-Identifier: Apache-2.0

"""Parts lists of skins of 16, 64 and 900 nodes: what the schematics show, times the boards."""

from __future__ import annotations

import csv
import io
import sys
from collections import Counter
from math import ceil
from pathlib import Path

from kicad_file import load
from netlist import Component, components, read
from panel import reference
from parts import SENSOR_SHEET, SUPPLY_5V, Part, PartError, part
from tactile_cdma.config.skin_config import SkinConfig

sys.path.append(str(Path(__file__).resolve().parents[1] / "analog"))
import spice
from amplifier import FrontEnd, design

FEW, MORE, MANY = SKINS = (16, 64, 900)
"""Nodes of the skins that there are boards for: the same boards for the first two."""
STRIP_NODES = 8
CHECKED = Path(__file__).with_name("checked.csv")
"""Numbers of parts that were compared with a public document; the others are as remembered."""
SHEETS = (
    *("node", "node-four", "node-fast", "strip", "strip-four", "strip-fast"),
    *("digitizer", "digitizer-fast", "group"),
)
"""Files of the boards of a skin."""
Parts = dict[str, list[Component]]
"""Parts that one buys, by file."""


def front_end(nodes: int) -> FrontEnd:
    """Design the front end of a skin, as `make spice` simulates it."""
    config = SkinConfig.of(spice.parameters(nodes))
    return design(config.spec, config.samples_per_chip)


def read_parts(folder: Path) -> Parts:
    """Read every sheet of a skin, by itself. Raises KicadFileError."""
    trees = {name: load(folder / f"{name}.kicad_sch") for name in SHEETS}
    return {
        name: [c for c, *_ in components(tree) if "MPN" in c.fields] for name, tree in trees.items()
    }


def boards_of(nodes: int) -> dict[str, int]:
    """Count each board of a skin. Strips of a group are not shared with another one."""
    front = front_end(nodes)
    if front.groups == 1:
        return {"node": nodes, "strip": ceil(nodes / STRIP_NODES), "digitizer": 1}
    size = front.nodes_stage.inputs
    sizes = [min(size, nodes - begin) for begin in range(0, nodes, size)]
    strips = sum(ceil(group / STRIP_NODES) for group in sizes)
    return {"node-fast": nodes, "strip-fast": strips, "group": len(sizes), "digitizer-fast": 1}


def needed(parts: Parts, nodes: int) -> Counter[Part]:
    """List the parts of a skin, without boards, cables and assembly. Raises PartError."""
    counts: Counter[Part] = Counter()
    for board, number in boards_of(nodes).items():
        for component in parts[board]:
            try:
                counts[bought(component, nodes)] += number
            except PartError as error:
                place = f"{board}.kicad_sch: {component.reference}"
                raise PartError(f"{place}: {error}") from None
    counts[SENSOR_SHEET] = ceil(nodes / SENSOR_SHEET_TAXELS)
    if front_end(nodes).groups > 1:
        counts[SUPPLY_5V] = 1
    return counts


SENSOR_SHEET_TAXELS = 27 * 27
"""Squares of 10 mm in a sheet of 280 mm, with a margin."""


def bought(component: Component, nodes: int) -> Part:
    """Choose the part of a symbol on a skin's boards. Raises PartError."""
    fields, key = component.fields, "MPN"
    value = fields.get("Use", component.value)
    if nodes == MORE and f"MPN{MORE}" in fields:
        value, key = fields.get("Note", "").partition(":")[0], f"MPN{MORE}"
    found = part(component.symbol, value)
    if found.number != fields[key]:
        raise PartError(f"its {key} is {fields[key]}; {component.symbol} {value} is {found.number}")
    return found


def csv_text(parts: Parts) -> str:
    """Write all parts as CSV: a line per part, quantities and costs by number of nodes."""
    counts = {nodes: needed(parts, nodes) for nodes in SKINS}
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(
        ["maker", "number", "what", "footprint", "usd_each", *(f"for_{n}_nodes" for n in SKINS)]
    )
    for p in _ordered(counts):
        row = [p.maker, p.number, p.what, p.footprint, f"{p.cost:.2f}"]
        writer.writerow([*row, *(counts[n][p] for n in SKINS)])
    return out.getvalue()


def checked_numbers() -> dict[str, str]:
    """Return numbers that agree with a public document, each with LCSC's where that was read."""
    with CHECKED.open(newline="", encoding="utf-8") as file:
        return {row["number"]: row["lcsc"] for row in csv.DictReader(file)}


def assembly_csv(schematic: Path, nodes: int = FEW, boards: int = 1) -> str:
    """Write a board's parts as assemblers take them: a line per number, with its places.

    nodes: of the skin; the boards of MORE have other parts in some places. boards: on a panel.
    """
    lines: dict[str, list[Component]] = {}
    for component in read(schematic).components.values():
        if "MPN" in component.fields:
            number = component.fields.get(f"MPN{nodes}", component.fields["MPN"])
            lines.setdefault(number, []).append(component)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    parts = {p.number: p for p in (bought(same[0], nodes) for same in lines.values())}
    head = ["Comment", "Designator", "Footprint", "Manufacturer", "Number", "Quantity", "LCSC"]
    writer.writerow(head)
    of_lcsc = checked_numbers()
    for number, same in sorted(lines.items()):
        names = sorted(component.reference for component in same)
        if boards > 1:
            names = [reference(name, board) for board in range(boards) for name in names]
        footprint = same[0].fields.get("Footprint", "").partition(":")[2]
        what = parts[number]
        row = [what.what, ",".join(names), footprint, what.maker, number, len(names)]
        writer.writerow([*row, of_lcsc.get(number, "")])
    return out.getvalue()


def markdown(parts: Parts) -> str:
    """Write a table of what parts cost together, and how many boards there are."""
    counts = {nodes: needed(parts, nodes) for nodes in SKINS}
    sums = [sum(p.cost * count for p, count in counts[n].items()) for n in SKINS]
    boards = [boards_of(n) for n in SKINS]
    rows = {
        "all parts, US$": [f"{total:.0f}" for total in sums],
        "per node": [f"{total / n:.2f}" for total, n in zip(sums, SKINS, strict=True)],
    }
    for kind in ("strip", "digitizer", "group"):
        numbers = (sum(n for name, n in b.items() if name.startswith(kind)) for b in boards)
        rows[f"boards: {kind}"] = [str(number or "") for number in numbers]
    lines = ["| | " + " | ".join(f"{n} nodes" for n in SKINS) + " |", "|---|" + "--:|" * len(SKINS)]
    lines += [f"| {name} | {' | '.join(cells)} |" for name, cells in rows.items()]
    return "\n".join([*lines, ""])


def _ordered(counts: dict[int, Counter[Part]]) -> list[Part]:
    """Yield every part, what costs most with MANY nodes first."""
    every = {p for c in counts.values() for p in c}
    most = max(SKINS)
    return sorted(every, key=lambda p: (-p.cost * counts[most][p], -p.cost, p.number))
