"""Nodes that say the same whatever happens around them: stuck.

One count is about 0.1 kPa, so a sound node under a changing load moves. Whether its load changes
its neighbours tell: where all of them are in contact it is expected to be pressed, at least by as
much as the least pressed of them and as the plane through their pressures has it (which runs out
towards a contact's edge, so that a corner beside a contact is expected to feel nothing); where all
are at rest, it is expected to be at rest. Anything else says nothing. A node is stuck while this
expectation goes up and down, and it does not move by a single count.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .layout import Layout
from .taxels import Readings, Status

LOOK_S = 0.1
"""Readings are looked at so often, s."""
LEAST_NEIGHBOURS = 3
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
        self._beside = layout.neighbours
        self._real = self._beside != np.arange(taxels)[:, None]  # the others are padding
        self._offsets = _offsets(layout)
        self._sound = np.zeros(taxels, dtype=bool)
        self._weights = np.zeros(self._beside.shape, dtype=np.float32)
        self._looked_s = -np.inf
        self._seen: Readings | None = None
        self._voltage_v = np.full(taxels, np.nan, dtype=np.float32)
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
        self._forget(self._moved(readings))
        expected_pa = self._expected(readings.pressure_pa, contact_pa)
        self._count(expected_pa, np.float32(SWING_CONTACTS * contact_pa))

    def _moved(self, readings: Readings) -> Bools:
        """(t,) who says another word than before, or none; an uncertain one is not counted."""
        certain = (readings.status & Status.LOW_SNR) == 0
        moved: Bools = certain & (readings.voltage_v != self._voltage_v)  # NaN: always
        np.copyto(self._voltage_v, readings.voltage_v, where=moved)
        return moved

    def _expected(self, pressure_pa: Floats, contact_pa: float) -> Floats:
        """(t,) what the neighbours tell of a taxel's pressure, Pa; NaN: nothing."""
        sound = np.isfinite(pressure_pa)
        if not np.array_equal(sound, self._sound):
            self._sound = sound
            self._weights = self._plane_weights(sound)
        around_pa = np.where(sound, pressure_pa, np.float32(0))[self._beside]
        heard = sound[self._beside] & self._real
        least_pa = np.where(heard, around_pa, np.inf).min(axis=1)
        most_pa = np.where(heard, around_pa, -np.inf).max(axis=1)
        plane_pa = np.einsum("tm,tm->t", self._weights, around_pa)
        pressed_pa = np.maximum(np.minimum(plane_pa, least_pa), 0)
        expected_pa = np.full(len(pressure_pa), np.nan, dtype=np.float32)
        enough = np.count_nonzero(heard, axis=1) >= LEAST_NEIGHBOURS
        np.copyto(expected_pa, pressed_pa, where=enough & (least_pa > contact_pa))
        np.copyto(expected_pa, np.float32(0), where=enough & (most_pa < contact_pa))
        return expected_pa

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

    def _forget(self, moved: Bools) -> None:
        self._swings[moved] = 0
        self._rising[moved] = False
        self._low_pa[moved], self._high_pa[moved] = np.inf, -np.inf

    def _plane_weights(self, sound: Bools) -> Floats:
        """(t, m): weights that make of the neighbours' pressures the plane's value at the taxel."""
        heard = (sound[self._beside] & self._real)[..., None]
        rows = np.concatenate((np.ones_like(self._offsets[..., :1]), self._offsets), axis=2) * heard
        normal = np.einsum("tmi,tmj->tij", rows, rows)
        normal += np.diag(np.array([1e-6, _RIDGE, _RIDGE], dtype=np.float32))
        first = np.linalg.solve(normal, np.eye(3, 1, dtype=np.float32)[None].repeat(len(rows), 0))
        weights: Floats = np.einsum("tmi,ti->tm", rows, first[..., 0])
        return weights


def _offsets(layout: Layout) -> Floats:
    """(t, m, 2) float32: where the neighbours are in each taxel's tangent plane, in pitches."""
    normals = layout.normals
    # The axis that is farthest from the normal gives a tangent that is never short.
    axis = np.eye(3, dtype=np.float32)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normals, first)
    apart = (layout.positions_m[layout.neighbours] - layout.positions_m[:, None]) / layout.pitch_m
    tangents = np.stack((first, second), axis=2)
    offsets: Floats = np.einsum("tmx,txd->tmd", apart, tangents).astype(np.float32)
    return offsets
