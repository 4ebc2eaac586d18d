# SPDX-License-Identifier: Apache-2.0

"""Nodes that say the same whatever happens around them: stuck.

One count is about 0.1 kPa, so a sound node under a changing load moves. Whether its load changes
its neighbours tell: where all of them are in contact it is expected to be pressed like the least
pressed of them, for contacts have no holes; where all are at rest, it is expected to be at rest.
Anything else says nothing, nor does a contact of neighbours that did not move either, for they may
be stuck themselves. A node is stuck while this expectation goes up and down, and it does not move
by a single count.

A node at the skin's border may lie beside a contact that has all its neighbours. So its expectation
is less: the plane through the neighbours' pressures, minus twice their spread. Where the pressure
is that of Hertz, p² = p₀²·(1 − r²/R²), a corner outside the contact has neighbours with
p₁² + p₂² ≤ p₃², and p₁ + p₂ − p₃ − 2·(p₃ − p₁) is below 0 then; softer edges leave even less.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..places.layout import Layout
from .taxels import Readings, Status

LOOK_S = 0.1
"""Readings are looked at so often, s."""
LEAST_NEIGHBOURS = 3
MANY_NEIGHBOURS, UNMOVED = 6, 2
"""Of so many all around, some may not have moved: among the others are two that face each other."""
BORDER_SPREADS = 2.0
"""At the border so many times the spread of the neighbours' pressures are taken off."""
SWING_CONTACTS = 5.0
"""A swing of the expectation is at least so many times the pressure at which a contact begins."""
SWINGS = 3
"""So many make a node that did not move a stuck one: up, down, and up again."""
_RIDGE = 1e-3
"""Steadies a plane through neighbours that lie on one line; distances are in pitches."""

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]


class StuckNodes:
    """Compares every taxel with its neighbours, a few times a second."""

    def __init__(self, layout: Layout) -> None:
        taxels = len(layout)
        self._nodes = layout.nodes
        # Arrays of neighbours are (m, t): numpy works along rows.
        self._beside = np.ascontiguousarray(layout.neighbours.T)
        self._real = self._beside != np.arange(taxels)  # the others are padding
        self._offsets = _offsets(layout)
        self._sound = np.zeros(taxels, dtype=bool)
        # Of those around each taxel, as long as nobody can be relied on; see _know.
        self._heard = np.zeros_like(self._real)
        self._but_others = np.full(self._beside.shape, np.inf, dtype=np.float32)
        self._weights = np.zeros(self._beside.shape, dtype=np.float32)
        self._enough, self._inner = np.zeros((2, taxels), dtype=bool)
        self._may_rest = np.zeros(taxels, dtype=np.int64)
        self._looked_s = -np.inf
        self._seen: Readings | None = None
        self._voltage_v = np.full(taxels, np.nan, dtype=np.float32)
        self._since_s = np.full(taxels, -np.inf)  # it has said the same word, device time
        self._changed_s = np.full(taxels, -np.inf)  # it last went from one word to another
        # Since it last moved, of each taxel: extremes of the expectation after its last turn.
        self._low_pa = np.full(taxels, np.inf, dtype=np.float32)
        self._high_pa = np.full(taxels, -np.inf, dtype=np.float32)
        self._rising = np.zeros(taxels, dtype=bool)
        self._swings = np.zeros(taxels, dtype=np.int32)

    @property
    def nodes(self) -> list[int]:
        """Numbers, from 1 on, of the nodes that are stuck."""
        numbers: list[int] = np.sort(self._nodes[self._swings >= SWINGS]).tolist()
        return numbers

    def look(self, readings: Readings, t_s: float, contact_pa: float) -> None:
        """Take a frame's readings at t_s (device time, s), unless others were seen just before.

        contact_pa: pressure at which a contact begins, Pa.
        """
        if 0 <= t_s - self._looked_s < LOOK_S or readings is self._seen:
            return
        self._looked_s, self._seen = t_s, readings
        self._move(readings, t_s)
        expected_pa = self._expected(readings, contact_pa)
        self._count(expected_pa, np.float32(SWING_CONTACTS * contact_pa))

    def _move(self, readings: Readings, t_s: float) -> None:
        """Begin anew with those who say another word than before; an uncertain one is not told."""
        certain = (readings.status & Status.LOW_SNR) == 0
        moved = certain & (readings.voltage_v != self._voltage_v)  # NaN: always
        np.copyto(self._changed_s, t_s, where=moved & np.isfinite(self._voltage_v))
        np.copyto(self._voltage_v, readings.voltage_v, where=moved)
        self._since_s[moved] = t_s
        self._swings[moved] = 0
        self._rising[moved] = False
        self._low_pa[moved], self._high_pa[moved] = np.inf, -np.inf

    def _expected(self, readings: Readings, contact_pa: float) -> Floats:
        """(t,) what the neighbours tell of a taxel's pressure, Pa; NaN: nothing."""
        pressure_pa = readings.pressure_pa
        sound = np.isfinite(pressure_pa) & (self._swings < SWINGS)
        self._know(sound)
        around_pa = np.where(sound, pressure_pa, np.float32(0))[self._beside]
        least_pa = (around_pa + self._but_others).min(axis=0)
        most_pa = (around_pa - self._but_others).max(axis=0)
        plane_pa = np.einsum("mt,mt->t", self._weights, around_pa)
        border_pa = np.minimum(plane_pa - BORDER_SPREADS * (most_pa - least_pa), least_pa)
        pressed_pa = np.maximum(np.where(self._inner, least_pa, border_pa), 0)
        # Beyond its range a sound node does not move either: of it is only expected to be there.
        np.copyto(pressed_pa, pressure_pa, where=(readings.status & Status.SATURATED) != 0)
        expected_pa = np.full(len(pressure_pa), np.nan, dtype=np.float32)
        pressed = self._enough & (least_pa > contact_pa)
        if pressed.any():
            unmoved = self._heard & (self._changed_s[self._beside] <= self._since_s)
            pressed &= np.count_nonzero(unmoved, axis=0) <= self._may_rest
        np.copyto(expected_pa, pressed_pa, where=pressed)
        np.copyto(expected_pa, np.float32(0), where=self._enough & (most_pa < contact_pa))
        return expected_pa

    def _know(self, sound: Bools) -> None:
        """Have ready what depends on who can be relied on, anew where one beside has changed."""
        changed = sound != self._sound
        if not changed.any():
            return
        self._sound = sound
        at = np.flatnonzero((changed[self._beside] & self._real).any(axis=0))
        heard = sound[self._beside[:, at]] & self._real[:, at]
        count, weights = np.count_nonzero(heard, axis=0), self._plane_weights(heard, at)
        inner = (count >= MANY_NEIGHBOURS) & ((weights > 0) | ~heard).all(axis=0)
        self._heard[:, at], self._weights[:, at] = heard, weights
        self._but_others[:, at] = np.where(heard, 0, np.inf)
        self._enough[at], self._inner[at] = count >= LEAST_NEIGHBOURS, inner
        self._may_rest[at] = np.where(inner, UNMOVED, 0)

    def _count(self, expected_pa: Floats, swing_pa: np.float32) -> None:
        """Follow the expectation and count its swings."""
        np.fmin(self._low_pa, expected_pa, out=self._low_pa)
        np.fmax(self._high_pa, expected_pa, out=self._high_pa)
        up = ~self._rising & (expected_pa - self._low_pa >= swing_pa)
        down = self._rising & (self._high_pa - expected_pa >= swing_pa)
        turned = up | down
        self._swings += turned
        self._rising ^= turned
        np.copyto(self._high_pa, expected_pa, where=up)
        np.copyto(self._low_pa, expected_pa, where=down)

    def _plane_weights(self, heard: Bools, at: NDArray[np.intp]) -> Floats:
        """(m, k): weights that make of the neighbours' pressures the plane's value at k taxels."""
        offsets = self._offsets[:, :, at] * heard
        rows = np.concatenate((heard[None].astype(np.float32), offsets))
        normal = np.einsum("imt,jmt->tij", rows, rows)
        normal += np.diag(np.array([1e-6, _RIDGE, _RIDGE], dtype=np.float32))
        first = np.zeros((len(normal), 3, 1), dtype=np.float32)
        first[:, 0] = 1
        weights: Floats = np.einsum("imt,ti->mt", rows, np.linalg.solve(normal, first)[..., 0])
        return weights


def _offsets(layout: Layout) -> Floats:
    """(2, m, t) float32: where the neighbours are in each taxel's tangent plane, in pitches."""
    normals = layout.normals
    # The axis that is farthest from the normal gives a tangent that is never short.
    axis = np.eye(3, dtype=np.float32)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    tangents = np.stack((first, np.cross(normals, first)))
    apart = (layout.positions_m[layout.neighbours] - layout.positions_m[:, None]) / layout.pitch_m
    offsets: Floats = np.einsum("tmx,dtx->dmt", apart, tangents).astype(np.float32)
    return offsets
