# SPDX-License-Identifier: Apache-2.0

"""The chain from voltages to pressures without its optional parts."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import RestError
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.baseline import LOOK_S, LOOKS, Baseline, RestRules
from tactile_cdma.readings.calibration import AdcScale, Calibration, Curves, PressureCurve
from tactile_cdma.readings.drift import DriftTracker, nodes_beside
from tactile_cdma.readings.pressure import PressureChain
from tactile_cdma.readings.status import Status
from tactile_cdma.readings.taxels import Taxels
from tactile_cdma.words.health import NodeHealth
from tactile_cdma.words.words import silent
from test.support.voltages import Voltages

NODES, LSB_V = 4, AdcScale().lsb_v
CURVE = PressureCurve.two_stage()
VALID = np.ones(NODES, dtype=bool)


def run(chain: PressureChain, voltage_v: np.ndarray, seconds: float) -> np.ndarray:
    voltages = Voltages(chain, NODES)
    for t_s in np.arange(0, seconds, LOOK_S):
        reading_pa = voltages.read(voltage_v, True, t_s).pressure_pa
    return reading_pa


def chain_of(drift_pa_per_min: float) -> PressureChain:
    beside = nodes_beside(Layout.grid(NODES, 2, 2, 7e-3, 5e-3), NODES)
    tracker = DriftTracker(AdcScale(), beside, RestRules(drift_pa_per_min, 1e3, 500.0))
    return PressureChain(Calibration.default(CURVE, NODES), Baseline(NODES), tracker)


def test_voltages_are_read_and_remembered_for_a_tare() -> None:
    chain = chain_of(0.0)
    baseline = chain.baseline
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
    tracker = DriftTracker(AdcScale(), np.zeros((1, 1), np.int32), RestRules(0.0, 1e3, 500.0))
    chain = PressureChain(Calibration.default(curve, 1), Baseline(1), tracker)
    voltage_v = adc.voltage(adc.code(curve.voltage([load_pa]))).astype(np.float32)
    saturated = Voltages(chain, 1).read(voltage_v, True, 0.0).status[0] & Status.SATURATED
    if load_pa >= 100e3:
        assert saturated
    if load_pa < 100e3 - LSB_V / 6e-6:
        assert not saturated


def test_at_a_drift_rate_of_zero_drift_is_not_followed_and_frames_can_be_held() -> None:
    """At a rate above zero the same voltages move the drift, which forbids holding."""
    for rate, followed in ((0.0, False), (60.0, True)):
        chain = chain_of(rate)
        baseline = chain.baseline
        before_v = baseline.drift_v
        run(chain, np.full(NODES, CURVE.voltage_v[0] - LSB_V, dtype=np.float32), 20.0 + LOOK_S)
        assert (baseline.drift_v is not before_v) == followed
        assert chain.try_hold(20.0 + LOOK_S / 2) != followed
        assert chain.tracker.strays_lsb(20.0) == {}


@pytest.mark.parametrize("seed", range(4))
def test_a_sensor_whose_voltage_rises_reads_as_its_mirror_image_does(seed: int) -> None:
    """Truth: the same chain with voltages and curves upside down, code for code.

    With loads beyond both ends of the curves, drift, a forced tare and a plain one, refused or not;
    nodes 2 and 4 of a skin are mirrored, the others not.
    """
    rng, adc, nodes = np.random.default_rng(seed), AdcScale(), 4
    top_v, mirrored = adc.vref_v - adc.lsb_v, np.array([False, True, False, True])
    volts = ((top_v + 0.002, 1.4, 0.0), (top_v - 0.4, 1.4, 0.6))[seed % 2]
    falls = PressureCurve((0.0, 40e3, 140e3), volts)
    rises = PressureCurve(falls.pressure_pa, tuple(top_v - v for v in falls.voltage_v))
    layout = Layout.grid(nodes, 2, 2, 7e-3, 5e-3)
    rules = RestRules(600.0, 1e3, 500.0)
    sides = []
    for curves in ([falls] * nodes, [rises if up else falls for up in mirrored]):
        tracker = DriftTracker(adc, nodes_beside(layout, nodes), rules)
        calibration = Calibration(Curves.of(curves), np.zeros(nodes, bool))
        taxels = Taxels(nodes, adc, PressureChain(calibration, Baseline(nodes), tracker), layout, 9)
        sides.append((taxels, NodeHealth(SkinConfig.of({"nodes": nodes}).spec)))
    load_pa, seen = np.zeros(nodes), set()
    for step in range(900):
        if step % 120 == 0:  # pressed and released in turn
            load_pa = rng.permutation([-4e3, 0.4e3, 3e3, 160e3]) * (step in (120, 480))
        slowly_v = -11e-6 * step  # a drift of the sensor
        codes = adc.code(np.interp(load_pa, falls.pressure_pa, falls.voltage_v) + slowly_v)
        codes = codes + (load_pa < 0) * 90
        codes = np.clip(codes, 0, 1023)
        read, said = [], []
        for (taxels, health), up in zip(sides, (np.zeros(nodes, bool), mirrored), strict=True):
            words = replace(
                silent(nodes, 0.0),
                active=np.ones(nodes, bool),
                codes=np.where(up, 1023 - codes, codes).astype(np.int32),
            )
            read.append(taxels.update(words, step * LOOK_S, health))
            if step in (100, 200, 300):
                try:
                    said.append(taxels.tare(1e3, force=step == 300))
                except RestError as error:
                    said.append(str(error))
        seen |= set(read[0].status.tolist())
        assert np.array_equal(read[0].status, read[1].status), step
        np.testing.assert_allclose(read[1].pressure_pa, read[0].pressure_pa, atol=1.0)
        assert said[:1] == said[1:]
    assert {Status.OK, Status.SATURATED, (0, Status.FAULTY)[seed % 2]} <= seen  # else too little
    drift_v, other_v = (side[0].baseline.drift_v for side in sides)
    np.testing.assert_allclose(other_v, np.where(mirrored, -drift_v, drift_v), atol=1e-5)
    assert np.all(np.abs(drift_v) > adc.lsb_v) or seed % 2 == 0
    strays = [side[0].chain.tracker.strays_lsb(900 * LOOK_S) for side in sides]
    assert strays[1] == pytest.approx(strays[0], abs=0.01)
