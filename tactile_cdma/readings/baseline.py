# SPDX-License-Identifier: Apache-2.0

"""What a skin at rest reads: tare and slow drift, which readings are freed of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LOOK_S = 0.125
"""The skin is looked at so often: for tares, and for drift."""
LOOKS = 8
"""Looks that a tare is taken from: the last second."""


@dataclass(frozen=True, slots=True)
class RestRules:
    """What counts as rest.

    drift_pa_per_min: fastest drift that is followed, Pa/min; 0: none. contact_pa: a node that reads
    more is under load. release_pa: one that reads more keeps the drift of itself and of the nodes
    beside it from being followed.
    """

    drift_pa_per_min: float
    contact_pa: float
    release_pa: float


class Baseline:
    """Per node, what is taken off, and the last second that a tare is taken from.

    tare_pa: (n,) float32, Pa, pressure at rest (mounting, preload), subtracted from readings.
    drift_v: (n,) float32, V, added to measured voltages to undo what temperature and age do.
    rest_v: (n,) float32, V, the voltage, drift added, at which the tare was taken; None: no tare.

    The arrays are replaced, never written to: who holds one holds a snapshot.
    """

    def __init__(self, nodes: int) -> None:
        self.tare_pa = np.zeros(nodes, dtype=np.float32)
        self.drift_v = np.zeros(nodes, dtype=np.float32)
        self.rest_v: NDArray[np.float32] | None = None
        self._looks = 0
        self._voltage_v = np.zeros((LOOKS, nodes), dtype=np.float32)
        self._pressure_pa = np.zeros((LOOKS, nodes), dtype=np.float32)
        self._valid = np.zeros((LOOKS, nodes), dtype=bool)

    def clear(self) -> None:
        """Forget tare and drift, and what was seen while they were in force."""
        self.forget()
        self.tare_pa = np.zeros_like(self.tare_pa)
        self.drift_v = np.zeros_like(self.drift_v)
        self.rest_v = None

    @property
    def tared(self) -> bool:
        """Whether there is a tare."""
        return self.rest_v is not None

    def forget(self) -> None:
        """What was seen is too long ago."""
        self._looks = 0

    def look(
        self,
        voltage_v: NDArray[np.float32],
        pressure_pa: NDArray[np.float32],
        valid: NDArray[np.bool_],
    ) -> None:
        """Remember what the skin reads now.

        voltage_v: (n,) V, without drift_v. pressure_pa: (n,) Pa, before the tare. valid: (n,) bool.
        """
        at = self._looks % LOOKS
        self._voltage_v[at], self._pressure_pa[at], self._valid[at] = voltage_v, pressure_pa, valid
        self._looks += 1

    @property
    def seen(self) -> bool:
        """Whether the skin has been looked at often enough for a tare."""
        return self._looks >= LOOKS

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(n,) bool, nodes with a valid reading in every one of the last looks."""
        return np.asarray(self._valid.all(axis=0))

    @property
    def ever_valid(self) -> NDArray[np.bool_]:
        """(n,) bool, nodes with a valid reading in any of the last looks."""
        return np.asarray(self._valid.any(axis=0))

    @property
    def voltage_v(self) -> NDArray[np.float32]:
        """(n,) float32, V, median of the last looks, without drift_v."""
        return np.asarray(np.median(self._voltage_v, axis=0))

    @property
    def pressure_pa(self) -> NDArray[np.float32]:
        """(n,) float32, Pa, median of the last looks, before the tare."""
        return np.asarray(np.median(self._pressure_pa, axis=0))

    @property
    def span_v(self) -> NDArray[np.float32]:
        """(n,) float32, V, by how much the voltages of the last looks differ."""
        return np.asarray(np.ptp(self._voltage_v, axis=0))
