# SPDX-License-Identifier: Apache-2.0

"""Drift is followed, contacts are not; nodes that do not change while their neighbours do."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.places.layout import Layout
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from tactile_cdma.readings.baseline import Baseline, RestRules
from tactile_cdma.readings.calibration import AdcScale, Calibration, PressureCurve
from tactile_cdma.readings.drift import (
    BAND_LSB,
    FARTHEST,
    SETTLE_S,
    STRAY_S,
    DriftTracker,
    nodes_beside,
)
from tactile_cdma.readings.pressure import PressureChain
from tactile_cdma.readings.status import Status
from tactile_cdma.readings.stuck import LOOK_S, SWINGS, StuckNodes
from tactile_cdma.readings.taxels import Readings
from test.support.examples import examples
from test.support.voltages import Voltages

ADC = AdcScale()
REST_V = 930 * ADC.lsb_v
BELOW_TOP = PressureCurve.two_stage(v0_v=REST_V)
"""A sensor whose voltage at rest the converter can see rise and fall."""
RISING = PressureCurve(
    BELOW_TOP.pressure_pa, tuple(REST_V + 100 * ADC.lsb_v - volts for volts in BELOW_TOP.voltage_v)
)
LSB_PA = ADC.lsb_v / 33e-6
RULES = RestRules(drift_pa_per_min=60.0, contact_pa=1000.0, release_pa=500.0)
HOUR_S = 3600.0
Values = np.ndarray | float
Course = Callable[[float], Values] | Values


class Rig:
    """Sensors of one kind behind a converter and the chain, in time of its own."""

    def __init__(
        self,
        nodes: int,
        rules: RestRules = RULES,
        beside: np.ndarray | None = None,
        curve: Any = BELOW_TOP,
    ) -> None:
        self.curve = curve
        self.calibration = Calibration.default(self.curve, nodes)
        beside = np.arange(nodes, dtype=np.int32)[:, None] if beside is None else beside
        self.baseline = Baseline(nodes)
        self.tracker = DriftTracker(ADC, beside, rules)
        self.chain = PressureChain(self.calibration, self.baseline, self.tracker)
        self.voltages = Voltages(self.chain, nodes)
        self.valid = np.ones(nodes, bool)
        self.nodes, self.t_s = nodes, 0.0

    def measure(self, load_pa: Values, offset_v: Values) -> np.ndarray:
        true_v = self.curve.voltage(np.broadcast_to(load_pa, self.nodes)) + offset_v
        return ADC.voltage(ADC.code(true_v)).astype(np.float32)

    def read(self, load_pa: Values = 0.0, offset_v: Values = 0.0) -> np.ndarray:
        """What the skin reads now, Pa."""
        measured_v = self.measure(load_pa, offset_v)
        return self.voltages.read(measured_v, self.valid, self.t_s).pressure_pa

    def run(
        self, seconds: float, load_pa: Values = 0.0, offset_v: Course = 0.0, step_s: float = 1.0
    ) -> np.ndarray:
        """The readings of so long, (frames, n), Pa."""
        readings = []
        for _ in range(round(seconds / step_s)):
            offset = offset_v(self.t_s) if callable(offset_v) else offset_v
            readings.append(self.read(load_pa, offset))
            self.t_s += step_s
        return np.array(readings)


def test_a_resting_node_comes_to_read_nothing() -> None:
    """Sensors that rest up to a count beside their curve, wherever the converter's codes lie."""
    offset_v = np.linspace(-1, 1, 41) * 0.9 * ADC.lsb_v
    rig = Rig(41)
    first = rig.read(0.0, offset_v)
    assert np.abs(first).max() > 0.5 * LSB_PA
    rig.run(300, 0.0, offset_v)
    assert np.abs(rig.read(0.0, offset_v)).max() < 0.02 * LSB_PA
    codes_v = rig.measure(0.0, offset_v)
    assert np.allclose(codes_v + rig.baseline.drift_v, REST_V, atol=0.02 * ADC.lsb_v)


@pytest.mark.slow
@pytest.mark.parametrize("settled", [True, False])
def test_hours_of_steady_contact_are_not_swallowed(settled: bool) -> None:
    """From two counts of load on, at any place of the rest between two codes.

    In 10 s before, the drift has settled or has yet to; then every load stays as it was read.
    """
    loads_pa = np.array([200.0, 220.0, 300.0, 500.0, 1000.0, 5e3, 30e3, 60e3, 130e3])
    rests_v = np.linspace(-0.5, 0.5, 11) * ADC.lsb_v
    load_pa, offset_v = np.repeat(loads_pa, 11), np.tile(rests_v, 9)
    rig = Rig(99)
    rig.run(HOUR_S if settled else 10, 0.0, offset_v)
    before_v = rig.baseline.drift_v
    begun = rig.read(load_pa, offset_v)
    held = rig.run(3 * HOUR_S, load_pa, offset_v)
    assert np.array_equal(rig.baseline.drift_v, before_v)
    assert np.array_equal(held[-1], begun)
    assert (held > 0).all()
    if settled:
        count_pa = np.where(load_pa < 50e3, LSB_PA, ADC.lsb_v / 5.9e-6)
        assert (np.abs(held - load_pa) < 1.02 * count_pa).all()  # of rest and of load, ½ each
    after = rig.run(300, 0.0, offset_v)
    assert np.abs(after[-1]).max() < 0.02 * LSB_PA


@pytest.mark.slow
def test_flickering_codes_do_not_let_a_light_contact_slip_away() -> None:
    """Noise of a third of a count: codes flicker, most where the rest is between two of them."""
    rng = np.random.default_rng(1)
    rests_v = np.linspace(-0.5, 0.5, 21) * ADC.lsb_v
    rig = Rig(21)

    def noisy(t_s: float) -> np.ndarray:
        return rests_v + rng.normal(0, ADC.lsb_v / 3, 21)

    rig.run(600, 0.0, noisy)
    load_pa = 2.5 * LSB_PA
    begun = rig.run(60, load_pa, noisy).mean(axis=0)
    rig.run(2 * HOUR_S, load_pa, noisy)
    held = rig.run(60, load_pa, noisy).mean(axis=0)
    assert (begun > 1.3 * LSB_PA).all()
    assert np.abs(held - begun).max() < 0.5 * LSB_PA


@pytest.mark.slow
@pytest.mark.parametrize("pa_per_min", [-50.0, -10.0, 10.0, 50.0])
def test_drift_slower_than_the_limit_is_followed(pa_per_min: float) -> None:
    """Within a count, which is all that a word can tell, over an hour: up to 30 counts of drift."""
    rig = Rig(5)
    phase_v = np.linspace(0, 0.8, 5) * ADC.lsb_v
    readings = rig.run(HOUR_S, 0.0, lambda t_s: phase_v - 33e-6 * pa_per_min * t_s / 60)
    assert np.abs(readings).max() < 1.05 * LSB_PA
    drift_pa = rig.baseline.drift_v / 33e-6
    assert np.allclose(drift_pa, 60 * pa_per_min, atol=1.6 * LSB_PA)


def test_drift_and_creep_beyond_the_limit_are_not_followed_away() -> None:
    """A load that creeps up at twice the limit: what is lost of it is bounded by the band."""
    rig = Rig(1)
    rig.run(60)
    for _ in range(2400):
        load_pa = min(120.0 * (rig.t_s - 60) / 60, 4000.0)
        last = rig.run(1, load_pa)[0]
    # While it is within the band it gains 60 Pa a minute on what is followed.
    assert 4000 - last[0] < (BAND_LSB + 1) * LSB_PA


def test_a_slow_load_and_a_slow_tear_are_followed_so_far_and_no_farther() -> None:
    """At 50 Pa a minute, for five hours, with a start anew in between: 15 kPa of it.

    It counts from the tare, before which there was as much, at two of the nodes.
    """
    rig = Rig(4)
    rise = np.array([-1.0, 1.0, -1.0, 1.0])
    before_v = rise * [0.0, 0.0, 100e-3, 100e-3]
    rig.baseline.drift_v = rig.baseline.tared_drift_v = -before_v.astype(np.float32)
    offset_v = np.zeros(4)
    for _ in range(5):
        kept_v = rig.baseline.drift_v, rig.baseline.tared_drift_v
        rig.tracker = rig.chain.tracker = DriftTracker(ADC, rig.tracker._beside, RULES)
        rig.baseline.drift_v, rig.baseline.tared_drift_v = kept_v
        begin_s, begin_v = rig.t_s, offset_v
        rig.run(
            HOUR_S,
            0.0,
            lambda t, s=begin_s, v=begin_v: before_v + v + rise * 33e-6 * 50 * (t - s) / 60,
        )
        offset_v = begin_v + rise * 0.099
    voltage_v = rig.measure(0.0, before_v + offset_v)
    readings = rig.voltages.read(voltage_v, rig.valid, rig.t_s)
    moved_v = rig.baseline.drift_v - rig.baseline.tared_drift_v
    assert moved_v == pytest.approx(-rise * FARTHEST * 33e-3, rel=1e-3)
    assert readings.pressure_pa[rise < 0] == pytest.approx(15e3 - FARTHEST * 1e3, abs=3 * LSB_PA)
    assert (readings.status[rise > 0] & Status.FAULTY).all()


@pytest.mark.parametrize("rise", [-1.0, 1.0])
def test_a_contact_during_drift_keeps_its_pressure(rise: float) -> None:
    """Light contacts of an hour begin at all phases of a drift of 30 Pa a minute.

    While they last drift is not followed, so that the drift itself shows in them, and no more.
    """
    begins_s = np.arange(600.0, 600.0 + 6 * 60, 10.0)
    nodes = len(begins_s)
    rig = Rig(nodes)

    def drifted_v(t_s: float) -> float:
        return rise * 33e-6 * 30.0 * min(t_s, 960.0) / 60

    readings = []
    while rig.t_s < 2400:
        load_pa = np.where(rig.t_s >= begins_s, 3 * LSB_PA, 0.0)
        readings.append(rig.run(1, load_pa, drifted_v)[0])
    first = np.array([readings[round(t)][i] for i, t in enumerate(begins_s)])
    drift_after_pa = -rise * 30.0 * (960.0 - begins_s) / 60
    lost_pa = first + drift_after_pa - readings[-1]
    assert (first > 0.9 * LSB_PA).all()
    assert lost_pa.max() < 1.1 * LSB_PA  # rounding to codes, twice


@pytest.mark.parametrize("curve", [BELOW_TOP, RISING])
def test_drift_is_followed_after_a_contact_that_moved_the_rest(curve: PressureCurve) -> None:
    rig, moved_v = Rig(1, curve=curve), ADC.lsb_v if curve.rises else -ADC.lsb_v
    rig.run(60)
    rig.run(600, 5e3, lambda t_s: moved_v * min(1.0, (t_s - 60) / 300))
    rig.run(9, 0.0, moved_v)  # the sensor may have to settle
    assert rig.baseline.drift_v[0] == 0
    rig.run(300, 0.0, moved_v)
    assert abs(rig.read(0.0, moved_v)[0]) < 0.02 * LSB_PA


def test_two_counts_are_a_contact_while_a_count_of_drift_is_still_being_followed() -> None:
    """The rest has just risen by a count: with the contact the node is a count off, as in drift."""
    rig = Rig(1)
    rig.run(60)
    rig.run(30, 0.0, ADC.lsb_v)
    begun = rig.read(2 * LSB_PA, ADC.lsb_v)
    assert begun[0] > 0.9 * LSB_PA
    assert np.array_equal(rig.run(HOUR_S, 2 * LSB_PA, ADC.lsb_v)[-1], begun)


def test_where_a_node_was_before_it_fell_silent_does_not_count() -> None:
    rig = Rig(1)
    rig.run(60)
    rig.run(12, 0.0, ADC.lsb_v)
    rig.valid[:] = False
    rig.run(60)
    rig.valid[:] = True
    rig.run(300, 0.0, -ADC.lsb_v)
    assert abs(rig.read(0.0, -ADC.lsb_v)[0]) < 0.02 * LSB_PA


def test_nodes_are_beside_each_other_by_their_places_not_their_numbers() -> None:
    grid = Layout.grid(9, 3, 3, 7e-3, 5e-3)
    shuffled = np.array([5, 9, 1, 7, 3, 8, 0, 2, 6], np.int32)
    layout = replace(grid, nodes=shuffled)
    table = nodes_beside(layout, 9)
    beside = [set(numbers.tolist()) - {own} for own, numbers in enumerate(table + 1, start=1)]
    assert beside[3 - 1] == {5, 9, 1, 7, 8, 2, 6}  # in the middle
    assert beside[6 - 1] == {3, 8, 2}  # in the corner
    assert beside[4 - 1] == set()  # it has no place


def test_nodes_without_a_valid_reading_are_frozen_and_settle_first_when_they_are_back() -> None:
    rig = Rig(2)
    rig.valid[1] = False
    rig.run(600, 0.0, -ADC.lsb_v)
    assert rig.baseline.drift_v[0] > 0.9 * ADC.lsb_v
    assert rig.baseline.drift_v[1] == 0
    rig.valid[1] = True
    rig.run(SETTLE_S - 1, 0.0, -ADC.lsb_v)
    assert rig.baseline.drift_v[1] == 0
    rig.run(300, 0.0, -ADC.lsb_v)
    assert rig.baseline.drift_v[1] > 0.9 * ADC.lsb_v


def test_rest_is_where_the_tare_is() -> None:
    """A preload of 60 kPa, in the flat second stage, tared: its drift is followed about there."""
    rig = Rig(1)
    rig.baseline.rest_v = rig.measure(60e3, 0.0)
    rig.baseline.tare_pa = rig.curve.pressure(rig.baseline.rest_v).astype(np.float32)
    rig.run(60, 60e3)
    rig.run(600, 60e3, -ADC.lsb_v)
    assert rig.baseline.drift_v[0] == pytest.approx(ADC.lsb_v, rel=0.02)
    assert abs(rig.read(60e3, -ADC.lsb_v)[0]) < 0.02 * ADC.lsb_v / 5.9e-6


def test_lost_frames_and_pauses_are_not_made_up_for() -> None:
    rig = Rig(1)
    rig.run(60)
    rig.t_s += HOUR_S
    before_v = rig.baseline.drift_v[0]
    rig.run(2, 0.0, -ADC.lsb_v)
    assert rig.baseline.drift_v[0] - before_v <= 33e-6 * 60 / 60 * 2 * 1.001


def test_a_device_clock_that_starts_again_moves_nothing_by_itself() -> None:
    rig = Rig(1)
    rig.t_s = 5000.0
    rig.run(300, 0.0, -0.5 * ADC.lsb_v)
    before_v = rig.baseline.drift_v
    rig.t_s = 0.0
    rig.chain.forget()
    rig.run(SETTLE_S, 0.0, -ADC.lsb_v)
    assert np.array_equal(rig.baseline.drift_v, before_v)
    rig.run(300, 0.0, -ADC.lsb_v)
    assert rig.baseline.drift_v[0] == pytest.approx(ADC.lsb_v, rel=0.02)


def test_strays_are_named_after_a_minute_with_how_far_they_are_off() -> None:
    rig = Rig(3)
    offset_v = np.array([0.0, -4.0, 3.0]) * ADC.lsb_v
    rig.run(STRAY_S, 0.0, offset_v)
    assert rig.tracker.strays_lsb(rig.t_s - 1) == {}
    rig.run(5, 0.0, offset_v)
    strays = rig.tracker.strays_lsb(rig.t_s)
    assert strays.keys() == {2, 3}
    assert strays[2] == pytest.approx(4, abs=1)
    assert strays[3] == pytest.approx(-3, abs=1)
    rig.run(5, 2e3 * np.array([0, 1, 0]), offset_v)  # pressed: there is a reason
    assert rig.tracker.strays_lsb(rig.t_s).keys() == {3}


def test_nobody_is_a_stray_for_not_being_looked_at() -> None:
    rig = Rig(2)
    rig.run(STRAY_S, 0.0, np.array([0.0, -4.0]) * ADC.lsb_v)
    rig.t_s += 2 * STRAY_S
    assert rig.tracker.strays_lsb(rig.t_s).keys() == {2}
    rig.tracker.rules = replace(RULES, drift_pa_per_min=0.0)
    assert rig.tracker.strays_lsb(rig.t_s) == {}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_frames_that_are_skipped_while_steady_change_nothing(seed: int) -> None:
    """Neither readings nor drift, however long voltages stay and whatever comes afterwards."""
    rng = np.random.default_rng(seed)
    beside = nodes_beside(Layout.grid(9, 3, 3, 7e-3, 5e-3), 9)
    every, some = Rig(9, beside=beside), Rig(9, beside=beside)
    t_s, skipped, frames = 0.0, 0, 0
    for stays_s in rng.choice([0.1, 1.0, 5.0, 15.0, 40.0], 25):
        codes = 930 - rng.integers(-3, 8, 9) * (rng.random(9) < 0.5)
        voltage_v, valid = ADC.voltage(codes).astype(np.float32), rng.random(9) < 0.97
        for frame in range(round(stays_s / 0.05)):
            t_s += 0.05
            expected = every.voltages.read(voltage_v, valid, t_s).pressure_pa
            if frame and some.chain.try_hold(t_s):
                skipped += 1
            else:
                read = some.voltages.read(voltage_v, valid, t_s).pressure_pa
            frames += 1
            assert np.array_equal(read, expected, equal_nan=True)
        assert np.array_equal(some.baseline.drift_v, every.baseline.drift_v)
    assert skipped > frames / 3


@examples(60)
@given(
    frames=st.lists(
        st.tuples(
            st.floats(0.0, 5.0),  # s since the frame before
            st.lists(st.integers(915, 940), min_size=4, max_size=4),  # rest is code 930
            st.lists(st.booleans(), min_size=4, max_size=4),
        ),
        min_size=1,
        max_size=60,
    ),
    pa_per_min=st.floats(0.0, 1e5),
)
def test_drift_never_moves_faster_than_the_limit_nor_where_it_is_frozen(
    frames: list[tuple[float, list[int], list[bool]]], pa_per_min: float
) -> None:
    beside = nodes_beside(Layout.grid(4, 1, 4, 7e-3, 5e-3), 4)
    rig = Rig(4, RestRules(pa_per_min, 1000.0, 500.0), beside)
    t_s, looked_s = 0.0, 0.0
    for passed_s, codes, valid in frames:
        t_s += passed_s
        before_v = rig.baseline.drift_v
        voltage_v = ADC.voltage(codes).astype(np.float32)
        off = np.abs(REST_V - voltage_v - before_v) > 1.01 * BAND_LSB * ADC.lsb_v
        reading = rig.voltages.read(voltage_v, np.array(valid), t_s).pressure_pa
        moved_v = np.abs(rig.baseline.drift_v - before_v)
        assert (moved_v <= 33e-6 * pa_per_min / 60 * (t_s - looked_s) * 1.001 + 1e-9).all()
        looked_s = t_s if moved_v.any() else looked_s
        touched = np.array(valid) & (reading > 500.0)
        frozen = off | ~np.array(valid) | touched[beside].any(axis=1)
        assert (moved_v[frozen] == 0).all()


CONTACT_PA = 1e3
COUNT_PA = 100.0
SIDE = 6
GRID = Layout.grid(SIDE * SIDE, SIDE, SIDE, 0.007, 0.0055)
LAYOUTS = Path(__file__).resolve().parents[3] / "config" / "layouts"
CYLINDER = read_layout(LAYOUTS / "cylinder.yaml", Wiring())
INNER, EDGE, CORNER = SIDE + 1, 2, 0
SWING = (0.0, 30e3)  # Pa


class Skin:
    """Feeds a StuckNodes of this layout, look by look."""

    def __init__(self, layout: Layout = GRID) -> None:
        self.stuck = StuckNodes(layout)
        self.status = np.zeros(len(layout), dtype=np.uint8)
        self._t_s = 0.0

    def show(self, pressure_pa: np.ndarray, voltage_v: np.ndarray | None = None) -> list[int]:
        """Pressures in Pa; the nodes' words are these in counts unless given."""
        counts = np.rint(pressure_pa / COUNT_PA) if voltage_v is None else voltage_v
        values = (given.astype(np.float32) for given in (pressure_pa, counts))
        readings = Readings(*values, self.status.copy())
        self._t_s += 1.01 * LOOK_S
        self.stuck.look(readings, self._t_s, CONTACT_PA)
        return self.stuck.nodes


def pressed(
    skin: Skin, taxels: int, held: dict[int, float], times: int, loads_pa: tuple[float, ...] = SWING
) -> list[int]:
    """The whole skin under one load after another, except for the taxels that do not change."""
    for number in range(times):
        pressure_pa = np.full(taxels, loads_pa[number % len(loads_pa)])
        for taxel, value in held.items():
            pressure_pa[taxel] = value
        skin.show(pressure_pa)
    return skin.stuck.nodes


@pytest.mark.parametrize("layout", [GRID, CYLINDER], ids=lambda layout: layout.name)
@pytest.mark.parametrize("value_pa", [0.0, 300.0, 45e3])
def test_who_never_moves_is_named_after_some_swings(layout: Layout, value_pa: float) -> None:
    placed = np.flatnonzero(layout.nodes)
    taxel = int(placed[len(placed) // 2])
    skin = Skin(layout)
    assert pressed(skin, len(layout), {taxel: value_pa}, SWINGS) == []
    assert pressed(skin, len(layout), {taxel: value_pa}, 2) == [layout.nodes[taxel]]


@pytest.mark.parametrize("taxel", [INNER, EDGE, CORNER])
def test_a_stuck_node_is_found_at_any_place_with_any_value(taxel: int) -> None:
    loads_pa = (20e3, 60e3)  # a hand that rests there: never free
    assert pressed(Skin(), len(GRID), {taxel: 0.0}, 6, loads_pa) == [taxel + 1]
    assert pressed(Skin(), len(GRID), {taxel: 60e3}, 6, loads_pa) == [taxel + 1]


def test_two_side_by_side_are_found_and_no_sound_one_with_them() -> None:
    held = {INNER: 0.0, INNER + 3: 7e3, INNER + 4 * SIDE: 90e3}
    assert pressed(Skin(), len(GRID), held, 9) == sorted(taxel + 1 for taxel in held)
    beside = {INNER + SIDE + 1: 40e3, INNER + SIDE + 2: 50e3}
    assert pressed(Skin(), len(GRID), beside, 9, (20e3, 60e3)) == sorted(t + 1 for t in beside)


def test_only_a_certain_change_clears_it() -> None:
    skin = Skin()
    assert pressed(skin, len(GRID), {INNER: 45e3}, 6)
    assert pressed(skin, len(GRID), {INNER: 45e3 + COUNT_PA}, 1) == []
    skin = Skin()
    assert pressed(skin, len(GRID), {INNER: 0.0}, 6)
    skin.status[INNER] = Status.LOW_SNR
    assert pressed(skin, len(GRID), {INNER: 12e3}, 1) == [INNER + 1]


def test_where_little_is_known_nobody_is_stuck() -> None:
    assert pressed(Skin(), len(GRID), {INNER: np.nan}, 8) == []
    assert pressed(Skin(), len(GRID), {INNER: 0.0}, 20, (2e3, 5e3)) == []
    strip = Layout.grid(8, 1, 8, 0.007, 0.0055)
    assert pressed(Skin(strip), 8, {3: 0.0}, 8) == []


def test_a_node_beyond_its_range_is_named_only_if_it_stays_there() -> None:
    skin = Skin()
    skin.status[INNER] = Status.SATURATED
    assert pressed(skin, len(GRID), {INNER: 140e3}, 12, (60e3, 130e3)) == []
    assert pressed(skin, len(GRID), {INNER: 140e3}, 6) == [INNER + 1]


@examples(40)
@given(st.lists(st.sets(st.integers(0, SIDE * SIDE - 1)), min_size=1, max_size=6))
def test_what_neighbours_tell_does_not_depend_on_the_past(unreadable: list[set[int]]) -> None:
    rng = np.random.default_rng(len(unreadable))
    looks_pa = [rng.uniform(2e3, 40e3, len(GRID)) for _ in (*unreadable, None)]
    for pressure_pa, taxels in zip(looks_pa[1:], unreadable, strict=True):
        pressure_pa[list(taxels)] = np.nan
    old, fresh = Skin(), Skin()
    for pressure_pa in looks_pa:
        old.show(pressure_pa)
    fresh.show(looks_pa[-1])
    # A node that does not change while its neighbours do is reported.
    last_pa = np.where(np.arange(len(GRID)) % 7 == 0, looks_pa[-1], looks_pa[-1] + 1e3)
    for skin in (old, fresh):
        skin.show(last_pa)
    last = Readings(last_pa.astype(np.float32), last_pa.astype(np.float32), old.status)
    told_pa = [skin.stuck._expected(last, CONTACT_PA) for skin in (old, fresh)]
    np.testing.assert_array_equal(*told_pa)
    assert unreadable[-1] or np.isfinite(told_pa[0]).any()


@examples(60)
@given(
    st.lists(
        st.tuples(
            st.floats(-0.5, SIDE - 0.5),
            st.floats(-0.5, SIDE - 0.5),
            st.floats(0.8, 4.0),
            st.floats(5e3, 130e3),
        ),
        min_size=1,
        max_size=4,
    ),
    st.floats(0.5, 1.5),
)
def test_round_contacts_on_a_sound_skin_name_nobody(
    contacts: list[tuple[float, float, float, float]], power: float
) -> None:
    """They come and go at the same positions, with edges as steep as Hertz's and softer ones."""
    row, column = np.divmod(np.arange(len(GRID)), SIDE)
    fields = [
        peak * np.clip(1 - ((row - y) ** 2 + (column - x) ** 2) / radius**2, 0, None) ** power
        for x, y, radius, peak in contacts
    ]
    skin = Skin()
    for turn in range(4 * len(fields)):
        assert skin.show(fields[turn % len(fields)]) == []
        assert skin.show(np.zeros(len(GRID))) == []
