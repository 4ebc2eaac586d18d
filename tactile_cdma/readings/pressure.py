# SPDX-License-Identifier: Apache-2.0

"""Voltages → pressures of a whole skin: curve, dynamics undone, then tare."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .baseline import LOOK_S, Baseline
from .calibration import Calibration
from .drift import DriftTracker
from .dynamics import Compensator


class PressureChain:
    """Turns the nodes' voltages into pressures, frame by frame.

    voltage + drift → curve → lag and hysteresis undone → pressure − tare. A few times a second it
    looks whether drift is to be followed; what that changes shows in the next update.
    """

    def __init__(
        self,
        calibration: Calibration,
        baseline: Baseline,
        tracker: DriftTracker | None = None,
        compensator: Compensator | None = None,
    ) -> None:
        """A tracker follows the drift, a compensator undoes lag and hysteresis; None: nothing."""
        self.calibration = calibration
        self.baseline = baseline
        self.tracker = tracker
        self.compensator = compensator
        self._looked_s: float | None = None
        self._moved = False

    def update(
        self, voltage_v: NDArray[np.float32], valid: NDArray[np.bool_], t_s: float
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Pressures (n,) float32, Pa, and where the sensor's range ends (n,) bool.

        voltage_v: (n,) float32, V. valid: (n,) bool, nodes whose voltage is a reading. t_s: device
        time, s.
        """
        curves, baseline = self.calibration.curves, self.baseline
        corrected_v = voltage_v + baseline.drift_v
        pressure_pa = curves.pressure(corrected_v)
        if self.compensator is not None:
            pressure_pa = self.compensator.update(pressure_pa, valid, t_s)
        reading_pa = pressure_pa - baseline.tare_pa
        saturated = curves.saturated(corrected_v)
        self._moved = False
        if self._due(t_s):
            self._look(voltage_v, pressure_pa, reading_pa, valid, t_s)
        return reading_pa, saturated

    def steady(self, t_s: float) -> bool:
        """Whether the same voltages at t_s (s) give the pressures of the last update."""
        if self._moved or self._due(t_s):
            return False
        # Last, for it takes a yes as an update.
        return self.compensator is None or self.compensator.steady(t_s)

    def forget(self) -> None:
        """The device's clock starts anew."""
        self.baseline.forget()
        if self.tracker is not None:
            self.tracker.forget()
        self.unsettle()

    def unsettle(self) -> None:
        """Something else than the voltages has changed."""
        self._looked_s = None

    def _due(self, t_s: float) -> bool:
        """Whether it is time for another look."""
        return self._looked_s is None or not 0 <= t_s - self._looked_s < LOOK_S

    def _look(
        self,
        voltage_v: NDArray[np.float32],
        pressure_pa: NDArray[np.float32],
        reading_pa: NDArray[np.float32],
        valid: NDArray[np.bool_],
        t_s: float,
    ) -> None:
        self._looked_s = t_s
        self.baseline.look(voltage_v, pressure_pa, valid)
        if self.tracker is None or not self.tracker.rules.drift_pa_per_min:
            return
        before_v, curves = self.baseline.drift_v, self.calibration.curves
        self.tracker.follow(self.baseline, curves, voltage_v, reading_pa, valid, t_s)
        self._moved = self.baseline.drift_v is not before_v
