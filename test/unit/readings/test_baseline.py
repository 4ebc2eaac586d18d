# SPDX-License-Identifier: Apache-2.0

"""Tare: the zero that it sets, when it is refused, and its effect on silent and unheard nodes."""

import re
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from tactile_cdma.base.errors import RestError
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver import checkup
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.readings import baseline as tare
from tactile_cdma.readings.baseline import LOOKS
from tactile_cdma.readings.calibration import AdcScale, Calibration, PressureCurve
from tactile_cdma.readings.contact import ContactTracker
from tactile_cdma.readings.status import Status
from tactile_cdma.readings.taxels import Readings
from tactile_cdma.words.health import NodeHealth
from tactile_cdma.words.words import Words, silent
from test.support.voltages import Voltages

FRAME_S = 0.0128
ADC = AdcScale()
CURVE = PressureCurve.two_stage()
SECOND = round(1.5 / FRAME_S)
"""Frames in the second of a tare, and a bit."""
SLOW_S = 0.1
"""Frame period where drift takes its minutes: as few frames as a tare can be taken from."""


class Patch:
    """Six nodes, 2 × 3, speaking as they would: on a change of two counts, and once a second."""

    def __init__(
        self, frame_s: float = FRAME_S, layout: dict[str, Any] | None = None, **parameters: float
    ) -> None:
        """layout: what is to be other than in a grid."""
        config = SkinConfig.of({"nodes": 6, "rows": 2, "columns": 3, **parameters})
        config = replace(config, layout=replace(config.layout, **(layout or {})))
        self.pipeline = Pipeline(config)
        self.taxels, self.health = self.pipeline.taxels, NodeHealth(config.spec)
        self.mute: tuple[int, ...] = ()
        self.frame, self.frame_s = 0, frame_s
        self._sent = np.full(6, -100)

    def words(self, codes: np.ndarray) -> Words:
        active = np.abs(codes - self._sent) > 1
        active |= np.arange(6) == self.frame % round(1 / self.frame_s)
        active[list(self.mute)] = False
        self._sent[active] = codes[active]
        return replace(silent(6, 0.0), active=active, codes=np.where(active, codes, 0).astype("i4"))

    def read(self, frames: int, load_pa: object = 0.0, offset_v: Any = 0.0) -> Readings:
        """So many frames under a load; the last reading."""
        codes = ADC.code(CURVE.voltage(np.broadcast_to(load_pa, 6)) + offset_v)  # clamped, too
        for _ in range(frames):
            readings = self.taxels.update(self.words(codes), self.frame * self.frame_s, self.health)
            self.frame += 1
        return readings

    def refusal(self, force: bool = False) -> str:
        """Why it is not tared."""
        with pytest.raises(RestError) as refused:
            self.taxels.tare(1000.0, force)
        return str(refused.value)


@pytest.fixture
def patch() -> Patch:
    return Patch(drift_pa_per_min=0.0)


PRELOAD_PA = np.array([0.0, 300.0, 600.0, 900.0, 100.0, 200.0])


def test_a_tare_makes_what_the_skin_reads_zero_and_keeps_differences(patch: Patch) -> None:
    before = patch.read(SECOND, PRELOAD_PA).pressure_pa
    assert patch.taxels.tare(1000.0) == []
    assert np.array_equal(patch.read(1, PRELOAD_PA).pressure_pa, np.zeros(6))
    more = patch.read(2, PRELOAD_PA + 10e3).pressure_pa
    assert np.allclose(more, 10e3, atol=110)
    patch.taxels.restore()
    assert np.array_equal(patch.read(2, PRELOAD_PA).pressure_pa, before)


def test_a_tare_is_taken_while_nobody_speaks(patch: Patch) -> None:
    """Long after the last change, between heartbeats, silent frames show it at once."""
    patch.read(3 * SECOND, PRELOAD_PA)
    patch.taxels.tare(1000.0)
    patch.frame = 78 * 5 + 20  # nobody's turn
    readings = patch.read(1, PRELOAD_PA)
    assert (readings.status & Status.SILENT).all()
    assert np.array_equal(readings.pressure_pa, np.zeros(6))


def test_the_tare_is_the_median_of_the_last_second(patch: Patch) -> None:
    chain = patch.taxels.chain
    voltages, curves = Voltages(chain, 6), chain.calibration.curves
    rng = np.random.default_rng(4)
    looks = 500 + rng.normal(0, 20, (LOOKS, 6))
    looks[5] += 45  # an outlier
    for number, pressure in enumerate(np.vstack([np.full(6, 9e4), looks])):
        voltages.read(curves.voltage(pressure).astype(np.float32), True, 0.125 * number)
    patch.taxels.tare(1000.0, force=True)
    assert np.allclose(patch.taxels.baseline.tare_pa, np.median(looks, axis=0), atol=0.05)


def test_a_tare_under_load_is_refused_by_name_unless_forced(patch: Patch) -> None:
    patch.read(SECOND, [0, 0, 0, 0, 2e3, 12.3e3])
    assert patch.refusal() == (
        "not tared, under load: node 6 (row 1, column 2) 12.30 kPa, node 5 (row 1, column 1) "
        "1.95 kPa; take away what touches them, or, if this is how the skin rests, tare with "
        "force: true"
    )
    assert (patch.taxels.baseline.tare_pa == 0).all()
    patch.taxels.tare(1000.0, force=True)
    assert np.array_equal(patch.read(1, [0, 0, 0, 0, 2e3, 12.3e3]).pressure_pa, np.zeros(6))


def test_many_tares_under_a_little_load_take_no_more_than_one() -> None:
    """As a program does before every grip, while something is left behind each time.

    A mounted skin is tared again as it is: load counts from its zero.
    """
    patch, taken = Patch(drift_pa_per_min=0.0), 0.0
    patch.read(SECOND, 20e3)
    patch.taxels.tare(1000.0, force=True)
    for load_pa in np.arange(20.6e3, 23e3, 600):
        patch.read(SECOND, load_pa)
        try:
            patch.taxels.tare(1000.0)
            taken = load_pa
        except RestError as error:
            assert "under load" in str(error)
    assert taken == 20.6e3
    patch.read(SECOND, 20.2e3)
    patch.taxels.tare(1000.0)  # what was left behind is gone


def test_what_moves_is_refused_by_name_and_nothing_else_is_named(patch: Patch) -> None:
    patch.read(SECOND)
    patch.read(SECOND // 3, [0, 0, 500.0, 0, 0, 0])
    assert re.search(r"moving: node 3 \(row 0, column 2\) 1\d\.\d\d mV; wait", patch.refusal())
    patch.read(SECOND, [0, 0, 500.0, 0, 0, 0])
    patch.taxels.tare(1000.0)
    patch.read(SECOND)
    patch.read(SECOND // 2, [20e3, 9e3, 0, 0, 0, 0])
    patch.read(5 * SECOND // 8, [0, 9e3, 20e3, 0, 0, 0])
    refusal = patch.refusal()
    assert refusal.startswith("not tared, moving: node 3 (row 0, column 2)")
    assert "node 2 (" not in refusal, "it is pressed, but does not move"
    assert "node 1 (" not in refusal, "it moved, but nothing is there any more"


def test_what_moves_lightly_or_where_no_pressure_reaches_is_named() -> None:
    patch = Patch(drift_pa_per_min=0.0)
    patch.read(2 * SECOND, [20e3, 0, 0, 0, 0, 0])
    patch.read(SECOND // 3, [20e3, 0, 500.0, 0, 0, 0])
    assert re.search(r"moving: node 3 \(row 0, column 2\) 1\d\.\d\d mV; wait", patch.refusal())
    # Its pressure is 0 all the time: the sensor rests above its curve, and hangs loose.
    patch = Patch(v0_v=3.2, drift_pa_per_min=0.0)
    for part in range(10):
        patch.read(SECOND // 8, 0.0, np.array([0, 0, 0, part % 2, 0, 0]) * 16e-3 - 0.09)
    assert re.search(r"moving: node 4 \(row 1, column 0\) 16\.11 mV; wait", patch.refusal())


def test_many_nodes_are_not_all_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor looked for on the skin: of 65,535 that takes half a second, for which frames wait."""
    name = Mock(wraps=tare._name)
    monkeypatch.setattr(tare, "_name", name)
    config = SkinConfig.of({"nodes": 12, "rows": 1, "columns": 12})
    taxels = Pipeline(config).taxels
    voltage_v = np.full(12, 2.0, np.float32)
    voltages = Voltages(taxels.chain, 12)
    for look in range(LOOKS):
        voltages.read(voltage_v, True, 0.125 * look)
    with pytest.raises(
        RestError, match=r"node 1 \(taxel 0\).*node 8 [^,]* and 4 more; take"
    ) as refused:
        taxels.tare(1000.0)
    assert "node 9" not in str(refused.value)
    assert name.call_count == 8


def test_nodes_without_a_reading_keep_their_tare_and_are_named() -> None:
    patch = Patch(drift_pa_per_min=0.0, stale_after_s=1.1)
    patch.read(SECOND, 500.0)
    patch.taxels.tare(1000.0)
    before_pa = patch.taxels.baseline.tare_pa
    patch.mute = (1, 4)
    patch.read(3 * SECOND, 1100.0)
    assert patch.taxels.tare(1000.0) == [2, 5]
    after_pa = patch.taxels.baseline.tare_pa
    assert np.array_equal(after_pa[[1, 4]], before_pa[[1, 4]])
    assert (after_pa[[0, 2, 3, 5]] > 1000).all()


def test_a_tare_needs_a_second_of_readings() -> None:
    patch = Patch()
    assert re.search("less than 1 s; try again", patch.refusal())
    patch.read(SECOND // 2)
    assert re.search("less than 1 s", patch.refusal(True))
    patch.read(SECOND // 2)
    patch.taxels.tare(1000.0)
    patch.taxels.forget()  # the digitizer was started again
    patch.frame = 0
    patch.read(5)
    assert re.search("less than 1 s", patch.refusal())


def test_a_tare_waits_for_nodes_that_are_still_to_be_heard() -> None:
    """Those that have yet to speak after a start, and those that spoke only just now."""
    patch = Patch(drift_pa_per_min=0.0, stale_after_s=3.0)
    patch.mute = (1, 4)
    patch.read(SECOND, 500.0)
    assert re.search("not yet heard for 1 s: nodes 2, 5; try again, or", patch.refusal())
    patch.mute = (4,)
    patch.read(2 * SECOND, 500.0)  # 4.5 s after the start node 5 is awaited no longer
    assert patch.taxels.tare(1000.0) == [5]
    patch.mute = ()
    patch.read(SECOND // 2, 500.0)
    assert re.search("not yet heard for 1 s: node 5;", patch.refusal())
    assert patch.taxels.tare(1000.0, force=True) == [5]
    patch.read(SECOND, 500.0)
    assert patch.taxels.tare(1000.0) == []
    assert np.array_equal(patch.read(1, 500.0).pressure_pa, np.zeros(6))


def test_a_skin_that_nobody_heard_is_not_tared() -> None:
    patch = Patch()
    patch.mute = tuple(range(6))
    patch.read(2 * SECOND)
    assert re.search("no node has a valid, certain reading", patch.refusal(True))


PRESSED = np.array([0.0, 40e3, 0.0, 0.0, 20e3, 0.0])


def unheard_release() -> Patch:
    """Nodes 2 and 5 were pressed; their release, which the skin reads from now on, was lost."""
    patch = Patch(drift_pa_per_min=0.0)
    patch.read(2 * SECOND)
    patch.taxels.tare(1000.0)
    patch.read(SECOND, PRESSED)
    patch.taxels.miss(False, np.zeros(6, bool))
    patch._sent[[1, 4]] = ADC.code(CURVE.voltage(0.0))
    patch.mute = (1, 4)  # until their heartbeat
    return patch


def test_what_was_not_heard_since_a_loss_is_tared_only_by_force_of_all() -> None:
    patch = unheard_release()
    readings = patch.read(SECOND, 0.0)
    assert readings.pressure_pa[1] > 39e3, "what was before the loss is held"
    assert patch.taxels.tare(1000.0, force=True) == [2, 5]
    patch.mute = ()
    readings = patch.read(SECOND, PRESSED)
    assert np.allclose(readings.pressure_pa, PRESSED, rtol=0.01, atol=110), "taken for rest"
    patch = unheard_release()
    patch.read(SECOND, 0.0)
    assert patch.taxels.tare(1000.0, force="all") == []
    patch.mute = ()
    assert np.allclose(patch.read(SECOND, PRESSED).pressure_pa, 0, atol=110)


def test_a_value_of_before_a_loss_is_no_rest_either_where_the_node_has_just_spoken() -> None:
    """Of most of the last second, and so the median of it."""
    patch = unheard_release()
    patch.read(SECOND // 2, 0.0)
    patch.mute = ()
    patch.read(SECOND // 8, [0, 300.0, 0, 0, 300.0, 0])
    assert patch.taxels.tare(1000.0, force=True) == [2, 5]
    patch.read(SECOND, 0.0)
    assert patch.taxels.tare(1000.0, force=True) == []
    assert np.array_equal(patch.read(1, 0.0).pressure_pa, np.zeros(6))


def test_a_load_that_outlasts_a_loss_is_tared_once_its_nodes_have_spoken_again() -> None:
    """Without waiting for a second that is free of losses."""
    patch = Patch(drift_pa_per_min=0.0)
    patch.read(SECOND, PRESSED)
    patch.taxels.miss(False, np.zeros(6, bool))
    assert patch.taxels.tare(1000.0, force=True) == [2, 5]
    patch._sent[[1, 4]] = 0  # they say it once more
    patch.read(2, PRESSED)
    assert patch.taxels.tare(1000.0, force=True) == []
    assert np.array_equal(patch.read(2, PRESSED).pressure_pa, np.zeros(6))


def test_where_force_is_not_needed_a_loss_changes_nothing(patch: Patch) -> None:
    patch.read(SECOND, PRELOAD_PA)
    patch.taxels.miss(False, np.zeros(6, bool))
    assert patch.taxels.tare(1000.0, force=True) == []


def test_a_voltage_above_the_curve_is_tared_too() -> None:
    """The sensor rests 8 counts above its curve: without a tare it would swallow 0.8 kPa."""
    patch = Patch(v0_v=3.2, drift_pa_per_min=0.0)
    curve = PressureCurve.two_stage(v0_v=3.2)
    rest = ADC.code(3.2 + 8 * ADC.lsb_v)
    voltage_v = np.full(6, ADC.voltage(rest), np.float32)
    voltages = Voltages(patch.taxels.chain, 6)
    for look in range(LOOKS):
        voltages.read(voltage_v, True, 0.125 * look)
    patch.taxels.tare(1000.0)
    lighter_v = (voltage_v - 0.033e-3 * 500).astype(np.float32)
    assert curve.pressure(lighter_v[0]) == 0
    assert np.allclose(voltages.read(lighter_v, True, 1.1).pressure_pa, 500, atol=1)


def test_the_highest_code_is_no_pressure_where_rest_lies_above_it() -> None:
    """3.3 V of 3.3 V reads as code 1023 at most: "so much or more"; the next codes are as ever."""
    patch = Patch(SLOW_S)
    readings = patch.read(round(38 / SLOW_S))
    assert np.array_equal(readings.pressure_pa, np.zeros(6))
    assert np.allclose(readings.voltage_v, 1023 * ADC.lsb_v)
    assert (patch.taxels.baseline.drift_v == 0).all()
    light = patch.read(round(1 / SLOW_S), [200.0, 300.0, 400.0, 1e3, 5e3, 80e3]).pressure_pa
    codes = ADC.code(CURVE.voltage([200.0, 300.0, 400.0, 1e3, 5e3, 80e3]))
    assert np.allclose(light, CURVE.pressure(ADC.voltage(codes)), rtol=1e-5, atol=0.05)
    hours_later = patch.read(round(300 / SLOW_S), [200.0, 300.0, 400.0, 1e3, 5e3, 80e3])
    assert np.array_equal(hours_later.pressure_pa, light)


@pytest.mark.slow
def test_drift_below_the_top_is_given_back_at_the_top() -> None:
    """The rest fell by three counts, was tared there, and has come back."""
    patch = Patch(SLOW_S, v0_v=1023 * ADC.lsb_v)
    above_v = 3.3 - 1023 * ADC.lsb_v
    for part in range(4):
        patch.read(round(200 / SLOW_S), 0.0, -part * ADC.lsb_v - above_v)
    assert (patch.taxels.baseline.drift_v > 2.9 * ADC.lsb_v).all()
    for part in range(2, -2, -1):
        patch.read(round(200 / SLOW_S), 0.0, -part * ADC.lsb_v - above_v)
    assert np.abs(patch.read(1).pressure_pa).max() < 2
    assert (patch.taxels.baseline.drift_v < 0.05 * ADC.lsb_v).all()


def test_drift_of_a_node_that_rests_above_the_top_is_followed_once_it_is_tared() -> None:
    """Code 1022 may be drift, or 0.2 kPa: that is not for the driver to say."""
    patch = Patch(SLOW_S)
    patch.read(round(1.5 / SLOW_S))
    seen = patch.read(round(300 / SLOW_S), 0.0, -2 * ADC.lsb_v).pressure_pa
    assert np.allclose(seen, 195.3, atol=0.1)
    patch.taxels.tare(1000.0)
    after = patch.read(round(300 / SLOW_S), 0.0, -3 * ADC.lsb_v).pressure_pa
    assert np.abs(after).max() < 2


def test_tare_and_drift_are_voltages_that_other_curves_read_anew(patch: Patch) -> None:
    patch.read(SECOND, 500.0)
    patch.taxels.tare(1000.0)
    drift_v = np.full(6, 1e-4, np.float32)
    baseline = patch.taxels.baseline
    patch.taxels.restore(baseline.rest_v, drift_v)
    before = patch.read(1, 700.0).pressure_pa
    patch.taxels.calibrate(Calibration.default(CURVE, 6))
    assert np.array_equal(patch.read(1, 700.0).pressure_pa, before)
    patch.taxels.calibrate(Calibration.default(PressureCurve.two_stage(stage1_v_per_pa=40e-6), 6))
    assert np.array_equal(patch.taxels.baseline.drift_v, drift_v)
    assert np.allclose(patch.read(1, 5e3).pressure_pa, (5e3 - 500) * 33 / 40, atol=90)


def test_a_tare_is_of_what_was_seen_with_the_curves_in_force(patch: Patch) -> None:
    patch.read(SECOND, 5e3)
    curve = PressureCurve.two_stage(stage1_v_per_pa=0.04e-3)
    patch.taxels.calibrate(Calibration.default(curve, 6))
    patch.read(SECOND // 2, 5e3)
    assert re.search("less than 1 s", patch.refusal(True))
    patch.read(SECOND // 2, 5e3)
    patch.taxels.tare(1000.0, force=True)
    assert np.array_equal(patch.read(1, 5e3).pressure_pa, np.zeros(6))


def test_nodes_out_of_service_are_not_named() -> None:
    """Their readings are not awaited; that of node 6, which is, is."""
    patch = Patch(layout={"masked": (2, 3)})
    patch.mute = (2, 5)
    patch.read(3 * SECOND)
    assert patch.taxels.tare(1000.0) == [6]


def test_tares_follow_nodes_not_places() -> None:
    numbers = np.arange(6, 0, -1, dtype=np.int32)
    patch = Patch(layout={"nodes": numbers}, drift_pa_per_min=0.0)
    patch.read(SECOND, PRELOAD_PA)
    patch.taxels.tare(1000.0)
    assert patch.taxels.baseline.tare_pa[3] == pytest.approx(900, abs=60)
    assert np.array_equal(patch.read(1, PRELOAD_PA).pressure_pa, np.zeros(6))
    patch.read(SECOND, 5e3 * (np.arange(6) == 0))
    assert re.search(r"node 1 \(row 1, column 2\)", patch.refusal())


def says(patch: Patch, readings: Readings) -> tuple[bool, bool, str]:
    """Whether the patch claims to be touched, and untouched; and what its diagnostics find."""
    thresholds = patch.pipeline.config.contact
    contacts = ContactTracker(patch.pipeline.config.layout, thresholds).update(readings, 0.0)
    assert np.isfinite(contacts.total_force_n).all() == (len(contacts) > 0 or contacts.untouched)
    found = checkup.off_rest(patch.pipeline, readings)
    return len(contacts) > 0, contacts.untouched, "; ".join(finding.text for finding in found)


BELOW_TOP_V = -0.3
"""Sensors that rest at 3 V, where the converter sees them rise."""
TORN = np.array([0, 0, 0, 92, 0, 0]) * ADC.lsb_v + BELOW_TOP_V


@pytest.mark.parametrize(
    ("tared_pa", "pressed_pa", "offset_v", "found"),
    [
        (0.0, 0.0, BELOW_TOP_V, ""),
        (0.0, [0, 0, 0, 0, 5e3, 0], BELOW_TOP_V, ""),
        (20e3, 20e3, BELOW_TOP_V, ""),
        ([0, 200e3, 0, 0, 0, 0], [0, 400e3, 0, 0, 0, 0], BELOW_TOP_V, "end of .* node 2;"),
        (200e3, 200e3, BELOW_TOP_V, "end of "),
        (30e3, 25e3, BELOW_TOP_V, "up to 5.* kPa below zero: nodes 1, 2"),
        ([0, 0, 0, 30e3, 0, 0], 0.0, TORN, "above the voltage at rest.* node 4;"),
        (0.0, 0.0, TORN, "above the voltage at rest.* node 4;"),
    ],
    ids=["rest", "touched", "preload", "end", "at its end", "under load", "torn, tared", "torn"],
)  # fmt: skip
def test_a_zero_is_claimed_only_where_it_is_one(
    tared_pa: object, pressed_pa: object, offset_v: float | np.ndarray, found: str
) -> None:
    patch = Patch(v0_v=3.0, drift_pa_per_min=0.0)
    patch.read(SECOND, tared_pa, BELOW_TOP_V)
    patch.taxels.tare(1000.0, force=True)
    readings = patch.read(SECOND, pressed_pa, offset_v)
    touched, untouched, findings = says(patch, readings)
    assert touched == (np.max(pressed_pa) == 5e3)
    assert untouched == (not found and not touched)
    assert re.search(found, findings) if found else not findings
    torn = np.broadcast_to(offset_v, 6) > BELOW_TOP_V
    assert np.array_equal(np.isnan(readings.pressure_pa), torn)
    assert np.array_equal(readings.status & Status.FAULTY != 0, torn)


def test_a_highest_code_that_hides_a_contact_is_no_zero() -> None:
    """Curves that begin 0.2 V above what the converter reads: up to 6 kPa are 0 Pa to it."""
    patch = Patch(v0_v=3.5)
    readings = patch.read(SECOND, 5e3, 0.2)
    assert not readings.pressure_pa.any() and (readings.status & Status.SATURATED).all()
    assert says(patch, readings)[:2] == (False, False)
    assert says(patch, patch.read(SECOND, 10e3, 0.2))[:2] == (True, False)


def test_a_torn_sensor_is_not_tared_unless_forced() -> None:
    """As is one whose rest the parameters do not have; then it is for a person to say."""
    patch = Patch(v0_v=3.0)
    patch.read(SECOND, 0.0, TORN)
    cause = r"before where their curves begin: node 4 .* 29\d\.\d\d mV;"
    assert re.search(cause, patch.refusal())
    patch.taxels.tare(1000.0, force=True)
    readings = patch.read(SECOND, 0.0, TORN)
    assert says(patch, readings) == (False, True, "")
    light = patch.read(SECOND, [0, 0, 0, 2e3, 0, 0], TORN).pressure_pa
    assert light[3] == pytest.approx(2e3, abs=110)
