# SPDX-License-Identifier: Apache-2.0

"""Check the boards in firmware/boards/kicad, list their parts, and write what makers take.

    python firmware/boards/make_boards.py            lists of parts; where kicad-cli is, all of it
    python firmware/boards/make_boards.py --check    lists stale files, exit code 1 if any

The schematics and layouts are KiCad's files. The lists of parts are read from them, with prices
from parts.py; Gerbers, drill, placement and assembly lists go to firmware/build/boards.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from kicad import BOARDS, LAYOUTS, KicadError, check, draw, fabricate
from layout import read_board, unconnected
from parts_list import FEW, MORE, assembly_csv, csv_text, markdown, read_parts

ROOT = Path(__file__).resolve().parents[2]
KICAD, BUILD = ROOT / "firmware" / "boards" / "kicad", ROOT / "firmware" / "build" / "boards"
PARTS, DOCUMENT = Path("firmware/boards/parts.csv"), Path("docs/building.md")
BEGIN, END = "<!-- begin parts -->\n", "<!-- end -->"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing, list stale files")
    only_check = parser.parse_args().check
    stale = []
    for path, text in outputs():
        target = ROOT / path
        if not target.exists() or target.read_text(encoding="utf-8") != text:
            stale.append(path)
            if not only_check:
                target.write_text(text, encoding="utf-8")
    for path in stale:
        print(f"{path}: {'stale; run make boards' if only_check else 'written'}")
    if only_check:
        return int(bool(stale))
    apart = {board: unconnected(read_board(KICAD / f"{board}.kicad_pcb")) for board in LAYOUTS}
    for board, nets in apart.items():
        for net, parts in nets:
            print(f"boards: {board}: {net} is in {len(parts)} parts", file=sys.stderr)
    if any(apart.values()):
        return 1
    if shutil.which("kicad-cli") is None:
        print("boards: no kicad-cli (Debian 13: kicad): no rules, Gerbers or parts lists")
        print(f"boards={len(BOARDS)} layouts={len(LAYOUTS)} unconnected=0")
        return 0
    try:
        print(check(KICAD))
        draw(KICAD, ROOT / "docs" / "img")
        for board in LAYOUTS:
            fabricate(KICAD, board, BUILD / board)
            for nodes in (FEW, MORE):
                lines = assembly_csv(KICAD / f"{board}.kicad_sch", nodes)
                file = BUILD / board / f"{board}-bom-{nodes}-nodes.csv"
                file.write_text(lines, encoding="utf-8")
    except KicadError as error:
        print(f"boards: {error}", file=sys.stderr)
        return 1
    print(f"for the maker: {BUILD.relative_to(ROOT)}")
    return 0


def outputs() -> Iterator[tuple[Path, str]]:
    """Path and text of every generated file."""
    parts = read_parts(KICAD)
    yield PARTS, csv_text(parts)
    text = (ROOT / DOCUMENT).read_text(encoding="utf-8")
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise SystemExit(f"{DOCUMENT} has no {BEGIN.strip()} … {END}")
    yield DOCUMENT, before + begin + markdown(parts) + end + after


if __name__ == "__main__":
    sys.exit(main())
