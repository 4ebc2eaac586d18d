# SPDX-License-Identifier: Apache-2.0

"""Logs a patch to the Rerun viewer: surface, picture, contacts, curves and complaints.

Everything is logged at its stamp, on the timeline `stamp`, and frames at the time of their
digitizer, too, on `device_time`. Curves have every frame; surface, picture and arrows the
newest frame at each flush().
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import count
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from ..base.arrays import Floats, Floats32
from ..places.layout import Layout
from ..places.poses import Pose
from ..readings.status import is_certain
from .heatmap import GAMMA, colours, heatmap
from .live import OLD_S

STAMP, DEVICE_TIME = "stamp", "device_time"
SHOWN_S = 20.0
"""Time that curves show, s; chosen."""
HALF_LENGTH_N = 5.0
"""An arrow for this force is half as long as the longest, which is half as long as the skin.
Chosen: a firm press."""
PIXELS = 32
"""Pixels per pitch in the picture, at most; chosen."""
MARGIN = 0.2
"""Room beneath the picture for its scale, as a share of its height; chosen."""
EYE = (0.55, -1.05, 0.85)
"""Position of the eye relative to the middle of the skins, in units of their extent; chosen."""
BACKGROUND_RGB = (44, 50, 58)
"""Chosen lighter than an untouched skin."""
PATCH_RGB = (
    (80, 200, 255),
    (130, 220, 120),
    (235, 235, 235),
    (180, 140, 255),
    (255, 170, 200),
    (90, 140, 255),
    (200, 200, 90),
    (160, 160, 160),
)
"""Colours of curves and arrows, patch after patch; chosen off the scale of pressure."""


class Touches(NamedTuple):
    """The c contacts of a frame.

    ids: (c,), numbers that last as long as the contacts do. position_m, force_n: (c, 3), centres
    of pressure, m, and forces, N. lower_bound: (c,), whether forces are that.
    """

    ids: Sequence[int]
    position_m: Floats
    force_n: Floats
    lower_bound: Sequence[bool]


_NO_CONTACTS = Touches((), np.zeros((0, 3)), np.zeros((0, 3)), ())


class PatchScene:
    """Logs one patch under its path. index: number of the patch, which gives its colour.

    picture_px: height and width of its picture, once it has a layout.
    """

    def __init__(self, recording: rr.RecordingStream, path: str, index: int, max_pa: float) -> None:
        self.path = path
        self._rgb = PATCH_RGB[index % len(PATCH_RGB)]
        self._recording = recording
        self._max_pa = max_pa
        self.pose = Pose(np.eye(3), np.zeros(3))
        """The patch's pose in the frame it is shown in."""
        self._shown_place: NDArray[np.float64] | None = None
        self._layout: Layout | None = None
        self._pressure_pa: NDArray[np.float32] | None = None
        self._unsure: NDArray[np.bool_] | bool = False
        self._contacts: Touches | None = None
        self._now = (0, 0)
        self._heard_s = math.inf  # when the last frame came; infinite: it is not shown any more
        self._curves: dict[str, list[tuple[int, int, float]]] = defaultdict(list)
        self._slots: dict[int, int] = {}  # numbers of the present contacts' curves, by id

    def place(self, layout: Layout) -> None:
        """Take the geometry for the frames that follow."""
        self._layout, self._pressure_pa = layout, None
        self._extent_m = float(np.ptp(layout.positions_m, axis=0).max()) + layout.pitch_m
        corners_m = layout.squares_m[layout.nodes > 0].reshape(-1, 3)
        # Without normals there is no shading, which would change the colours of the scale.
        triangles = np.arange(len(corners_m)).reshape(-1, 3)
        surface = rr.Mesh3D(vertex_positions=corners_m, triangle_indices=triangles)
        self._recording.log(f"{self.path}/surface", surface, static=True)
        no_pressure_pa = np.zeros(len(layout), dtype=np.float32)
        self.picture_px = heatmap(no_pressure_pa, layout, self._max_pa, PIXELS).shape[:2]
        self._explain_picture()
        for entity, width in (("force", 2.5), ("peak", 1.5)):
            self._style(entity, self.path, width)

    @property
    def places_m(self) -> NDArray[np.float64]:
        """Return (t, 3) positions of its taxels in the frame it is shown in, m."""
        assert self._layout is not None
        return self.pose.apply(self._layout.positions_m.astype(np.float64))

    def take_frame(
        self, stamp_ns: int, device_us: int, pressure_pa: Floats32, status: NDArray[np.uint8]
    ) -> None:
        """Take a frame's pressures, (t,), Pa, and status; ignored if they do not fit the layout."""
        if self._layout is None or len(pressure_pa) != len(self._layout):
            return
        self._now = stamp_ns, device_us
        self._heard_s = time.monotonic()
        self._pressure_pa, self._unsure = pressure_pa, ~is_certain(status)
        self._extend("peak", self._now, float(np.fmax.reduce(self._pressure_pa)) * 1e-3)

    def take_contacts(self, stamp_ns: int, touches: Touches, total_n: float) -> None:
        """Take a frame's contacts, and the size of their resultant, N; NaN: unknown.

        A contact's curve has the least free number, so that there are no more curves than contacts
        at once.
        """
        if self._layout is None:
            return
        now = stamp_ns, self._now[1]
        self._contacts = touches
        self._extend("force", now, total_n)  # NaN makes a gap
        sizes_n = np.linalg.norm(touches.force_n, axis=1).tolist()
        present = dict(zip(touches.ids, sizes_n, strict=True))
        for ended in self._slots.keys() - present.keys():
            self._extend(f"force/contact_{self._slots.pop(ended)}", now, math.nan)
        taken = set(self._slots.values())
        free = (slot for slot in count(1) if slot not in taken)
        for contact, newtons in present.items():
            if contact not in self._slots:
                self._slots[contact] = slot = next(free)
                self._style(f"force/contact_{slot}", f"contact {slot}", 1.0)
            self._extend(f"force/contact_{self._slots[contact]}", now, newtons)

    def say(self, stamp_ns: int, text: str, level: str) -> None:
        """Log a line of text. level: Rerun's name of how bad it is."""
        self._recording.reset_time()
        self._recording.set_time(STAMP, timestamp=np.datetime64(stamp_ns, "ns"))
        self._recording.log(f"{self.path}/diagnostics", rr.TextLog(text, level=level))

    def flush(self) -> None:
        """Log what came since the last call; after OLD_S without a frame, that none is there."""
        if (silent_s := time.monotonic() - self._heard_s) > OLD_S:
            self._end(silent_s)
        for name, values in self._curves.items():
            stamps_ns, devices_us, value = zip(*values, strict=True)
            times = [
                rr.TimeColumn(STAMP, timestamp=np.array(stamps_ns, dtype="datetime64[ns]")),
                rr.TimeColumn(DEVICE_TIME, duration=np.array(devices_us, dtype="timedelta64[us]")),
            ]
            columns = rr.Scalars.columns(scalars=value)
            self._recording.send_columns(f"{self.path}/{name}", times, columns)
        self._curves.clear()
        if self._layout is None or self._pressure_pa is None:
            return
        stamp_ns, device_us = self._now
        self._recording.set_time(STAMP, timestamp=np.datetime64(stamp_ns, "ns"))
        self._recording.set_time(DEVICE_TIME, duration=np.timedelta64(device_us, "us"))
        place = np.column_stack([self.pose.rotation, self.pose.translation_m])
        if self._shown_place is None or not np.array_equal(place, self._shown_place):
            transform = rr.Transform3D(translation=place[:, 3], mat3x3=place[:, :3])
            self._recording.log(self.path, transform)
            self._shown_place = place
        paint = colours(self._pressure_pa, self._max_pa, self._unsure)[self._layout.nodes > 0]
        surface = rr.Mesh3D.from_fields(vertex_colors=np.repeat(paint, 6, axis=0))
        self._recording.log(f"{self.path}/surface", surface)
        picture = heatmap(self._pressure_pa, self._layout, self._max_pa, PIXELS, self._unsure)
        self._recording.log(f"{self.path}/heatmap", rr.Image(picture))
        if self._contacts is not None:
            self._recording.log(f"{self.path}/contacts", self._arrows(self._contacts))
        self._pressure_pa = self._contacts = None

    def _explain_picture(self) -> None:
        """Log the picture's scale, beneath it, and the skin's axes, at its lower left corner."""
        height, width = self.picture_px
        share = np.linspace(0.0, 1.0, 5)
        pressure_pa = (share ** (1 / GAMMA) * self._max_pa).astype(np.float32)
        places = np.column_stack(
            [width * (0.1 + 0.8 * share), np.full(5, (1 + MARGIN / 3) * height)]
        )
        labels = [f"{pressure / 1e3:.3g}" for pressure in pressure_pa.tolist()]
        labels[-1] += " kPa"
        paint, radius = colours(pressure_pa, self._max_pa), MARGIN * height / 8
        scale = rr.Points2D(places, colors=paint, radii=radius, labels=labels, show_labels=True)
        self._recording.log(f"{self.path}/heatmap/scale", scale, static=True)
        vectors = [[MARGIN * height, 0.0], [0.0, -MARGIN * height]]
        axes = rr.Arrows2D(vectors=vectors, origins=[[0.0, height]] * 2, labels=["x", "y"])
        self._recording.log(f"{self.path}/heatmap/axes", axes, static=True)

    def _end(self, silent_s: float) -> None:
        """Let all taxels be without a reading, contacts be gone and curves break."""
        if self._layout is None:
            return
        stamp_ns, device_us = self._now
        self._now = stamp_ns + round(silent_s * 1e9), device_us + round(silent_s * 1e6)
        self._pressure_pa = np.full(len(self._layout), np.nan, dtype=np.float32)
        self._unsure = False
        self._contacts = _NO_CONTACTS
        for curve in ("peak", "force", *(f"force/contact_{slot}" for slot in self._slots.values())):
            self._extend(curve, self._now, math.nan)
        self._slots.clear()
        self._heard_s = math.inf

    def _arrows(self, touches: Touches) -> rr.Arrows3D:
        _, position_m, force_n, lower_bound = touches
        size_n = np.linalg.norm(force_n, axis=1)
        vectors_m = force_n * (self._extent_m / 2 / (size_n + HALF_LENGTH_N))[:, None]
        return rr.Arrows3D(
            origins=position_m - vectors_m,  # outside the skin: forces point into it
            vectors=vectors_m,
            radii=self._extent_m / 80,
            colors=self._rgb,
            labels=[
                f"{'> ' if at_least else ''}{newtons:.1f} N"
                for newtons, at_least in zip(size_n, lower_bound, strict=True)
            ],
            show_labels=True,
        )

    def _style(self, curve: str, name: str, width: float) -> None:
        style = rr.SeriesLines(names=name, widths=width, colors=self._rgb)
        self._recording.log(f"{self.path}/{curve}", style, static=True)

    def _extend(self, curve: str, now: tuple[int, int], value: float) -> None:
        self._curves[curve].append((*now, value))


def blueprint(scenes: Mapping[PatchScene, str]) -> rrb.Blueprint:
    """Arrange the viewer. scenes: placed patches, each with the frame it is shown in."""
    frames = list(dict.fromkeys(scenes.values()))
    spaces = [_space(frame, [s for s in scenes if scenes[s] == frame]) for frame in frames]
    past = rrb.VisibleTimeRange(
        STAMP,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-SHOWN_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    curves = [
        rrb.TimeSeriesView(
            name=name,
            contents=[f"/{scene.path}/{entity}" for scene in scenes],
            time_ranges=past,
            plot_legend=rrb.PlotLegend(visible=legend),
        )
        for name, entity, legend in (("force, N", "force/**", False), ("peak, kPa", "peak", True))
    ]
    log = rrb.TextLogView(
        name="diagnostics", contents=[f"/{scene.path}/diagnostics" for scene in scenes]
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Grid(*spaces),
            rrb.Vertical(rrb.Grid(*map(_picture, scenes)), *curves, log, row_shares=[4, 2, 2, 2]),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline=STAMP, state="collapsed", play_state="following"),
        collapse_panels=True,
    )


def _space(frame: str, scenes: Sequence[PatchScene]) -> rrb.Spatial3DView:
    places_m = np.concatenate([scene.places_m for scene in scenes])
    low, high = places_m.min(axis=0), places_m.max(axis=0)
    centre_m, extent_m = (low + high) / 2, float((high - low).max())
    return rrb.Spatial3DView(
        name=frame,
        contents=[f"/{s.path}/{entity}" for s in scenes for entity in ("surface", "contacts")],
        background=BACKGROUND_RGB,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            position=centre_m + extent_m * np.array(EYE), look_target=centre_m, eye_up=[0, 0, 1]
        ),
    )


def _picture(scene: PatchScene) -> rrb.Spatial2DView:
    height, width = scene.picture_px
    return rrb.Spatial2DView(
        origin=f"/{scene.path}/heatmap",
        name=scene.path,
        background=BACKGROUND_RGB,
        visual_bounds=rrb.VisualBounds2D(x_range=[0, width], y_range=[0, (1 + MARGIN) * height]),
    )
