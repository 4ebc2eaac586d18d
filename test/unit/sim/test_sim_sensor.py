# SPDX-License-Identifier: Apache-2.0

"""The simulated sensor: figures of the paper (Liu et al., IV.A), lag, hysteresis, imperfections."""

import math
from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from benchmarks.paper.sensor import (
    HYSTERESIS,
    RECOVERY_S,
    RESPONSE_S,
    SENSITIVITY_V_PER_KPA,
    hysteresis,
    matching,
    measure,
)
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.readings.calibration import AdcScale, Calibration, PressureCurve
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.nodes import NodeFrame
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.scene import DWELL_S, LOADS, STEPS_KPA, TURN_S, TURNS_KPA
from tactile_cdma.sim.sensor import (
    MOST_MISMATCH,
    PAPER,
    PAPER_DYNAMICS,
    SCALE_PA,
    Dynamics,
    Sensor,
    SensorModel,
    delayed,
    followed,
)

PERIOD_S = FrameSpec().frame_period_s


def frames(query: str, count: int) -> list[NodeFrame]:
    options = SimOptions.from_url(f"sim://?{query}")
    return list(islice(truth(options, options.setup()), count))


def test_the_sensor_has_the_papers_figures() -> None:
    figures = measure(SensorModel(kind=PAPER))
    assert figures.sensitivity_v_per_kpa == pytest.approx(SENSITIVITY_V_PER_KPA, rel=0.01)
    assert figures.response_s == pytest.approx(RESPONSE_S, rel=0.01)
    assert figures.recovery_s == pytest.approx(RECOVERY_S, rel=0.05)
    for load_kpa in (90.0, 140.0):
        assert figures.hysteresis[load_kpa] == pytest.approx(HYSTERESIS[load_kpa], abs=0.3)


@pytest.mark.parametrize("load_kpa", HYSTERESIS)
def test_the_option_matches_each_load_singly(load_kpa: float) -> None:
    model = SensorModel(kind=PAPER, hysteresis=matching(load_kpa))
    assert hysteresis(model)[load_kpa] == pytest.approx(HYSTERESIS[load_kpa], rel=0.01)


def test_an_ideal_sensor_has_nothing_but_its_curve() -> None:
    figures = measure(SensorModel())
    assert max(figures.hysteresis.values()) < 1e-6
    assert figures.recovery_s < 2e-3
    assert figures.response_s == pytest.approx(0.5, abs=0.01), "the load itself takes so long"


@pytest.mark.parametrize("seed", range(5))
def test_curves_of_any_mismatch_are_curves(seed: int) -> None:
    """Each falls strictly and stays within the converter's range, to the last of 4096."""
    curves = SensorModel(mismatch=MOST_MISMATCH, seed=seed).curves(4096)
    assert np.all(np.diff(curves.pressure_pa, axis=0) > 0)
    assert np.all(np.diff(curves.voltage_v, axis=0) < 0)
    assert np.all((curves.voltage_v >= 0) & (curves.voltage_v <= 3.3))


def test_mismatch_is_as_large_as_it_says() -> None:
    nominal = PressureCurve.two_stage()
    curves = SensorModel(mismatch=0.05).curves(4096)
    slopes = np.diff(curves.voltage_v, axis=0) / np.diff(curves.pressure_pa, axis=0)
    expected = np.diff(nominal.voltage_v) / np.diff(nominal.pressure_pa)
    assert np.std(slopes / expected[:, None], axis=1) == pytest.approx([0.05, 0.05], rel=0.1)
    assert np.std(curves.pressure_pa[1] / 50e3) == pytest.approx(0.05, rel=0.1)
    rest = curves.voltage_v[0] / nominal.voltage_v[0]
    assert np.sqrt(np.mean((rest - 1) ** 2)) == pytest.approx(0.025, rel=0.1)


def test_true_curves_read_true_pressures() -> None:
    """What benchmarks calibrate with: but for the converter nothing is left of the mismatch."""
    options = SimOptions(scene="all", mismatch=0.1, seed=3)
    calibration = Calibration(options.sensors.curves(16), np.zeros(16, dtype=bool))
    for frame in islice(truth(options, options.setup()), 50):
        found = calibration.curves.pressure(frame.voltage_v.astype(np.float32))
        np.testing.assert_allclose(found, frame.pressure_pa, atol=0.5)


def test_warming_drifts_within_its_bound_and_back() -> None:
    sensor = Sensor(SensorModel(warming_v=0.02), 64)
    courses = np.array([sensor.step(np.zeros(64), t_s) for t_s in np.arange(0, 601, 10.0)])
    drift_v = courses - sensor.rest_v
    peaks_v = np.abs(drift_v).max(axis=0)
    assert np.all((peaks_v >= 0.0099) & (peaks_v <= 0.02))
    assert np.ptp(peaks_v) > 0.005, "each taxel has its share"
    assert np.allclose(drift_v[[0, 60]], 0, atol=1e-9)


def test_noise_is_white_and_as_large_as_it_says() -> None:
    sensor = Sensor(SensorModel(noise_v=0.01), 64)
    noise_v = np.array([sensor.step(np.zeros(64), 0.02 * step) for step in range(500)]) - 3.3
    assert np.std(noise_v) == pytest.approx(0.01, rel=0.02)
    assert abs(np.mean(noise_v[1:] * noise_v[:-1])) < 0.05 * 0.01**2


def test_steps_and_cycles_are_what_they_are_said_to_be() -> None:
    skin = SimOptions().skin(16)
    steps, cycles = LOADS["steps"], LOADS["cycles"]
    for index, load_kpa in enumerate(STEPS_KPA * 2):
        for share in (0.01, 0.5, 0.99):
            assert np.all(steps((index + share) * DWELL_S, skin) == load_kpa * 1e3)
    for index, load_kpa in enumerate(TURNS_KPA * 2):
        assert cycles(index * TURN_S, skin) == pytest.approx(load_kpa * 1e3, abs=1e-6)
    t_s = np.arange(0, len(TURNS_KPA) * TURN_S, 0.01)
    course = np.array([cycles(time, skin) for time in t_s])
    assert np.all(course == course[:, :1]), "all taxels alike"
    assert np.abs(np.diff(course[:, 0])).max() <= 140e3 * np.pi / 2 / TURN_S * 0.0101, "smooth"
    for load in (STEPS_KPA, TURNS_KPA):
        assert (min(load), max(load)) == (0, 140)


def test_a_paper_sensor_on_the_skin_lags_and_remembers() -> None:
    course = frames("scene=cycles&sensor=paper", round(3 * TURN_S / PERIOD_S))
    curve = PressureCurve.two_stage()
    pressure = np.array([frame.pressure_pa[0] for frame in course])
    read = curve.pressure(np.array([frame.voltage_v[0] for frame in course]))
    rising = np.gradient(pressure) > 100
    falling = np.gradient(pressure) < -100
    assert np.mean(read[rising] - pressure[rising]) < -2e3
    assert np.mean(read[falling] - pressure[falling]) > 1e3
    assert course[0].codes[0] == AdcScale().code(curve.voltage(0))


paths_pa = arrays(np.float64, (40, 3), elements=st.floats(0.0, 140e3))


@st.composite
def any_dynamics(draw: st.DrawFn) -> Dynamics:
    plays = draw(st.integers(0, 10))
    steps = draw(st.lists(st.floats(0.01, 0.5), min_size=plays, max_size=plays))
    parts = draw(st.lists(st.floats(0.0, 1.0), min_size=plays, max_size=plays))
    total = draw(st.floats(0.0, 0.9))
    return Dynamics(
        rise_s=draw(st.floats(1e-3, 10.0)),
        fall_s=draw(st.floats(1e-3, 1.0)),
        widths=tuple(np.cumsum(steps).tolist()),
        weights=tuple(total * part / max(sum(parts), 1e-9) for part in parts),
    )


def run(dynamics: Dynamics, path_pa: np.ndarray) -> np.ndarray:
    """Apparent pressures along a path of pressures of sensors, both (steps, n), Pa."""
    plays, apparent_pa = (np.zeros(path_pa.shape[1]),) * len(dynamics.widths), []
    for pressure_pa in path_pa:
        plays, felt_pa = followed(plays, pressure_pa, dynamics, np)
        apparent_pa.append(felt_pa)
    return np.array(apparent_pa)


@given(any_dynamics(), paths_pa)
def test_rising_loads_read_what_the_curve_says_and_falling_ones_no_less(
    dynamics: Dynamics, path_pa: np.ndarray
) -> None:
    apparent_pa = run(dynamics, path_pa)
    assert np.all(apparent_pa >= path_pa * (1 - 1e-9) - 1e-6)
    highest = path_pa >= np.maximum.accumulate(path_pa, axis=0)
    np.testing.assert_allclose(apparent_pa[highest], path_pa[highest], rtol=1e-9, atol=1e-6)


@given(any_dynamics(), paths_pa)
def test_hysteresis_depends_on_turns_but_not_on_time(
    dynamics: Dynamics, path_pa: np.ndarray
) -> None:
    """Frames that repeat a pressure, or split a move in two, change nothing."""
    middles_pa = path_pa.copy()
    middles_pa[1:] = (path_pa[1:] + path_pa[:-1]) / 2
    finer = np.stack((middles_pa, path_pa, path_pa), axis=1).reshape(-1, 3)
    whole, split = run(dynamics, path_pa), run(dynamics, finer)
    np.testing.assert_allclose(split[1::3], whole, rtol=1e-9, atol=1e-6)
    assert np.array_equal(split[2::3], split[1::3])


def test_loops_open_with_the_load() -> None:
    """The gap after a full turn is (P + scale)·(e^Σw·width − 1), proportional to the load."""
    loads_pa = np.array([20e3, 40e3, 60e3])
    _, back_pa, released_pa = run(PAPER_DYNAMICS, np.array([3 * loads_pa, loads_pa, 0 * loads_pa]))
    opened = math.exp(np.dot(PAPER_DYNAMICS.widths, PAPER_DYNAMICS.weights)) - 1
    np.testing.assert_allclose(back_pa - loads_pa, (loads_pa + SCALE_PA) * opened, rtol=1e-9)
    # The remainder at zero is at most about two counts of a 10-bit ADC, 98 Pa each.
    assert np.all(released_pa < 200)


@given(
    st.floats(1e-3, 1.0),
    st.floats(1e-3, 1.0),
    paths_pa,
    arrays(np.float64, 40, elements=st.floats(0.0, 2.0)),
)
def test_the_lag_is_the_same_in_steps_of_any_size(
    rise_s: float, fall_s: float, path_pa: np.ndarray, passed_s: np.ndarray
) -> None:
    dynamics = Dynamics(rise_s, fall_s)
    whole_pa = split_pa = path_pa[0]
    for pressure_pa, step_s in zip(path_pa, passed_s, strict=True):
        whole_pa = delayed(whole_pa, pressure_pa, step_s, dynamics, np)
        for share in (0.3, 0.7):
            split_pa = delayed(split_pa, pressure_pa, share * step_s, dynamics, np)
        np.testing.assert_allclose(split_pa, whole_pa, atol=1e-4)


def test_the_lag_is_an_exponential_of_either_kind() -> None:
    rise_s, fall_s = PAPER_DYNAMICS.rise_s, PAPER_DYNAMICS.fall_s
    left = math.exp(-1)
    assert delayed(0.0, 1e3, rise_s, PAPER_DYNAMICS, np) == pytest.approx(1e3 * (1 - left))
    assert delayed(1e3, 0.0, fall_s, PAPER_DYNAMICS, np) == pytest.approx(1e3 * left)
