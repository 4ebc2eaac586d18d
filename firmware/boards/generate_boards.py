# SPDX-License-Identifier: Apache-2.0

"""Generate the schematics in firmware/boards/kicad, and the parts lists.

    python firmware/boards/generate_boards.py            writes the files that have changed
    python firmware/boards/generate_boards.py --check    lists stale ones, exit code 1 if any
    python firmware/boards/generate_boards.py --draw     with kicad-cli checks and draws them, too

Values come from firmware/analog/amplifier.py, part numbers and prices from parts.py.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import symbols
from drawing import LIBRARY, library_text
from kicad import BOARDS, KicadError, check, draw
from parts_list import csv_text, markdown
from schematics import all_boards

ROOT = Path(__file__).resolve().parents[2]
KICAD = Path("firmware/boards/kicad")
PARTS, DOCUMENT = Path("firmware/boards/parts.csv"), Path("docs/building.md")
BEGIN, END = "<!-- begin parts -->\n", "<!-- end -->"
TABLE = (
    f'(sym_lib_table (version 7)\n (lib (name "{LIBRARY}") (type "KiCad") '
    f'(uri "${{KIPRJMOD}}/{LIBRARY}.kicad_sym") (options "") (descr ""))\n)\n'
)
RULES = {"erc": {"rule_severities": {"footprint_link_issues": "ignore"}}}
"""KiCad's libraries of footprints need not be installed where boards are checked."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing, list stale files")
    parser.add_argument("--draw", action="store_true", help="check and draw with kicad-cli")
    arguments = parser.parse_args()
    stale = []
    for path, text in outputs():
        target = ROOT / path
        if not target.exists() or target.read_text(encoding="utf-8") != text:
            stale.append(path)
            if not arguments.check:
                target.write_text(text, encoding="utf-8")
    for path in stale:
        print(f"{path}: {'stale; run make boards' if arguments.check else 'written'}")
    if arguments.draw and shutil.which("kicad-cli") is None:
        print(f"boards={len(BOARDS)} up to date; not checked: no kicad-cli")
    elif arguments.draw:
        try:
            print(check(ROOT / KICAD))
            draw(ROOT / KICAD, ROOT / "docs" / "img")
        except KicadError as error:
            print(f"boards: {error}", file=sys.stderr)
            return 1
    return int(arguments.check and bool(stale))


def outputs() -> Iterator[tuple[Path, str]]:
    """Path and text of every generated file."""
    sheets = all_boards()
    for sheet in sheets:
        yield KICAD / f"{sheet.name}.kicad_sch", sheet.text()
        if sheet.users is None:
            project = {"meta": {"filename": f"{sheet.name}.kicad_pro", "version": 3}, **RULES}
            yield KICAD / f"{sheet.name}.kicad_pro", json.dumps(project) + "\n"
    yield KICAD / f"{LIBRARY}.kicad_sym", library_text(symbols.ALL)
    yield KICAD / "sym-lib-table", TABLE
    yield PARTS, csv_text(sheets)
    text = (ROOT / DOCUMENT).read_text(encoding="utf-8")
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise SystemExit(f"{DOCUMENT} has no {BEGIN.strip()} … {END}")
    yield DOCUMENT, before + begin + markdown(sheets) + end + after


if __name__ == "__main__":
    sys.exit(main())
