# SPDX-License-Identifier: Apache-2.0

"""Identifies lag and hysteresis of a skin's sensors from loading cycles with a known pressure.

The model is that of `readings.dynamics`. For given time constants its logarithmic reading is linear
in the weights of the plays, which non-negative least squares give; nonlinear least squares over the
time constants, and over the clock offset of the known pressure where that is uncertain, do the rest
(variable projection). The last third of the record is held out: there the result has to remove
error, through the same compensation that the driver runs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats, Floats32
from ..base.errors import CalibrationError
from ..readings.dynamics import Compensator, Dynamics, Lag, Plays

WIDTHS = (0.03, 0.06, 0.1, 0.15, 0.22, 0.32, 0.45, 0.65, 0.9, 1.3)
"""Widths of the plays, on the logarithmic axis: chosen to span 3 % of a load to more than half."""
MOST_WEIGHT = 0.75
"""Bound of the sum of all weights: the inverse multiplies noise by 1/(1 − sum), here 4."""
LEAST_CYCLES = 3
"""Loading cycles: two to fit, and one in the third that is held out."""
LEAST_POINTS = 200
"""Frames; chosen: some 20 for each of the twelve or thirteen unknowns, less the third held out."""
LEAST_LOAD_PA = 5e3
"""Largest load, Pa; chosen: well above SCALE_PA, where the model is no longer linear."""
LEAST_REMOVED = 0.1
"""Share of the error that must be removed; chosen: a fit to noise removes a few per cent."""
MOST_LEFT = 0.2
"""Largest remaining error, as a share of the largest load; chosen: more is of no use."""
SCALE_PA = 2e3
"""Pressure at which the logarithmic axis turns linear, Pa: the default of `Dynamics.scale_pa`."""
_LEAST_S, _MOST_S = (2e-3, 2e-3), (3.0, 1.0)
"""Limits of the time constants of rising and falling pressures, s; chosen: from a fraction of a
frame to several times what the paper's sensor has (docs/sensor.md)."""
_STEP = 1e-3
"""Step of the numerical derivatives: a thousandth of a time constant, or of the uncertainty."""
_TOLERANCE = 1e-4
"""Relative change of cost or unknowns that ends the search: less than what noise changes."""
_PROBE_S = 0.1
"""Lag that the loads must be quick enough to show, s; chosen: about that of the paper's sensor."""


@dataclass(frozen=True, eq=False)
class Identified:
    """Dynamics, and what their compensation makes of cycles that they were not fitted to.

    cycles: loads and releases in the record. late_s: by how much the reference was late, s.
    The m frames of n nodes that were not fitted: t_s, (m,) s; reference_pa, (m,) known pressure,
    Pa; static_pa, compensated_pa, (m, n) Pa, NaN where a node has no reading.
    """

    dynamics: Dynamics
    cycles: int
    late_s: float
    t_s: Floats
    reference_pa: Floats
    static_pa: NDArray[np.floating]
    compensated_pa: NDArray[np.floating]

    @property
    def before_pa(self) -> float:
        """Rms error of the static pressures, Pa, median of the nodes."""
        return self._error_pa(self.static_pa)

    @property
    def after_pa(self) -> float:
        """Rms error of the compensated pressures, Pa, median of the nodes."""
        return self._error_pa(self.compensated_pa)

    @property
    def removed(self) -> float:
        """Share of the error that compensation removes."""
        return 1.0 - self.after_pa / self.before_pa

    def _error_pa(self, pressure_pa: NDArray[np.floating]) -> float:
        error_pa = np.ma.masked_invalid(pressure_pa - self.reference_pa[:, None])
        return float(np.nanmedian(np.sqrt((error_pa**2).mean(axis=0).filled(np.nan))))


def identify(
    t_s: Floats, reference_pa: Floats, pressure_pa: NDArray[np.floating], uncertain_s: float = 0.0
) -> Identified:
    """Identify the dynamics that all sensors of a skin share; needs scipy.

    t_s: (m,) rising, s. reference_pa: (m,) the known pressure on all taxels, Pa, ≥ 0. pressure_pa:
    (m, n) what the static curves make of the voltages of n nodes, Pa; NaN where there is none.
    uncertain_s: bound of the offset, early or late, of the reference's clock, s.

    Raises CalibrationError, with the reason, where the record cannot tell.
    """
    _check(t_s, reference_pa, pressure_pa)
    cycles = _cycles(reference_pa)
    if cycles < LEAST_CYCLES:
        raise CalibrationError(
            f"the loads rise and fall {cycles} times; dynamics take {LEAST_CYCLES} cycles or more"
        )
    heard = np.isfinite(pressure_pa).any(axis=1)
    t_s, reference_pa, pressure_pa = t_s[heard], reference_pa[heard], pressure_pa[heard]
    fitted = len(t_s) * 2 // 3
    record = _Record(t_s, reference_pa, np.nanmedian(pressure_pa[:fitted], axis=1), uncertain_s)
    dynamics, late_s = _search(record)
    reference_pa = np.interp(t_s + late_s, t_s, reference_pa)[fitted:]
    compensated_pa = _compensated(dynamics, t_s, pressure_pa)[fitted:]
    found = Identified(
        dynamics, cycles, late_s, t_s[fitted:], reference_pa, pressure_pa[fitted:], compensated_pa
    )
    if not found.after_pa < (1 - LEAST_REMOVED) * found.before_pa:
        raise CalibrationError(
            "what the first cycles taught makes the last ones hardly better: "
            f"{found.before_pa:.0f} Pa rms before, {found.after_pa:.0f} Pa after; do the "
            "curves and the reference belong together?"
        )
    if found.after_pa > MOST_LEFT * reference_pa.max():
        raise CalibrationError(
            f"{found.after_pa:.0f} Pa rms stay of loads up to {reference_pa.max():.0f} Pa: do the "
            "capture, the reference and the curves belong together?"
        )
    return found


@dataclass(frozen=True, eq=False)
class _Record:
    """A record of f frames, of which the first m are fitted.

    t_s: (f,) s. reference_pa: (f,) Pa. measured_pa: (m,) median of the nodes, Pa. uncertain_s:
    bound of the reference's clock offset, s. A try is (ln rise_s, ln fall_s, offset as a share of
    uncertain_s).
    """

    t_s: Floats
    reference_pa: Floats
    measured_pa: Floats
    uncertain_s: float

    def delayed(self, tries: Floats) -> Floats:
        """The known pressure behind the lags of k tries, (k, 3): (m, k) Pa."""
        t_s, late_s = self.t_s[: len(self.measured_pa)], self.uncertain_s * tries[:, 2]
        known_pa = np.interp(t_s[:, None] + late_s, self.t_s, self.reference_pa)
        lag, passed_s = Lag(*np.exp(tries[:, :2].T)), np.diff(t_s, prepend=t_s[0]).tolist()
        return np.array([lag.update(*now) for now in zip(known_pa, passed_s, strict=True)])

    def explain(self, tries: Floats) -> tuple[Floats, Floats]:
        """Best weights of the plays for k tries, (k, 3), and what stays unexplained.

        Returns (k, j) weights and (k, m) Pa.
        """
        levels = np.log1p(self.delayed(tries) / SCALE_PA)
        plays = Plays(np.array(WIDTHS), len(tries), np.float64)
        behind = np.array([plays.follow(level) - level for level in levels])  # (m, j, k)
        missing = np.log1p(self.measured_pa[:, None] / SCALE_PA) - levels
        # Errors on the logarithmic axis, times this, are errors in Pa.
        slope_pa = SCALE_PA + self.measured_pa
        behind *= slope_pa[:, None, None]
        missing *= slope_pa[:, None]
        weights = np.array([_weights(*pair) for pair in zip(behind.T, missing.T, strict=True)])
        return weights, missing.T - np.einsum("mjk,kj->km", behind, weights)


def _weights(behind: Floats, missing: Floats) -> Floats:
    """Non-negative weights of the plays, (j, m), whose sum explains most of (m,); bounded."""
    from scipy.optimize import nnls  # slow to load, and an extra

    weights = nnls(behind.T, missing, maxiter=1000)[0]
    return np.asarray(weights * MOST_WEIGHT / max(weights.sum(), MOST_WEIGHT))


def _search(record: _Record) -> tuple[Dynamics, float]:
    """The dynamics that leave the least error, and by how much the reference is late, s."""
    from scipy.optimize import least_squares

    def slopes(x: Floats) -> Floats:
        left_pa = record.explain(np.vstack((x, x + _STEP * np.eye(len(x)))))[1]
        return np.asarray((left_pa[1:] - left_pa[0]).T / _STEP)

    low, high = np.append(np.log(_LEAST_S), -1.0), np.append(np.log(_MOST_S), 1.0)
    found = least_squares(
        lambda x: record.explain(x[None])[1][0],
        (low + high) / 2,
        slopes,
        bounds=(low, high),
        ftol=_TOLERANCE,
        xtol=_TOLERANCE,
    )
    rise, fall, late = found.x.tolist()
    if record.uncertain_s and abs(late) > 1 - _STEP:
        raise CalibrationError(
            f"the clocks differ by {record.uncertain_s:g} s or more from the offset that was found "
            "by matching the loads: give --offset"
        )
    constants = np.log([[1e-6, 1e-6], [_PROBE_S, 1e-6]])
    quick_pa, slow_pa = record.delayed(np.insert(constants, 2, late, axis=1)).T
    shown_pa, left_pa = (np.sqrt(np.mean(x**2)) for x in (slow_pa - quick_pa, found.fun))
    if shown_pa < left_pa:
        raise CalibrationError(
            f"a lag of {_PROBE_S:g} s would change the readings by {shown_pa:.0f} Pa rms, but "
            f"{left_pa:.0f} Pa stay unexplained anyway: the loads change too slowly to tell, or "
            "capture and reference do not belong together"
        )
    weights = tuple(record.explain(found.x[None])[0][0].tolist())
    rise_s, fall_s = np.exp([rise, fall]).tolist()
    return Dynamics(rise_s, fall_s, WIDTHS, weights, SCALE_PA), record.uncertain_s * late


def _compensated(dynamics: Dynamics, t_s: Floats, pressure_pa: NDArray[np.floating]) -> Floats32:
    everywhere = np.ones(pressure_pa.shape[1], dtype=bool)
    # The bound of the range is not to help.
    compensator = Compensator(dynamics, everywhere * 2.0 * np.nanmax(pressure_pa))
    readings = zip(pressure_pa.astype(np.float32), t_s.tolist(), strict=True)
    return np.array([compensator.update(row, everywhere, t) for row, t in readings])


def _check(t_s: Floats, reference_pa: Floats, pressure_pa: NDArray[np.floating]) -> None:
    if len(t_s) < LEAST_POINTS:
        raise CalibrationError(f"{len(t_s)} frames; dynamics take {LEAST_POINTS} or more")
    if not np.all(np.diff(t_s) > 0):
        raise CalibrationError("times must rise from frame to frame")
    if np.isfinite(pressure_pa).any(axis=1).mean() < 0.5:
        raise CalibrationError("in more than half of the frames no node has a reading")
    if (highest_pa := reference_pa.max()) < LEAST_LOAD_PA:
        raise CalibrationError(
            f"the loads reach {highest_pa:.0f} Pa; dynamics take {LEAST_LOAD_PA:.0f} Pa or more. "
            "Is the reference in Pa?"
        )
    if np.ptp(reference_pa) < 0.1 * highest_pa:
        raise CalibrationError("the reference pressure hardly changes; dynamics take cycles")


def _cycles(reference_pa: Floats) -> int:
    """How often the load rises well above its middle after it was well below."""
    low, high = np.quantile(reference_pa, (0.02, 0.98))
    share = (reference_pa - low) / (high - low)
    pressed = share[(share < 0.4) | (share > 0.6)] > 0.5
    return int(np.count_nonzero(pressed[1:] & ~pressed[:-1]))
