# SPDX-License-Identifier: Apache-2.0

"""How the pictures of the pages look: 900 px wide, one palette, legible at half size.

Every picture has a white ground of its own, so that it reads on light and dark pages.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
from cycler import cycler
from matplotlib.figure import Figure
from PIL import Image

DPI = 100
WIDTH_PX = 900
COLOURS = 64
"""Colours that a picture is stored in; chosen: a third of the bytes, and all edges look alike."""
BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"
SKY, PINK, YELLOW = "#56B4E9", "#CC79A7", "#E69F00"
"""Okabe and Ito's palette, which people of every colour vision tell apart; that of all curves."""
CYCLE = BLUE, ORANGE, GREEN, PINK, SKY, YELLOW
BLACK, GREY, PALE = "#1a1a1a", "#8c8c8c", "#d9d9d9"
FALSE = "#c4001a"
"""Red, for what is false, and for nothing else."""
MARKERS = "osD^vP"
"""One for each colour of CYCLE, for whom colours are not enough."""

LOOK = {
    "font.size": 13,
    "axes.titlesize": 13,
    "axes.titlelocation": "left",
    "legend.fontsize": 12,
    "axes.prop_cycle": cycler(color=CYCLE),
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.3,
    "lines.linewidth": 2,
    "lines.markersize": 7,
    "legend.frameon": False,
    "axes.edgecolor": BLACK,
    "text.color": BLACK,
    "axes.labelcolor": BLACK,
}


def sheet(height_px: int) -> Figure:
    """Return an empty picture; what is drawn in this process has this look from then on."""
    mpl.rcParams.update(LOOK)
    return Figure(figsize=(WIDTH_PX / DPI, height_px / DPI), dpi=DPI, layout="constrained")


def save(figure: Figure, path: Path) -> None:
    """Write a picture as a PNG of few colours."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI, facecolor="white")
    shrink(path)


def shrink(path: Path) -> None:
    """Store a PNG in few colours."""
    with Image.open(path) as image:
        method, none = Image.Quantize.MAXCOVERAGE, Image.Dither.NONE  # rare colours stay
        few = image.convert("RGB").quantize(COLOURS, method, dither=none)
    few.save(path, optimize=True)
