# SPDX-License-Identifier: Apache-2.0

"""A skin and its contacts as markers: coloured squares, arrows, and forces as text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from struct import Struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from visualization_msgs.msg import Marker

from ...base.arrays import Bools, Floats, Floats32
from ...messages.cdr import PADDING, CdrWriter, Heading, string
from ...places.layout import CORNERS, MOST_SQUARES, Layout
from ...readings.contact import Contacts
from ...views.heatmap import GAMMA, SCALE_RGB, scale_steps

SURFACE, ARROWS, TEXTS, RESULTANT, SUM, BLIND = (
    *("skin", "contacts", "forces", "resultant", "sum", "blind"),
)
"""Namespaces of markers; rviz can hide each."""
SQUARE_SHARE, UNREAD_SHARE = 0.9, 0.45
"""Edge of a square in that of its taxel's area, with a reading and without. Chosen: the gaps are a
grid that shows an untouched skin, and how a bent one is bent."""
SUNK_PITCHES = 0.06
"""Depth of the squares below the taxels' places, in pitches; chosen: points stand out of them."""
ARROW_SHARES = 0.14, 0.32, 0.4
"""Diameters of shaft and head and length of the head in the arrow's length, chosen."""
LETTER_SHARE = 0.08
"""Height of letters in the edge of a square of the skin's area. Chosen: legible where the skin
fills the picture."""
SUM_LETTERS = 2.5
"""Distance of the resultant's text from its arrow, in letters; chosen: beyond that of a contact
there, which is at 1."""
ABOVE_SHARE = 0.45
"""Height of the text about taxels without a reading above the skin, in the same; chosen: over most
arrows."""
CONTACT_RGBA = 0.3, 0.85, 1.0, 1.0
"""Chosen off the pressure scale, so that arrows stand out."""
RESULTANT_RGBA = 1.0, 1.0, 1.0, 1.0
_SCALE_RGBA = np.hstack([SCALE_RGB / 255, np.ones((len(SCALE_RGB), 1))]).astype("<f4")
_TINY_N = 1e-12
_NUMBERS, _SHAPE = Struct("<3i"), Struct("<10d4fiI?")
_NOWHERE, _UPRIGHT = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
_Rgba = tuple[float, float, float, float]
_NOTHING = string("") + PADDING[3]
_NO_TEXTURE = _NOTHING + bytes(8) + 2 * _NOTHING + bytes(8)
"""Empty texture_resource, texture (with its header) and uv_coordinates of a marker."""
_NO_MESH = 2 * _NOTHING + bytes(5)
"""Empty mesh_resource and mesh_file; mesh_use_embedded_materials is False."""
_NO_POINTS, _NO_COLOURS = np.zeros((0, 3)), _SCALE_RGBA[:0]


class SkinMarkers:
    """Builds the markers of one skin."""

    def __init__(self, layout: Layout, most_squares: int = MOST_SQUARES) -> None:
        self._drawn: set[tuple[str, int]] = set()  # namespaces and ids in the last message
        edge_m = math.sqrt(float(layout.areas_m2.sum()))  # of a square of the skin's area
        self._letter_m = LETTER_SHARE * edge_m
        middle_m, outward = layout.positions_m[layout.middle], layout.normals[layout.middle]
        self._above_m = (middle_m + ABOVE_SHARE * edge_m * outward).tolist()
        self._placed = np.flatnonzero(layout.nodes)
        if len(self._placed) > most_squares:
            self._placed = self._placed[:0]
        self._corners_m = _squares(layout, SQUARE_SHARE)[self._placed]
        self._unread_m = _squares(layout, UNREAD_SHARE)[self._placed]

    def markers(
        self,
        pressure_pa: Floats32,
        max_pa: float,
        contacts: Contacts,
        heading: Heading,
        lifetime_s: float,
        unsure: Bools | bool = False,
        gamma: float = GAMMA,
    ) -> bytes:
        """Return the message MarkerArray of a frame; markers of contacts that ended are deleted.

        A text says how many taxels in service have no certain reading, or a doubtful zero, if any:
        nothing drawn means that nothing touches only without it.

        pressure_pa: (t,), Pa; colours are on the scale 0…max_pa. unsure, gamma: see scale_steps.
        lifetime_s: time after which markers vanish that no message renews.
        """
        steps = scale_steps(pressure_pa, max_pa, unsure, gamma)
        markers = [self._surface(pressure_pa, steps)] if len(self._placed) else []
        if len(contacts):
            markers += self._forces(contacts, max_pa)
        if not (seen := contacts.coverage).is_certain:
            lacks = {"unread": seen.in_service - seen.valid, "doubtful": seen.doubtful}
            said = "\n".join(f"{lack}:{n}/{seen.in_service}" for lack, n in lacks.items() if n)
            markers.append(self._text(BLIND, 0, self._above_m, said, CONTACT_RGBA))
        drawn = {(marker.namespace, marker.number) for marker in markers}
        markers += [_Marker(*gone, is_deleted=True) for gone in sorted(self._drawn - drawn)]
        self._drawn = drawn
        return _message(markers, heading, lifetime_s)

    def _surface(self, pressure_pa: Floats32, steps: NDArray[np.int16]) -> _Marker:
        placed_pa, corners_m = pressure_pa[self._placed], self._corners_m
        if (unread := np.isnan(placed_pa)).any():
            corners_m = np.where(unread[:, None, None], self._unread_m, corners_m)
        return _Marker(
            *(SURFACE, 0, Marker.TRIANGLE_LIST, (1.0, 1.0, 1.0)),
            points_m=corners_m.reshape(-1, 3),
            rgba=_SCALE_RGBA[steps[self._placed].repeat(len(CORNERS))],
        )

    def _forces(self, contacts: Contacts, max_pa: float) -> list[_Marker]:
        """Draw an arrow for each contact, which ends at its place, and its force at the other end.

        Arrows are as long as the edge of the square that would bear the force at max_pa: light
        touches show, and no arrow is longer than the skin is wide. The last is the resultant, if
        there are several contacts.
        """
        markers: list[_Marker] = []
        # Few numbers: plain Python is faster than numpy.
        places_m, forces_n = contacts.position_m.tolist(), contacts.force_n.tolist()
        at_least = [">" if is_lower else "" for is_lower in contacts.lower_bound.tolist()]
        for i, number in enumerate(contacts.ids.tolist()):
            label = at_least[i], self._letter_m
            markers += self._force(
                *(ARROWS, TEXTS, number), places_m[i], forces_n[i], max_pa, label, CONTACT_RGBA
            )
        if len(contacts) > 1 and contacts.has_resultant:
            place_m, force_n = contacts.centre_m.tolist(), contacts.total_force_n.tolist()
            label = "sum>" if any(at_least) else "sum=", SUM_LETTERS * self._letter_m
            markers += self._force(
                RESULTANT, SUM, 0, place_m, force_n, max_pa, label, RESULTANT_RGBA
            )
        return markers

    def _force(
        self,
        arrows: str,
        texts: str,
        number: int,
        place_m: Sequence[float],
        force_n: Sequence[float],
        max_pa: float,
        label: tuple[str, float],
        rgba: _Rgba,
    ) -> list[_Marker]:
        """Return an arrow and its text. label: what the text begins with, and its distance, m."""
        newtons = math.hypot(*force_n)
        length_m = math.sqrt(newtons / max_pa)
        # Forces point into the skin; the sum of contacts that cancel each other points nowhere.
        outward = [-along / max(newtons, _TINY_N) for along in force_n]
        tail_m = [at + length_m * along for at, along in zip(place_m, outward, strict=True)]
        text_m = [at + label[1] * along for at, along in zip(tail_m, outward, strict=True)]
        size_m = [share * length_m for share in ARROW_SHARES]
        points_m = np.array([tail_m, place_m])
        return [
            _Marker(arrows, number, Marker.ARROW, size_m, points_m=points_m, look=rgba),
            self._text(texts, number, text_m, f"{label[0]}{newtons:.3g}N", rgba),
        ]

    def _text(
        self, namespace: str, number: int, place_m: Sequence[float], text: str, rgba: _Rgba
    ) -> _Marker:
        # Without spaces: rviz computes their width for letters of 1 m.
        kind, size_m = Marker.TEXT_VIEW_FACING, (0.0, 0.0, self._letter_m)
        return _Marker(namespace, number, kind, size_m, place_m, look=rgba, text=text)


def _squares(layout: Layout, share: float) -> Floats:
    """Return (t, 6, 3) corners of squares a little below the taxels. share: of their edge."""
    places_m = layout.positions_m[:, None].astype("<f8")
    sunk_m = SUNK_PITCHES * layout.pitch_m * layout.normals[:, None]
    return np.asarray(places_m + share * (layout.squares_m - places_m) - sunk_m)


class _Marker(NamedTuple):
    """Holds what differs between our markers; a deleted one needs only the first two fields.

    points_m: (m, 3) float64. rgba: (m, 4) float32, of every point. look: colour of all else.
    """

    namespace: str
    number: int
    kind: int = Marker.ARROW
    scale_m: Sequence[float] = _NOWHERE
    place_m: Sequence[float] = _NOWHERE
    points_m: Floats = _NO_POINTS
    rgba: Floats32 = _NO_COLOURS
    look: _Rgba = CONTACT_RGBA
    text: str = ""
    is_deleted: bool = False


def _message(markers: Sequence[_Marker], heading: Heading, lifetime_s: float) -> bytes:
    header = heading.fields
    lifetime = divmod(round(lifetime_s * 1e9), 1_000_000_000)
    writer = CdrWriter()
    writer.count(len(markers))
    for marker in markers:
        writer.add(header, 4)
        writer.text(marker.namespace)
        action, look = Marker.ADD, (*marker.look, *lifetime)
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
