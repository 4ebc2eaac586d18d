# SPDX-License-Identifier: Apache-2.0

"""Figures for papers: every taxel over time, and the force below."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..base.arrays import Floats
from ..base.errors import needed_for
from ..base.whole_file import replacing
from ..readings.taxels import Coverage
from ..views.heatmap import GAMMA, NO_READING_RGB, SCALE_RGB
from ..views.history import force_n
from .samples import PatchInfo
from .tables import Rows

FIGURES = (".pdf", ".svg", ".png")
"""Ends of the names of figures."""
MOST_COLUMNS = 1000
"""Columns of the map, each of two frames at least; chosen."""
GAP = 3.0
"""Usual steps between two frames after which the curve of the force is interrupted; chosen."""


def write_figure(
    path: Path,
    frames: Rows,
    patch: PatchInfo,
    about: Mapping[str, Any],
    max_pa: float | None = None,
) -> None:
    """Draw pressures, grey where not known, and force, dotted where it is a lower bound.

    max_pa: top of the colours; None: the peak. See formats.TableWriter.
    """
    with needed_for("a figure", "matplotlib"):
        from matplotlib.colors import ListedColormap, PowerNorm
        from matplotlib.figure import Figure
    read = [frame for _, frame in frames]
    t_s = np.array([frame.device_time_s for frame in read])
    t_s -= t_s[0]
    seen = [(frame.pressure_pa, frame.status) for frame in read]
    pressure_kpa = np.array([pressure_pa for pressure_pa, _ in seen]) / np.float32(1e3)
    force = np.array([force_n(*one, patch.areas_m2) for one in seen])
    whole = np.array([Coverage.of(*one).is_whole for one in seen])
    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    over_time, curve = figure.subplots(2, 1, sharex=True)
    grey = np.array(NO_READING_RGB) / 255
    image = over_time.imshow(
        binned(t_s, pressure_kpa, int(np.clip(len(t_s) // 2, 1, MOST_COLUMNS))).T,
        ListedColormap(SCALE_RGB[:256] / 255).with_extremes(bad=grey),
        PowerNorm(GAMMA, 0, (max_pa or 0.0) / 1e3 or float(np.nanmax(pressure_kpa, initial=1.0))),
        aspect="auto",
        interpolation="none",
        extent=(0, float(t_s[-1]) or 1.0, len(patch) - 0.5, -0.5),
    )
    figure.colorbar(image, ax=over_time, label="pressure, kPa")
    over_time.set(ylabel="taxel")
    for parts, style, label in ((whole, "k-", None), (~whole, "k:", "at least")):
        if np.isfinite(shown := np.where(parts, force, np.nan)).any():
            curve.plot(*interrupted(t_s, shown), style, linewidth=1, label=label)
    if curve.get_legend_handles_labels()[1]:
        curve.legend()
    curve.set(xlabel="time, s", ylabel="force, N")
    with replacing(path) as file:
        figure.savefig(file, format=path.suffix[1:], dpi=200)


def binned(t_s: Floats, values: Any, columns: int) -> Any:
    """Return the greatest values in equal parts of the time, (columns, t); NaN: none is known."""
    column = np.minimum((t_s / (t_s[-1] or 1.0) * columns).astype(int), columns - 1)
    greatest = np.full((columns, values.shape[1]), np.nan, np.float32)
    np.fmax.at(greatest, column, values)
    return greatest


def interrupted(t_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Put a NaN where frames are missing, so that no line spans what is not known."""
    steps_s = np.diff(t_s)
    usual_s = np.median(steps_s) if len(steps_s) else 0.0
    gaps = np.flatnonzero(steps_s > GAP * usual_s) + 1
    return np.insert(t_s, gaps, np.nan), np.insert(values, gaps, np.nan)
