# SPDX-License-Identifier: Apache-2.0

"""Voltages to pressures beside plain arithmetic, how sure they are, and taxels out of service."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import ParameterError, RestError, SpecError
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.baseline import LOOK_S, RestRules
from tactile_cdma.readings.calibration import AdcScale, Calibration, Curves, PressureCurve
from tactile_cdma.readings.contact import Contacts, ContactTracker, wrench_covariance
from tactile_cdma.readings.status import Status
from tactile_cdma.readings.taxels import Readings, Taxels
from tactile_cdma.skin import Skin
from tactile_cdma.words.health import WEAK_RHO, NodeHealth, NodeState
from tactile_cdma.words.limits import LIMITS
from tactile_cdma.words.words import Words, silent
from test.support.examples import examples
from test.support.simulated import run, stream
from test.support.voltages import Voltages, chain_of

NODES, LSB_V = 4, AdcScale().lsb_v
CURVE = PressureCurve.two_stage()


@given(st.floats(0.5, 2.5), st.floats(0, 1e6))
def test_a_code_that_may_be_of_more_than_the_range_is_beyond(end_v: float, load_pa: float) -> None:
    """A sensor that stays at its end, wherever that lies between two codes; and none below it."""
    curve = PressureCurve((0.0, 100e3), (end_v + 0.6, end_v))
    adc = AdcScale()
    chain = chain_of(curve, Layout.grid(1, 1, 1, 7e-3, 5e-3), RestRules(0.0, 1e3, 500.0))
    voltage_v = adc.voltage(adc.code(curve.voltage([load_pa]))).astype(np.float32)
    saturated = Voltages(chain, 1).read(voltage_v, True, 0.0).status[0] & Status.SATURATED
    if load_pa >= 100e3:
        assert saturated
    if load_pa < 100e3 - LSB_V / 6e-6:
        assert not saturated


def test_at_a_drift_rate_of_zero_drift_is_not_followed_and_frames_can_be_held() -> None:
    """At a rate above zero the same voltages move the drift, which forbids holding."""
    for rate, followed in ((0.0, False), (60.0, True)):
        layout, rules = Layout.grid(NODES, 2, 2, 7e-3, 5e-3), RestRules(rate, 1e3, 500.0)
        chain = chain_of(CURVE, layout, rules)
        baseline = chain.baseline
        before_v = baseline.drift_v
        voltages, voltage_v = Voltages(chain, NODES), np.full(NODES, CURVE.voltage_v[0] - LSB_V)
        for t_s in np.arange(0, 20.0 + LOOK_S, LOOK_S):
            voltages.read(voltage_v.astype(np.float32), True, t_s)
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
        calibration = Calibration(Curves.of(curves), np.zeros(nodes, bool))
        taxels = Taxels(nodes, adc, chain_of(calibration, layout, rules), layout, 9)
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
        rules = RestRules(CONTACT_PA, 0.0, 500.0)
        chain = chain_of(Calibration(Curves.of(self.curves), self.bare), layout, rules, self.adc)
        baseline = chain.baseline
        baseline.tare_pa = rng.uniform(0, 500, nodes).astype(np.float32)
        baseline.drift_v = rng.uniform(-0.1, 0.1, nodes).astype(np.float32)
        self.tare_pa, self.drift_v = baseline.tare_pa.copy(), baseline.drift_v.copy()
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


MANY, ADC, COUNT_V = 64, AdcScale(10), AdcScale(10).lsb_v
KNOWN_CURVE = PressureCurve((0.0, 50e3, 140e3), (3.0, 1.35, 0.8))


class Read:
    """A skin whose nodes say what a converter makes of given voltages."""

    def __init__(self, calibration: Calibration, nodes: int = MANY) -> None:
        layout = Layout.grid(nodes, 0, 0, 7e-3, 5e-3)
        self.taxels = Taxels(nodes, ADC, chain_of(calibration, layout), layout, 1e6)
        self.taxels.with_sigma = True
        self.health = NodeHealth(FrameSpec(nodes=nodes, chip_s=1e-8, frame_period_s=1.0))
        self.t_s = 0.0

    def of(self, voltage_v: np.ndarray, active: bool = True) -> Readings:
        nodes, codes = voltage_v.size, ADC.code(voltage_v).astype(np.int32)
        words = replace(silent(nodes, 1e-3), codes=codes, active=np.full(nodes, active))
        self.t_s += LOOK_S
        return self.taxels.update(words, self.t_s, self.health)


def known(residual_v: float = COUNT_V / math.sqrt(12), loop: float = 0.0) -> Calibration:
    curve = replace(KNOWN_CURVE, residual_v=residual_v, loop=loop)
    return Calibration(Curves.of([curve] * MANY), np.zeros(MANY, dtype=bool), "known")


@pytest.mark.parametrize("noise_v", [0.0, 1e-3, 8e-3])
@pytest.mark.parametrize("residual_v", [0.0, 12e-3])
@pytest.mark.parametrize("loop", [0.0, 0.08])
def test_errors_over_what_is_said_of_them_have_a_standard_deviation_of_one(
    noise_v: float, residual_v: float, loop: float
) -> None:
    """Each part is drawn here, from what its name says: a curve's misfit, a loop, noise."""
    rng = np.random.default_rng(5)
    skin = Read(known(math.hypot(residual_v, COUNT_V / math.sqrt(12)), loop))
    rest_v = KNOWN_CURVE.voltage(rng.uniform(0, 3e3, MANY))
    for _ in range(12):
        skin.of(rest_v + rng.normal(0, noise_v, MANY))
    skin.taxels.tare(1e3, force=True)
    over = []
    for _ in range(30):
        load_pa = np.exp(rng.uniform(math.log(1e3), math.log(120e3), MANY))
        total_pa = KNOWN_CURVE.pressure(rest_v) + load_pa
        apparent_pa = total_pa * (1 + rng.normal(0, loop, MANY))
        voltage_v = KNOWN_CURVE.voltage(np.minimum(apparent_pa, 139e3))
        voltage_v += rng.normal(0, residual_v, MANY)
        inside = (apparent_pa < 135e3) & (np.abs(total_pa - 50e3) > 15e3)  # of one piece
        for _ in range(40):  # five seconds
            readings = skin.of(voltage_v + rng.normal(0, noise_v, MANY))
        assert readings.sigma_pa is not None
        over.append(((readings.pressure_pa - load_pa) / readings.sigma_pa)[inside])
    ratio = np.concatenate(over)
    ratio = ratio[np.isfinite(ratio)]
    assert len(ratio) > 500
    assert 0.85 < np.sqrt(np.mean(np.square(ratio))) < 1.15
    assert 0.55 < np.mean(np.abs(ratio) < 1) < 0.8  # of a uniform error 0.58, of a normal one 0.68


def test_a_silent_node_is_less_sure_than_one_that_speaks() -> None:
    """It may have changed by its threshold without a word."""
    skin = Read(known())
    spoken = skin.of(KNOWN_CURVE.voltage(np.full(MANY, 20e3)))
    held = skin.of(np.zeros(MANY), active=False)
    assert spoken.sigma_pa is not None and held.sigma_pa is not None
    assert np.allclose(spoken.pressure_pa, held.pressure_pa)
    count_pa = COUNT_V / (1.65 / 50e3)
    assert np.allclose(spoken.sigma_pa, count_pa / math.sqrt(12), rtol=1e-3)
    assert np.allclose(held.sigma_pa, 3 * count_pa / math.sqrt(12), rtol=1e-3)


def test_what_nobody_knows_is_nan_and_beyond_the_range_there_is_no_limit() -> None:
    bare = Calibration(Curves.of([KNOWN_CURVE] * MANY), np.zeros(MANY, dtype=bool), "older")
    for calibration, is_known in ((known(), True), (bare, False)):
        skin = Read(calibration)
        pressures_pa = np.full(MANY, 20e3)
        pressures_pa[0] = 140e3
        voltage_v = KNOWN_CURVE.voltage(pressures_pa)
        voltage_v[0] -= 0.1
        skin.taxels.mask(parameter=[2])
        readings = skin.of(voltage_v)
        assert readings.sigma_pa is not None
        assert readings.sigma_pa[0] == math.inf and readings.status[0] & Status.SATURATED
        assert math.isnan(readings.sigma_pa[1])  # masked
        assert np.isfinite(readings.sigma_pa[2:]).all() == is_known
    skin.taxels.with_sigma = False
    skin.taxels.refresh()
    assert skin.of(voltage_v).sigma_pa is None


def test_the_covariance_of_a_wrench_is_that_of_wrenches_with_such_errors() -> None:
    config = SkinConfig.of({"nodes": 36})
    layout, rng = config.layout, np.random.default_rng(3)
    distance_m = np.linalg.norm(layout.positions_m[:, :2] - [5e-3, 8e-3], axis=1)
    pressure_pa = (30e3 * np.clip(1 - distance_m / 16e-3, 0, 1)).astype(np.float32)
    pressure_pa[pressure_pa < 200] = 0
    sigma_pa = (20 + 0.02 * pressure_pa).astype(np.float32)
    status = np.zeros(36, dtype=np.uint8)

    def found(values_pa: np.ndarray) -> Contacts:
        tracker = ContactTracker(layout, config.contact)
        return tracker.update(Readings(values_pa, values_pa, status), 0.0)

    truth = found(pressure_pa)
    said = wrench_covariance(layout, truth, pressure_pa, sigma_pa, config.contact.release_pa)
    pressed = pressure_pa > 0
    wrenches = []
    for _ in range(4000):
        noise_pa = np.where(pressed, rng.normal(0, sigma_pa), 0).astype(np.float32)
        wrenches.append(found(pressure_pa + noise_pa).wrench)
    drawn = np.cov(np.array(wrenches).T)
    scale = np.sqrt(np.outer(np.diag(said), np.diag(said)))
    there = scale > 0
    assert there[2:5, 2:5].all()  # force along z, torques about x and y
    assert np.allclose(
        (drawn / np.where(there, scale, 1))[there],
        (said / np.where(there, scale, 1))[there],
        atol=0.08,
    )
    status[0] = Status.STALE
    values_pa = np.zeros(36, dtype=np.float32)
    values_pa[0] = np.nan
    blind = found(values_pa)
    unknown = wrench_covariance(layout, blind, values_pa, sigma_pa, 500.0)
    assert not blind.untouched and np.isnan(unknown).all()
    status[0] = 0
    nothing = found(np.zeros(36, dtype=np.float32))
    assert not wrench_covariance(layout, nothing, values_pa, sigma_pa, 500.0).any()


def test_sigma_of_a_skin_in_python_is_told_only_where_it_is_asked_for() -> None:
    port = "sim://?scene=presses&seed=4&threshold=0"
    with Skin(port, contacts=True) as skin:
        frame = skin.read()
        assert frame.sigma_pa is None and frame.wrench_covariance is None
    config = SkinConfig.of({"publish_sigma": True})
    [*_, frame] = run(config, stream(config, port, 10))
    assert frame.readings.sigma_pa is not None and np.isnan(frame.readings.sigma_pa).all()
    with Skin(port, contacts=True, publish_sigma=True) as skin:
        frame = skin.read()
        assert frame.sigma_pa is not None and frame.wrench_covariance is not None
        assert frame.sigma_pa.shape == (16,) and not frame.sigma_pa.flags.writeable


@given(
    spoken=st.lists(st.integers(0, 7), min_size=20, max_size=70),
    share=st.sampled_from([0.0, 0.34, 0.5]),
    quiet_from=st.integers(0, 70),
)
@examples(60)
def test_a_taxel_is_left_out_from_a_stale_time_after_it_went_stale_until_it_speaks(
    spoken: list[int], share: float, quiet_from: int
) -> None:
    """Bits of spoken: which of three nodes speak in a frame. Silent frames take a short cut."""
    layout = Layout.grid(3, 1, 3, 7e-3, 5e-3)
    taxels = Taxels(3, ADC, chain_of(PressureCurve.two_stage(), layout), layout, 1.0)
    taxels.dead_share = share
    health = NodeHealth(FrameSpec(nodes=3, chip_s=1e-5, frame_period_s=0.25))
    heard_s, named_s = [-np.inf] * 3, [np.inf] * 3
    for number, bits in enumerate(spoken):
        now_s = 0.25 * number
        active = np.array([bits >> i & 1 and number < quiet_from for i in range(3)], dtype=bool)
        words = silent(3, 1e-3)
        if active.any():
            words = replace(words, active=active, codes=np.full(3, 700, np.int32))
            readings = taxels.update(words, now_s, health)
        else:
            readings = taxels.update_silent(words, now_s, health)
        for i in range(3):
            heard_s[i] = now_s if active[i] else heard_s[i]
            is_stale = now_s - heard_s[i] > 1.0
            named_s[i] = min(named_s[i], now_s) if is_stale else np.inf
        dead = [i for i in range(3) if now_s - named_s[i] > 1.0]
        expected = dead if 0 < len(dead) <= share * 3 else []
        assert np.flatnonzero(readings.status & Status.MASKED).tolist() == expected
        assert taxels.retired == tuple(i + 1 for i in expected)


@pytest.mark.parametrize("value", [(7, 3), "7 3", "3, 7,3", [3, 7]])
def test_numbers_of_nodes_are_taken_as_people_write_them(value: object) -> None:
    assert SkinConfig.of({"masked": value}).masked == (3, 7)  # type: ignore[dict-item]


def test_numbers_that_are_no_nodes_are_refused() -> None:
    for wrong in ("3-7", "0", [-1], [True], "99999", 2.0):
        with pytest.raises(ParameterError, match="must be numbers of nodes"):
            SkinConfig.of({"masked": wrong})  # type: ignore[dict-item]
    with pytest.raises(SpecError, match="masked has node 17, but the skin has 16 nodes"):
        SkinConfig.of({"masked": 17})
