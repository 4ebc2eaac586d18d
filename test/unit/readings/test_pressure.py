# SPDX-License-Identifier: Apache-2.0

"""The chain from voltages to pressures without its optional parts."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.baseline import LOOK_S, LOOKS, Baseline, RestRules
from tactile_cdma.readings.calibration import AdcScale, Calibration, PressureCurve
from tactile_cdma.readings.drift import DriftTracker, nodes_beside
from tactile_cdma.readings.pressure import PressureChain

NODES, LSB_V = 4, AdcScale().lsb_v
CURVE = PressureCurve.two_stage()
VALID = np.ones(NODES, dtype=bool)


def run(chain: PressureChain, voltage_v: np.ndarray, seconds: float) -> np.ndarray:
    for t_s in np.arange(0, seconds, LOOK_S):
        reading_pa = chain.update(voltage_v, VALID, t_s)[0]
    return reading_pa


def test_without_a_tracker_voltages_are_read_and_remembered_for_a_tare() -> None:
    baseline = Baseline(NODES)
    chain = PressureChain(Calibration.default(CURVE, NODES), baseline)
    loads_pa = np.array([0.0, 10e3, 60e3, 139e3])
    voltage_v = CURVE.voltage(loads_pa).astype(np.float32)
    np.testing.assert_allclose(run(chain, voltage_v, 2.0), loads_pa, atol=0.1)
    seen_v, *_ = baseline.last_second
    assert baseline.seen and np.array_equal(seen_v, [voltage_v] * LOOKS)


@given(st.floats(0.5, 2.5), st.floats(0, 1e6))
def test_a_code_that_may_be_of_more_than_the_range_is_beyond_it(
    end_v: float, load_pa: float
) -> None:
    """A sensor that stays at its end, wherever that lies between two codes; and none below it."""
    curve = PressureCurve((0.0, 100e3), (end_v + 0.6, end_v))
    adc = AdcScale()
    tracker = DriftTracker(LSB_V, np.zeros((1, 1), np.int32), RestRules(0.0, 1e3, 500.0))
    chain = PressureChain(Calibration.default(curve, 1), Baseline(1), tracker)
    voltage_v = adc.voltage(adc.code(curve.voltage([load_pa]))).astype(np.float32)
    _, saturated, _ = chain.update(voltage_v, VALID[:1], 0.0)
    if load_pa >= 100e3:
        assert saturated[0]
    if load_pa < 100e3 - LSB_V / 6e-6:
        assert not saturated[0]


def test_at_a_drift_rate_of_zero_drift_is_not_followed_and_frames_can_be_held() -> None:
    """At a rate above zero the same voltages move the drift, which forbids holding."""
    for rate, followed in ((0.0, False), (60.0, True)):
        baseline = Baseline(NODES)
        beside = nodes_beside(Layout.grid(NODES, 2, 2, 7e-3, 5e-3), NODES)
        tracker = DriftTracker(LSB_V, beside, RestRules(rate, 1e3, 500.0))
        chain = PressureChain(Calibration.default(CURVE, NODES), baseline, tracker)
        before_v = baseline.drift_v
        run(chain, np.full(NODES, CURVE.voltage_v[0] - LSB_V, dtype=np.float32), 20.0 + LOOK_S)
        assert (baseline.drift_v is not before_v) == followed
        assert chain.try_hold(20.0 + LOOK_S / 2) != followed
        assert tracker.strays_lsb(20.0) == {}
