# SPDX-License-Identifier: Apache-2.0

"""Tables of loads: units are understood, mistakes are named with file and line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_cdma.base.errors import CalibrationError
from tactile_cdma.calibrating.load_points import (
    HEADING,
    LoadPoints,
    directions,
    point_lines,
    read_points,
)
from tactile_cdma.calibrating.load_table import read_table


def read(path: Path, text: str, area_m2: float | None = None) -> LoadPoints:
    path.write_text(text)
    return read_points(path, nodes=16, vref_v=3.3, area_m2=area_m2)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "loads.csv"


@pytest.mark.parametrize(
    ("text", "area_m2"),
    [
        ("node,pressure_kpa,voltage_v\n3,0,3.2\n3,50,1.65\n", None),
        ("# by hand\n\nVoltage_mV, Pressure_Pa, node\n3200,0,3\n1650,5e4,3\n", None),
        ("node;pressure_bar;voltage_v\n3;0;3,2\n3;0,5;1,65\n", None),
        ("node\tpressure_mpa\tvoltage_v\n3\t0\t3,2\n3\t0.05\t1.65\n", None),
        ("node,force_n,voltage_v\n3,0,3.2\n3,2.5,1.65\n", 50e-6),
        ("Sensor,Weight [kg],Vout (mV)\n3,0,3200\n3,0.254929,1650\n", 50e-6),
        ("sensor,force_g,voltage_v\n3,0,3.2\n3,254.929,1.65\n", 50e-6),
        ("taxel;Pressure (psi);Voltage V\n3;0;3,2\n3;7,25189;1,65\n", None),
        ('"node","pressure_kpa", "voltage_v"\n"3","0","3.2"\n3,50,"1.65"\n', None),
        ('"# by hand"\n;;\nnode;pressure_kpa;voltage_v\n3;0;3,2\n3;50;1,65\n', None),
        ("sep=;\nnode;pressure_kpa;voltage_v\n3;0;3,2\n3;50;1,65\n", None),
        ('"sep=|"\nnode|pressure_kpa|voltage_v\n3|0|3,2\n3|50|1,65\n', None),
        ("Sensor;Load;Output\n;[kPa];[mV]\n3;0;3200\n3;50;1650\n", None),
        ("node,pressure,voltage\n-,kPa,V,\n3,0,3.2\n3,50,1.65\n", None),
        ("node,pressure_kpa,voltage_v,,\n3,0,3.2,,\n3,50,1.65,\n", None),
        ("node pressure_kpa  voltage_v\n3 0 3.2\n3 50 1.65 \n", None),
    ],
)
def test_units_and_separators(path: Path, text: str, area_m2: float | None) -> None:
    points = read(path, text, area_m2)
    assert points.node.tolist() == [3, 3]
    assert points.pressure_pa == pytest.approx([0, 50e3])
    assert points.voltage_v == pytest.approx([3.2, 1.65])
    last = len(text.splitlines())
    assert points.line.tolist() == [last - 1, last]


def test_units_that_headings_do_not_name_are_asked_for_and_taken_from_the_option(
    path: Path,
) -> None:
    path.write_text("Load,Output\n0,3200\n250,1650\n")
    with pytest.raises(CalibrationError, match=r"column 'Load' has no unit .* --units"):
        read_points(path, 16, 3.3, 50e-6)
    points = read_points(path, 16, 3.3, 50e-6, ["g", "mV"], node=7)
    assert points.node.tolist() == [7, 7]
    assert points.pressure_pa == pytest.approx([0, 0.25 * 9.80665 / 50e-6])
    assert points.voltage_v == pytest.approx([3.2, 1.65])
    path.write_text("Weight,Voltage_V\n0,3.2\n250,1.65\n")
    with pytest.raises(CalibrationError, match="column 'Weight' has no unit"):
        read_points(path, 16, 3.3, 50e-6, ["kPa"], node=7)  # a weight is no pressure


def test_empty_rows_of_a_spreadsheet_are_none(path: Path) -> None:
    assert read(path, f"{HEADING}\n{GOOD},,\n,,\n").line.tolist() == [2, 3]


def test_the_noise_of_a_reference_without_load_is_none(path: Path) -> None:
    points = read(path, f"{HEADING}\n1,-0.49,3.2\n1,50,1.6\n")
    assert points.pressure_pa.tolist() == [0, 50e3]
    with pytest.raises(CalibrationError, match=r"line 2: pressure_kpa is -0\.51"):
        read(path, f"{HEADING}\n1,-0.51,3.2\n1,50,1.6\n")


def test_what_a_session_writes_is_read(path: Path) -> None:
    volts = np.array([3.2, np.nan, 1.234567])
    points = read(path, HEADING + "\n" + point_lines([1, 2, 3], 12_345.678, volts))
    assert points.node.tolist() == [1, 3]
    assert points.pressure_pa == pytest.approx([12_345.678] * 2)
    assert points.voltage_v.tolist() == [3.2, 1.234567]


GOOD = "1,0,3.2\n1,50,1.6\n"


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("", "the file is empty"),
        (HEADING, "there is a heading, but no numbers"),
        (GOOD, "line 1: 1 where a heading should be; .* as in node,pressure_kpa,voltage_v"),
        (
            f"node,pressure,voltage_v\n{GOOD}",
            "'pressure' has no unit .*; name it as in pressure_pa, .*kpa.*--units",
        ),
        (f"node,presure_kpb,voltage_v\n{GOOD}", "'presure_kpb'; did you mean 'pressure_kpa'"),
        (f"node,pressure_torr,voltage_v\n{GOOD}", "'pressure_torr' has no unit that is known"),
        (f"node,pressure_kpa,pressure_pa\n{GOOD}", "two columns of pressure"),
        ("node,pressure_kpa\n1,0\n", "no column voltage_v$"),
        ("time_s,pressure_kpa\n1,9\n", r"no column node \(with times instead, give --capture\)"),
        (f"{HEADING}\n{GOOD}1,60\n", "line 4: 2 columns, the heading has 3$"),
        (f"{HEADING}\n1,0,3,2\n", "line 2: 4 columns, the heading has 3; with decimal commas, .*"),
        (f"{HEADING},remark\n1,0,3.2,ok\n", "'remark'; known are node, .*; delete what is none"),
        (f"{HEADING}\nnone,5 kPa,V\n{GOOD}", "line 2: 'none' is not a number for node"),
        ("node,pressure,voltage_v\na,b,c\n", "line 1: column 'pressure' has no unit"),
        (f"{HEADING}\n{GOOD}1,60,x\n", "line 4: 'x' is not a number for voltage_v"),
        (f"{HEADING}\n{GOOD}1,nan,1\n", "line 4: 'nan' is not a number for pressure_kpa"),
        (f"{HEADING}\n{GOOD}1,1e308,1\n", "line 4: '1e308' is not a number for pressure_kpa"),
        (f"{HEADING}\n{GOOD}1,{'x' * 10**6},1\n", "line 4: 'x{40}' is not a number"),
        (f"{'x' * 10**6},1\n{GOOD}", "line 1: unknown column 'x{40}'; known are"),
        (f"{HEADING}\n{GOOD}17,60,1.5\n", r"line 4: node 17; the skin has nodes 1…16"),
        (f"{HEADING}\n{GOOD}0,60,1.5\n", "line 4: node 0"),
        (f"{HEADING}\n{GOOD}1.5,60,1.5\n", "line 4: node 1.5"),
        (f"{HEADING}\n{GOOD}1,-60,1.5\n", "line 4: pressure_kpa is -60; .* 0 or more"),
        (f"{HEADING}\n{GOOD}1,60,3.4\n", "line 4: 3.4 V; a node measures 0…3.3 V"),
        (f"{HEADING}\n1,0,3200\n1,50,1600\n", "line 2: 3200 V; .* Name the column voltage_mv"),
        ("node,pressure_kpa,voltage_mv\n1,0,3.2\n1,50,1.6\n", "3.2 mV: are these V"),
        ("node,pressure_kpa,code\n1,0,993\n", "'code'; known are node, "),
        (f"{HEADING}\n1,3.2,0\n1,1.6,50\n", "are the columns swapped"),
        (f"{HEADING}\n1,0,3.2\n", "pressure_kpa is never above 0: a curve needs loads"),
        (f"{HEADING}\n1,0,3.2\n1,0.14,1.1\n", "only 140 Pa: is pressure_kpa the right unit"),
        (
            f"{HEADING}\n1,0,3.2\n1,140000,1.1\n",
            r"as much as 1\.4e\+08 Pa: is pressure_kpa .* In pressure_pa it would be 140 kPa",
        ),
        ("node,pressure_pa,voltage_v\n1,0,3.2\n1,140,1.1\n", "140 Pa: is pressure_pa the right"),
        ("node,force_n,voltage_v\n1,0,3.2\n", "give --area-mm2"),
        ("node,force_n,pressure_pa\n1,0,3.2\n", "both force and pressure"),
    ],
)
def test_mistakes_are_named(path: Path, text: str, cause: str) -> None:
    with pytest.raises(CalibrationError, match=cause) as caught:
        read(path, text)
    assert str(caught.value).startswith(f"{path}: ")


def test_grams_that_are_called_newtons_are_told(path: Path) -> None:
    """430 g on 30.25 mm² are 139 kPa, and not 14 MPa."""
    path.write_text("node,force_n,voltage_v\n1,0,3.2\n1,430,1.1\n")
    with pytest.raises(
        CalibrationError, match=r"is force_n the .* In force_g it would be 139\.4 kPa"
    ):
        read_points(path, 16, 3.3, area_m2=30.25e-6)


@settings(deadline=None)
@given(st.one_of(st.text(), st.text("0123456789.,;-e\n\t naif_"), st.binary()), st.booleans())
def test_any_text_is_a_table_or_refused(
    tmp_path_factory: pytest.TempPathFactory, body: str | bytes, heading: bool
) -> None:
    path = tmp_path_factory.mktemp("any") / "loads.csv"
    content = body if isinstance(body, bytes) else body.encode("utf-8", "replace")
    path.write_bytes((HEADING + "\n").encode() * heading + content)
    try:
        points = read_points(path, nodes=16, vref_v=3.3)
    except CalibrationError as error:
        assert str(error).startswith(f"{path}: ")
    else:
        assert np.isfinite(points.pressure_pa).all()
        assert ((points.voltage_v >= 0) & (points.voltage_v <= 3.3)).all()


def test_files_that_are_no_tables(path: Path) -> None:
    with pytest.raises(CalibrationError, match="No such file"):
        read_table(path)
    for encoding, told in (("utf-16", "UTF-16"), ("latin-1", "Latin-1")):
        path.write_bytes(f"{HEADING}\n{GOOD}# at 20 °C".encode(encoding))
        with pytest.raises(CalibrationError, match=f"not a text file in UTF-8, but in {told}"):
            read_table(path)


def test_a_load_is_reached_from_below_or_above() -> None:
    """A held load keeps the direction of the step to it, and jitter is no change."""
    loads_pa = np.array([0, 10, 20, 20.05, 15, 15, 30, 0, 0, 5]) * 1e3
    assert directions(loads_pa).tolist() == [0, 1, 1, 1, -1, -1, 1, -1, -1, 1]
