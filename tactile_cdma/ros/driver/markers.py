# SPDX-License-Identifier: Apache-2.0

"""A skin and its contacts as markers: coloured squares, arrows, and forces as text."""

from __future__ import annotations

from collections.abc import Sequence
from struct import Struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from visualization_msgs.msg import Marker

from ...base.arrays import Floats, Floats32
from ...places.layout import Layout
from ...places.mesh import CORNERS, taxel_squares
from ...readings.contact import Contacts
from ...readings.taxels import Coverage
from ...views.heatmap import SCALE_RGB, scale_steps
from ..common.cdr import CdrWriter, Heading

SURFACE, ARROWS, TEXTS, BLIND = "skin", "contacts", "forces", "blind"
"""Namespaces of markers; rviz can hide each."""
MOST_SQUARES = 256
"""Taxels up to which squares are drawn, 240 bytes each; chosen: larger skins have ~/points, which
take a sixth of that."""
ARROW_M_PER_N = 0.005
"""Length of an arrow per force, m/N; it ends at the centre of pressure. Chosen:
1 N is a little shorter than the default pitch."""
ARROW_PITCHES = 0.25, 0.5
"""Diameters of shaft and head in pitches, chosen; the head's length is left to the viewer."""
CONTACT_RGBA = 0.3, 0.85, 1.0, 1.0
"""Chosen off the pressure scale, so that arrows stand out."""
_SCALE_RGBA = np.hstack([SCALE_RGB / 255, np.ones((len(SCALE_RGB), 1))]).astype("<f4")
_NUMBERS, _SHAPE = Struct("<3i"), Struct("<10d4fiI?")
_NOWHERE, _UPRIGHT = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
_NO_POINTS, _NO_COLOURS = np.zeros((0, 3)), _SCALE_RGBA[:0]


class SkinMarkers:
    """Builds the markers of one skin."""

    def __init__(self, layout: Layout, most_squares: int = MOST_SQUARES) -> None:
        self._shown: set[int] = set()
        shaft, head = (pitches * layout.pitch_m for pitches in ARROW_PITCHES)
        self._arrow_m, self._letter_m = (shaft, head, 0.0), layout.pitch_m
        from_middle_m = layout.positions_m - layout.positions_m.mean(axis=0)
        middle = np.linalg.norm(from_middle_m, axis=1).argmin()
        self._above_m = layout.positions_m[middle] + layout.pitch_m * layout.normals[middle]
        self._was_certain = True
        self._placed = np.flatnonzero(layout.nodes)
        if len(self._placed) > most_squares:
            self._placed = self._placed[:0]
        self._corners_m = taxel_squares(layout)[self._placed].reshape(-1, 3).astype("<f8")

    def markers(
        self,
        pressure_pa: NDArray[np.float32],
        max_pa: float,
        contacts: Contacts,
        heading: Heading,
        lifetime_s: float,
    ) -> bytes:
        """The message MarkerArray of a frame; markers of contacts that ended are deleted.

        A text says how many taxels in service have no reading or a doubtful one, if any: nothing
        drawn means that nothing touches only without it.

        pressure_pa: (t,) float32, Pa; colours are on the scale 0…max_pa. lifetime_s: time after
        which markers vanish that no message renews, as when the skin is no longer read.
        """
        markers = [self._surface(pressure_pa, max_pa)] if len(self._placed) else []
        ids = contacts.ids.tolist()
        markers += [
            _Marker(namespace, gone, is_deleted=True)
            for gone in self._shown.difference(ids)
            for namespace in (ARROWS, TEXTS)
        ]
        self._shown = set(ids)
        heads_m, forces_n = contacts.position_m, contacts.force_n
        tails_m = heads_m - ARROW_M_PER_N * forces_n  # outside: forces point into the skin
        for i, number in enumerate(ids):
            arrow_m = np.stack([tails_m[i], heads_m[i]])
            markers.append(_Marker(ARROWS, number, Marker.ARROW, self._arrow_m, points_m=arrow_m))
            at_least = "> " if contacts.lower_bound[i] else ""
            text = f"{at_least}{np.linalg.norm(forces_n[i]):.3g} N"
            markers.append(self._text(TEXTS, number, tails_m[i], text))
        if not contacts.coverage.is_certain:
            markers.append(self._text(BLIND, 0, self._above_m, _blind(contacts.coverage)))
        elif not self._was_certain:
            markers.append(_Marker(BLIND, 0, is_deleted=True))
        self._was_certain = contacts.coverage.is_certain
        return _message(markers, heading, lifetime_s)

    def _surface(self, pressure_pa: NDArray[np.float32], max_pa: float) -> _Marker:
        steps = scale_steps(pressure_pa[self._placed], max_pa).repeat(len(CORNERS))
        return _Marker(
            *(SURFACE, 0, Marker.TRIANGLE_LIST, (1.0, 1.0, 1.0)),
            points_m=self._corners_m,
            rgba=_SCALE_RGBA[steps],
        )

    def _text(self, namespace: str, number: int, place_m: Floats, text: str) -> _Marker:
        kind, size_m = Marker.TEXT_VIEW_FACING, (0.0, 0.0, self._letter_m)
        return _Marker(namespace, number, kind, size_m, place_m.tolist(), text=text)


def _blind(coverage: Coverage) -> str:
    """Says how much is not known."""
    unread, doubtful = coverage.in_service - coverage.valid, coverage.doubtful
    lacks = [f"no reading: {unread}"] * bool(unread) + [f"doubtful: {doubtful}"] * bool(doubtful)
    return f"{', '.join(lacks)} of {coverage.in_service} taxels"


class _Marker(NamedTuple):
    """What differs between our markers; of those that are deleted only the first two count.

    points_m: (m, 3) float64. rgba: (m, 4) float32, of every point.
    """

    namespace: str
    number: int
    kind: int = Marker.ARROW
    scale_m: Sequence[float] = _NOWHERE
    place_m: Sequence[float] = _NOWHERE
    points_m: Floats = _NO_POINTS
    rgba: Floats32 = _NO_COLOURS
    text: str = ""
    is_deleted: bool = False


def _message(markers: Sequence[_Marker], heading: Heading, lifetime_s: float) -> bytes:
    """The message MarkerArray."""
    header = heading.fields
    lifetime = divmod(round(lifetime_s * 1e9), 1_000_000_000)
    writer = CdrWriter()
    writer.count(len(markers))
    for marker in markers:
        writer.add(header, 4)
        writer.text(marker.namespace)
        action, look = Marker.ADD, (*CONTACT_RGBA, *lifetime)
        if marker.is_deleted:
            action, look = Marker.DELETE, (0.0, 0.0, 0.0, 0.0, 0, 0)
        writer.add(_NUMBERS.pack(marker.number, marker.kind, action), 4)
        writer.add(_SHAPE.pack(*marker.place_m, *_UPRIGHT, *marker.scale_m, *look, False), 8)
        writer.array(marker.points_m)
        writer.array(marker.rgba)
        writer.add(_NO_TEXTURE, 4)
        writer.text(marker.text)
        writer.add(_NO_MESH, 4)
    return writer.message


def _no_texture() -> bytes:
    """Empty texture_resource, texture and uv_coordinates of a marker."""
    writer = CdrWriter()
    writer.text("")
    writer.header(Heading(0, ""))
    writer.text("")
    writer.count(0)
    writer.count(0)
    return writer.fields


def _no_mesh() -> bytes:
    """Empty mesh_resource and mesh_file; mesh_use_embedded_materials is False."""
    writer = CdrWriter()
    writer.text("")
    writer.text("")
    writer.count(0)
    writer.add(b"\0")
    return writer.fields


_NO_TEXTURE, _NO_MESH = _no_texture(), _no_mesh()
