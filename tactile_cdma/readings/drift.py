# SPDX-License-Identifier: Apache-2.0

"""Slow drift of resting nodes: told from contacts, and followed.

Nothing in one reading tells a light steady touch from drift. But a touch comes and goes at once,
and drift is small and slow. So a node's drift is followed while its voltage is within BAND_LSB of
its voltage at rest and of where it has lately been, and has been so for SETTLE_S. A node that has
left that band is touched; it rests again when it is back in the band by a jump, or close to rest.
Neither touched nodes nor those beside a contact are followed, however long it lasts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..places.layout import Layout
from .baseline import Baseline, RestRules
from .calibration import Curves

BAND_LSB = 1.5
"""Farther from rest than this is no drift. A node that falls by one count is within, by two not."""
CLOSE_LSB = 0.75
"""A touched node that comes back slowly rests when it is so close to rest: no whole count off."""
SETTLE_S = 10.0
"""So long a node must have rested. Slower than a count in this time is no jump."""
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
        self._tared_v: NDArray[np.float32] | None = None
        self._rest_v = self._slope = np.zeros(nodes, dtype=np.float32)
        self._deviation_v = np.zeros(nodes, dtype=np.float32)
        self._usual_v = np.full(nodes, np.inf, dtype=np.float32)  # where it lately was at rest
        self._trail_v = np.full(nodes, np.inf, dtype=np.float32)  # behind the voltage, at all times
        self._touched = np.zeros(nodes, dtype=bool)
        self._away_s = np.zeros(nodes)  # when it last was not at rest
        self._stray = np.zeros(nodes, dtype=bool)  # off its rest, and no contact explains it
        self._stray_s = np.zeros(nodes)  # since when
        self._last_s: float | None = None

    def forget(self) -> None:
        """The device's clock starts anew."""
        self._last_s = None
        self._stray[:] = False
        self._begin()

    def follow(
        self,
        baseline: Baseline,
        curves: Curves,
        voltage_v: NDArray[np.float32],
        reading_pa: NDArray[np.float32],
        valid: NDArray[np.bool_],
        t_s: float,
    ) -> None:
        """Move the baseline's drift by what is due at t_s (device time, s).

        voltage_v: (n,) V, without drift. reading_pa: (n,) Pa, after the tare. valid: (n,) bool.
        """
        self._rest_at(curves, baseline)
        if self._last_s is None:
            self._away_s[:] = self._last_s = t_s
        passed_s = min(max(t_s - self._last_s, 0.0), LONGEST_S)
        self._last_s = t_s
        deviation_v = self._rest_v - voltage_v - baseline.drift_v
        self._deviation_v = deviation_v
        near = valid & (np.abs(deviation_v) < BAND_LSB * self._lsb_v)
        resting = self._untouched(voltage_v, near, valid, passed_s)
        resting &= ~self._in_contact(valid & ~near & (reading_pa > self.rules.release_pa))
        np.copyto(self._away_s, t_s, where=~resting)
        stray = valid & ~near & (reading_pa < self.rules.contact_pa)
        np.copyto(self._stray_s, t_s, where=stray & ~self._stray)
        self._stray = stray

        nothing_v = _NOTHING_LSB * self._lsb_v
        due = resting & (np.abs(deviation_v) > nothing_v)
        now = due & (t_s - self._away_s >= SETTLE_S)
        if now.any():
            most_v = self._slope * np.float32(self.rules.drift_pa_per_min / 60 * passed_s)
            step_v = np.clip(deviation_v, -most_v, most_v) * now
            baseline.drift_v = baseline.drift_v + step_v
        change_v = np.clip(voltage_v - self._usual_v, *self._slowly(passed_s)) * resting
        self._usual_v += change_v

    def _untouched(
        self,
        voltage_v: NDArray[np.float32],
        near: NDArray[np.bool_],
        valid: NDArray[np.bool_],
        passed_s: float,
    ) -> NDArray[np.bool_]:
        """(n,) bool, who is near rest and has not been touched since it was there before."""
        band_v = np.float32(BAND_LSB * self._lsb_v)
        np.copyto(self._trail_v, voltage_v, where=np.isinf(self._trail_v))
        behind_v = np.clip(voltage_v - self._trail_v, -2 * band_v, 2 * band_v)
        self._trail_v = voltage_v - behind_v + np.clip(behind_v, *self._slowly(passed_s))
        np.copyto(self._usual_v, np.inf, where=~valid)
        np.copyto(self._usual_v, voltage_v, where=near & np.isinf(self._usual_v))
        home = near & (np.abs(voltage_v - self._usual_v) < band_v)
        back = (behind_v > band_v) | (np.abs(self._deviation_v) < CLOSE_LSB * self._lsb_v)
        self._touched = valid & np.where(home, self._touched & ~back, True)
        return np.asarray(home & ~self._touched)

    def _in_contact(self, pressed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Nodes that are pressed, and those beside them."""
        contact = pressed.copy()
        contact[self._beside[np.flatnonzero(pressed)]] = True
        return contact

    def _slowly(self, passed_s: float) -> tuple[np.float32, np.float32]:
        """The most that a voltage may change to be no jump, either way, V."""
        most_v = np.float32(self._lsb_v * passed_s / SETTLE_S)
        return -most_v, most_v

    def strays_lsb(self, t_s: float) -> dict[int, float]:
        """By number, the nodes that have been off their rest for STRAY_S, and how far, LSB.

        Below 0: they read less than nothing. t_s: device time of the newest frame, s.
        """
        if not self.rules.drift_pa_per_min:
            return {}  # nobody looks
        strays = np.flatnonzero(self._stray & (t_s - self._stray_s > STRAY_S))
        return {int(i) + 1: float(self._deviation_v[i] / self._lsb_v) for i in strays}

    def _rest_at(self, curves: Curves, baseline: Baseline) -> None:
        """Rest is where the tare was taken; without one, where the curves begin."""
        if curves is self._curves and baseline.rest_v is self._tared_v:
            return
        self._curves, self._tared_v = curves, baseline.rest_v
        begin_v = curves.voltage_v[0].astype(np.float32)
        self._rest_v = begin_v if baseline.rest_v is None else baseline.rest_v
        fall_v = curves.voltage_v[0] - curves.voltage_v[1]
        self._slope = (fall_v / (curves.pressure_pa[1] - curves.pressure_pa[0])).astype(np.float32)
        self._begin()

    def _begin(self) -> None:
        """Nothing is known of where the nodes were."""
        self._usual_v[:] = self._trail_v[:] = np.inf
        self._touched[:] = False


def nodes_beside(layout: Layout, nodes: int) -> NDArray[np.int32]:
    """(n, m) int32, indices of the nodes beside each node, padded with its own."""
    placed = layout.nodes > 0
    neighbours = layout.neighbours[placed]
    table = np.repeat(np.arange(nodes, dtype=np.int32)[:, None], neighbours.shape[1], axis=1)
    table[layout.nodes[placed] - 1] = layout.nodes[neighbours] - 1
    return table
