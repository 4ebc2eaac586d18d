# SPDX-License-Identifier: Apache-2.0

"""Fits of curves: exact without noise, near the limit, or refused for a reason; of many nodes."""

import math
import re

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tactile_cdma.calibrating.curve_fit import CurveFit, fit_curves, levels_of
from tactile_cdma.calibrating.load_points import LoadPoints
from tactile_cdma.calibrating.report import (
    advice,
    describe,
    errors,
    results,
    rms_pa,
    stages,
    warnings,
)
from tactile_cdma.calibrating.skin_fit import POWER_LAW, SkinFit, fit_skin
from tactile_cdma.readings.calibration import POWER_PIECES, AdcScale, Curves, PressureCurve

ADC = AdcScale()
CURVE = PressureCurve.two_stage(v0_v=3.0)
UP_PA = np.linspace(0, 140e3, 21)
LOADS_PA = np.concatenate([UP_PA, UP_PA[-2::-1]])
NODES = 3


def points_of(loads_pa: np.ndarray, volts: dict[int, np.ndarray]) -> LoadPoints:
    """Load by load, node by node, from line 2 of a file on."""
    node = np.tile(list(volts), len(loads_pa))
    return LoadPoints(
        node=node,
        pressure_pa=np.repeat(loads_pa, len(volts)),
        voltage_v=np.array(list(volts.values())).T.ravel(),
        line=np.arange(2, 2 + len(node)),
        source="loads.csv",
    )


def read(loads_pa: np.ndarray, curve: PressureCurve = CURVE) -> np.ndarray:
    return ADC.voltage(ADC.code(curve.voltage(loads_pa)))


def fit_with(volts: np.ndarray, loads_pa: np.ndarray = LOADS_PA, pieces: int = 2) -> SkinFit:
    """Fit a skin whose node 2 gives these voltages, and whose other nodes are right."""
    good = read(loads_pa)
    points = points_of(loads_pa, {1: good, 2: volts, 3: good})
    return fit_skin(points, NODES, ADC, pieces)


@pytest.mark.parametrize(
    "other",
    [
        PressureCurve.two_stage(v0_v=2.8, knee_pa=45e3, stage1_v_per_pa=0.03e-3),
        PressureCurve(CURVE.pressure_pa, tuple(3.1 - volts for volts in CURVE.voltage_v)),
    ],
    ids=["falls", "rises"],
)
def test_every_node_gets_its_curve(other: PressureCurve) -> None:
    """Voltages may rise on one node and fall on others."""
    fit = fit_with(read(LOADS_PA, other))
    assert not fit.refused
    assert not fit.outlier.any()
    for node, curve in ((1, CURVE), (2, other), (3, CURVE)):
        assert fit.curves[node].pressure_pa == pytest.approx(curve.pressure_pa, abs=150)
        assert fit.curves[node].voltage_v == pytest.approx(curve.voltage_v, abs=ADC.lsb_v)
    assert ("voltages rise with the pressure: node 2" in describe(fit)) == other.rises
    assert np.abs(fit.residual_pa).max() < 1.1 * ADC.lsb_v / 5.9e-6


def _noisy() -> np.ndarray:
    return np.clip(read(LOADS_PA) + np.random.default_rng(0).normal(0, 0.4, len(LOADS_PA)), 0.1, 3)


def _contradicting() -> np.ndarray:
    volts = read(LOADS_PA)
    volts[:40:4] = 0.2
    return volts


def _rising_at_the_end() -> np.ndarray:
    return read(LOADS_PA) + 0.012e-3 * np.clip(LOADS_PA - 50e3, 0, None)


@pytest.mark.parametrize(
    ("volts", "reason"),
    [
        (np.full(len(LOADS_PA), 3.0), "changes by 0 mV only.*was the load on this node"),
        (np.full(len(LOADS_PA), 3.3 - ADC.lsb_v), "41 of 41 voltages are at an end.*connected"),
        (np.zeros(len(LOADS_PA)), "41 of 41 voltages are at an end"),
        (_noisy(), "too noisy: .* V rms from point to point"),
        (_contradicting(), r"10 of 41 points contradict the others \(lines 3, 15, 27, 39"),
        (_rising_at_the_end(), "does not fall from 50.* to 140.0 kPa .lines "),
        (3.0 - 0.01e-3 * LOADS_PA, "no knee up to 140 kPa: the loads do not reach it"),
        (1.0 + 0.01e-3 * LOADS_PA, "no knee up to 140 kPa"),
    ],
)
def test_a_bad_node_alone_is_refused_with_the_reason(volts: np.ndarray, reason: str) -> None:
    fit = fit_with(volts)
    assert list(fit.curves) == [1, 3]
    assert list(fit.refused) == [2]
    with pytest.raises(AssertionError, match=reason):
        raise AssertionError(fit.refused[2])
    assert np.isnan(fit.residual_v[fit.points.node == 2]).all()
    assert f"node 2: no curve: {fit.refused[2]}" in describe(fit)


@pytest.mark.parametrize(
    ("loads_kpa", "reason"),
    [
        ([0, 20, 60, 100, 140], "5 different loads; a curve of 2 pieces needs 6"),
        ([0, 0.1, 0.2, 20, 20.1, 60, 100, 100, 140], "5 different loads"),
        ([0, 0, 0], "no load but 0"),
        ([60, 70, 80, 90, 100, 120, 140], "no load below 60 kPa"),
        ([0, 5, 10, 15, 20, 25, 140], "no load between 25 and 140 kPa"),
        ([0, 5, 10, 15, 20, 25, 30], "no knee up to 30 kPa"),
    ],
)
def test_loads_that_do_not_tell_are_refused(loads_kpa: list[float], reason: str) -> None:
    loads_pa = np.array(loads_kpa) * 1e3
    fit = fit_with(read(loads_pa), loads_pa)
    assert set(fit.refused) == {1, 2, 3}
    assert all(reason in refusal for refusal in fit.refused.values())
    assert "fitted" in describe(fit)


def test_one_piece_may_do_and_a_node_without_points_is_named() -> None:
    loads_pa = np.arange(0, 31e3, 5e3)
    fit = fit_with(read(loads_pa), loads_pa, pieces=1)
    assert not fit.refused
    assert fit.curves[1].pressure_pa == (0.0, 30e3)
    fit = fit_skin(points_of(LOADS_PA, {1: read(LOADS_PA), 3: read(LOADS_PA)}), 4, ADC)
    assert fit.refused == {2: "no points", 4: "no points"}


FSR_402_G = np.array([20, 50, 100, 250, 500, 1000, 2000, 4000, 7000, 10_000])
FSR_402_OHM = np.array([30e3, 10e3, 6e3, 3.5e3, 2e3, 1250, 750, 450, 300, 250])
"""Interlink's FSR 402, force and resistance as its integration guide draws them."""


@pytest.mark.parametrize("rises", [True, False])
def test_a_power_law_is_advised_where_it_fits_better(rises: bool) -> None:
    """On a sensor's data sheet, over 1 cm²: 24 kPa rms of 981 with it, 95 with two pieces."""
    load_pa, fixed_ohm = FSR_402_G * 9.80665e-3 / 1e-4, 1e3
    share = fixed_ohm / (FSR_402_OHM + fixed_ohm)
    volts = ADC.voltage(ADC.code(3.3 * (share if rises else 1 - share)))
    points = points_of(np.append(load_pa, 0.0), {1: np.append(volts, 0.0 if rises else 3.3)})
    in_pieces = fit_skin(points, 1, ADC)
    assert rms_pa(in_pieces) == pytest.approx(95e3, rel=0.03)
    assert re.match("--power-law would be off by 1.* kPa .*, not ", advice(in_pieces, 1) or "")
    assert "node 1: at rest before where the curve begins" in "".join(
        warnings(in_pieces, CURVE, 1e3)
    )
    fit = fit_skin(points, 1, ADC, POWER_LAW)
    assert rms_pa(fit) == pytest.approx(24e3, rel=0.05)
    assert advice(fit, 1) is None and "at rest before" not in "".join(warnings(fit, CURVE, 1e3))
    read_pa = fit.curves[1].pressure(volts)
    assert math.sqrt(np.mean(np.square(read_pa - load_pa))) == pytest.approx(24e3, rel=0.15)
    assert [end_pa for end_pa, _ in errors(fit)][-1] == pytest.approx(load_pa[-1])


@pytest.mark.parametrize(("numb_pa", "says"), [(0.5e3, False), (12e3, True)])
def test_light_loads_that_are_not_felt_are_told(numb_pa: float, says: bool) -> None:
    ratio = (np.maximum(UP_PA - numb_pa, 0) / 60e3) ** 0.9
    volts = ADC.voltage(ADC.code(3.3 * ratio / (1 + ratio)))
    said = "".join(warnings(fit_skin(points_of(UP_PA, {1: volts}), 1, ADC, POWER_LAW), CURVE, 1e3))
    assert ("loads up to 7 kPa leave a converter at the end" in said) is says


def test_a_power_law_is_found_in_spite_of_outliers_and_not_where_there_is_none() -> None:
    ratio = (UP_PA / 30e3) ** 0.8
    exact = ADC.voltage(ADC.code(3.3 * ratio / (1 + ratio)))
    volts = np.where(np.isin(np.arange(len(UP_PA)), [4, 9]), 2.9, exact)
    fit = fit_skin(points_of(UP_PA, {1: volts}), 1, ADC, POWER_LAW)
    assert np.flatnonzero(fit.outlier & (UP_PA > 0)).tolist() == [4, 9]
    np.testing.assert_allclose(fit.curves[1].pressure(exact), UP_PA, atol=0.005 * 140e3)
    assert advice(fit_with(read(LOADS_PA)), NODES) is None
    assert "--pieces 2" in (advice(fit_with(read(LOADS_PA), pieces=1), NODES) or "")


def test_what_the_converter_cuts_off_does_not_bend_the_curve() -> None:
    high = PressureCurve.two_stage(v0_v=3.4, stage1_v_per_pa=0.035e-3)  # above 3.3 V to 2.9 kPa
    loads_pa = np.linspace(0, 140e3, 57)
    fit = fit_with(read(loads_pa, high), loads_pa)
    assert fit.curves[2].voltage_v == pytest.approx(high.voltage_v, abs=2 * ADC.lsb_v)
    cut_off = (fit.points.node == 2) & (fit.points.pressure_pa < 2.6e3)
    assert np.isnan(fit.residual_v[cut_off]).all()
    assert cut_off.any()


@pytest.mark.parametrize("loop_v", [0.08, 0.7])
def test_the_loop_of_hysteresis_is_measured_and_its_middle_fitted(loop_v: float) -> None:
    """The paper's is up to 34 % of the fall."""
    width_v = loop_v * np.sin(np.pi * LOADS_PA / LOADS_PA[20])  # a loop closes at its ends
    offset = np.where(np.arange(len(LOADS_PA)) > 20, width_v / 2, -width_v / 2)
    volts = CURVE.voltage(LOADS_PA) + offset
    fit = fit_with(volts)
    fall_v = CURVE.voltage_v[0] - CURVE.voltage_v[-1]
    assert not fit.refused
    assert fit.loop[2] == pytest.approx(loop_v / fall_v, rel=0.15)
    assert fit.loop[1] < 0.01
    assert (
        np.abs(fit.curves[2].voltage(UP_PA[1:-1]) - CURVE.voltage(UP_PA[1:-1])).max()
        < 0.05 * loop_v + 0.01
    )
    rising_only = fit_with(CURVE.voltage(UP_PA), UP_PA)
    assert math.isnan(rising_only.loop[2])
    assert "loop between" not in describe(rising_only)


def test_the_report_knows_resolution_and_quantisation_of_each_stage() -> None:
    """The paper's: an LSB is 0.098 and 0.546 kPa, the limit 0.028 and 0.158 kPa (design 4)."""
    fit = fit_with(read(LOADS_PA))
    values = {key: float(value) for key, value in results(fit).items()}
    for stage, lsb_pa, limit_pa in zip(stages(fit), (98, 546), (28, 158), strict=True):
        assert stage.lsb_pa == pytest.approx(lsb_pa, abs=2)
        assert stage.limit_pa == pytest.approx(limit_pa, abs=1)
    assert max(values[f"residual{stage}_over_quantisation"] for stage in (1, 2)) < 1.1
    assert "knee 1: 50.0" in describe(fit)
    assert values["fitted"] == 3
    residual_v = fit.residual_v[fit.points.pressure_pa < 49e3]
    own = math.sqrt(np.mean(np.square(residual_v))) / 0.033e-3
    assert stages(fit)[0].rms_pa == pytest.approx(own, rel=0.01)


def _loop_of(share: float) -> np.ndarray:
    """Voltages whose way back is lower by up to a share of the fall."""
    falling = np.arange(len(LOADS_PA)) >= len(UP_PA)
    fall_v = share * float(np.ptp(CURVE.voltage(LOADS_PA)))
    return read(LOADS_PA) - fall_v * falling * np.sin(np.pi * LOADS_PA / 140e3)


@pytest.mark.parametrize(
    ("volts", "loads_pa", "pieces", "words"),
    [
        (read(LOADS_PA), LOADS_PA, 1, ["at rest before", "3: off to one side", "kPa rms"]),
        (read(LOADS_PA), LOADS_PA / 100, 2, ["100 times as sensitive"]),
        (read(LOADS_PA), LOADS_PA * 100, 2, [r"0\.01 times as sensitive"]),
        (read(LOADS_PA), LOADS_PA + 2e3, 2, ["no load below 2 kPa"]),
        (_loop_of(0.15), LOADS_PA, 2, ["off by .* kPa rms, .* noise, hysteresis"]),
        (_loop_of(0.02), LOADS_PA, 2, []),
        (read(LOADS_PA), LOADS_PA, 2, []),
    ],
)
def test_what_may_be_wrong_is_said(
    volts: np.ndarray, loads_pa: np.ndarray, pieces: int, words: list[str]
) -> None:
    nodes = dict.fromkeys(range(1, NODES + 1), volts)
    fit = fit_skin(points_of(loads_pa, nodes), NODES, ADC, pieces)
    assert len(fit.curves) == NODES
    said = warnings(fit, CURVE, 1e3)
    assert len(said) == len(words), said
    for line, word in zip(said, words, strict=True):
        assert re.search(word, line)


def test_without_falling_loads_no_hysteresis_is_seen_and_that_is_said() -> None:
    rising = fit_skin(points_of(UP_PA, {1: read(UP_PA)}), 1, ADC)
    assert "no falling loads" in describe(rising)
    assert "no falling loads" not in describe(fit_with(read(LOADS_PA)))


@pytest.mark.parametrize("falls", [True, False])
def test_a_curve_knows_its_noise_and_its_loop_where_loads_fell(falls: bool) -> None:
    up_pa, rng = np.linspace(0, 140e3, 40), np.random.default_rng(2)
    loads_pa = np.concatenate([up_pa, up_pa[-2::-1]]) if falls else up_pa
    sign = np.where(np.arange(len(loads_pa)) < len(up_pa), -1, 1) * falls
    volts = 3.0 - 2e-5 * loads_pa * (1 + 0.06 * sign) + rng.normal(0, 4e-3, len(loads_pa))
    curve = fit_skin(points_of(loads_pa, {1: volts}), 1, ADC, pieces=1).curves[1]
    assert curve.loop == pytest.approx(0.06 if falls else math.nan, rel=0.15, nan_ok=True)
    assert curve.residual_v == pytest.approx(4e-3, rel=0.35)


def test_outliers_are_named_by_their_lines() -> None:
    volts = read(LOADS_PA)
    volts[7] = 0.4
    fit = fit_with(volts)
    assert np.flatnonzero(fit.outlier).tolist() == [22]
    assert "outliers: loads.csv, line 24" in describe(fit)
    assert results(fit)["outliers"] == "1"


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(0, 4), st.integers(1, 60))
@example(15178907, POWER_LAW, 11)  # its exponent is 0.0001
def test_any_points_give_monotone_curves_or_reasons(seed: int, pieces: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    loads_pa = rng.choice([0.0, 30e3, 60e3, 140e3], (3, count))
    loads_pa += rng.choice([0.0, 1e3, 1e5]) * rng.random((3, count))
    volts = CURVE.voltage(loads_pa) + rng.choice([0, 0.01, 1]) * rng.normal(size=(3, count))
    mirrored = rng.random((3, count)) < rng.choice([0.0, 0.1, 0.4])
    points = LoadPoints(
        node=np.repeat([1, 2, 3], count),
        pressure_pa=loads_pa.ravel(),
        voltage_v=np.clip(np.where(mirrored, 3.3 - volts, volts), 0, 3.3).ravel(),
        line=np.arange(3 * count),
        source="any.csv",
    )
    fit = fit_skin(points, NODES, ADC, pieces)
    assert sorted([*fit.curves, *fit.refused]) == [1, 2, 3]
    for curve in fit.curves.values():
        assert len(set(np.sign(np.diff(curve.voltage_v)))) == 1
        assert len(curve.pressure_pa) == (pieces or POWER_PIECES) + 1
    assert describe(fit)


NOISE_V = ADC.lsb_v / math.sqrt(12)
RANGE_PA = 140e3
EVEN_PA = np.linspace(0, RANGE_PA, 40)


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


def voltages(curves: Curves, loads_pa: np.ndarray = EVEN_PA) -> np.ndarray:
    return np.array([curves.voltage(load) for load in loads_pa]).T


def quantised(voltage_v: np.ndarray) -> np.ndarray:
    return ADC.voltage(ADC.code(voltage_v))


def fit(voltage_v: np.ndarray, pieces: int = 2, loads_pa: np.ndarray = EVEN_PA) -> CurveFit:
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
    found = fit(curve.voltage(EVEN_PA)[None, :], 3)
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
        alone = fit(voltage_v[row : row + 1, kept], loads_pa=EVEN_PA[kept])
        assert together.corner_v[row] == pytest.approx(alone.corner_v[0], abs=1e-9)
        assert together.sigma_v[row] == pytest.approx(alone.sigma_v[0])
    assert np.array_equal(np.isnan(together.residual_v), np.isnan(voltage_v))


def test_order_and_unit_of_the_loads_do_not_matter() -> None:
    voltage_v = quantised(voltages(sensors(4, 8)))
    shuffled = np.random.default_rng(0).permutation(40)
    plain, mixed = fit(voltage_v), fit(voltage_v[:, shuffled], loads_pa=EVEN_PA[shuffled] * 7)
    assert mixed.corner_pa == pytest.approx(plain.corner_pa * 7, rel=1e-9)
    assert mixed.corner_v == pytest.approx(plain.corner_v, abs=1e-9)


def test_sigma_is_that_of_the_noise_and_no_knee_is_invented() -> None:
    truth, sigma_v = sensors(64, 9), 0.02
    voltage_v = voltages(truth) + np.random.default_rng(1).normal(0, sigma_v, (64, 40))
    found = fit(voltage_v)
    assert np.sqrt(np.mean(np.square(found.sigma_v))) == pytest.approx(sigma_v, rel=0.08)
    rng = np.random.default_rng(3)
    straight = 3.0 - 1.5 * EVEN_PA / RANGE_PA + rng.normal(0, 0.01, (200, 40))
    assert fit(straight).knee_found.mean() < 0.02
    assert fit(quantised(voltages(sensors(200, 4)))).knee_found.all()
    assert fit(straight, pieces=1).knee_found.all()


def test_levels_are_different_loads() -> None:
    assert levels_of(np.array([0.0, 1.0, 0.501, 0.5, 0.0, 0.2])).tolist() == [0, 0.2, 0.5, 1]
    assert levels_of(np.array([3.0, 3.0, 0.01, 3.0, 0.0])).tolist() == [0.0, 3.0]
