"""`tactile-cdma calibrate --dynamics`: lag and hysteresis join a skin's calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .calibration import Calibration
from .identify import Identified, identify


def add_dynamics(
    calibration: Calibration,
    t_s: NDArray[np.float64],
    reference_pa: NDArray[np.float64],
    voltage_v: NDArray[np.floating],
) -> tuple[Calibration, str]:
    """The calibration with the dynamics that a record of loading cycles shows, and a report.

    t_s: (m,) times of the frames, s. reference_pa: (m,) known pressure on all taxels at these
    times, Pa. voltage_v: (m, n) of the nodes, V; NaN where there is none.

    Raises CalibrationError, with the reason, where the record cannot tell.
    """
    rows = voltage_v.astype(np.float32)
    curves = calibration.curves
    pressure_pa = np.array([curves.pressure(row) for row in rows]).reshape(rows.shape)
    pressure_pa[:, calibration.uncalibrated] = np.nan
    found = identify(t_s, reference_pa, pressure_pa)
    return replace(calibration, dynamics=found.dynamics), describe(found)


def describe(found: Identified) -> str:
    """A report for people."""
    dynamics = found.dynamics
    opened = np.expm1(np.dot(dynamics.widths, dynamics.weights))
    return "\n".join(
        (
            f"dynamics from {found.cycles} loading cycles",
            f"lag: rising {dynamics.rise_s * 1e3:.0f} ms, falling {dynamics.fall_s * 1e3:.0f} ms",
            f"hysteresis: falling loads read up to {opened:.1%} more than rising ones",
            f"error on the last third, which was not fitted: {found.before_pa:.0f} Pa rms without, "
            f"{found.after_pa:.0f} Pa with compensation ({found.removed:.0%} removed)",
            f"noise grows up to {dynamics.noise_gain:.1f} times while a pressure rises",
        )
    )
