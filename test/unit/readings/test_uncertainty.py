# SPDX-License-Identifier: Apache-2.0

"""How sure readings are: known sensors are off by as much as is said, and unknown is unknown."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tactile_cdma.calibrating.load_points import LoadPoints
from tactile_cdma.calibrating.skin_fit import fit_skin
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.baseline import LOOK_S, Baseline, RestRules
from tactile_cdma.readings.calibration import AdcScale, Calibration, Curves, PressureCurve
from tactile_cdma.readings.contact import Contacts, ContactTracker, wrench_covariance
from tactile_cdma.readings.drift import DriftTracker, nodes_beside
from tactile_cdma.readings.pressure import PressureChain
from tactile_cdma.readings.status import Status
from tactile_cdma.readings.taxels import Readings, Taxels
from tactile_cdma.skin import Skin
from tactile_cdma.words.health import NodeHealth
from tactile_cdma.words.words import Words, silent
from test.support.simulated import run, stream

NODES, ADC, LSB_V = 64, AdcScale(10), AdcScale(10).lsb_v
CURVE = PressureCurve((0.0, 50e3, 140e3), (3.0, 1.35, 0.8))
RULES = RestRules(60.0, 1e3, 500.0)


class Read:
    """A skin whose nodes say what a converter makes of given voltages."""

    def __init__(self, calibration: Calibration, nodes: int = NODES) -> None:
        layout = Layout.grid(nodes, 0, 0, 7e-3, 5e-3)
        tracker = DriftTracker(ADC, nodes_beside(layout, nodes), RULES)
        chain = PressureChain(calibration, Baseline(nodes), tracker)
        self.taxels = Taxels(nodes, ADC, chain, layout, 1e6)
        self.taxels.with_sigma = True
        self.health = NodeHealth(FrameSpec(nodes=nodes, chip_s=1e-8, frame_period_s=1.0))
        self.t_s = 0.0

    def of(self, voltage_v: np.ndarray, active: bool = True) -> Readings:
        empty = silent(voltage_v.size, 1e-3)
        said = {name: getattr(empty, name) for name in Words.__dataclass_fields__}
        said |= {"codes": ADC.code(voltage_v).astype(np.int32)}
        said |= {"active": np.full(voltage_v.size, active)}
        self.t_s += LOOK_S
        return self.taxels.update(Words(**said), self.t_s, self.health)


def known(residual_v: float = LSB_V / math.sqrt(12), loop: float = 0.0) -> Calibration:
    curve = replace(CURVE, residual_v=residual_v, loop=loop)
    return Calibration(Curves.of([curve] * NODES), np.zeros(NODES, dtype=bool), "known")


@pytest.mark.parametrize("noise_v", [0.0, 1e-3, 8e-3])
@pytest.mark.parametrize("residual_v", [0.0, 12e-3])
@pytest.mark.parametrize("loop", [0.0, 0.08])
def test_errors_over_what_is_said_of_them_have_a_standard_deviation_of_one(
    noise_v: float, residual_v: float, loop: float
) -> None:
    """Each part is drawn here, from what its name says: a curve's misfit, a loop, noise."""
    rng = np.random.default_rng(5)
    skin = Read(known(math.hypot(residual_v, LSB_V / math.sqrt(12)), loop))
    rest_v = CURVE.voltage(rng.uniform(0, 3e3, NODES))
    for _ in range(12):
        skin.of(rest_v + rng.normal(0, noise_v, NODES))
    skin.taxels.tare(1e3, force=True)
    over = []
    for _ in range(30):
        load_pa = np.exp(rng.uniform(math.log(1e3), math.log(120e3), NODES))
        total_pa = CURVE.pressure(rest_v) + load_pa
        apparent_pa = total_pa * (1 + rng.normal(0, loop, NODES))
        voltage_v = CURVE.voltage(np.minimum(apparent_pa, 139e3))
        voltage_v += rng.normal(0, residual_v, NODES)
        inside = (apparent_pa < 135e3) & (np.abs(total_pa - 50e3) > 15e3)  # of one piece
        for _ in range(40):  # five seconds
            readings = skin.of(voltage_v + rng.normal(0, noise_v, NODES))
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
    spoken = skin.of(CURVE.voltage(np.full(NODES, 20e3)))
    held = skin.of(np.zeros(NODES), active=False)
    assert spoken.sigma_pa is not None and held.sigma_pa is not None
    assert np.allclose(spoken.pressure_pa, held.pressure_pa)
    count_pa = LSB_V / (1.65 / 50e3)
    assert np.allclose(spoken.sigma_pa, count_pa / math.sqrt(12), rtol=1e-3)
    assert np.allclose(held.sigma_pa, 3 * count_pa / math.sqrt(12), rtol=1e-3)


def test_what_nobody_knows_is_nan_and_beyond_the_range_there_is_no_limit() -> None:
    calibration = known()
    bare = Calibration(Curves.of([CURVE] * NODES), np.zeros(NODES, dtype=bool), "older")
    for each, is_known in ((calibration, True), (bare, False)):
        skin = Read(each)
        pressures_pa = np.full(NODES, 20e3)
        pressures_pa[0] = 140e3
        voltage_v = CURVE.voltage(pressures_pa)
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


@pytest.mark.parametrize("falls", [True, False])
def test_a_calibration_knows_the_loop_only_where_loads_fell(falls: bool) -> None:
    rng = np.random.default_rng(2)
    up_pa = np.linspace(0, 140e3, 40)
    loads_pa = np.concatenate([up_pa, up_pa[-2::-1]]) if falls else np.tile(up_pa, 1)
    sign = np.where(np.arange(len(loads_pa)) < len(up_pa), -1, 1)
    apparent_pa = loads_pa * (1 + 0.06 * sign * falls)
    voltage_v = 3.0 - 2e-5 * apparent_pa + rng.normal(0, 4e-3, len(loads_pa))
    count = len(loads_pa)
    points = LoadPoints(
        np.ones(count, dtype=np.int64), loads_pa, voltage_v, np.arange(count), "made"
    )
    curve = fit_skin(points, 1, ADC, pieces=1).curves[1]
    if falls:
        assert curve.loop == pytest.approx(0.06, rel=0.15)
    else:
        assert math.isnan(curve.loop)
    assert curve.residual_v == pytest.approx(4e-3, rel=0.35)


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
