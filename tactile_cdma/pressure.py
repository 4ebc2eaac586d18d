"""Voltages → pressures of a whole skin: curve, dynamics undone, then tare."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .baseline import Baseline
from .calibration import Calibration
from .dynamics import Compensator


class PressureChain:
    """Turns the nodes' voltages into pressures, frame by frame.

    voltage + drift → curve → lag and hysteresis undone → pressure − tare.
    """

    def __init__(
        self,
        calibration: Calibration,
        baseline: Baseline,
        compensator: Compensator | None = None,
    ) -> None:
        """compensator: undoes lag and hysteresis; None: they are left as they are."""
        self.calibration = calibration
        self.baseline = baseline
        self.compensator = compensator

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
        return pressure_pa - baseline.tare_pa, curves.saturated(corrected_v)

    def steady(self, t_s: float) -> bool:
        """Whether the same voltages at t_s (s) give the pressures of the last update."""
        return self.compensator is None or self.compensator.steady(t_s)
