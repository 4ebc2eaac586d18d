# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma layout`: checks a layout file, describes and draws it."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import LayoutError, needed_for
from ..base.named_file import naming
from ..base.text import listed
from ..config.parameters import DEFAULTS, Values, read_file
from ..places.layout import Layout
from ..places.layout_file import read_layout
from ..places.layout_nodes import Wiring
from ..places.position_table import write_positions

_PIECES = 6
"""Most pieces of a skin whose sizes are listed."""
_INCHES_PER_PITCH = 0.6
"""Scale of the picture, as long as it is no larger than _MOST_INCHES. All lengths in the picture
are chosen by eye."""
_MOST_INCHES = 40.0
_SHAPE_INCHES, _HEADING_INCHES = 4.5, 3.0
_LEFT_INCHES, _RIGHT_INCHES, _BOTTOM_INCHES, _TOP_INCHES = 0.8, 0.4, 0.6, 0.8
_DPI = 100
_GAP = 0.92
"""Edge of a drawn taxel over that of what it covers, so that neighbours stand apart."""
_LABELLED_INCHES = 0.3
"""Taxels smaller than this in the picture have no numbers."""
_ARROWS = 400
"""Normals that are drawn, at most."""
_MASKED_COLOUR, _EMPTY_COLOUR = (0.85, 0.3, 0.25), (1.0, 1.0, 1.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    parser.add_argument("file", type=Path, help="layout file")
    text = "also write the taxels' places as a table, which is a layout, too; without masks"
    parser.add_argument("--table", type=Path, metavar="OUT.csv", help=text)
    parser.add_argument("--png", type=Path, metavar="OUT", help="also write a picture")
    text = "ROS 2 parameter file of the skin, to check the layout against"
    parser.add_argument("--params", type=Path, metavar="FILE", help=text)


def run(arguments: argparse.Namespace) -> int:
    """Check, describe and draw a layout file; returns the exit code."""
    for output in filter(None, (arguments.png, arguments.table)):
        if output.resolve() == arguments.file.resolve():
            raise LayoutError(f"{output}: the picture or table would overwrite the layout")
    values = read_file(arguments.params) if arguments.params else {}
    get: Values = {**DEFAULTS, **values}
    nodes = get["nodes"] if arguments.params else None
    layout = read_layout(arguments.file, Wiring(nodes, get["first_row"], get["skin"]))
    print(describe_layout(layout))
    if arguments.png:
        draw_layout(layout, arguments.png, get["first_row"])
        print(f"written: {arguments.png}")
    if arguments.table:
        with naming(arguments.table, LayoutError):
            write_positions(arguments.table, layout)
        print(f"written: {arguments.table}")
    return 0


def describe_layout(layout: Layout) -> str:
    """Describe a layout's size, areas and neighbours, with a line for whatever may be wrong."""
    real = layout.nodes > 0
    low_mm, high_mm = layout.positions_m[real].min(axis=0), layout.positions_m[real].max(axis=0)
    size_mm = " × ".join(f"{edge:.1f}" for edge in (high_mm - low_mm) * 1e3)
    own = np.arange(len(layout))[:, None]
    beside = (layout.neighbours != own).sum(axis=1)[real]
    area_mm2 = layout.areas_m2[real] * 1e6
    pitch = " × ".join(f"{edge * 1e3:.4g}" for edge in dict.fromkeys(layout.pitches_m))
    arranged = "irregular" if layout.irregular else f"{layout.rows} × {layout.columns}"
    lines = [
        f"{layout.name}: {arranged}, {np.count_nonzero(real)} taxels, {layout.wired} nodes",
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


def draw_layout(layout: Layout, path: Path, first_row: int) -> None:
    """Write a PNG: the unrolled skin to scale, and its shape in space where it is not flat.

    Seen from outside, as it lies on the bench: x to the right, y up. Every taxel shows its index,
    its node and its node's code row; colours are its normal's direction, (n + 1)/2 as red, green
    and blue. Raises LayoutError where the file cannot be written.
    """
    with needed_for("a picture", "matplotlib"):
        from matplotlib.figure import Figure

    extent_m = np.ptp(layout.flat_m, axis=0) + max(layout.pitches_m)
    inches_per_m = min(_INCHES_PER_PITCH / layout.pitch_m, _MOST_INCHES / float(extent_m.max()))
    flat_width, flat_height = (extent_m * inches_per_m).tolist()
    bent = bool(np.ptp(layout.positions_m[:, 2]) > 1e-6 or (layout.normals[:, 2] < 1).any())
    body_width = max(flat_width, _HEADING_INCHES)
    width = _LEFT_INCHES + body_width + _RIGHT_INCHES + bent * _SHAPE_INCHES
    height = _BOTTOM_INCHES + max(flat_height, bent * _SHAPE_INCHES) + _TOP_INCHES
    figure = Figure(figsize=(width, height), dpi=_DPI)

    def axes(left: float, across: float, down: float, projection: str | None = None) -> Any:
        bottom = height - _TOP_INCHES - down
        share = (left / width, bottom / height, across / width, down / height)
        return figure.add_axes(share, projection=projection)

    labelled = inches_per_m * layout.pitch_m >= _LABELLED_INCHES
    _draw_flat(axes(_LEFT_INCHES, flat_width, flat_height), layout, labelled, first_row)
    if bent:
        left = _LEFT_INCHES + body_width + _RIGHT_INCHES / 2
        _draw_shape(axes(left, _SHAPE_INCHES, _SHAPE_INCHES, "3d"), layout)
    heading = f"{layout.name}, {layout.pitch_m * 1e3:.3g} mm pitch, seen from outside"
    numbers = "taxel, n: node, r: code row" if labelled else "too many taxels for numbers"
    figure.text(0.1 / width, 1 - 0.1 / height, f"{heading}\n{numbers}", va="top")
    with naming(path, LayoutError):
        figure.savefig(path, format="png", metadata={"Software": None})


def _colours(layout: Layout) -> Any:
    colours = (layout.normals + 1) / 2
    colours[np.isin(layout.nodes, layout.masked)] = _MASKED_COLOUR
    colours[layout.nodes == 0] = _EMPTY_COLOUR
    return colours


def _draw_flat(axes: Any, layout: Layout, labelled: bool, first_row: int) -> None:
    from matplotlib.collections import PolyCollection

    flat_mm = layout.flat_m * 1e3
    covered = [
        place_mm + outline_m * 1e3 * _GAP
        for place_mm, outline_m in zip(flat_mm, layout.outlines_m, strict=True)
    ]
    axes.add_collection(
        PolyCollection(covered, facecolors=_colours(layout), edgecolors="0.5", linewidths=0.5)
    )
    half_mm = max(layout.pitches_m) * 500
    low_mm, high_mm = flat_mm.min(axis=0) - half_mm, flat_mm.max(axis=0) + half_mm
    axes.set(xlim=(low_mm[0], high_mm[0]), ylim=(low_mm[1], high_mm[1]))
    axes.set(xlabel="x along the surface, mm", ylabel="y along the surface, mm")
    for taxel in np.flatnonzero(layout.nodes) if labelled else ():
        node, place = int(layout.nodes[taxel]), flat_mm[taxel]
        out = " out" if node in layout.masked else ""
        text = f"{taxel}{out}\nn{node} r{node + first_row - 1}"
        axes.text(*place, text, ha="center", va="center", fontsize=6.5)


def _draw_shape(axes: Any, layout: Layout) -> None:
    real = np.flatnonzero(layout.nodes)
    places_mm = layout.positions_m[real] * 1e3
    axes.scatter(*places_mm.T, c=_colours(layout)[real], edgecolors="0.4", depthshade=False)
    shown = real[:: -(-len(real) // _ARROWS)]
    axes.quiver(
        *(layout.positions_m[shown] * 1e3).T,
        *layout.normals[shown].T,
        length=layout.pitch_m * 600,
        color="0.4",
        linewidth=0.7,
    )
    limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
    axes.set_box_aspect(np.ptp(limits, axis=1), zoom=0.8)  # to scale
    axes.locator_params(axis="z", nbins=4)
    axes.set(xlabel="x, mm", ylabel="y, mm", zlabel="z, mm")
