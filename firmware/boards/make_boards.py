# SPDX-License-Identifier: Apache-2.0

"""Check the boards in firmware/boards/kicad, list their parts, and write what makers take.

    python firmware/boards/make_boards.py            lists of parts; where kicad-cli is, its rules
    python firmware/boards/make_boards.py --order    also a zip per board of what makers take
    python firmware/boards/make_boards.py --check    lists stale files, exit code 1 if any

The schematics and layouts are KiCad's files. The lists of parts are read from them, with prices
from parts.py; orders go to firmware/build/boards.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from kicad import BOARDS, LAYOUTS, KicadError, check, draw
from kicad_file import KicadFileError
from layout import nets, read_board, unconnected
from netlist import Netlist, read
from order import STRIPS, pack, pack_panel
from parts import PartError
from parts_list import csv_text, markdown, read_parts
from tactile_cdma.base.errors import TactileError
from tactile_cdma.base.whole_file import replace_file

ROOT = Path(__file__).resolve().parents[2]
KICAD, BUILD = ROOT / "firmware" / "boards" / "kicad", ROOT / "firmware" / "build" / "boards"
PARTS, DOCUMENT = Path("firmware/boards/parts.csv"), Path("docs/building.md")
MOST_SHOWN = 8
"""Pins of a net that are printed; chosen."""
BEGIN, END = "<!-- begin parts -->\n", "<!-- end -->"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing, list stale files")
    parser.add_argument("--order", action="store_true", help="pack orders, which needs KiCad")
    arguments = parser.parse_args()
    try:
        return lists_stale() if arguments.check else make(arguments.order)
    except (KicadError, KicadFileError, PartError, TactileError) as error:
        print(f"boards: {error}", file=sys.stderr)
    except OSError as error:
        print(f"boards: {error.filename}: {error.strerror}", file=sys.stderr)
    return 1


def lists_stale() -> int:
    """Name the generated files that are stale; returns 1 if there are any."""
    stale = [path for path, text in outputs() if not is_fresh(ROOT / path, text)]
    for path in stale:
        print(f"{path}: stale; run make boards")
    return int(bool(stale))


def make(order: bool) -> int:
    """Write what is stale, check the boards, and have KiCad do what it can; returns the exit code.

    Raises KicadError, KicadFileError, PartError and OSError.
    """
    schematics = {board: read(KICAD / f"{board}.kicad_sch") for board in BOARDS}
    faults = [fault for board in LAYOUTS for fault in faults_of(board, schematics[board])]
    for fault in faults:
        print(f"boards: {fault}", file=sys.stderr)
    if faults:
        return 1
    for path, text in outputs():
        if not is_fresh(ROOT / path, text):
            replace_file(ROOT / path, text)
            print(f"{path}: written")
    if shutil.which("kicad-cli") is None:
        print("boards: no kicad-cli (Debian 13: kicad): no rules, no orders")
        print(f"boards={len(BOARDS)} layouts={len(LAYOUTS)} unconnected=0")
        return int(order)
    checked = check(KICAD)
    draw(KICAD, ROOT / "docs" / "img")
    print(checked)
    return pack_orders(schematics, checked.partition(" erc=")[2]) if order else 0


def pack_orders(schematics: dict[str, Netlist], rules: str) -> int:
    """Write an order per layout; returns 1 where a part has no number or no place."""
    orders = [pack(KICAD, board, schematics[board], BUILD / board) for board in LAYOUTS]
    without, unplaced = (
        sorted(reference for order in orders for reference in getattr(order, name))
        for name in ("without_number", "unplaced")
    )
    if without or unplaced:
        print(f"boards: without a number: {without}; without a place: {unplaced}", file=sys.stderr)
    unverified = set().union(*(order.unverified for order in orders))
    print(f"for makers: {BUILD.relative_to(ROOT)}")
    for strip in STRIPS:
        print(pack_panel(KICAD, strip, schematics[strip], BUILD / f"{strip}-panel"))
    print(
        f"boards={len(orders)} parts_without_number={len(without)} unverified={len(unverified)} "
        f"unplaced={len(unplaced)} erc={rules}"
    )
    return int(bool(without or unplaced))


def faults_of(board: str, schematic: Netlist) -> Iterator[str]:
    """List nets of a layout that are in parts, or that are not the schematic's."""
    copper = read_board(KICAD / f"{board}.kicad_pcb")
    for net, parts in unconnected(copper):
        yield f"{board}.kicad_pcb: {net} is in {len(parts)} parts"
    wanted, laid_out = {*schematic.nets}, nets(copper)
    for kind, missing in (("pcb", wanted - laid_out), ("sch", laid_out - wanted)):
        for pads in sorted(map(sorted, missing)):
            pins = [f"{reference}.{pin}" for reference, pin in pads]
            more = f" and {len(pins) - MOST_SHOWN} more" if len(pins) > MOST_SHOWN else ""
            yield f"{board}.kicad_{kind} has no net of {' '.join(pins[:MOST_SHOWN])}{more}"


def is_fresh(path: Path, text: str) -> bool:
    """Tell whether a file is there with this text."""
    return path.exists() and path.read_bytes() == text.encode()


def outputs() -> Iterator[tuple[Path, str]]:
    """Return path and text of every generated file."""
    parts = read_parts(KICAD)
    yield PARTS, csv_text(parts)
    text = (ROOT / DOCUMENT).read_text(encoding="utf-8")
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise SystemExit(f"boards: {DOCUMENT} has no {BEGIN.strip()} … {END}")
    yield DOCUMENT, before + begin + markdown(parts) + end + after


if __name__ == "__main__":
    sys.exit(main())
