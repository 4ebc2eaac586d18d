# SPDX-License-Identifier: Apache-2.0

"""Has kicad-cli (KiCad 8 or later; Debian 13 has 9) check and draw the boards."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

BOARDS = ("strip", "strip-fast", "digitizer", "digitizer-fast", "group")
PICTURES = {
    "node": ("strip", 2),
    "digitizer": ("digitizer", 1),
    "group": ("group", 1),
    "digitizer-fast": ("digitizer-fast", 1),
}
"""Board and page of every picture."""
DOTS_PER_INCH = 110


class KicadError(RuntimeError):
    """kicad-cli is not installed, or found a violation."""


def check(folder: Path) -> str:
    """Run the electrical rules check on every board; returns what there is to say of it."""
    for board in BOARDS:
        _run(
            "sch",
            "erc",
            "--exit-code-violations",
            "--severity-all",
            f"{board}.kicad_sch",
            to="erc.rpt",
            folder=folder,
        )
    return f"boards={len(BOARDS)} violations=0"


def netlist(folder: Path, board: str) -> str:
    """KiCad's netlist of a board, as XML."""
    return _run(
        "sch",
        "export",
        "netlist",
        "--format",
        "kicadxml",
        f"{board}.kicad_sch",
        to="netlist.xml",
        folder=folder,
    )


def draw(folder: Path, pictures: Path) -> None:
    """Draw every board, as PNG."""
    for name, (board, page) in PICTURES.items():
        options = ("--exclude-drawing-sheet", "--no-background-color")
        with TemporaryDirectory(dir=folder) as scratch:
            pdf = Path(scratch) / "out.pdf"
            _kicad(folder, "sch", "export", "pdf", *options, f"{board}.kicad_sch", "-o", str(pdf))
            size = ("-r", str(DOTS_PER_INCH), "-f", str(page), "-l", str(page), "-singlefile")
            target = str(pictures / f"board-{name}")
            subprocess.run(
                [_need("pdftoppm"), "-png", "-gray", *size, str(pdf), target], check=True
            )


def _run(*arguments: str, to: str, folder: Path) -> str:
    """What kicad-cli writes into a file; in the boards' folder, where their library is found."""
    with TemporaryDirectory(dir=folder) as scratch:
        out = Path(scratch) / to
        _kicad(folder, *arguments, "-o", str(out))
        return out.read_text(encoding="utf-8")


def _kicad(folder: Path, *arguments: str) -> None:
    result = subprocess.run(
        [_need("kicad-cli"), *arguments], cwd=folder, capture_output=True, text=True
    )
    if result.returncode:
        out = Path(arguments[-1])
        report = out.read_text(encoding="utf-8") if out.exists() else result.stderr
        raise KicadError(f"{' '.join(arguments[:3])}: {report}")


def _need(program: str) -> str:
    path = shutil.which(program)
    if path is None:
        raise KicadError(f"no {program} on this machine (Debian 13: kicad, poppler-utils)")
    return path
