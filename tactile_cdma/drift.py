"""Slow drift of resting nodes: told from contacts, and followed.

Nothing in one reading tells a light steady touch from drift. So drift is what is small and slow: a
node's drift is followed while its voltage is within BAND_LSB of its voltage at rest and of where
it has lately been, and has been so for SETTLE_S, and neither it nor a node beside it is in contact.
A touch takes a node out of the band at once, and there nothing is followed, however long it lasts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .baseline import Baseline, RestRules
from .calibration import Curves
from .layout import Layout

BAND_LSB = 1.5
"""Farther from rest than this is no drift. A node that falls by one count is within, by two not."""
SETTLE_S = 10.0
"""So long a node must have rested. It may change by one count in this time."""
LONGEST_S = 1.0
"""Where nothing was seen for longer, no more than this is made up for."""
STRAY_S = 60.0
"""A node off its rest for longer, without a contact to explain it, is worth a word."""
_NOTHING_LSB = 0.01
"""Less than this is not followed: rounding of float32 is 10⁻⁴ of a count at 10 bits."""


class DriftTracker:
    """Moves a baseline's drift_v so that resting nodes read their voltage at rest.

    rules: may be replaced at any time.
    """

    def __init__(self, lsb_v: float, beside: NDArray[np.int32], rules: RestRules) -> None:
        """lsb_v: one count of the nodes' converters, V. beside: (n, m), see nodes_beside."""
        self.rules = rules
        self._lsb_v = lsb_v
        self._beside = beside
        nodes = len(beside)
        self._curves: Curves | None = None
        self._tare_pa: NDArray[np.float32] | None = None
        self._rest_v = self._slope = np.zeros(nodes, dtype=np.float32)
        self._deviation_v = np.zeros(nodes, dtype=np.float32)
        self._usual_v = np.full(nodes, np.inf, dtype=np.float32)  # where it lately was at rest
        self._away_s = np.zeros(nodes)  # when it last was not at rest
        self._straight_s = np.zeros(nodes)  # when it last was no stray
        self._last_s: float | None = None

    def forget(self) -> None:
        """The device's clock starts anew."""
        self._last_s = None
        self._usual_v[:] = np.inf

    def follow(
        self,
        baseline: Baseline,
        curves: Curves,
        voltage_v: NDArray[np.float32],
        reading_pa: NDArray[np.float32],
        valid: NDArray[np.bool_],
        t_s: float,
    ) -> bool:
        """Move the baseline's drift by what is due at t_s (device time, s).

        voltage_v: (n,) V, without drift. reading_pa: (n,) Pa, after the tare. valid: (n,) bool.
        Returns whether there is more to follow, even if the voltages stay as they are.
        """
        self._zero_at(curves, baseline.tare_pa)
        if self._last_s is None:
            self._away_s[:] = self._straight_s[:] = self._last_s = t_s
        passed_s = min(max(t_s - self._last_s, 0.0), LONGEST_S)
        self._last_s = t_s
        band_v, nothing_v = BAND_LSB * self._lsb_v, _NOTHING_LSB * self._lsb_v
        deviation_v = self._rest_v - voltage_v - baseline.drift_v
        distance_v = np.abs(deviation_v)
        near = valid & (distance_v < band_v)
        np.copyto(self._usual_v, np.inf, where=~valid)
        np.copyto(self._usual_v, voltage_v, where=near & np.isinf(self._usual_v))
        change_v = voltage_v - self._usual_v
        resting = near & (np.abs(change_v) < band_v) & ~self._held(valid, reading_pa)
        np.copyto(self._away_s, t_s, where=~resting)
        stray = valid & ~near & (reading_pa < self.rules.contact_pa)
        np.copyto(self._straight_s, t_s, where=~stray)
        self._deviation_v = deviation_v

        usual_step_v = self._lsb_v * passed_s / SETTLE_S
        self._usual_v[resting] += np.clip(change_v[resting], -usual_step_v, usual_step_v)
        due = resting & (distance_v > nothing_v)
        now = due & (t_s - self._away_s >= SETTLE_S)
        if now.any():
            most_v = self._slope * np.float32(self.rules.drift_pa_per_min / 60 * passed_s)
            step_v = np.clip(deviation_v, -most_v, most_v) * now
            baseline.drift_v = baseline.drift_v + step_v
        return bool(due.any() or (resting & (np.abs(change_v) > nothing_v)).any())

    def strays_lsb(self, t_s: float) -> dict[int, float]:
        """By number, the nodes that have been off their rest for STRAY_S, and how far, LSB.

        Below 0: they read less than nothing. t_s: device time of the newest frame, s.
        """
        if self._last_s is None:
            return {}
        strays = np.flatnonzero(t_s - self._straight_s > STRAY_S)
        return {int(i) + 1: float(self._deviation_v[i] / self._lsb_v) for i in strays}

    def _held(self, valid: NDArray[np.bool_], reading_pa: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Nodes in contact, and those beside them."""
        touched = valid & (reading_pa > self.rules.release_pa)
        return touched | touched[self._beside].any(axis=1) if touched.any() else touched

    def _zero_at(self, curves: Curves, tare_pa: NDArray[np.float32]) -> None:
        """Rest is where these curves have the tare."""
        if curves is self._curves and tare_pa is self._tare_pa:
            return
        self._curves, self._tare_pa = curves, tare_pa
        self._rest_v = curves.voltage(tare_pa).astype(np.float32)
        fall_v = curves.voltage_v[0] - curves.voltage_v[1]
        self._slope = (fall_v / (curves.pressure_pa[1] - curves.pressure_pa[0])).astype(np.float32)
        self._usual_v[:] = np.inf


def nodes_beside(layout: Layout, nodes: int) -> NDArray[np.int32]:
    """(n, m) int32, indices of the nodes beside each node, padded with its own."""
    placed = layout.nodes > 0
    neighbours = layout.neighbours[placed]
    table = np.repeat(np.arange(nodes, dtype=np.int32)[:, None], neighbours.shape[1], axis=1)
    table[layout.nodes[placed] - 1] = layout.nodes[neighbours] - 1
    return table
