# SPDX-License-Identifier: Apache-2.0

"""Calibration files: written content is read back; anything else is refused with line and cause."""

import cProfile
import os
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
from tactile_cdma.readings.calibration import AdcScale, Calibration, PressureCurve
from tactile_cdma.readings.calibration_file import read_calibration, seal_calibration
from test.support.calibrations import write_calibration

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


def test_what_is_written_is_read(path: Path) -> None:
    calibration = read(path)
    for node in range(1, NODES + 1):
        curve = calibration.curves[node - 1]
        assert curve == CURVES.get(node, DEFAULT)
    assert calibration.uncalibrated.tolist() == [False, False, True, False]
    assert len(calibration.identity) == 12


def test_integers_are_accepted_as_numbers(path: Path) -> None:
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


def test_loads_in_a_wrong_unit_are_refused_until_the_sensors_range_says_otherwise(
    path: Path,
) -> None:
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
        (
            "tactile_cdma/calibration",
            "other/file",
            "schema is 'other/file'; it must be 'tactile_cdma/calibration'",
        ),
        (
            "version: 1",
            "version: 2",
            "version is 2; this program reads version 1: update this program",
        ),
        (
            "version: 1",
            "version: 0",
            "version is 0; this program reads version 1: write the file again",
        ),
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


def test_writing_is_all_or_nothing(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = path.read_bytes()

    def fail(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(CalibrationError, match="cannot be written: No space left"):
        write_calibration(path, Calibration.default(DEFAULT, NODES), ADC)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]
    with pytest.raises(CalibrationError, match="cannot be written"):
        write_calibration(path / "in a file", Calibration.default(DEFAULT, NODES), ADC)


def test_it_is_plain_yaml(path: Path) -> None:
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


def test_a_single_curve_of_a_skin_is_returned_without_padding() -> None:
    all_curves = Calibration.of_nodes(CURVES, DEFAULT, NODES).curves
    assert all_curves[3] == CURVES[4]
    assert all_curves[0] == CURVES[1]  # without the repeated corner
    with pytest.raises(SpecError):
        PressureCurve((0.0, 0.0), (1.0, 0.5))
