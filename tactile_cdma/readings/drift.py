# SPDX-License-Identifier: Apache-2.0

"""Tells slow drift of resting nodes from contacts, and follows it.

A single reading cannot tell a light steady touch from drift. But touches begin and end quickly,
and drift is small and slow. So the drift of a node is followed once its voltage has been within
BAND_LSB of its voltage at rest, and of its recent voltage, for SETTLE_S. A node that leaves that
band counts as touched; it rests again when it jumps back into the band, or comes close to rest.
Neither touched nodes nor those beside a contact are followed, however long the touch lasts.
A load that grows as slowly looks like drift, too, so that drift is followed only so far: FARTHEST.
"""

import numpy as np

from ..base.arrays import Bools, Floats32, Int32s
from ..places.layout import Layout
from .baseline import Baseline, RestRules
from .calibration import AdcScale, Curves

BAND_LSB = 1.5
"""Greatest distance from rest that may be drift, LSB: a node that falls by one count is within, by
two it is not."""
CLOSE_LSB = 0.75
"""A touched node that comes back slowly rests within this distance, LSB: less than a count."""
SETTLE_S = 10.0
"""Time that a node must have rested before it is followed, s; chosen. A change of less than a count
in this time is no jump."""
FARTHEST = 4.0
"""Most drift since the first or a forced tare that is followed, either way, in multiples of the
pressure at which a contact begins; chosen: more than 80 mV over temperature need (make
bench-pressure)."""
FOLLOW_S = 0.5
"""Least interval of following, s. Chosen: drift is seen in seconds, and following takes as long as
reading a frame."""
LONGEST_S = 1.0
"""Longest step of drift, s: after a longer pause it is not caught up with at once. Chosen."""
STRAY_S = 60.0
"""A node off its rest for longer, s, without a contact to explain it, is reported. Chosen."""
_NOTHING_LSB = 0.01
"""Smaller deviations are not followed, LSB: rounding of float32 is 10⁻⁴ of a count at 10 bits."""


class DriftTracker:
    """Moves a baseline's drift_v so that resting nodes read their voltage at rest.

    rules: may be replaced at any time. adc: of the nodes. lsb_v: one count of it, V. rested_s:
    (n,), when each node was last followed at rest, s.
    """

    def __init__(self, adc: AdcScale, beside: Int32s, rules: RestRules) -> None:
        """beside: (n, m), see nodes_beside."""
        self.rules = rules
        self.adc, self.lsb_v = adc, adc.lsb_v
        self._beside = beside.astype(np.intp)  # else cast at each use
        nodes = len(beside)
        self._of: tuple[object, ...] = (None,) * 3  # curves, tare and rules that the next are of
        # Voltages at rest, V; slopes of curves' first pieces, V/Pa; most drift, V; Curves.sign.
        self._rest_v, self._slope, self._farthest_v, self._sign = np.zeros((4, nodes), np.float32)
        self._deviation_v = np.zeros(nodes, dtype=np.float32)
        self._usual_v = np.full(nodes, np.inf, dtype=np.float32)  # where it lately was at rest
        self._trail_v = np.full(nodes, np.inf, dtype=np.float32)  # behind the voltage, at all times
        self._touched = np.zeros(nodes, dtype=bool)
        self._away_s = np.zeros(nodes)  # when it last was not at rest
        self.rested_s = np.zeros(nodes)
        self._stray = np.zeros(nodes, dtype=bool)  # off its rest, and no contact explains it
        self._stray_s = np.zeros(nodes)  # since when
        self._last_s: float | None = None

    def is_due(self, t_s: float) -> bool:
        """Tell whether FOLLOW_S have passed, or time was reset, at device time t_s, s."""
        return self._last_s is None or not 0 <= t_s - self._last_s < FOLLOW_S

    def forget(self) -> None:
        """Forget times: the device's clock starts anew."""
        self._last_s = None
        self._stray[:] = False
        self._begin()

    def follow(
        self,
        baseline: Baseline,
        curves: Curves,
        voltage_v: Floats32,
        reading_pa: Floats32,
        valid: Bools,
        t_s: float,
    ) -> None:
        """Move the baseline's drift up to device time t_s, s.

        voltage_v: (n,) V, without drift. reading_pa: (n,) Pa, after the tare. valid: (n,) bool.
        """
        self._update_rest(curves, baseline)
        if self._last_s is None:
            self._away_s[:] = self.rested_s[:] = self._last_s = t_s
        passed_s = min(max(t_s - self._last_s, 0.0), LONGEST_S)
        self._last_s = t_s
        deviation_v = self._rest_v - voltage_v - baseline.drift_v
        self._deviation_v = deviation_v
        near = valid & (np.abs(deviation_v) < BAND_LSB * self.lsb_v)
        resting = self._untouched(voltage_v, near, valid, passed_s)
        pressed = valid & ~near & (reading_pa > self.rules.release_pa)
        resting[self._beside[pressed]] = False
        np.copyto(self._away_s, t_s, where=~resting)
        stray = valid & ~near & (reading_pa < self.rules.contact_pa)
        np.copyto(self._stray_s, t_s, where=stray & ~self._stray)
        self._stray = stray

        nothing_v = _NOTHING_LSB * self.lsb_v
        np.copyto(self.rested_s, t_s, where=resting & (t_s - self._away_s >= SETTLE_S))
        due = resting & (np.abs(deviation_v) > nothing_v)
        now = due & (t_s - self._away_s >= SETTLE_S)
        if now.any():
            most_v = self._slope * np.float32(self.rules.drift_pa_per_min / 60 * passed_s)
            drift_v = baseline.drift_v + np.clip(deviation_v, -most_v, most_v) * now
            low_v = baseline.tared_drift_v - self._farthest_v
            high_v = baseline.tared_drift_v + self._farthest_v
            # It stays where it is beyond that, as found on file.
            low_v, high_v = np.fmin(low_v, baseline.drift_v), np.fmax(high_v, baseline.drift_v)
            baseline.drift_v = np.clip(drift_v, low_v, high_v)
        change_v = np.clip(voltage_v - self._usual_v, *self._slowly(passed_s)) * resting
        self._usual_v += change_v

    def _untouched(self, voltage_v: Floats32, near: Bools, valid: Bools, passed_s: float) -> Bools:
        """Return (n,) bool, nodes near rest that were not touched since they last rested."""
        band_v = np.float32(BAND_LSB * self.lsb_v)
        np.copyto(self._trail_v, voltage_v, where=np.isinf(self._trail_v))
        behind_v = np.clip(voltage_v - self._trail_v, -2 * band_v, 2 * band_v)
        self._trail_v = voltage_v - behind_v + np.clip(behind_v, *self._slowly(passed_s))
        np.copyto(self._usual_v, np.inf, where=~valid)
        np.copyto(self._usual_v, voltage_v, where=near & np.isinf(self._usual_v))
        home = near & (np.abs(voltage_v - self._usual_v) < band_v)
        back = self._sign * behind_v > band_v
        back |= np.abs(self._deviation_v) < CLOSE_LSB * self.lsb_v
        self._touched = valid & np.where(home, self._touched & ~back, True)
        return np.asarray(home & ~self._touched)

    def _slowly(self, passed_s: float) -> tuple[np.float32, np.float32]:
        """Greatest changes of a voltage that are no jump, down and up, V."""
        most_v = np.float32(self.lsb_v * passed_s / SETTLE_S)
        return -most_v, most_v

    def strays_lsb(self, t_s: float) -> dict[int, float]:
        """Return the nodes off their rest for STRAY_S: distance in LSB by number of the node.

        Negative: they read less than zero. t_s: device time of the newest frame, s.
        """
        if not self.rules.drift_pa_per_min:
            return {}  # drift is not watched
        strays = np.flatnonzero(self._stray & (t_s - self._stray_s > STRAY_S))
        off_lsb = self._sign * self._deviation_v / self.lsb_v
        return {int(i) + 1: float(off_lsb[i]) for i in strays}

    def _update_rest(self, curves: Curves, baseline: Baseline) -> None:
        """Start over with other curves or another tare; with other rules, drift goes as far."""
        of = curves, baseline.rest_v, self.rules
        same = [one is other for one, other in zip(of, self._of, strict=True)]
        if not all(same):
            rest_v = curves.begin_v if baseline.rest_v is None else baseline.rest_v
            far_pa = curves.pressure(rest_v) + FARTHEST * self.rules.contact_pa
            step_v = np.abs(curves.voltage_v[1] - curves.voltage_v[0])
            self._of, self._rest_v, self._sign = of, rest_v, curves.sign
            self._slope = (step_v / curves.pressure_pa[1]).astype(np.float32)
            self._farthest_v = np.abs(rest_v - curves.voltage(far_pa).astype(np.float32))
        if not all(same[:2]):
            self._begin()

    def _begin(self) -> None:
        """Forget where the nodes were."""
        self._usual_v[:] = self._trail_v[:] = np.inf
        self._touched[:] = False


def nodes_beside(layout: Layout, nodes: int) -> Int32s:
    """Return (n, m) int32, indices of the nodes beside each node, padded with its own."""
    placed = layout.nodes > 0
    neighbours = layout.neighbours[placed]
    table = np.repeat(np.arange(nodes, dtype=np.int32)[:, None], neighbours.shape[1], axis=1)
    table[layout.nodes[placed] - 1] = layout.nodes[neighbours] - 1
    return table
