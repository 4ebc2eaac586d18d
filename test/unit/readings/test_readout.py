# SPDX-License-Identifier: Apache-2.0

"""The kernel's readings are those of plain arithmetic: curve, drift, tare, status and age."""

from dataclasses import replace
from itertools import pairwise

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
from tactile_cdma.words.words import Words, silent
from test.support.examples import examples

STALE_S, CONTACT_PA = 1.0, 1e3
STATES = {NodeState.WEAK: Status.WEAK, NodeState.FAULTY: Status.FAULTY}
STATES[NodeState.DOUBLED] = Status.FAULTY


class Patch:
    """A skin of nodes whose curves, tare and drift are drawn; the last two are masked or bare."""

    def __init__(self, nodes: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.spec = FrameSpec(nodes=nodes, order=264, chip_s=1e-7, frame_period_s=1.0)
        self.adc, self.health = AdcScale(self.spec.bits), NodeHealth(self.spec)
        self.health.state[:] = rng.choice(len(NodeState), nodes)
        self.health.invalid[:] = self.health.state >= NodeState.FAULTY
        layout = Layout.grid(nodes, 1, nodes, 7e-3, 5e-3)
        self.node_of = list(range(nodes))
        if seed % 3 and nodes > 3:  # taxels in another order, one without a node, one masked
            number = rng.permutation(nodes).astype(np.int32) + 1
            self.node_of = [-1 if n == 2 else n - 1 for n in number.tolist()]
            layout = replace(
                layout, nodes=np.where(number == 2, 0, number), masked=(3,), unplaced=(2,)
            )
        self.masked = {2} if self.node_of != list(range(nodes)) else set()
        self.curves = []
        for _ in range(nodes):
            corners_pa = np.cumsum(rng.uniform(1e3, 5e4, rng.integers(1, 4)))
            corners_v = 3.2 - np.cumsum(rng.uniform(0.1, 0.8, len(corners_pa) + 1))
            corners_v = corners_v if rng.random() < 0.5 else 3.1 - corners_v
            curve = PressureCurve((0.0, *corners_pa.tolist()), tuple(corners_v.tolist()))
            self.curves.append(curve)
        self.bare = rng.random(nodes) < 0.2
        baseline = Baseline(nodes)
        baseline.tare_pa = rng.uniform(0, 500, nodes).astype(np.float32)
        baseline.drift_v = rng.uniform(-0.1, 0.1, nodes).astype(np.float32)
        self.tare_pa, self.drift_v = baseline.tare_pa.copy(), baseline.drift_v.copy()
        rules = RestRules(CONTACT_PA, 0.0, 500.0)
        tracker = DriftTracker(self.adc, nodes_beside(layout, nodes), rules)
        calibration = Calibration(Curves.of(self.curves), self.bare)
        chain = PressureChain(calibration, baseline, tracker)
        self.bounds = chain.bounds
        self.taxels = Taxels(nodes, self.adc, chain, layout, STALE_S)


def pressed_pa(curve: PressureCurve, volts: float) -> float:
    """Pressure at a voltage, between 0 and the end of the curve."""
    corners = list(zip(curve.pressure_pa, curve.voltage_v, strict=True))
    falls = corners[0][1] > corners[1][1]
    for (low_pa, low_v), (high_pa, high_v) in pairwise(corners):
        if (volts > high_v) if falls else (volts < high_v):
            share = max(0.0, (volts - low_v) / (high_v - low_v))
            return float(low_pa + share * (high_pa - low_pa))
    return float(corners[-1][0])


def drawn_words(spec: FrameSpec, rng: np.random.Generator) -> Words:
    nodes = spec.nodes
    return replace(
        silent(nodes, 0.0),
        active=rng.random(nodes) < 0.6,
        doubtful=rng.random(nodes) < 0.2,
        codes=rng.choice([0, (1 << spec.bits) - 1, *range(1 << spec.bits)], nodes).astype(np.int32),
    )


@examples(60)
@given(st.sampled_from([1, 5, 16, 70, 256]), st.integers(0, 2**32 - 1))
def test_readings_are_those_of_plain_arithmetic(nodes: int, seed: int) -> None:
    patch, rng = Patch(nodes, seed), np.random.default_rng(seed)
    codes, heard_s, unsure = [0] * nodes, [-np.inf] * nodes, [False] * nodes
    now_s = 0.0
    for _ in range(6):
        now_s += float(rng.choice([0.02, 0.2, 1.5 * STALE_S]))
        words = drawn_words(patch.spec, rng)
        readings = patch.taxels.update(words, now_s, patch.health)
        for node in range(nodes):
            if words.active[node]:
                codes[node], heard_s[node] = int(words.codes[node]), now_s
            if words.active[node] or words.doubtful[node]:
                unsure[node] = bool(words.doubtful[node])
        for taxel, node in enumerate(patch.node_of):
            if node < 0 or node in patch.masked:
                expected = np.nan, np.nan, Status.MASKED
            else:
                is_stale = now_s - heard_s[node] > STALE_S
                expected = read(
                    patch, node, codes[node], is_stale, unsure[node], bool(words.active[node])
                )
            check(readings, taxel, *expected)


def read(
    patch: Patch, node: int, code: int, is_stale: bool, unsure: bool, active: bool
) -> tuple[float, float, int]:
    """Pressure, Pa, voltage, V, and status of a node in service."""
    sign, rest_v, margin_v, end_v = (float(bound[node]) for bound in patch.bounds)
    volts = float(np.float32(patch.adc.voltage(np.array(code))))
    at_end = code == ((1 << patch.adc.bits) - 1 if sign > 0 else 0)
    pulled_v = sign * (rest_v - volts)
    meant_v = np.float32(rest_v if at_end and pulled_v > 0 else volts) + patch.drift_v[node]
    meant_v = float(meant_v)  # rounded as in the kernel: words at the curve's end are frequent
    if is_stale:
        status = Status.SILENT | Status.STALE
    else:
        status = STATES.get(NodeState(patch.health.state[node]), Status.OK)
        status |= Status.OK if active else Status.SILENT
        status |= Status.LOW_SNR if unsure else Status.OK
    is_valid = not (is_stale or patch.health.invalid[node])
    off_rest = (meant_v - rest_v) * sign > margin_v
    if is_valid and ((meant_v - end_v) * sign < 0 or (at_end and pulled_v > margin_v)):
        status |= Status.SATURATED
    if is_valid and off_rest:
        status |= Status.FAULTY
    if patch.bare[node]:
        status |= Status.UNCALIBRATED
    if not is_valid or off_rest:
        return np.nan, np.nan, status
    return pressed_pa(patch.curves[node], meant_v) - float(patch.tare_pa[node]), volts, status


def check(readings: Readings, taxel: int, pressure: float, volts: float, status: int) -> None:
    assert readings.status[taxel] == status
    assert readings.voltage_v[taxel] == pytest.approx(volts, abs=1e-6, nan_ok=True)
    assert readings.pressure_pa[taxel] == pytest.approx(pressure, rel=1e-4, abs=1.0, nan_ok=True)


def test_what_words_say_of_their_nodes_is_counted() -> None:
    patch, rng, expected = Patch(70, 0), np.random.default_rng(2), np.zeros((6, 70))
    for number in range(5):
        drawn = drawn_words(patch.spec, rng)
        flags = {name: (rng.random(70) < 0.2) & drawn.active for name in ("doubled", "odd")}
        words = replace(
            drawn,
            **flags,
            faint=(rng.random(70) < 0.2) & ~drawn.active,
            amplitude_v=rng.uniform(0, 0.5, 70).astype(np.float32),
            rho=rng.uniform(1, 30, 70).astype(np.float32),
            margin=rng.uniform(0, 1, 70).astype(np.float32),
        )
        patch.taxels.update(words, 0.02 * number, patch.health, counts=number < 4)
        if number == 4:
            continue
        clear, weak = words.rho > LIMITS.low_rho, words.margin < LIMITS.low_margin
        is_faint = words.faint & (words.amplitude_v > patch.health.weak_v) & ~weak
        is_faint &= words.rho > WEAK_RHO
        heard, uneven = words.active | is_faint, words.active & words.doubtful & clear & weak
        counted = heard, words.amplitude_v * heard, uneven, words.doubled
        expected += np.array([*counted, words.odd & clear & ~weak, words.faint])
    np.testing.assert_allclose(patch.health.sums, expected, rtol=1e-5)


def test_what_does_not_fit_is_refused() -> None:
    patch, rng = Patch(5, 0), np.random.default_rng(4)
    patch.taxels.update(drawn_words(patch.spec, rng), 0.0, patch.health)
    patch.taxels._codes[0] = 1 << 10
    patch.health.state = patch.health.state.copy()
    with pytest.raises(ValueError, match="the kernel makes no struct readout: sizes"):
        patch.taxels.update(drawn_words(patch.spec, rng), 0.1, patch.health)
