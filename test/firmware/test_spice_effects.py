# SPDX-License-Identifier: Apache-2.0

"""Cables, discharges and inexact parts in SPICE, against standards, data sheets and sums."""

import csv
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import cable_spice
from cable_spice import COUPLED_F_M, LOOSE_F_M, PWM_HZ, CableRun, cabled_skin, run_cabled
from circuit import GUARD_OHM, INPUT_OHM
from decoding import packets_of
from design_amplifier import describe
from effects import missed_words
from esd_spice import (
    CLAMP_ZENER_V,
    CONTACTS,
    OP_AMP_A,
    Contact,
    discharge_a,
    needed_ohm,
    netlist,
    strike,
)
from ngspice import transients
from parts_spice import share_outside
from tactile_cdma.doctor.report import Check, Grade
from tactile_cdma.doctor.stream import judge
from tactile_cdma.wire.packets import PacketWriter
from test.support.firmware import needs_ngspice
from tolerance import scatter

PARTS = Path(__file__).resolve().parents[2] / "firmware" / "boards" / "parts.csv"
on_cables = pytest.mark.xdist_group("cables")  # they share runs


@cache
def run(impedance: float = 1.0, coupled_f_m: float = 0.0, shift_hz: float = 0.0) -> CableRun:
    """Two strips, of 8 nodes and of one; with a frequency, the ground of one moves by 20 mV.

    Three wires, or, with a capacitance to it, a sync wire.
    """
    skin = cabled_skin(9, own_sync=coupled_f_m > 0, bits=8, frame_period_ms=6.0)
    skin = replace(skin, impedance=impedance, coupled_f_m=coupled_f_m)
    return run_cabled(replace(skin, shift_v=0.02 if shift_hz else 0.0, shift_hz=shift_hz))


def test_a_discharge_is_the_standards() -> None:
    """IEC 61000-4-2, table of the contact discharge: 30 A, 0.8 ns, 16 A and 8 A at 8 kV."""
    times = np.arange(0.0, 100e-9, 10e-12)
    ampere = discharge_a(times, 8.0)
    peak = ampere[:500].max()
    assert peak == pytest.approx(30.0, rel=0.15)
    tenth, nine_tenths = (np.argmax(ampere > share * peak) for share in (0.1, 0.9))
    assert times[nine_tenths] - times[tenth] == pytest.approx(0.8e-9, rel=0.25)
    for after_s, stated in ((30e-9, 16.0), (60e-9, 8.0)):
        assert np.interp(times[tenth] + after_s, times, ampere) == pytest.approx(stated, rel=0.3)
    assert discharge_a(times, 2.0) == pytest.approx(ampere / 4)


@needs_ngspice
def test_the_clamp_is_the_data_sheets() -> None:
    """SRV05-4, contact to ground: 8.8, 11.5 and 13.2 V at 1, 5 and 8 A; at most 10, 13, 15."""
    text = netlist(Contact("alone", 1e9, 1.0), 8.0)
    kept = [line for line in text.splitlines() if line.startswith((".model", "d", "l"))]
    wanted = [line for line in kept if line.startswith((".model", "dsteer", "dground", "dzener"))]
    wanted = [line.replace("tosupply", "supply").replace("fromground", "0") for line in wanted]
    ramp = ["* clamp", "iramp 0 contact pwl(0 0 8 8)", "rleak supply 0 1meg"]
    end = [".tran 0.01 8", ".save v(contact)", ".end", ""]
    found = transients("\n".join([*ramp, *wanted, *end]))
    for ampere, typical, most in ((1.0, 8.8, 10.0), (5.0, 11.5, 13.0), (8.0, 13.2, 15.0)):
        volts = float(np.interp(ampere, found["time"], found["v(contact)"]))
        assert volts == pytest.approx(typical, rel=0.07) and volts < most
    assert CLAMP_ZENER_V > 6.0  # stands off 6 V


@needs_ngspice
def test_a_resistor_behind_the_clamp_keeps_a_pin_within_its_limits() -> None:
    """Pins that have one; and what those would need that are at a contact themselves."""
    seen = {contact.name: (contact, strike(contact)) for contact in CONTACTS}
    within = {name for name, (contact, struck) in seen.items() if struck.within(contact)}
    assert within == {"sensor-PC0", "line-PB1", "line-opamp"}
    # behind 34 kΩ a pin gets what Ohm's law lets through of the clamp's 15 to 20 V
    assert 0.3e-3 < seen["line-PB1"][1].pin_a < 0.6e-3
    bare, struck = seen["sync-PB0"]
    assert struck.pin_a > 1.0
    ohm = needed_ohm(bare)
    assert strike(replace(bare, series_ohm=ohm)).within(bare)
    assert not strike(replace(bare, series_ohm=ohm / 2)).within(bare)


@needs_ngspice
def test_the_second_clamp_is_the_data_sheets() -> None:
    """BAV99: at most 0.715, 0.855, 1 and 1.25 V at 1, 10, 50 and 150 mA, of either diode."""
    text = netlist(Contact("alone", 1.0, 1.0, guard_ohm=1.0), 8.0)
    kept = [line for line in text.splitlines() if line.startswith((".model second", "dabove"))]
    ramp = ["* diode", "iramp 0 held pwl(0 0 0.15 0.15)", "vchip tochip 0 0", *kept]
    found = transients("\n".join([*ramp, ".tran 1e-4 0.15", ".save v(held)", ".end", ""]))
    for ampere, most in ((1e-3, 0.715), (10e-3, 0.855), (50e-3, 1.0), (0.15, 1.25)):
        volts = float(np.interp(ampere, found["time"], found["v(held)"]))
        assert volts == pytest.approx(most, rel=0.03)


@needs_ngspice
def test_the_op_amp_needs_both_resistors_and_the_second_clamp() -> None:
    """Its input stands 10 mA; a hundredth of an ohm is none."""
    (guarded,) = (contact for contact in CONTACTS if contact.name == "line-opamp")
    assert guarded.limit_a == OP_AMP_A == 10e-3
    assert strike(guarded).pin_a < OP_AMP_A
    assert strike(replace(guarded, guard_ohm=0.01)).pin_a > OP_AMP_A
    assert strike(replace(guarded, series_ohm=0.01)).pin_a > 10 * OP_AMP_A
    in_line = Contact("without a clamp", GUARD_OHM + INPUT_OHM, OP_AMP_A)
    assert strike(in_line).pin_a > 3 * OP_AMP_A


@on_cables
@needs_ngspice
def test_supply_sags_by_its_current_times_its_wires() -> None:
    """By hand: nodes awake and half of their LEDs, through 0.05 Ω, 1 m and 0.15 m of cable."""
    ampere = 9 * (3.5e-3 + 0.5 * 1.4e-3)
    first_ohm, next_ohm = (0.22 * metres + 2 * 0.02 for metres in (1.0, 0.15))
    ohm = 0.05 + first_ohm * 2 + next_ohm * 2 / 9
    still, worse = run(), run(impedance=10.0)
    assert still.sag_v == pytest.approx(ampere * ohm, rel=0.1)
    assert worse.sag_v == pytest.approx(10 * ampere * ohm, rel=0.1)
    assert still.level_off < 0.02 < worse.level_off
    assert missed_words(still, still.times, still.volts) == 0
    assert missed_words(worse, worse.times, worse.volts) == 0


@on_cables
@needs_ngspice
def test_the_sync_edge_reaches_the_line_through_their_capacitance() -> None:
    """Its charge ends in Cf; 390 pF, the filter and Rf leave a third of that at the converter."""
    shielded, loose = run(coupled_f_m=COUPLED_F_M), run(coupled_f_m=LOOSE_F_M)
    charged_v = LOOSE_F_M * 1.15 * 3.3 / loose.cabled.front.nodes_stage.feedback_f
    step_v, over_s = loose.crosstalk()
    assert 0.25 * charged_v < step_v < 0.5 * charged_v
    assert shielded.crosstalk()[0] == pytest.approx(step_v * COUPLED_F_M / LOOSE_F_M, rel=0.1)
    assert 0 < shielded.crosstalk()[1] < over_s < 16e-6  # half of what there is
    assert missed_words(loose, loose.times, loose.volts) == 0


def doctor_says(run: CableRun) -> dict[str, Check]:
    """What `tactile-cdma doctor` says of a run's frame, sent a dozen times."""
    config, front = run.cabled.config, run.cabled.front
    packets = packets_of(config, front, run.times, run.volts, periods=12)
    writer, period_s = PacketWriter(), config.spec.frame_period_s
    chunks = [(writer.encode(p), period_s * number) for number, p in enumerate(packets)]
    return {check.subject: check for check in judge(chunks, config, 1.0)}


@on_cables
@needs_ngspice
def test_the_doctor_finds_what_the_circuit_has() -> None:
    """Nothing where all is as on the boards; crosstalk as high as in SPICE, beside loose wires."""
    sound, loose = doctor_says(run()), doctor_says(run(coupled_f_m=5 * LOOSE_F_M))
    assert {check.verdict for check in sound.values()} == {Grade.OK}
    assert sound["sync"].text == "9 spoke in step with the pulses"
    told = loose["crosstalk"]
    assert told.verdict is Grade.WARNING and "lay a ground wire" in told.text
    [found_mv] = map(float, re.findall(r"by ([\d.]+) mV", told.text))
    step_v, _ = run(coupled_f_m=5 * LOOSE_F_M).crosstalk()
    assert 0.5 * step_v < found_mv * 1e-3 <= step_v  # samples miss the top


@on_cables
@needs_ngspice
@pytest.mark.parametrize(
    ("joints_ohm", "verdict", "why"),
    [
        ((0.0, 0.0), Grade.OK, ""),
        ((5.0, 0.0), Grade.WARNING, "low, or a bad joint of it"),
        ((0.0, 5.0), Grade.WARNING, "a bad joint of ground"),
    ],
)
def test_the_doctor_tells_of_a_bad_joint_of_supply_or_ground(
    joints_ohm: tuple[float, float], verdict: Grade, why: str
) -> None:
    """By hand: current of nodes and LEDs times its ohms moves the middle of pins."""
    said = doctor_says(run_cabled(replace(run().cabled, joints_ohm=joints_ohm)))["supply"]
    [percent] = map(float, re.findall(r"at ([\d.]+)% of", said.text))
    moved_v = 9 * (3.5e-3 + 0.5 * 1.4e-3) * (joints_ohm[1] - joints_ohm[0])
    assert percent / 100 == pytest.approx(1 + moved_v / 3.3, abs=0.01)
    assert said.verdict is verdict and why in said.text


@on_cables
@needs_ngspice
def test_ground_that_shifts_is_tolerated_up_to_a_limit_that_is_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nodes reset before words are wrong; nodes that did not reset would send wrong ones."""
    still, shifted = run(), run(shift_hz=PWM_HZ)
    assert missed_words(shifted, shifted.times, shifted.volts) == 0

    def wrong(times: np.ndarray, volts: np.ndarray) -> int:
        return missed_words(still, times, volts)

    most_v, ends = cable_spice.tolerated_shift_v(still, shifted, wrong)
    assert ends == "supply" and 0.2 < most_v < 3.3 - 2.9
    monkeypatch.setattr(cable_spice, "BROWN_OUT_V", -99.0)
    wrong_v, ends = cable_spice.tolerated_shift_v(still, shifted, wrong)
    assert ends == "words" and wrong_v > most_v


@needs_ngspice
def test_half_of_the_skins_with_parts_of_5_percent_leave_the_range() -> None:
    """SPICE against sums: with 1 % none does."""
    front = cabled_skin(16).front
    computed = scatter(front, 0.05, tolerance=0.05).left
    assert 0.5 < computed < 0.6
    deviation = np.sqrt(computed * (1 - computed) * (1 / 400 + 1 / 1000))
    assert share_outside(front, 0.05, 400) == pytest.approx(computed, abs=4 * deviation)
    assert share_outside(front, 0.01, 400) == 0


def test_one_percent_is_what_the_calculator_and_the_parts_list_ask_for() -> None:
    skin = cabled_skin(16)
    text = describe(skin.config.spec, skin.front)
    assert "all resistors 5%: rest ±65.3 mV rms, 56% leave the range; order 1%" in text
    with PARTS.open(encoding="utf-8") as file:
        resistors = [
            part
            for part in csv.DictReader(file)
            if " Ω, " in part["what"] or "kΩ, " in part["what"]
        ]
    assert len(resistors) > 10
    assert all("1 %" in part["what"] and part["number"].startswith("RC0402F") for part in resistors)
