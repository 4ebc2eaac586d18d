"""A picture of a layout: what to compare with the skin on the bench."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .errors import LayoutError
from .layout import Layout

_INCHES_PER_PITCH = 0.6
_LEAST_INCHES, _MOST_INCHES = 3.0, 40.0
_MARGIN_INCHES = 1.2
_DPI = 100
_GAP = 0.92
"""Edge of a drawn taxel over that of its area, so that neighbours stand apart."""
_LABELLED_INCHES = 0.3
"""Taxels smaller than this in the picture have no numbers."""
_ARROWS = 400
_MASKED_COLOUR, _EMPTY_COLOUR = (0.85, 0.3, 0.25), (1.0, 1.0, 1.0)


def draw_layout(layout: Layout, path: Path, first_row: int) -> None:
    """Write a PNG: the unrolled skin to scale, and its shape in space where it is not flat.

    Every taxel shows its index, its node and its node's code row; colours are its normal's
    direction, (n + 1)/2 as red, green and blue. Raises LayoutError where the file cannot be
    written.
    """
    from matplotlib.figure import Figure  # slow to load, and needed here only

    size, inches_per_m = _size_inches(layout)
    flat = bool(np.ptp(layout.positions_m[:, 2]) < 1e-6 and np.ptp(layout.normals) <= 1)
    panels = 1 if flat else 2
    figure = Figure(figsize=(size[0] * panels, size[1]), dpi=_DPI, layout="constrained")
    _draw_flat(figure.add_subplot(1, panels, 1), layout, inches_per_m, first_row)
    if not flat:
        _draw_shape(figure.add_subplot(1, panels, 2, projection="3d"), layout)
    figure.suptitle(
        f"{layout.name}: {np.count_nonzero(layout.nodes)} taxels, pitch "
        f"{layout.pitch_m * 1e3:.3g} mm, as seen from outside"
    )
    try:
        figure.savefig(path, format="png", metadata={"Software": None})
    except OSError as error:
        raise LayoutError(f"{path}: {error.strerror}") from None


def _size_inches(layout: Layout) -> tuple[tuple[float, float], float]:
    """Width and height of a panel, and its scale in inches per m."""
    extent_m = np.ptp(layout.flat_m, axis=0) + layout.pitch_m
    scale = min(_INCHES_PER_PITCH / layout.pitch_m, _MOST_INCHES / float(extent_m.max()))
    width, height = np.maximum(extent_m * scale, _LEAST_INCHES) + _MARGIN_INCHES
    return (float(width), float(height)), scale


def _colours(layout: Layout) -> Any:
    colours = (layout.normals + 1) / 2
    colours[np.isin(layout.nodes, layout.masked)] = _MASKED_COLOUR
    colours[layout.nodes == 0] = _EMPTY_COLOUR
    return colours


def _draw_flat(axes: Any, layout: Layout, inches_per_m: float, first_row: int) -> None:
    from matplotlib.collections import PolyCollection

    edge_mm = np.sqrt(layout.areas_m2) * 1e3 * _GAP
    flat_mm = layout.flat_m * 1e3
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    squares = flat_mm[:, None] + corners * edge_mm[:, None, None]
    axes.add_collection(
        PolyCollection(list(squares), facecolors=_colours(layout), edgecolors="0.5", linewidths=0.5)
    )
    half_mm = layout.pitch_m * 500
    axes.set_xlim(flat_mm[:, 0].min() - half_mm, flat_mm[:, 0].max() + half_mm)
    axes.set_ylim(flat_mm[:, 1].max() + half_mm, flat_mm[:, 1].min() - half_mm)  # row 0 on top
    axes.set_aspect("equal")
    axes.set_xlabel("x on the surface, mm")
    axes.set_ylabel("y on the surface, mm")
    axes.set_title("taxel, node, code row", fontsize="small")
    if inches_per_m * layout.pitch_m < _LABELLED_INCHES:
        axes.set_title("too many taxels for numbers", fontsize="small")
        return
    for taxel in np.flatnonzero(layout.nodes):
        x, y = flat_mm[taxel].tolist()
        node = int(layout.nodes[taxel])
        off = " off" if node in layout.masked else ""
        axes.annotate(str(taxel), (x, y), ha="center", va="bottom", fontsize=9, weight="bold")
        text = f"n{node} r{node + first_row - 1}{off}"
        axes.annotate(text, (x, y), ha="center", va="top", fontsize=5.5)


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
    axes.set_aspect("equal")
    axes.set_xlabel("x, mm")
    axes.set_ylabel("y, mm")
    axes.set_zlabel("z, mm")
    axes.set_title("places and normals", fontsize="small")
