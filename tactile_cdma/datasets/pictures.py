# SPDX-License-Identifier: Apache-2.0

"""Frames as pictures: films of the heatmap, and figures of every taxel and the force over time."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..base.arrays import Floats, Uint8s
from ..base.errors import needed_for
from ..base.whole_file import replacing
from ..places.layout import Layout
from ..readings.status import is_certain
from ..readings.taxels import Coverage
from ..views.heatmap import GAMMA, NO_READING_RGB, SCALE_RGB, heatmap
from ..views.live import force_n
from .alignment import STALE_S
from .samples import PatchInfo, SkinFrame
from .tables import Rows

PICTURES_HZ = {".mp4": 30, ".gif": 20}
"""Pictures per s by the end of a file's name; chosen: a GIF counts in steps of 10 ms."""
PAUSE_S = 2.0
"""s that are shown of a longer time without frames; chosen: long enough to see that all is grey."""
EDGE_PX, CAPTION_PX = 480, 20


def write_video(
    path: Path, frames: Rows, patch: PatchInfo, about: Mapping[str, Any], max_pa: float = 140e3
) -> None:
    """Write a film in real time, of whose frames the newest is shown; see formats.TableWriter.

    A taxel without a reading is grey: all are, once the newest frame is older than STALE_S.
    """
    with needed_for("a video", "PIL", "pillow"):
        import PIL.Image
    rate_hz, layout = PICTURES_HZ[path.suffix], patch.layout
    shown = _at_rate((frame for _, frame in frames), rate_hz)
    pictures = (_picture(frame, t_s, layout, patch, max_pa) for t_s, frame in shown)
    with replacing(path) as file:
        if path.suffix == ".gif":
            first, *others = map(PIL.Image.fromarray, pictures)
            first.save(file, "GIF", save_all=True, append_images=others, duration=1000 // rate_hz)
        else:
            _write_mp4(file, pictures, rate_hz)


def _at_rate(frames: Iterator[SkinFrame], rate_hz: float) -> Iterator[tuple[float, SkinFrame]]:
    """Yield what is known at the times of the pictures, s on the digitizer's clock."""
    last = next(frames)
    tick_s, step_s = last.device_time_s, 1 / rate_hz
    unread = np.full_like(last.pressure_pa, np.nan)
    for frame in chain(frames, [None]):
        since_s = last.device_time_s
        until_s = since_s + step_s if frame is None else frame.device_time_s
        while tick_s < min(until_s, since_s + PAUSE_S):
            is_old = tick_s - since_s > STALE_S
            yield tick_s, replace(last, pressure_pa=unread) if is_old else last
            tick_s += step_s
        if frame is not None:
            last = frame
            if not 0 <= tick_s - last.device_time_s < step_s:  # after a pause, or a restart
                tick_s = last.device_time_s


def _picture(
    frame: SkinFrame, t_s: float, layout: Layout, patch: PatchInfo, max_pa: float
) -> Uint8s:
    """Draw a frame and its caption, (height, width, 3), of even size as films want it."""
    from PIL import Image, ImageDraw

    cell_m = np.full(2, layout.cell_m) if layout.irregular else np.flip(layout.pitches_m)
    pixels = int(EDGE_PX * layout.pitch_m / np.multiply(layout.raster.shape, cell_m).max())
    unsure = ~is_certain(frame.status)
    skin = heatmap(frame.pressure_pa, layout, max_pa, max(1, pixels), unsure)
    height, width = skin.shape[:2]
    size = max(width, EDGE_PX // 2), height + CAPTION_PX
    image = Image.new("RGB", [math.ceil(edge / 2) * 2 for edge in size])
    image.paste(Image.fromarray(skin))
    said = frame.pressure_pa, frame.status
    bound = "" if Coverage.of(*said).is_whole else ">"
    force = f"{bound}{force_n(*said, patch.areas_m2):.2f}".replace(">nan", "--")
    text = f"{t_s:.2f} s   force {force} N   0…{max_pa / 1e3:g} kPa"
    ImageDraw.Draw(image).text((4, height + 4), text)
    return np.asarray(image)


def _write_mp4(file: BinaryIO, pictures: Iterator[Uint8s], rate_hz: int) -> None:
    with needed_for("*.mp4", "av"):
        import av
    with av.open(file, "w", format="mp4") as film:
        stream: Any = None
        for picture in pictures:
            if stream is None:
                stream = film.add_stream("libx264", rate=rate_hz)
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
            film.mux(stream.encode(av.VideoFrame.from_ndarray(picture)))
        film.mux(stream.encode())


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
