"""Voltages → pressures of a whole skin: curve, then tare."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .baseline import Baseline
from .calibration import Calibration


class PressureChain:
    """Turns the nodes' voltages into pressures, frame by frame.

    voltage + drift → curve → pressure − tare.
    """

    def __init__(self, calibration: Calibration, baseline: Baseline) -> None:
        self.calibration = calibration
        self.baseline = baseline

    def update(
        self, voltage_v: NDArray[np.float32], valid: NDArray[np.bool_], t_s: float
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Pressures (n,) float32, Pa, and where the sensor's range ends (n,) bool.

        voltage_v: (n,) float32, V. valid: (n,) bool, nodes whose voltage is a reading. t_s: device
        time, s.
        """
        curves, baseline = self.calibration.curves, self.baseline
        corrected_v = voltage_v + baseline.drift_v
        return curves.pressure(corrected_v) - baseline.tare_pa, curves.saturated(corrected_v)

    def steady(self, t_s: float) -> bool:
        """Whether the same voltages at t_s (s) give the pressures of the last update."""
        return True
