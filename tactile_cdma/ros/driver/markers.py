# SPDX-License-Identifier: Apache-2.0

"""A skin and its contacts as markers: coloured squares, arrows, and forces as text."""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import Pose, Vector3
from numpy.typing import NDArray
from rclpy.duration import Duration
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from ...places.layout import Layout
from ...places.mesh import CORNERS, taxel_squares
from ...readings.contact import Contacts
from ...readings.taxels import Coverage
from ...views.heatmap import SCALE_RGB, scale_steps
from ..common.convert import point

SURFACE, ARROWS, TEXTS, BLIND = "skin", "contacts", "forces", "blind"
"""Namespaces of markers; rviz can hide each."""
MOST_SQUARES = 256
"""Taxels up to which squares are drawn. rclpy converts messages number by number, 20 µs for a
square, while the decoder waits (`make bench-pictures`): larger skins have ~/points."""
ARROW_M_PER_N = 0.005
"""Length of an arrow per force, m/N; it ends at the centre of pressure. Chosen:
1 N is a little shorter than the default pitch."""
ARROW_PITCHES = 0.25, 0.5
"""Diameters of shaft and head in pitches, chosen; the head's length is left to the viewer."""
CONTACT_COLOUR = ColorRGBA(r=0.3, g=0.85, b=1.0, a=1.0)
"""Chosen off the pressure scale, so that arrows stand out."""
_COLOURS = [ColorRGBA(r=r, g=g, b=b, a=1.0) for r, g, b in (SCALE_RGB / 255).tolist()]


class SkinMarkers:
    """Builds the markers of one skin; the messages share what never changes."""

    def __init__(self, layout: Layout, most_squares: int = MOST_SQUARES) -> None:
        self._shown: set[int] = set()
        shaft, head = (pitches * layout.pitch_m for pitches in ARROW_PITCHES)
        self._arrow_scale = Vector3(x=shaft, y=head)
        self._text_scale = Vector3(z=layout.pitch_m)
        from_middle_m = layout.positions_m - layout.positions_m.mean(axis=0)
        middle = np.linalg.norm(from_middle_m, axis=1).argmin()
        above_m = layout.positions_m[middle] + layout.pitch_m * layout.normals[middle]
        self._above = Pose(position=point(above_m))
        self._was_certain = True
        self._placed = np.flatnonzero(layout.nodes)
        if len(self._placed) > most_squares:
            self._placed = self._placed[:0]
        corners_m = taxel_squares(layout)[self._placed].reshape(-1, 3)
        self._corners = [point(corner_m) for corner_m in corners_m]

    def markers(
        self,
        pressure_pa: NDArray[np.float32],
        max_pa: float,
        contacts: Contacts,
        header: Header,
        lifetime_s: float,
    ) -> MarkerArray:
        """The markers of a frame; those of contacts that ended since the last one are deleted.

        A text says how many taxels in service have no reading or a doubtful one, if any: nothing
        drawn means that nothing touches only without it.

        pressure_pa: (t,) float32, Pa; colours are on the scale 0…max_pa. lifetime_s: time after
        which markers vanish that no message renews, as when the skin is no longer read.
        """
        lifetime = Duration(seconds=lifetime_s).to_msg()
        common = {"header": header, "lifetime": lifetime, "color": CONTACT_COLOUR}
        markers = [self._surface(pressure_pa, max_pa, common)] if self._corners else []
        ids = contacts.ids.tolist()
        markers += [
            Marker(header=header, ns=namespace, id=gone, action=Marker.DELETE)
            for gone in self._shown.difference(ids)
            for namespace in (ARROWS, TEXTS)
        ]
        self._shown = set(ids)
        for contact, number in enumerate(ids):
            markers += self._contact(contacts, contact, {**common, "id": number})
        if not contacts.coverage.is_certain:
            markers.append(self._blind(contacts.coverage, common))
        elif not self._was_certain:
            markers.append(Marker(header=header, ns=BLIND, action=Marker.DELETE))
        self._was_certain = contacts.coverage.is_certain
        return MarkerArray(markers=markers)

    def _surface(
        self, pressure_pa: NDArray[np.float32], max_pa: float, common: dict[str, Any]
    ) -> Marker:
        steps = scale_steps(pressure_pa[self._placed], max_pa).repeat(len(CORNERS))
        return Marker(
            **common,
            ns=SURFACE,
            type=Marker.TRIANGLE_LIST,
            scale=Vector3(x=1.0, y=1.0, z=1.0),
            points=self._corners,
            colors=[_COLOURS[step] for step in steps.tolist()],
        )

    def _blind(self, coverage: Coverage, common: dict[str, Any]) -> Marker:
        unread, doubtful = coverage.in_service - coverage.valid, coverage.doubtful
        lacks = [f"no reading: {unread}"] * bool(unread) + [f"doubtful: {doubtful}"] * bool(
            doubtful
        )
        return Marker(
            **common,
            ns=BLIND,
            type=Marker.TEXT_VIEW_FACING,
            scale=self._text_scale,
            pose=self._above,
            text=f"{', '.join(lacks)} of {coverage.in_service} taxels",
        )

    def _contact(self, contacts: Contacts, contact: int, common: dict[str, Any]) -> list[Marker]:
        head_m, force_n = contacts.position_m[contact], contacts.force_n[contact]
        tail = point(head_m - ARROW_M_PER_N * force_n)  # outside: the force points into the skin
        at_least = "> " if contacts.lower_bound[contact] else ""
        arrow = Marker(
            **common,
            ns=ARROWS,
            type=Marker.ARROW,
            scale=self._arrow_scale,
            points=[tail, point(head_m)],
        )
        text = Marker(
            **common,
            ns=TEXTS,
            type=Marker.TEXT_VIEW_FACING,
            scale=self._text_scale,
            pose=Pose(position=tail),
            text=f"{at_least}{np.linalg.norm(force_n):.3g} N",
        )
        return [arrow, text]
