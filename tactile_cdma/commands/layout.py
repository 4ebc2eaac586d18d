# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma layout`: checks a layout file, describes and draws it."""

import argparse
from pathlib import Path

import numpy as np

from ..base.errors import LayoutError
from ..base.listing import listed
from ..base.plain_text import plain
from ..config.parameters import DEFAULTS, Values, read_file
from ..places.layout import Layout
from ..places.layout_file import read_layout
from ..places.layout_nodes import Wiring
from .layout_picture import draw_layout

_PIECES = 6
"""Most pieces of a skin whose sizes are listed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    parser.add_argument("file", type=Path, help="layout file")
    parser.add_argument("--png", type=Path, metavar="OUT", help="also write a picture")
    text = "ROS 2 parameter file of the skin, to check the layout against"
    parser.add_argument("--params", type=Path, metavar="FILE", help=text)


def run(arguments: argparse.Namespace) -> int:
    """Check, describe and draw a layout file; returns the exit code."""
    if arguments.png and arguments.png.resolve() == arguments.file.resolve():
        raise LayoutError(f"{arguments.png}: the picture would overwrite the layout")
    values = read_file(arguments.params) if arguments.params else {}
    get: Values = {**DEFAULTS, **values}
    nodes = get["nodes"] if arguments.params else None
    layout = read_layout(arguments.file, Wiring(nodes, get["first_row"], get["skin"]))
    print(describe_layout(layout))
    if arguments.png:
        draw_layout(layout, arguments.png, get["first_row"])
        print(f"written: {arguments.png}")
    return 0


def describe_layout(layout: Layout) -> str:
    """Its size, areas and neighbours, a line for each thing that may be wrong."""
    real = layout.nodes > 0
    low_mm, high_mm = layout.positions_m[real].min(axis=0), layout.positions_m[real].max(axis=0)
    size_mm = " × ".join(f"{edge:.1f}" for edge in (high_mm - low_mm) * 1e3)
    own = np.arange(len(layout))[:, None]
    beside = (layout.neighbours != own).sum(axis=1)[real]
    area_mm2 = layout.areas_m2[real] * 1e6
    pitch = " × ".join(f"{edge * 1e3:.4g}" for edge in dict.fromkeys(layout.pitches_m))
    arranged = "irregular" if layout.irregular else f"{layout.rows} × {layout.columns}"
    lines = [
        f"{plain(layout.name)}: {arranged}, {np.count_nonzero(real)} taxels, {layout.wired} nodes",
        f"pitch {pitch} mm, centres within {size_mm} mm",
        f"area {area_mm2.sum() / 100:.4g} cm², {area_mm2.min():.4g}…{area_mm2.max():.4g} mm² each",
        f"neighbours of a taxel: {beside.min()}…{beside.max()}",
    ]
    for what, nodes in (("masked", layout.masked), ("without a place", layout.unplaced)):
        if nodes:
            lines.append(f"{what}: {listed(nodes, 'node')}")
    if alone := np.flatnonzero(real)[beside == 0].tolist():
        lines.append(f"taxels without a neighbour: {listed(alone)}")
    if (pieces := int(layout.pieces.max()) + 1) > 1:
        sizes = np.sort(np.bincount(layout.pieces[real]))[::-1]
        shown = ", ".join(map(str, sizes[:_PIECES])) + (" …" if pieces > _PIECES else "")
        lines.append(
            f"in {pieces} pieces of {shown} taxels, farther from each other than neighbours are: a "
            "contact across a gap counts once for each; if it is one skin, give pitch_mm"
        )
    return "\n".join(lines)
