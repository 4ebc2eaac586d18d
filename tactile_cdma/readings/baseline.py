# SPDX-License-Identifier: Apache-2.0

"""Keeps what a skin reads at rest: tare and slow drift, which are taken off its readings."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from ..base.arrays import Bools, Floats32

LOOK_S = 0.125
"""Interval of the looks at the skin for tare and drift, s; chosen: rare enough to cost nothing."""
LOOKS = 8
"""Looks that a tare is taken from: those of the last second."""


@dataclass(frozen=True, slots=True)
class RestRules:
    """Limits of what counts as rest.

    drift_pa_per_min: fastest drift that is followed, Pa/min; 0: none. contact_pa: a node that reads
    more is under load, Pa. release_pa: where a node reads more, Pa, drift is followed neither there
    nor on the nodes beside it.
    """

    drift_pa_per_min: float
    contact_pa: float
    release_pa: float


class Baseline:
    """Holds what is taken off each node's readings, and the last second, of which a tare is made.

    tare_pa: (n,) float32, Pa, pressure at rest (mounting, preload), subtracted from readings.
    drift_v: (n,) float32, V, added to measured voltages to undo what temperature and age do.
    rest_v: (n,) float32, V, the voltage, drift added, at which the tare was taken; None: no tare.
    least_pa: (n,) float32, Pa, the lowest tare since the first or a forced one, taken at least_v,
    (n,) float32, V, as rest_v. tared_drift_v: (n,) float32, V, the drift at that one. From these
    counts what is taken for rest unasked.

    These arrays are replaced, never written to: a reference to one is a snapshot.
    """

    def __init__(self, nodes: int) -> None:
        self.tare_pa = self.least_pa = np.zeros(nodes, dtype=np.float32)
        self.drift_v = np.zeros(nodes, dtype=np.float32)
        self.tared_drift_v = np.zeros(nodes, dtype=np.float32)
        self.rest_v: Floats32 | None = None
        self.least_v: Floats32 | None = None
        self._looks = deque[tuple[Floats32, Floats32, Bools]](maxlen=LOOKS)

    def clear(self) -> None:
        """Forget tare and drift, and the looks taken while they were in force."""
        self.forget()
        self.tare_pa = self.least_pa = np.zeros_like(self.tare_pa)
        self.drift_v = self.tared_drift_v = np.zeros_like(self.drift_v)
        self.rest_v = self.least_v = None

    @property
    def tared(self) -> bool:
        return self.rest_v is not None

    def forget(self) -> None:
        """Forget the looks: they are too old."""
        self._looks.clear()

    def look(self, voltage_v: Floats32, pressure_pa: Floats32, valid: Bools) -> None:
        """Remember what the skin reads now, for the next LOOKS looks.

        voltage_v: (n,) V, without drift_v. pressure_pa: (n,) Pa, before the tare. valid: (n,) bool.
        """
        self._looks.append((voltage_v.copy(), pressure_pa.copy(), valid.copy()))

    @property
    def seen(self) -> bool:
        """Tell whether the skin has been looked at often enough for a tare."""
        return len(self._looks) == LOOKS

    @property
    def last_second(self) -> tuple[Floats32, Floats32, Bools]:
        """Return the last looks, (l, n) each: V without drift_v, Pa before the tare, validity."""
        voltage_v, pressure_pa, valid = map(np.array, zip(*self._looks, strict=True))
        return voltage_v, pressure_pa, valid
