# SPDX-License-Identifier: Apache-2.0

"""Code → voltage → pressure."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import SpecError
from tactile_cdma.readings.calibration import AdcScale, Curves, PressureCurve
from test.support.examples import examples

CURVE = PressureCurve.two_stage()


PAPER = [(0b0101101110, 1.18), (0b1000110000, 1.80), (0b1010011001, 2.14)]


@pytest.mark.parametrize(("code", "volts"), PAPER)
def test_the_papers_words_are_the_papers_voltages(code: int, volts: float) -> None:
    assert round(float(AdcScale(10, 3.3).voltage(code)), 2) == volts


@given(st.integers(8, 16), st.floats(0.5, 5.0), st.data())
def test_adc_inverts_within_one_count(bits: int, vref_v: float, data: st.DataObject) -> None:
    scale = AdcScale(bits, vref_v)
    voltage = data.draw(st.floats(0, vref_v * (1 - 2.0**-bits)))
    error_v = voltage - scale.voltage(scale.code(voltage))
    assert abs(error_v) <= (0.5 if voltage < vref_v - 1.5 * scale.lsb_v else 1) * scale.lsb_v * (
        1 + 1e-9
    )
    assert scale.code(vref_v * 2) == 2**bits - 1
    assert scale.code(-1.0) == 0


def test_the_papers_two_stages() -> None:
    assert CURVE.voltage(0) == pytest.approx(3.3)
    assert CURVE.voltage(50e3) == pytest.approx(3.3 - 50 * 0.033)
    assert CURVE.voltage(140e3) == pytest.approx(3.3 - 50 * 0.033 - 90 * 0.0059)
    slopes = np.diff(CURVE.voltage([10e3, 20e3, 60e3, 70e3])) / 10
    assert slopes[[0, 2]] == pytest.approx([-0.033, -0.0059])


@given(st.floats(0, 140e3))
def test_pressure_inverts_voltage(pressure_pa: float) -> None:
    assert CURVE.pressure(CURVE.voltage(pressure_pa)) == pytest.approx(pressure_pa, abs=1e-3)


def test_quantisation_alone_has_the_derived_error() -> None:
    """LSB/√12 in each stage: 0.028 and 0.158 kPa rms (design section 4)."""
    scale = AdcScale()
    for low, high, expected_kpa in ((1e3, 49e3, 0.028), (51e3, 139e3, 0.158)):
        pressure = np.linspace(low, high, 20_001)
        read = CURVE.pressure(scale.voltage(scale.code(CURVE.voltage(pressure))))
        rms = np.sqrt(np.mean((read - pressure) ** 2)) / 1e3
        assert rms == pytest.approx(expected_kpa, rel=0.05)


def test_outside_the_range_is_clamped() -> None:
    volts = np.array([CURVE.voltage_v[-1] - 0.01, CURVE.voltage_v[-1], 3.4], dtype=np.float32)
    for pressure_pa in (CURVE.pressure(volts), Curves.of([CURVE] * 3).pressure(volts)):
        assert pressure_pa.tolist() == pytest.approx([140e3, 140e3, 0], abs=0.1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"knee_pa": 150e3}, "knee at 150 kPa must lie between 0 and the range's end at 140 kPa"),
        ({"stage1_v_per_pa": -0.033e-3}, r"negative .it rises., got -0\.033 and 0\.0059 V/kPa"),
        ({"v0_v": 2.0}, "reaches -0.181 V at 140 kPa; a node measures 0…3.3 V"),
        (
            {"v0_v": 1.2, "stage1_v_per_pa": -0.033e-3, "stage2_v_per_pa": -0.0059e-3},
            "reaches 3.381 V at 140 kPa; a node measures 0…3.3 V",
        ),
    ],
)
def test_impossible_curves_are_refused(changes: dict, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        PressureCurve.two_stage(**changes)


def test_a_curve_must_fall_or_rise() -> None:
    for volts in ((1.0, 1.0), (1.0, 2.0, 1.5), (2.0, 1.0, 1.5)):
        with pytest.raises(SpecError, match="fall, or rise, strictly"):
            PressureCurve(tuple(1e3 * corner for corner in range(len(volts))), volts)
    with pytest.raises(SpecError, match="two or more corners"):
        PressureCurve((0.0,), (1.0,))


@pytest.mark.parametrize("rises", [True, False])
@given(st.floats(5e3, 500e3), st.floats(0.5, 1.5))
def test_a_power_law_in_pieces_is_that_of_its_divider(
    rises: bool, half_pa: float, exponent: float
) -> None:
    """Truth: Ohm's law. R ∝ P^−a beside a fixed resistor, equal to it at half_pa."""
    curve = PressureCurve.power_law(half_pa, exponent, 140e3, 5.0, rises)
    pressure_pa = np.linspace(0.0, 140e3, 500)[1:]
    ohm, fixed_ohm = 1e4 * (half_pa / pressure_pa) ** exponent, 1e4
    volts = 5.0 * (fixed_ohm if rises else ohm) / (ohm + fixed_ohm)
    if volts.max() < 4.5 and volts.min() > 0.5 * (not rises):
        np.testing.assert_allclose(curve.pressure(volts), pressure_pa, atol=0.003 * 140e3)
    assert curve.rises == rises and curve.voltage_v[0] == (0.0 if rises else 5.0)


@st.composite
def any_curve(draw: st.DrawFn) -> PressureCurve:
    pieces = draw(st.integers(1, 64))
    widths_pa = draw(st.lists(st.floats(10.0, 5e3), min_size=pieces, max_size=pieces))
    falls_v = draw(st.lists(st.floats(1e-4, 0.05), min_size=pieces, max_size=pieces))
    pressure_pa = np.append(0.0, np.cumsum(widths_pa))
    return PressureCurve(tuple(pressure_pa), tuple(3.3 - np.append(0.0, np.cumsum(falls_v))))


@examples(40)
@given(st.lists(any_curve(), min_size=1, max_size=5), st.floats(0.0, 1.0))
def test_the_curves_of_a_skin_are_those_of_its_sensors(
    curves: list[PressureCurve], share: float
) -> None:
    """For any number of pieces, at corners and between them, up to the rounding of float32."""
    skin = Curves.of(curves)
    assert [skin[i] for i in range(len(curves))] == curves
    steepest = max(np.max(np.diff(c.pressure_pa) / -np.diff(c.voltage_v)) for c in curves)
    range_pa = skin.range_pa
    np.testing.assert_allclose(
        skin.voltage(share * range_pa),
        [c.voltage(share * c.pressure_pa[-1]) for c in curves],
        atol=1e-12,
    )
    for voltage_v in (*skin.voltage_v, skin.voltage(share * range_pa)):
        rounded_v = voltage_v.astype(np.float32)
        expected = [float(c.pressure(v)) for c, v in zip(curves, rounded_v, strict=True)]
        np.testing.assert_allclose(
            skin.pressure(rounded_v), expected, rtol=1e-5, atol=5e-7 * steepest
        )


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_float32_is_fine_enough_for_every_converter(bits: int) -> None:
    """Rounding errors are below 1 % of the quantisation error, LSB/√12, up to 5 V."""
    scale, curve = AdcScale(bits, 5.0), PressureCurve.two_stage(v0_v=5.0)
    voltage_v = scale.voltage(np.arange(1 << bits))
    exact_pa = curve.pressure(voltage_v)
    read_pa = Curves.of([curve] * (1 << bits)).pressure(voltage_v.astype(np.float32))
    for stage, slope in ((exact_pa < 50e3, 0.033e-3), (exact_pa >= 50e3, 0.0059e-3)):
        error_pa = np.sqrt(np.mean(np.square(read_pa - exact_pa)[stage]))
        assert error_pa < 0.01 * scale.lsb_v / slope / np.sqrt(12)
