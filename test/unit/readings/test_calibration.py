# SPDX-License-Identifier: Apache-2.0

"""Code → voltage → pressure, and files of curves: what is written is read, else line and cause."""

import cProfile
import pstats
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_cdma.base.errors import CalibrationError, SpecError, TactileError
from tactile_cdma.config.parameters import DEFAULTS
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.readings.calibration import AdcScale, Calibration, Curves, PressureCurve
from tactile_cdma.readings.calibration_file import read_calibration, seal_calibration
from test.support.calibrations import write_calibration
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
    with pytest.raises(SpecError):
        PressureCurve((0.0, 0.0), (1.0, 0.5))


@pytest.mark.parametrize("rises", [True, False])
@given(st.floats(5e3, 500e3), st.floats(0.5, 1.5))
def test_pieces_of_a_power_law_are_as_by_ohm(rises: bool, half_pa: float, exponent: float) -> None:
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
def test_a_skins_curves_are_those_of_its_sensors(curves: list[PressureCurve], share: float) -> None:
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


DEFAULT = PressureCurve.two_stage()
ADC = AdcScale()
NODES = 4
CURVES = {
    1: PressureCurve((0.0, 50e3, 140e3), (3.2, 1.6, 1.0)),
    2: PressureCurve((0.0, 48e3, 140e3), (3.25, 1.7, 1.1)),
    4: PressureCurve((0.0, 40e3, 90e3, 140e3), (3.1, 1.7, 1.3, 1.2)),
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A file of four nodes, the third one uncalibrated."""
    path = tmp_path / "skin.yaml"
    write_calibration(path, Calibration.of_nodes(CURVES, DEFAULT, NODES), ADC, "palm", "loads.csv")
    return path


def read(path: Path, **changes: object) -> Calibration:
    arguments = {"nodes": NODES, "adc": ADC, "default": DEFAULT, "skin": "palm"} | changes
    return read_calibration(path, **arguments)


def refusal(path: Path, **changes: object) -> str:
    with pytest.raises(CalibrationError) as caught:
        read(path, **changes)
    assert str(caught.value).startswith((f"{path}: ", f"{path}, line "))
    return str(caught.value)


def edit(path: Path, old: str, new: str) -> int:
    """Replace a text that occurs exactly once; returns its line."""
    text = path.read_text()
    assert text.count(old) == 1, text
    path.write_text(text.replace(old, new))
    return text[: text.index(old)].count("\n") + 1


def test_what_is_written_is_read_integers_too(path: Path) -> None:
    calibration = read(path)
    for node in range(1, NODES + 1):
        curve = calibration.curves[node - 1]
        assert curve == CURVES.get(node, DEFAULT)
    assert calibration.uncalibrated.tolist() == [False, False, True, False]
    assert len(calibration.identity) == 12
    curve = PressureCurve((0, 100_000), (3, 1))
    write_calibration(path, Calibration.of_nodes({1: curve}, DEFAULT, 1), ADC)
    assert read(path, nodes=1, skin="").curves[0] == curve


def test_dynamics_of_earlier_versions_are_refused_with_what_to_do(path: Path) -> None:
    line = edit(path, "uncalibrated: [3]", "uncalibrated: [3]\ndynamics: {rise_s: 0.085}") + 1
    assert f"{path}, line {line}: dynamics are no longer compensated" in refusal(path)


@st.composite
def curves(draw: st.DrawFn) -> PressureCurve:
    corners = draw(st.integers(2, 6))
    steps_pa = draw(st.lists(st.floats(0.01, 8e4), min_size=corners - 1, max_size=corners - 1))
    falls = draw(st.lists(st.floats(0.01, 1.0), min_size=corners, max_size=corners))
    fall_v = 3.3 * np.cumsum(falls[::-1])[::-1] / sum(falls)
    volts = fall_v if draw(st.booleans()) else 3.3 - fall_v
    return PressureCurve((0.0, *np.cumsum(steps_pa)), tuple(volts))


@given(st.lists(curves(), min_size=1, max_size=5), st.data())
def test_any_calibration_survives_writing_and_reading_twice(
    tmp_path_factory: pytest.TempPathFactory, drawn: list[PressureCurve], data: st.DataObject
) -> None:
    own = data.draw(st.sets(st.integers(1, len(drawn))))
    known = {node: drawn[node - 1] for node in own}
    calibration = Calibration.of_nodes(known, DEFAULT, len(drawn))
    path = tmp_path_factory.mktemp("curves") / "skin.yaml"
    identity = write_calibration(path, calibration, ADC)
    once = read(path, nodes=len(drawn), skin="")
    for node in range(1, len(drawn) + 1):
        wanted, found = known.get(node, DEFAULT), once.curves[node - 1]
        assert found.pressure_pa == pytest.approx(wanted.pressure_pa, abs=1e-3)
        assert found.voltage_v == pytest.approx(wanted.voltage_v, abs=1e-6)
    assert once.identity == identity
    assert write_calibration(path, once, ADC) == identity
    assert np.array_equal(once.uncalibrated, calibration.uncalibrated)


def test_the_identity_depends_on_what_determines_readings_only(path: Path) -> None:
    identity = read(path).identity
    whole = Calibration.of_nodes(CURVES, DEFAULT, NODES)
    assert write_calibration(path, whole, ADC, "palm", "other source") == identity
    moved = CURVES | {1: PressureCurve((0.0, 50e3, 140e3), (3.2, 1.6, 1.00001))}
    others = [
        write_calibration(path, Calibration.of_nodes(moved, DEFAULT, NODES), ADC, "palm"),
        write_calibration(path, whole, ADC, "thumb"),
        write_calibration(path, whole, replace(ADC, vref_v=3.31), "palm"),
        write_calibration(path, Calibration.of_nodes(CURVES, DEFAULT, NODES + 1), ADC, "palm"),
    ]
    assert len({identity, *others}) == 5


def test_the_skin_configuration_reads_it(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(path.parent)
    values = {"nodes": NODES, "skin": "palm", "calibration_file": path.name}
    config = SkinConfig.of(values)
    assert config.calibration.identity == read(path).identity
    monkeypatch.setenv("HOME", str(path.parent))
    home = SkinConfig.of(values | {"calibration_file": f"~/{path.name}"})
    assert home.calibration.identity == config.calibration.identity
    with pytest.raises(TactileError, match=rf"{path.parent}/none\.yaml: No such file"):
        SkinConfig.of(values | {"calibration_file": "none.yaml"})


def test_loads_in_a_wrong_unit_are_refused_unless_the_range_says_otherwise(path: Path) -> None:
    beyond = PressureCurve((0.0, 430e3), (3.2, 1.0))
    write_calibration(path, Calibration.of_nodes(CURVES | {2: beyond}, DEFAULT, NODES), ADC, "palm")
    assert "node 2: loads up to 430 kPa are 3.07 times range_kpa (140)" in refusal(path)
    values = {"nodes": NODES, "skin": "palm", "calibration_file": str(path)}
    with pytest.raises(CalibrationError, match=r"3\.07 times range_kpa"):
        SkinConfig.of(values)
    config = SkinConfig.of(values | {"range_kpa": 150.0})
    with pytest.raises(CalibrationError, match=r"3\.07 times range_kpa"):  # of a running driver
        config.recalibrated({**DEFAULTS, **values})


def test_a_file_for_another_skin_is_refused(path: Path) -> None:
    assert "made for skin palm, this skin has skin thumb" in refusal(path, skin="thumb")
    assert read(path, skin="").identity  # a skin without a name takes any
    assert "made for nodes 4, this skin has nodes 16" in refusal(path, nodes=16)
    assert "made for bits 10, this skin has bits 12" in refusal(path, adc=AdcScale(12))
    assert "made for vref_v 3.3, this skin has vref_v 5.0" in refusal(path, adc=AdcScale(10, 5.0))


@pytest.mark.parametrize(
    ("old", "new", "cause"),
    [
        ("tactile_cdma/calibration", "other/file", "schema is 'other/file'; it must be 'tac"),
        ("version: 1", "version: 2", "version is 2; this program reads version 1: update"),
        ("version: 1", "version: 0", "version is 0; this program reads version 1: write"),
        ("pressure: Pa", "pressure: kPa", "the unit of pressure is kPa; it must be Pa"),
        ("voltage: V}", "volt: V}", "unknown key 'volt' in units; did you mean 'voltage'"),
        ("bits: 10", "bits: 17", "bits is 17; it must lie within 8…16"),
        ("bits: 10", "bits: 010", "bits is '010'; it must be a whole number"),
        ("bits: 10", "bitz: 10", "unknown key 'bitz' in the file; did you mean 'bits'"),
        ("skin: palm", "skin:", "skin is empty; it must be text"),
        ("skin: palm", "skin: [palm]", "skin is a list; it must be text"),
        ("vref_v: 3.3", "vref_v: .nan", r"vref_v is \.nan; it must be finite"),
        ("vref_v: 3.3", "vref_v: -1", r"vref_v is -1; it must lie within 0\.1…100 V"),
        ("3.25", "1.65", "node 2, corner 3: 1.1 V after 1.7 V"),
        ("1.7, 1.1]", "3.25, 1.1]", "node 2, corner 2: 3.25 V after 3.25 V"),
        ("48000.0", "148000.0", "node 2, corner 3: 140000 Pa after 148000 Pa"),
        ("48000.0", "inf", "node 2, corner 2: pressure is inf; it must be finite"),
        ("48000.0", "'many'", "node 2, corner 2: pressure is 'many'; it must be a number"),
        ("[0.0, 48000.0", "[5.0, 48000.0", "node 2 begins at 5 Pa, not at 0"),
        ("[0.0, 48000.0, 140000.0]", "[0.0, 48000.0]", "node 2: 2 pressures and 3 voltages"),
        ("[0.0, 48000.0, 140000.0]", "high", "node 2: pressure is 'high'; it must be a list"),
        (", 1.1]", ", -0.1]", r"corner 3: voltage is -0\.1; it must lie within 0…3\.3 V"),
        ("3.25", "4.25", r"corner 1: voltage is 4\.25; it must lie within -0\.825…4\.125 V"),
        ("pressure: [0.0, 48000.0", "pressur: [0.0, 48000.0", "did you mean 'pressure'"),
        ("  2: {", "  1: {", "'1' again; it stands in line 1[0-9] already"),
        ("  2: {", "  02: {", "a node's number is '02'; it must be a whole number"),
        ("  2: {", "  5: {", "a node's number is 5; it must lie within 1…4"),
        ("uncalibrated: [3]", "uncalibrated: []", "no curve for node 3; calibrate"),
        ("uncalibrated: [3]", "uncalibrated: [03]", "a node's number is '03'; it must be"),
        ("uncalibrated: [3]", "uncalibrated: [3, 3]", "node 3 is listed twice"),
        ("uncalibrated: [3]", "uncalibrated: [2, 3]", "node 2 is uncalibrated, but has a curve"),
        ("3.25", "3.24", "damaged, or edited; .* --seal"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(path: Path, old: str, new: str, cause: str) -> None:
    line = edit(path, old, new)
    with pytest.raises(CalibrationError, match=cause):
        read(path)
    # If something is missing, or contradicts the identity, another line is named.
    if cause not in ("no curve for node 3; calibrate", "damaged, or edited; .* --seal"):
        assert f"{path}, line {line}: " in refusal(path)


def test_other_files_are_refused(path: Path) -> None:
    text = path.read_text()
    for content, cause in (
        ("", "empty"),
        ("just words", "it must be keys with values"),
        ("a: 1", "the file has no 'schema'"),
        (text[: text.index("curves")], "the file has no 'curves'"),
    ):
        path.write_text(content)
        assert cause in refusal(path)
    path.unlink()
    assert "No such file" in refusal(path)


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(0, 10_000), st.binary(max_size=6)), min_size=1, max_size=4))
def test_a_damaged_file_is_refused_and_nothing_else(
    tmp_path_factory: pytest.TempPathFactory, damage: list[tuple[int, bytes]]
) -> None:
    path = tmp_path_factory.mktemp("damage") / "skin.yaml"
    write_calibration(path, Calibration.of_nodes(CURVES, DEFAULT, NODES), ADC, "palm")
    before, content = read(path), bytearray(path.read_bytes())
    for place, new in damage:
        place %= len(content)
        content[place : place + 3] = new
    path.write_bytes(content)
    try:
        after = read(path)
    except CalibrationError as error:
        assert str(error).startswith((f"{path}: ", f"{path}, line "))
    else:  # what was hit does not matter
        assert after.identity == before.identity
        assert np.array_equal(after.curves.voltage_v, before.curves.voltage_v)


def test_an_edited_file_can_be_sealed_anew(path: Path) -> None:
    before = read(path).identity
    edit(path, "curves:", "curves:  # node 2 was corrected by hand")
    edit(path, "3.25", "3.24")
    identity = seal_calibration(path)
    calibration = read(path)
    assert calibration.identity == identity != before
    assert calibration.curves[1].voltage_v[0] == 3.24
    assert "corrected by hand" in path.read_text()
    text = path.read_text()
    for written in ("'x y'  # by hand", '"x"', "x y", "x # by hand"):
        path.write_text(text.replace(f"identity: '{identity}'", f"identity: {written}"))
        assert seal_calibration(path) == read(path).identity == identity
    path.write_text(text.replace("identity: ", "identity:\n  "))
    with pytest.raises(CalibrationError, match="no line begins with 'identity: …'"):
        seal_calibration(path)
    path.write_text(text)
    edit(path, "3.24", "1.24")
    with pytest.raises(CalibrationError, match="node 2, corner 3"):
        seal_calibration(path)


def test_files_are_plain_yaml_and_one_that_cannot_be_written_is_named(path: Path) -> None:
    with pytest.raises(CalibrationError, match="cannot be written"):
        write_calibration(path / "in a file", Calibration.default(DEFAULT, NODES), ADC)
    content = yaml.safe_load(path.read_text())
    assert content["curves"][2] == {
        "pressure": [0.0, 48000.0, 140000.0],
        "voltage": [3.25, 1.7, 1.1],
    }
    assert content["made"]["from"] == "loads.csv"


def test_a_large_skin_takes_as_many_calls_per_node_as_a_small_one(tmp_path: Path) -> None:
    def calls(nodes: int) -> int:
        path, profile = tmp_path / f"{nodes}.yaml", cProfile.Profile()
        write_calibration(path, Calibration.default(DEFAULT, nodes), ADC)
        assert len(profile.runcall(read, path, nodes=nodes, skin="").curves) == nodes
        return int(pstats.Stats(profile).total_calls)  # type: ignore[attr-defined]

    few, many = calls(256), calls(1024)
    assert few < many < 5 * few
