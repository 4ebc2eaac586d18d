# SPDX-License-Identifier: Apache-2.0

"""Has kicad-cli (KiCad 9, as in Debian 13) check and draw boards, and write what makers take."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

from tactile_cdma.base.whole_file import replace_file

BOARDS = (
    *("strip", "strip-four", "strip-fast"),
    *("digitizer", "digitizer-fast", "group", "electrodes"),
)
LAYOUTS = ("strip", "strip-four", "strip-fast", "digitizer", "electrodes")
"""Boards that are laid out, too."""
PICTURES = {
    "node": ("strip", 2),
    "node-four": ("strip-four", 2),
    "digitizer": ("digitizer", 1),
    "group": ("group", 1),
    "digitizer-fast": ("digitizer-fast", 1),
}
"""Board and page of every picture."""
DOTS_PER_INCH = 110
PALE = 247
"""Grey from which on a point is an area of a symbol (248) or the paper, not a line."""
MADE = "F.Cu,{inner}B.Cu,F.Mask,B.Mask,F.Paste,B.Paste,F.Silkscreen,B.Silkscreen,Edge.Cuts"
"""Layers that a board house gets."""
PAGE_MM = 270.0
"""Width of a drawing of the assembly: an A4 page, across."""
OUTLINES = "F.Cu,F.Mask,B.Cu,Edge.Cuts"
"""Layers that a drawing program gets, as DXF."""


class KicadError(RuntimeError):
    """kicad-cli is not installed, or found a violation."""


def check(folder: Path) -> str:
    """Run KiCad's electrical and layout rules on every board; returns what there is to say of it.

    Layouts are compared with their schematics, too. Raises KicadError with the first report.
    """
    strict = ("--exit-code-violations", "--severity-all")
    for board in BOARDS:
        _run("sch", "erc", *strict, f"{board}.kicad_sch", to="erc.rpt", folder=folder)
    unconnected = 0
    for board in LAYOUTS:
        options = (*strict, "--schematic-parity", "--format", "json")
        report = _run("pcb", "drc", *options, f"{board}.kicad_pcb", to="drc.json", folder=folder)
        unconnected += len(json.loads(report)["unconnected_items"])
    return f"boards={len(BOARDS)} layouts={len(LAYOUTS)} erc=0 drc=0 unconnected={unconnected}"


def check_rules(folder: Path, board: str) -> None:
    """Run the layout rules on a board without a schematic. Raises KicadError with the report."""
    strict = ("--exit-code-violations", "--severity-all")
    _run("pcb", "drc", *strict, f"{board}.kicad_pcb", to="drc.rpt", folder=folder)


def netlist(folder: Path, board: str) -> str:
    """Return KiCad's netlist of a board, as XML."""
    options = ("--format", "kicadxml", f"{board}.kicad_sch")
    return _run("sch", "export", "netlist", *options, to="netlist.xml", folder=folder)


def draw(folder: Path, pictures: Path) -> None:
    """Draw the schematics, as PNG."""
    for name, (board, page) in PICTURES.items():
        options = ("--exclude-drawing-sheet", "--no-background-color")
        with TemporaryDirectory(dir=folder) as scratch:
            pdf = Path(scratch) / "out.pdf"
            _kicad(folder, "sch", "export", "pdf", *options, f"{board}.kicad_sch", "-o", str(pdf))
            size = ("-r", str(DOTS_PER_INCH), "-f", str(page), "-l", str(page), "-singlefile")
            target = str(pictures / f"board-{name}")
            _run_program("pdftoppm", "-png", "-gray", *size, str(pdf), target)
            darken(Path(f"{target}.png"))


def darken(picture: Path) -> None:
    """Make thin wires of a schematic as dark as its texts; areas of symbols stay as they are."""
    with Image.open(picture) as image:
        dark = image.convert("L").point([int(0.35 * v) if v < PALE else v for v in range(256)])
    dark.quantize(16).save(picture, optimize=True)


def fabricate(folder: Path, board: str, target: Path) -> None:
    """Write Gerbers, drill files and a DXF of a layout into a folder."""
    target.mkdir(parents=True, exist_ok=True)
    source, out = f"{board}.kicad_pcb", f"{target}/"
    four = '"In1.Cu"' in (folder / source).read_text(encoding="utf-8")
    layers = MADE.format(inner="In1.Cu,In2.Cu," if four else "")
    _kicad(folder, "pcb", "export", "gerbers", "--layers", layers, source, "-o", out)
    _kicad(folder, "pcb", "export", "drill", source, "-o", out)
    dxf = ("--layers", OUTLINES, "--output-units", "mm", "--mode-single")
    _kicad(folder, "pcb", "export", "dxf", *dxf, source, "-o", f"{out}{board}.dxf")


def placement(folder: Path, board: str) -> str:
    """Return places of a layout's parts as CSV: Ref, Val, Package, PosX, PosY, Rot, Side."""
    options = ("--format", "csv", "--units", "mm", "--exclude-dnp", f"{board}.kicad_pcb")
    return _run("pcb", "export", "pos", *options, to="places.csv", folder=folder)


def assembly_drawings(folder: Path, board: str, target: Path) -> None:
    """Draw where parts are, with references and pins 1, an SVG per side as it is looked at."""
    for side, layer, options in (("top", "F.Fab", ()), ("bottom", "B.Fab", ("--mirror",))):
        page = ("--mode-single", "--page-size-mode", "2", "--exclude-drawing-sheet", *options)
        layers = ("--black-and-white", "--layers", f"{layer},Edge.Cuts")
        out = target / f"{board}-assembly-{side}.svg"
        _kicad(folder, "pcb", "export", "svg", *page, *layers, f"{board}.kicad_pcb", "-o", str(out))
        replace_file(out, enlarged(out.read_text(encoding="utf-8")))


def enlarged(drawing: str) -> str:
    """Have a drawing of a board's size fill a page across."""
    width, height = re.findall(r'\b(?:width|height)="([\d.]+)mm"', drawing)[:2]
    scale = PAGE_MM / float(width)
    size = f'width="{PAGE_MM:g}mm" height="{scale * float(height):.6g}mm"'
    return drawing.replace(f'width="{width}mm" height="{height}mm"', size, 1)


def _run(*arguments: str, to: str, folder: Path) -> str:
    """Return what kicad-cli writes into a file; in the boards' folder, where their library is."""
    with TemporaryDirectory(dir=folder) as scratch:
        out = Path(scratch) / to
        _kicad(folder, *arguments, "-o", str(out))
        return out.read_text(encoding="utf-8")


def _kicad(folder: Path, *arguments: str) -> None:
    _run_program("kicad-cli", *arguments, folder=folder)


def _run_program(name: str, *arguments: str, folder: Path | None = None) -> None:
    path = shutil.which(name)
    if path is None:
        raise KicadError(f"no {name} on this machine (Debian 13: kicad, poppler-utils)")
    result = subprocess.run([path, *arguments], cwd=folder, capture_output=True, text=True)
    if result.returncode:
        out = Path(arguments[-1])
        report = out.read_text(encoding="utf-8") if out.is_file() else result.stderr
        raise KicadError(f"{name} {' '.join(arguments[:3])}: {report}")
