# SPDX-License-Identifier: Apache-2.0

"""Curve fits: exact without noise, near the quantisation limit, not bent by outliers."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_cdma.calibrating.curve_fit import CurveFit, fit_curves, levels_of
from tactile_cdma.readings.calibration import AdcScale, Curves, PressureCurve

ADC = AdcScale()
NOISE_V = ADC.lsb_v / math.sqrt(12)
RANGE_PA = 140e3
LOADS_PA = np.linspace(0, RANGE_PA, 40)


def sensors(count: int, seed: int, spread: float = 0.1) -> Curves:
    """The paper's sensor with V0, knee and both slopes off by up to a share."""
    rng = np.random.default_rng(seed)

    def vary(value: float) -> np.ndarray:
        return value * (1 + spread * rng.uniform(-1, 1, count))

    v0, knee, slope1, slope2 = vary(2.95), vary(50e3), vary(0.033e-3), vary(0.0059e-3)
    knee_v = v0 - slope1 * knee
    return Curves(
        np.array([np.zeros(count), knee, np.full(count, RANGE_PA)]),
        np.array([v0, knee_v, knee_v - slope2 * (RANGE_PA - knee)]),
    )


def voltages(curves: Curves, loads_pa: np.ndarray = LOADS_PA) -> np.ndarray:
    return np.array([curves.voltage(load) for load in loads_pa]).T


def quantised(voltage_v: np.ndarray) -> np.ndarray:
    return ADC.voltage(ADC.code(voltage_v))


def fit(voltage_v: np.ndarray, pieces: int = 2, loads_pa: np.ndarray = LOADS_PA) -> CurveFit:
    return fit_curves(np.broadcast_to(loads_pa, voltage_v.shape), voltage_v, pieces, NOISE_V)


@st.composite
def curves_of(draw: st.DrawFn, pieces: int) -> PressureCurve:
    """Curves whose slopes differ, with three or more of 40 even loads on every piece."""
    widths = draw(st.lists(st.floats(0.25, 1.0), min_size=pieces, max_size=pieces))
    corners = np.concatenate(([0.0], np.cumsum(widths))) / sum(widths)
    slopes = [draw(st.floats(0.2, 1.0))]
    for _ in range(pieces - 1):
        factor = draw(st.floats(0.1, 0.6))
        slopes.append(slopes[-1] * (factor if draw(st.booleans()) else 1 / factor))
    falls = np.concatenate(([0.0], np.cumsum(np.array(slopes) * np.diff(corners))))
    scale = draw(st.floats(1e3, 1e7))
    return PressureCurve(tuple(corners * scale), tuple(3.2 - 2.5 * falls / falls[-1]))


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 2).flatmap(curves_of))
def test_without_noise_the_curve_is_found_exactly(curve: PressureCurve) -> None:
    loads_pa = np.linspace(0, curve.pressure_pa[-1], 40)
    found = fit(curve.voltage(loads_pa)[None, :], len(curve.pressure_pa) - 1, loads_pa)
    assert found.corner_v[0] == pytest.approx(curve.voltage_v, abs=1e-6)
    assert found.corner_pa[0] == pytest.approx(curve.pressure_pa, abs=1e-6 * curve.pressure_pa[-1])
    assert found.used.all()
    assert np.abs(found.residual_v).max() < 1e-6


def test_three_stages_are_found_exactly() -> None:
    """Knees are added one at a time: each shows before the next one is known."""
    curve = PressureCurve((0.0, 30e3, 80e3, RANGE_PA), (3.2, 1.9, 1.1, 0.8))
    found = fit(curve.voltage(LOADS_PA)[None, :], 3)
    assert found.corner_pa[0] == pytest.approx(curve.pressure_pa, rel=1e-6, abs=1e-3)
    assert found.corner_v[0] == pytest.approx(curve.voltage_v, abs=1e-6)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_held_out_readings_are_within_a_tenth_of_the_quantisation_limit(seed: int) -> None:
    truth = sensors(24, seed)
    found = fit(quantised(voltages(truth)))
    fitted = Curves(found.corner_pa.T, found.corner_v.T)
    slopes = -np.diff(truth.voltage_v, axis=0) / np.diff(truth.pressure_pa, axis=0)
    for low, high, stage in ((1e3, 44e3, 0), (57e3, 139e3, 1)):
        held_out = np.linspace(low, high, 1501)
        errors = [
            fitted.pressure(quantised(truth.voltage(load)).astype(np.float32)) - load
            for load in held_out
        ]
        relative = np.array(errors) / (NOISE_V / slopes[stage])
        assert np.sqrt(np.mean(np.square(relative))) <= 1.1


@pytest.mark.parametrize("outliers", [1, 4, 7])
def test_gross_outliers_do_not_bend_it(outliers: int) -> None:
    truth, rng = sensors(48, 5), np.random.default_rng(outliers)
    voltage_v = voltages(truth)
    wrong = np.zeros(voltage_v.shape, dtype=bool)
    for row in wrong:
        row[rng.choice(len(row), outliers, replace=False)] = True
    voltage_v[wrong] += rng.choice([-1, 1], wrong.sum()) * rng.uniform(0.1, 3.0, wrong.sum())
    found = fit(voltage_v)
    assert np.array_equal(found.used, ~wrong) or np.mean(found.used != ~wrong) < 2e-3
    inner_pa = np.linspace(0, 0.9 * RANGE_PA, 50)  # the last points may be outliers
    fitted = Curves(found.corner_pa.T, found.corner_v.T)
    assert np.abs(voltages(fitted, inner_pa) - voltages(truth, inner_pa)).max() < ADC.lsb_v


def test_sensors_do_not_touch_each_other() -> None:
    """Sensors with different numbers of points, fitted together, give the same as alone."""
    truth = sensors(6, 7)
    voltage_v = quantised(voltages(truth))
    for row in range(6):
        voltage_v[row, 40 - row :] = np.nan
    together = fit(voltage_v)
    for row in range(6):
        kept = np.isfinite(voltage_v[row])
        alone = fit(voltage_v[row : row + 1, kept], loads_pa=LOADS_PA[kept])
        assert together.corner_v[row] == pytest.approx(alone.corner_v[0], abs=1e-9)
        assert together.sigma_v[row] == pytest.approx(alone.sigma_v[0])
    assert np.array_equal(np.isnan(together.residual_v), np.isnan(voltage_v))


def test_order_and_unit_of_the_loads_do_not_matter() -> None:
    voltage_v = quantised(voltages(sensors(4, 8)))
    shuffled = np.random.default_rng(0).permutation(40)
    plain, mixed = fit(voltage_v), fit(voltage_v[:, shuffled], loads_pa=LOADS_PA[shuffled] * 7)
    assert mixed.corner_pa == pytest.approx(plain.corner_pa * 7, rel=1e-9)
    assert mixed.corner_v == pytest.approx(plain.corner_v, abs=1e-9)


def test_sigma_is_that_of_the_noise() -> None:
    truth, sigma_v = sensors(64, 9), 0.02
    voltage_v = voltages(truth) + np.random.default_rng(1).normal(0, sigma_v, (64, 40))
    found = fit(voltage_v)
    assert np.sqrt(np.mean(np.square(found.sigma_v))) == pytest.approx(sigma_v, rel=0.08)


def test_a_knee_that_is_not_there_is_not_found() -> None:
    rng = np.random.default_rng(3)
    straight = 3.0 - 1.5 * LOADS_PA / RANGE_PA + rng.normal(0, 0.01, (200, 40))
    assert fit(straight).knee_found.mean() < 0.02
    assert fit(quantised(voltages(sensors(200, 4)))).knee_found.all()
    assert fit(straight, pieces=1).knee_found.all()


def test_levels_are_different_loads() -> None:
    assert levels_of(np.array([0.0, 1.0, 0.501, 0.5, 0.0, 0.2])).tolist() == [0, 0.2, 0.5, 1]
    assert levels_of(np.array([3.0, 3.0, 0.01, 3.0, 0.0])).tolist() == [0.0, 3.0]
