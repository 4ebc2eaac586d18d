# SPDX-License-Identifier: Apache-2.0

"""Words → readings and health, by plain arithmetic on each node alone."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.baseline import Baseline, RestRules
from tactile_cdma.readings.calibration import AdcScale, Calibration, Curves, PressureCurve
from tactile_cdma.readings.drift import DriftTracker, nodes_beside
from tactile_cdma.readings.pressure import PressureChain
from tactile_cdma.readings.status import Status
from tactile_cdma.readings.taxels import Readings, Taxels
from tactile_cdma.words.health import WEAK_RHO, NodeHealth, NodeState
from tactile_cdma.words.limits import LIMITS
from tactile_cdma.words.words import Words, words_memory, words_of
from test.support.examples import examples

STALE_S = 1.0
ADC = AdcScale()


class Side:
    """Some nodes of a skin of 300, each with a curve, a tare and a drift of its own."""

    def __init__(self, seed: int, some: slice = slice(None)) -> None:
        rng, nodes = np.random.default_rng(seed), 300
        curves = []
        for _ in range(nodes):
            corners_pa = np.cumsum(rng.uniform(1e3, 5e4, rng.integers(1, 4)))
            corners_v = 3.2 - np.cumsum(rng.uniform(0.1, 0.8, len(corners_pa) + 1))
            corners_v = corners_v if rng.random() < 0.5 else 3.1 - corners_v
            curves.append(PressureCurve((0.0, *corners_pa.tolist()), tuple(corners_v.tolist())))
        tare_pa = rng.uniform(0, 500, nodes).astype(np.float32)
        drift_v = rng.uniform(-0.1, 0.1, nodes).astype(np.float32)
        state = rng.choice(np.array([*NodeState], np.uint8), nodes)
        self.curves, self.nodes = curves[some], len(curves[some])
        layout = Layout.grid(self.nodes, 1, self.nodes, 7e-3, 5e-3)
        rules = RestRules(0.0, 1e3, 500.0)
        tracker = DriftTracker(ADC, nodes_beside(layout, self.nodes), rules)
        self.baseline = Baseline(self.nodes)
        self.baseline.tare_pa, self.baseline.drift_v = tare_pa[some], drift_v[some]
        calibration = Calibration(Curves.of(self.curves), np.zeros(self.nodes, bool))
        chain = PressureChain(calibration, self.baseline, tracker)
        self.taxels = Taxels(self.nodes, ADC, chain, layout, STALE_S)
        self.health = NodeHealth(FrameSpec(nodes=self.nodes, frame_period_s=10.0))
        self.health.state = state[some].copy()
        self.health.invalid[:] = self.health.state >= NodeState.FAULTY

    def read(self, words: Words, t_s: float) -> Readings:
        return self.taxels.update(words, t_s, self.health, counts=True)


def random_words(rng: np.random.Generator, nodes: int = 300) -> Words:
    words = words_of(words_memory(nodes), nodes, 0.0)
    words.active[:] = rng.random(nodes) < 0.6
    words.codes[:] = rng.integers(0, 1024, nodes) * words.active
    words.amplitude_v[:] = rng.uniform(0, 0.5, nodes)
    words.rho[:], words.margin[:] = rng.uniform(1, 30, nodes), rng.uniform(0, 1, nodes)
    for name in ("doubtful", "doubled", "odd"):
        getattr(words, name)[:] = (rng.random(nodes) < 0.2) & words.active
    words.faint[:] = (rng.random(nodes) < 0.2) & ~words.active
    return words


def part_of(words: Words, some: slice) -> Words:
    arrays = {name: getattr(words, name)[some] for name in Words.__slots__ if name != "noise_rms_v"}
    return replace(words, **arrays)


@examples(20)
@given(st.integers(0, 99), st.integers(0, 280), st.integers(1, 20))
def test_a_node_is_read_alone_as_among_others(seed: int, begin: int, size: int) -> None:
    some = slice(begin, begin + size)
    whole, alone, rng = Side(seed), Side(seed, some), np.random.default_rng(seed)
    t_s = 0.0
    for _ in range(6):
        t_s += float(rng.choice([0.02, 0.4, 1.5 * STALE_S]))
        words = random_words(rng)
        expected, readings = whole.read(words, t_s), alone.read(part_of(words, some), t_s)
        for name in Readings.__slots__:
            values = getattr(readings, name), getattr(expected, name)[some]
            np.testing.assert_array_equal(*values, err_msg=name)
    np.testing.assert_array_equal(alone.health.sums, whole.health.sums[:, some])


def test_pressures_are_those_of_each_nodes_curve() -> None:
    side, rng = Side(1), np.random.default_rng(1)
    words = random_words(rng)
    readings = side.read(words, 0.0)
    compared = 0
    for node, curve in enumerate(side.curves):
        status = readings.status[node]
        if not words.active[node] or side.health.invalid[node]:
            assert status & (Status.STALE | Status.FAULTY) and np.isnan(readings.pressure_pa[node])
            continue
        assert bool(status & Status.LOW_SNR) == words.doubtful[node]
        voltage_v = ADC.voltage(words.codes[node])
        if status & (Status.SATURATED | Status.FAULTY):
            continue
        assert readings.voltage_v[node] == pytest.approx(voltage_v, abs=1e-6)
        volts, pascals = np.array(curve.voltage_v), np.array(curve.pressure_pa)
        order = np.argsort(volts)
        meant_v = voltage_v + side.baseline.drift_v[node]
        expected_pa = np.interp(meant_v, volts[order], pascals[order])
        expected_pa = max(0.0, expected_pa - side.baseline.tare_pa[node])
        slack_pa = 1e-4 * max(pascals) + 1
        assert max(0.0, readings.pressure_pa[node]) == pytest.approx(expected_pa, abs=slack_pa)
        compared += 1
    assert compared > 40


def test_what_words_say_of_their_nodes_is_counted() -> None:
    side, rng = Side(2), np.random.default_rng(2)
    expected = np.zeros((6, 300))
    for number in range(5):
        words = random_words(rng)
        side.read(words, 0.02 * number)
        clear, weak = words.rho > LIMITS.low_rho, words.margin < LIMITS.low_margin
        heard = words.active | (
            (words.amplitude_v > side.health.weak_v) & (words.rho > WEAK_RHO) & ~weak
        )
        uneven = words.active & words.doubtful & clear & weak
        counted = heard, words.amplitude_v * heard, uneven, words.doubled
        expected += np.array([*counted, words.odd & clear & ~weak, words.faint])
    np.testing.assert_allclose(side.health.sums, expected, rtol=1e-5)
    before = side.health.sums.copy()
    side.taxels.update(random_words(rng), 0.2, side.health, counts=False)
    np.testing.assert_array_equal(side.health.sums, before)


def test_a_silent_node_holds_its_last_word_until_it_is_stale() -> None:
    side, rng = Side(3), np.random.default_rng(3)
    side.health.state = np.full(300, NodeState.OK, np.uint8)
    side.health.invalid[:] = False
    words = random_words(rng)
    said = side.read(replace(words, active=np.ones(300, bool)), 0.0)
    silence = replace(words, active=np.zeros(300, bool), faint=np.zeros(300, bool))
    held = side.read(replace(silence, doubtful=np.zeros(300, bool)), 0.9 * STALE_S)
    np.testing.assert_array_equal(held.pressure_pa, said.pressure_pa)
    assert (held.status & Status.SILENT).all()
    gone = side.read(silence, 1.1 * STALE_S)
    assert np.isnan(gone.pressure_pa).all() and (gone.status & Status.STALE).all()
    assert math.isnan(gone.voltage_v[0])


def test_what_does_not_fit_is_refused() -> None:
    side, words = Side(4), random_words(np.random.default_rng(4))
    side.read(words, 0.0)
    side.taxels._kept.codes[0] = 1 << 10
    side.health.state = side.health.state.copy()
    with pytest.raises(ValueError, match="struct readout of the kernel: what it is made of"):
        side.read(words, 0.1)
