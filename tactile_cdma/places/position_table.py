# SPDX-License-Identifier: Apache-2.0

"""Tables of taxels' places, as programs export them: CSV ↔ the list of a layout file."""

import re
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path

from ..base.errors import LayoutError
from ..base.marked_yaml import MOST_BYTES, Marked, MarkedFile
from ..base.table_rows import table_rows, words
from ..base.whole_file import replace_file
from .layout import Layout
from .layout_nodes import MOST_TAXELS

SUFFIXES = (".csv", ".tsv", ".txt")
"""Ends of the names of tables."""
_MM = {"mm": 1.0, "cm": 10.0, "m": 1e3}
"""Units of positions, in mm."""
_COLUMN = re.compile("(?:p|pos|position)?([xyz])(mm|cm|m)|n(?:ormal)?([xyz])|(node|taxel)")
_KNOWN = "x_mm, y_mm, z_mm (or _cm, _m), nx, ny, nz, node, taxel"
_VECTORS = {"position_mm": ("x", "y", "z"), "normal": ("nx", "ny", "nz")}


def read_positions(path: Path) -> Marked:
    """Read a table with columns of _KNOWN as the list `taxels` of a layout file.

    Without a column node, nodes are numbered as the rows are. Raises LayoutError, naming the line.
    """
    file, taxels = MarkedFile(path, LayoutError), list[Marked]()
    rows = table_rows(path, MOST_BYTES, LayoutError, _MM)
    units_mm = _columns(*next(rows), file)
    for index, (line, cells) in enumerate(islice(rows, MOST_TAXELS + 1)):
        said = {"taxel": str(index), "node": str(index + 1)}
        said |= zip(units_mm, cells, strict=False)
        if len(cells) != len(units_mm) or said["taxel"] != str(index):
            told = f"{len(cells)} cells of taxel {said['taxel'][:40]}; expected"
            raise file.refuse(f"{told} {len(units_mm)} of taxel {index}", line)
        for name, unit_mm in units_mm.items():
            with suppress(ValueError):  # which is refused as in any other layout
                said[name] = repr(float(said[name]) * unit_mm) if unit_mm else said[name]
        each = {name: Marked(text, line, False, file) for name, text in said.items()}
        taxel = {"node": each["node"]}
        for key, names in _VECTORS.items():
            if names[0] in each:
                taxel[key] = replace(each["x"], content=[each[name] for name in names])
        taxels.append(replace(each["x"], content=taxel))
    return Marked(taxels, 1, False, file)


def write_positions(path: Path, layout: Layout) -> None:
    """Write the taxels that have a node, so that read_positions reads them. Raises OSError."""
    rows = ["node,x_mm,y_mm,z_mm,nx,ny,nz"]
    for taxel in (layout.nodes > 0).nonzero()[0]:
        place = (*(layout.positions_m[taxel] * 1e3), *layout.normals[taxel])
        rows.append(",".join([str(layout.nodes[taxel]), *(f"{cell:.8g}" for cell in place)]))
    replace_file(path, "\n".join(rows) + "\n")


def _columns(line: int, heading: list[str], file: MarkedFile) -> dict[str, float]:
    """Return the names of the columns, each with its unit in mm, 0 for none."""
    units_mm = dict[str, float]()
    for cell in heading:
        found = _COLUMN.fullmatch("".join(words(cell)))
        name = (found[1] or found[4] or f"n{found[3]}") if found else ""
        if found is None or name in units_mm:
            told = f"{cell[:40]!r} where the name of a column should be: {_KNOWN}"
            raise file.refuse(told, line)
        units_mm[name] = _MM.get(found[2], 0.0)
    given = units_mm.keys()
    wanted = [_VECTORS["position_mm"], *(v for v in _VECTORS.values() if not given.isdisjoint(v))]
    if missing := sorted(set().union(*wanted) - given):
        raise file.refuse(f"no column {', '.join(missing)}; known are {_KNOWN}", line)
    return units_mm
