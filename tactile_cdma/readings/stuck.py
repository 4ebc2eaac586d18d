# SPDX-License-Identifier: Apache-2.0

"""Detects stuck nodes: those whose value does not change whatever happens around them.

One count is about 0.1 kPa, so a working node under a changing load changes its value. The
neighbours tell whether its load changes: if all of them are in contact, the node is expected to be
pressed like the least pressed of them, as contacts have no holes; if all are at rest, it is
expected to be at rest. Anything else gives no expectation, nor does a contact of neighbours that
did not change either, which may be stuck themselves. A node is stuck if this expectation goes up
and down while its value does not change by a single count.

A contact may cover all neighbours of a node at the skin's border without covering the node. There
the expectation is lower: the plane through the neighbours' pressures, minus twice their spread. For
Hertz's pressure, p² = p₀²·(1 − r²/R²), a corner outside the contact has neighbours with
p₁² + p₂² ≤ p₃², so p₁ + p₂ − p₃ − 2·(p₃ − p₁) < 0; softer edges give even less.
"""

import numpy as np

from ..base.arrays import Bools, Floats32, Indices
from ..places.layout import Layout
from ..places.layout_shapes import tangents
from .status import Status
from .taxels import Readings

LOOK_S = 0.5
"""Interval between the readings that are compared, s; chosen: loads of a hand stay as long, and a
look at 4096 taxels takes nearly as long as decoding a frame."""
LEAST_NEIGHBOURS = 3
"""Fewest neighbours that give an expectation: as many as a corner of a grid has."""
MANY_NEIGHBOURS, UNMOVED = 6, 2
"""With so many neighbours all around, so many may be unmoved: two of the others still lie opposite
each other."""
BORDER_SPREADS = 2.0
"""Spreads of the neighbours' pressures that are subtracted at the border; derived above."""
SWING_CONTACTS = 5.0
"""Smallest swing of the expectation that counts, in multiples of the pressure at which a contact
begins; chosen: 5 kPa by default, 50 counts of the paper's sensor."""
SWINGS = 3
"""Swings (up, down, up) without a change of value that make a node stuck. Chosen: in 787
node-hours of simulated touch no sound node was named."""
_RIDGE = 1e-3
"""Regularisation of the plane for neighbours on one line, in squared pitches."""
_LOW_SNR, _SATURATED = np.uint8(Status.LOW_SNR), np.uint8(Status.SATURATED)


class StuckNodes:
    """Compares taxels with their neighbours every LOOK_S; looked_s: last time, device time, s."""

    def __init__(self, layout: Layout) -> None:
        taxels = len(layout)
        self._nodes, self._around = layout.nodes, _Around(layout)
        self.looked_s = -np.inf
        self._seen: Readings | None = None
        self._voltage_v = np.full(taxels, np.nan, dtype=np.float32)
        self._since_s = np.full(taxels, -np.inf)  # when the present word came, device time
        self._changed_s = np.full(taxels, -np.inf)  # when one word last replaced another
        # Since the taxel last moved: extremes of the expectation after its last turn.
        self._low_pa = np.full(taxels, np.inf, dtype=np.float32)
        self._high_pa = np.full(taxels, -np.inf, dtype=np.float32)
        self._rising = np.zeros(taxels, dtype=bool)
        self._swings = np.zeros(taxels, dtype=np.int32)

    @property
    def nodes(self) -> list[int]:
        return sorted(map(int, self._nodes[self._swings >= SWINGS]))

    def look(self, readings: Readings, t_s: float, contact_pa: float) -> None:
        """Compare readings at device time t_s, s, every LOOK_S; contact_pa: of a contact, Pa."""
        self.looked_s = t_s
        if readings is self._seen:
            return
        self._seen = readings
        self._move(readings, t_s)
        expected_pa = self._expected(readings, contact_pa)
        self._count(expected_pa, np.float32(SWING_CONTACTS * contact_pa))

    def _move(self, readings: Readings, t_s: float) -> None:
        """Start over with taxels whose word has changed; uncertain words are ignored."""
        certain = (readings.status & _LOW_SNR) == 0
        moved = certain & (readings.voltage_v != self._voltage_v)  # NaN differs always
        np.copyto(self._changed_s, t_s, where=moved & np.isfinite(self._voltage_v))
        np.copyto(self._voltage_v, readings.voltage_v, where=moved)
        self._since_s[moved] = t_s
        self._swings[moved] = 0
        self._rising[moved] = False
        self._low_pa[moved], self._high_pa[moved] = np.inf, -np.inf

    def _expected(self, readings: Readings, contact_pa: float) -> Floats32:
        """Return (t,) pressure expected from the neighbours, Pa; NaN: no expectation."""
        pressure_pa, around = readings.pressure_pa, self._around
        around.update(sound := np.isfinite(pressure_pa) & (self._swings < SWINGS))
        around_pa = np.where(sound, pressure_pa, np.float32(0)).take(around.beside)
        least_pa = (around_pa + around.but_others).min(axis=0)
        most_pa = (around_pa - around.but_others).max(axis=0)
        expected_pa = np.full(len(pressure_pa), np.nan, dtype=np.float32)
        expected_pa[around.enough & (most_pa < contact_pa)] = 0
        at = np.flatnonzero(around.enough & (least_pa > contact_pa))
        unmoved = around.sound[:, at] & (self._changed_s[around.beside[:, at]] <= self._since_s[at])
        at = at[np.count_nonzero(unmoved, axis=0) <= np.where(around.inner[at], UNMOVED, 0)]
        low_pa, high_pa = least_pa[at], most_pa[at]
        plane_pa = np.einsum("mt,mt->t", around.weights[:, at], around_pa[:, at])
        border_pa = np.minimum(plane_pa - BORDER_SPREADS * (high_pa - low_pa), low_pa)
        pressed_pa = np.maximum(np.where(around.inner[at], low_pa, border_pa), 0)
        # Beyond its range a sound node does not change either: expect no more than it reads.
        saturated = (readings.status[at] & _SATURATED) != 0
        expected_pa[at] = np.where(saturated, pressure_pa[at], pressed_pa)
        return expected_pa

    def _count(self, expected_pa: Floats32, swing_pa: np.float32) -> None:
        np.fmin(self._low_pa, expected_pa, out=self._low_pa)
        np.fmax(self._high_pa, expected_pa, out=self._high_pa)
        up = ~self._rising & (expected_pa - self._low_pa >= swing_pa)
        down = self._rising & (self._high_pa - expected_pa >= swing_pa)
        turned = up | down
        self._swings += turned
        self._rising ^= turned
        np.copyto(self._high_pa, expected_pa, where=up)
        np.copyto(self._low_pa, expected_pa, where=down)


class _Around:
    """Knows which neighbours of each taxel are sound, and what follows from that; (m, t) arrays.

    beside: the neighbours, padded with the taxel itself. sound: they are, and no padding.
    but_others: 0 where they are, else infinite. weights: of their pressures, which give the value
    of their plane at the taxel. enough, inner: (t,) bool, there are enough of them to expect
    something; they are all around.
    """

    def __init__(self, layout: Layout) -> None:
        # numpy is quicker along rows of (m, t) than of (t, m).
        self.beside = np.ascontiguousarray(layout.neighbours.T, np.intp)  # else cast at each use
        self._real = self.beside != np.arange(len(layout))  # False: padding
        self._sound = np.zeros(len(layout), dtype=bool)
        # Neighbours in each taxel's tangent plane, (2, m, t) float32, in pitches.
        apart_m = layout.positions_m[layout.neighbours] - layout.positions_m[:, None]
        apart, plane = apart_m / layout.pitch_m, np.stack(tangents(layout.normals))
        self._offsets = np.asarray(np.einsum("tmx,dtx->dmt", apart, plane), dtype=np.float32)
        self.sound = np.zeros_like(self._real)
        self.but_others = np.full(self.beside.shape, np.inf, dtype=np.float32)
        self.weights = np.zeros(self.beside.shape, dtype=np.float32)
        self.enough, self.inner = np.zeros((2, len(layout)), dtype=bool)

    def update(self, sound: Bools) -> None:
        """Update the neighbourhoods in which a taxel has become sound, or is not any more."""
        changed = sound != self._sound
        if not changed.any():
            return
        self._sound = sound
        at = np.flatnonzero((changed[self.beside] & self._real).any(axis=0))
        heard = sound[self.beside[:, at]] & self._real[:, at]
        count, weights = np.count_nonzero(heard, axis=0), self._plane_weights(heard, at)
        self.sound[:, at], self.weights[:, at] = heard, weights
        self.but_others[:, at] = np.where(heard, 0, np.inf)
        self.enough[at] = count >= LEAST_NEIGHBOURS
        self.inner[at] = (count >= MANY_NEIGHBOURS) & ((weights > 0) | ~heard).all(axis=0)

    def _plane_weights(self, heard: Bools, at: Indices) -> Floats32:
        """Weigh the neighbours' pressures, (m, k), to have the plane's value at k taxels."""
        offsets = self._offsets[:, :, at] * heard
        rows = np.concatenate((heard[None].astype(np.float32), offsets))
        normal = np.einsum("imt,jmt->tij", rows, rows)
        normal += np.diag(np.array([1e-6, _RIDGE, _RIDGE], dtype=np.float32))
        first = np.zeros((len(normal), 3, 1), dtype=np.float32)
        first[:, 0] = 1
        return np.asarray(np.einsum("imt,ti->mt", rows, np.linalg.solve(normal, first)[..., 0]))
