# SPDX-License-Identifier: Apache-2.0

"""Figures of the simulated sensor beside those of the paper (Liu et al., section IV.A).

Prints the table of docs/sensor.md, the same in QUICK runs, and writes no files.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.sim.sensor import MOST_HYSTERESIS, PAPER, Sensor, SensorModel

SENSITIVITY_V_PER_KPA = (-0.033, -0.0059)
RESPONSE_S, RECOVERY_S = 0.740, 0.024
HYSTERESIS = {55.0: 33.87, 90.0: 10.99, 140.0: 10.62}
"""Liu et al., section IV.A: kPa, and % of the span of the voltage."""
SETTLED = 0.01
"""Response and recovery end this close to the last value."""

_STEP_S, _CYCLE_STEP_S = 1e-3, 4e-3
_RESPONSE_KPA, _RESPONSE_RAMP_S, _HOLD_S = 40.0, 0.5, 5.0
_CYCLE_S = 10.0
_DWELL_STEPS, _DWELL_STEP_S = 20, 0.1


@dataclass(frozen=True, slots=True)
class Figures:
    """What a test bench would measure of a sensor.

    sensitivity_v_per_kpa: of both stages. response_s, recovery_s: from the beginning of a load and
    of its removal, until 1 % of the change is left. hysteresis: by the largest load in kPa, largest
    difference of the voltages at one pressure, % of the cycle's span.
    """

    sensitivity_v_per_kpa: tuple[float, float]
    response_s: float
    recovery_s: float
    hysteresis: dict[float, float]


def measure(model: SensorModel) -> Figures:
    """Put one sensor through the paper's tests."""
    return Figures(
        sensitivity_v_per_kpa=_sensitivity(model),
        response_s=_response_s(model),
        recovery_s=_recovery_s(model),
        hysteresis=hysteresis(model),
    )


def hysteresis(model: SensorModel) -> dict[float, float]:
    """Hysteresis in % by the largest load in kPa: triangles of 0.1 Hz, the second cycle of two."""
    loads_kpa = np.array(list(HYSTERESIS))
    share = np.arange(0, 2 * _CYCLE_S, _CYCLE_STEP_S) / _CYCLE_S % 1.0
    pressure_kpa = (1 - np.abs(1 - 2 * share))[:, None] * loads_kpa
    voltage_v = _run(model, pressure_kpa, _CYCLE_STEP_S)
    middle = len(share) * 3 // 4
    falls = voltage_v[:middle:-1]
    rises = voltage_v[len(share) // 2 + 1 : len(share) // 2 + 1 + len(falls)]
    gap_v = np.abs(rises - falls).max(axis=0)
    span_v = np.ptp(voltage_v[len(share) // 2 :], axis=0)
    return dict(zip(HYSTERESIS, (100 * gap_v / span_v).tolist(), strict=True))


def matching(load_kpa: float) -> float:
    """The option `hysteresis` that gives the paper's figure at this load, closely."""
    option, found = 1.0, math.inf
    while abs(found / HYSTERESIS[load_kpa] - 1) > 0.005:
        found = hysteresis(SensorModel(kind=PAPER, hysteresis=option))[load_kpa]
        option = min(option * HYSTERESIS[load_kpa] / found, MOST_HYSTERESIS)
    return option


def describe() -> str:
    """The table that is printed."""
    figures = measure(SensorModel(kind=PAPER))
    lines = [("", "paper", "simulated", "")]
    stages = zip(SENSITIVITY_V_PER_KPA, figures.sensitivity_v_per_kpa, strict=True)
    for stage, (paper, found) in zip(("0…50 kPa", "50…140 kPa"), stages, strict=True):
        lines.append((f"sensitivity {stage}", f"{paper:.4f}", f"{found:.4f}", "V/kPa"))
    for name, paper, found in (
        ("response, 40 kPa in 0.5 s", RESPONSE_S, figures.response_s),
        ("recovery, 40 kPa at once", RECOVERY_S, figures.recovery_s),
    ):
        lines.append((name, f"{paper * 1e3:.0f}", f"{found * 1e3:.0f}", "ms"))
    for load_kpa, paper in HYSTERESIS.items():
        found = figures.hysteresis[load_kpa]
        note = f"%; hysteresis={matching(load_kpa):.2f} gives the paper's"
        lines.append((f"hysteresis to {load_kpa:.0f} kPa", f"{paper:.2f}", f"{found:.2f}", note))
    return "\n".join(
        f"{name:<26}{paper:>9}{found:>11}  {unit}".rstrip() for name, paper, found, unit in lines
    )


def _sensitivity(model: SensorModel) -> tuple[float, float]:
    """Slopes of lines through settled voltages under rising loads, V/kPa."""
    loads_kpa = np.arange(0.0, 145.0, 5.0)
    held = np.repeat(loads_kpa, _DWELL_STEPS)[:, None]
    settled_v = _run(model, held, _DWELL_STEP_S)[_DWELL_STEPS - 1 :: _DWELL_STEPS, 0]
    first, second = loads_kpa <= 50, loads_kpa >= 50
    slopes = [np.polyfit(loads_kpa[stage], settled_v[stage], 1)[0] for stage in (first, second)]
    return float(slopes[0]), float(slopes[1])


def _response_s(model: SensorModel) -> float:
    t_s = np.arange(0, _RESPONSE_RAMP_S + _HOLD_S, _STEP_S)
    return _settling_s(model, _RESPONSE_KPA * np.minimum(t_s / _RESPONSE_RAMP_S, 1.0))


def _recovery_s(model: SensorModel) -> float:
    released = np.zeros(round(_HOLD_S / _STEP_S))
    released[0] = _RESPONSE_KPA
    return _settling_s(model, released)


def _settling_s(model: SensorModel, pressure_kpa: NDArray[np.float64]) -> float:
    """From the first pressure until the voltage stays within SETTLED of its change, s."""
    voltage_v = _run(model, pressure_kpa[:, None])[:, 0]
    left = np.abs(voltage_v - voltage_v[-1]) / abs(voltage_v[0] - voltage_v[-1])
    return float(np.flatnonzero(left > SETTLED + 1e-9)[-1] + 1) * _STEP_S


def _run(
    model: SensorModel, pressure_kpa: NDArray[np.float64], step_s: float = _STEP_S
) -> NDArray[np.float64]:
    """Voltages (m, n), V, under pressures (m, n), kPa, step_s apart."""
    sensor = Sensor(model, pressure_kpa.shape[1])
    return np.array(
        [sensor.step(row, index * step_s) for index, row in enumerate(pressure_kpa * 1e3)]
    )


if __name__ == "__main__":
    print(describe())
