# SPDX-License-Identifier: Apache-2.0

"""Tables of loads, and references beside recordings: units, mistakes by line, plateaus."""

from dataclasses import replace
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
    read_table,
)
from tactile_cdma.calibrating.plateaus import (
    Recording,
    Reference,
    find_offset,
    plateau_points,
    read_reference,
    steady_voltage,
)
from tactile_cdma.readings.calibration import AdcScale, PressureCurve


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


def test_units_that_no_heading_names_are_asked_for_and_taken_from_the_option(path: Path) -> None:
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


def test_empty_rows_and_noise_without_load_are_none(path: Path) -> None:
    assert read(path, f"{HEADING}\n{GOOD},,\n,,\n").line.tolist() == [2, 3]
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
            "'pressure' has no unit .*pressure_pa, .*kpa.*--units",
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


def test_grams_that_are_called_newtons_are_told(path: Path) -> None:
    """430 g on 30.25 mm² are 139 kPa, and not 14 MPa."""
    path.write_text("node,force_n,voltage_v\n1,0,3.2\n1,430,1.1\n")
    with pytest.raises(CalibrationError, match=r"force_n the .* In force_g it would be 139\.4 kPa"):
        read_points(path, 16, 3.3, area_m2=30.25e-6)


def test_a_table_that_is_not_there(path: Path) -> None:
    with pytest.raises(CalibrationError, match="No such file"):
        read_table(path)


def test_a_load_is_reached_from_below_or_above() -> None:
    """A held load keeps the direction of the step to it, and jitter is no change."""
    loads_pa = np.array([0, 10, 20, 20.05, 15, 15, 30, 0, 0, 5]) * 1e3
    assert directions(loads_pa).tolist() == [0, 1, 1, 1, -1, -1, 1, -1, -1, 1]


ADC = AdcScale()
CURVE = PressureCurve.two_stage(v0_v=3.0)
KNOWN = PressureCurve.two_stage(v0_v=3.2, knee_pa=45e3, stage1_v_per_pa=0.03e-3)
"""The curve that is assumed before calibration."""
FRAME_S = 0.0128
LEVELS_PA = np.array([0, 20, 40, 60, 90, 140, 75, 30, 0]) * 1e3
DWELL_S, RAMP_S = 4.0, 0.5


def load_pa(t_s: np.ndarray, levels_pa: np.ndarray = LEVELS_PA) -> np.ndarray:
    """A staircase with ramps; each level is reached at a multiple of DWELL_S + RAMP_S."""
    starts = np.arange(len(levels_pa)) * (DWELL_S + RAMP_S)
    corners = np.stack([starts, starts + DWELL_S], axis=1).ravel()
    return np.interp(t_s, corners, np.repeat(levels_pa, 2))


END_S = len(LEVELS_PA) * (DWELL_S + RAMP_S) - RAMP_S


def reference(step_s: float = 0.1, begin_s: float = 0.0, end_s: float = END_S) -> Reference:
    t_s = np.arange(begin_s, end_s, step_s)
    return Reference(Path("ref.csv"), np.arange(2, 2 + len(t_s)), t_s, load_pa(t_s))


def recording(offset_s: float, nodes: int = 4, before_s: float = 3.0, lag_s: float = 0.0):
    """Device time is the reference's time plus offset_s; it runs before and after the loads."""
    own_s = np.arange(-before_s, END_S + before_s, FRAME_S)
    pressure_pa = load_pa(own_s - lag_s)
    volts = ADC.voltage(ADC.code(CURVE.voltage(pressure_pa)))
    return Recording(own_s + offset_s, np.tile(volts[:, None], nodes).astype(np.float32))


def test_plateaus_give_points_of_every_node_once_settled() -> None:
    points = plateau_points(reference(), recording(7.0), 7.0, 1.0, ADC)
    assert points.node.tolist() == [1, 2, 3, 4] * len(LEVELS_PA)
    assert points.pressure_pa == pytest.approx(np.repeat(LEVELS_PA, 4), abs=1.0)
    assert points.voltage_v == pytest.approx(CURVE.voltage(points.pressure_pa), abs=ADC.lsb_v / 2)
    assert points.line[0] == 2
    first_rows = points.line.reshape(-1, 4)[:, 0] - 2
    assert np.diff(first_rows) == pytest.approx(10 * (DWELL_S + RAMP_S), abs=2)
    lagging = recording(0.0, lag_s=0.8)
    late = plateau_points(reference(), lagging, 0.0, 1.0, ADC)
    assert late.voltage_v == pytest.approx(CURVE.voltage(late.pressure_pa), abs=ADC.lsb_v / 2)
    with pytest.raises(CalibrationError, match=r"^ref\.csv: 0 loads rest for longer than the 5 s"):
        plateau_points(reference(), lagging, 0.0, 5.0, ADC)


def test_one_node_at_a_time_and_those_that_were_heard_give_points() -> None:
    levels = reference()
    node = np.where(levels.t_s < END_S / 2, 2, 4)
    single = replace(levels, node=node)
    points = plateau_points(single, recording(0.0), 0.0, 1.0, ADC)
    assert set(points.node[: len(points) // 2 - 1]) == {2}
    assert set(points.node[len(points) // 2 + 1 :]) == {4}
    heard = recording(0.0)
    heard.voltage_v[:, 2] = np.nan
    points = plateau_points(reference(), heard, 0.0, 1.0, ADC)
    assert set(points.node) == {1, 2, 4}
    assert np.isfinite(points.voltage_v).all()


@settings(deadline=None, max_examples=20)
@given(st.floats(-5000, 5000), st.floats(0.05, 0.5), st.integers(0, 100))
def test_the_offset_of_the_clocks_is_found(offset_s: float, step_s: float, seed: int) -> None:
    heard = recording(offset_s)
    noise = np.random.default_rng(seed).normal(0, 0.01, heard.voltage_v.shape)
    noisy = Recording(heard.t_s, (heard.voltage_v + noise).astype(np.float32))
    found = find_offset(reference(step_s), noisy, KNOWN)
    assert found.offset_s == pytest.approx(offset_s, abs=found.error_s + 0.1)
    assert found.match > 0.9
    assert found.error_s < 0.5


@pytest.mark.parametrize(("begin_s", "end_s"), [(0, END_S), (0, 30), (5, 40)])
@pytest.mark.parametrize("cut", [0, 200, 600])
def test_a_part_of_one_does_not_mislead(begin_s: float, end_s: float, cut: int) -> None:
    whole = recording(100.0)
    part = Recording(whole.t_s[cut:], whole.voltage_v[cut:])
    found = find_offset(reference(begin_s=begin_s, end_s=end_s), part, KNOWN)
    assert found.offset_s == pytest.approx(100.0, abs=0.2)


def test_a_part_that_looks_like_another_is_refused() -> None:
    with pytest.raises(CalibrationError, match="in several places"):
        find_offset(reference(begin_s=10, end_s=25), recording(100.0), CURVE)


def staircase_up(begin_s: float, end_s: float) -> tuple[Reference, Recording]:
    """A reference of rising loads, and a capture of some of it; with the same clock."""
    levels_pa = np.array([0, 4, 9, 14, 20, 30, 40, 47, 55, 70, 90, 110, 125, 140]) * 1e3
    t_s = np.arange(1, len(levels_pa) * (DWELL_S + RAMP_S), 0.05)
    frames_s = np.arange(begin_s, end_s, FRAME_S)
    volts = CURVE.voltage(load_pa(frames_s, levels_pa))[:, None].astype(np.float32)
    known = Reference(Path("ref.csv"), np.arange(len(t_s)), t_s, load_pa(t_s, levels_pa))
    return known, Recording(frames_s, volts)


def test_parts_of_a_staircase_and_late_nodes_do_not_mislead() -> None:
    whole, part = staircase_up(0, 63), staircase_up(0, 33)
    assert find_offset(*whole, CURVE).offset_s == pytest.approx(0.0, abs=0.1)
    with pytest.raises(CalibrationError, match="in several places: one of the two is a part"):
        find_offset(*part, CURVE)
    whole = recording(100.0)
    late = Recording(whole.t_s[600:], whole.voltage_v[600:].copy())
    late.voltage_v[:300, 1:] = np.nan
    assert find_offset(reference(), late, KNOWN).offset_s == pytest.approx(100.0, abs=0.15)


def test_loads_that_are_not_in_the_capture_are_refused() -> None:
    rng = np.random.default_rng(0)
    other = np.interp(
        np.arange(0, END_S, FRAME_S), np.arange(0, END_S + 3, 3), rng.uniform(1, 3, 15)
    )
    stranger = Recording(FRAME_S * np.arange(len(other)), other[:, None].astype(np.float32))
    with pytest.raises(CalibrationError, match=r"nowhere in the capture .*give --offset"):
        find_offset(reference(), stranger, KNOWN)
    silent = Recording(stranger.t_s, np.full_like(stranger.voltage_v, 3.0))
    with pytest.raises(CalibrationError, match="nowhere in the capture"):
        find_offset(reference(), silent, KNOWN)


def test_loads_that_repeat_themselves_are_refused() -> None:
    once_s = np.arange(0, 40, FRAME_S)
    load = 50e3 * (1 - np.cos(2 * np.pi * once_s / 4))
    volts = CURVE.voltage(load)[:, None].astype(np.float32)
    short = once_s[: len(once_s) // 2 : 8]
    cycles = Reference(Path("ref.csv"), short, short, load[: len(once_s) // 2 : 8])
    with pytest.raises(CalibrationError, match="in several places"):
        find_offset(cycles, Recording(once_s, volts), KNOWN)


def test_steady_voltage_is_finer_than_a_count_and_blind_to_outliers() -> None:
    rng = np.random.default_rng(1)
    true_v = 1.0 + np.linspace(0, ADC.lsb_v, 7)
    codes = ADC.code(true_v + rng.normal(0, 0.7 * ADC.lsb_v, (400, 7)))
    frames = ADC.voltage(codes).astype(np.float32)
    frames[::9] = 3.0
    frames[1::9] = np.nan
    frames[:, 6] = np.nan
    steady = steady_voltage(frames, ADC.lsb_v)
    assert steady[:6] == pytest.approx(true_v[:6], abs=0.2 * ADC.lsb_v)
    assert np.isnan(steady[6])


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("time_s,voltage_v\n0,1\n", "no column pressure_kpa, which goes with a capture"),
        ("node,pressure_kpa\n1,1\n", "no column time_s"),
        ("time_s,pressure_kpa\n0,1\n2,1\n1,1\n", "line 4: time runs backwards"),
        ("time_s,pressure_kpa,node\n0,1,1\n1,1,9\n", "line 3: node 9; the skin has nodes 1…4"),
        ("time_s,pressure_kpa\n0,0.01\n1,0.1\n", "is pressure_kpa the right unit"),
    ],
)
def test_mistakes_in_a_reference_are_named(tmp_path: Path, text: str, cause: str) -> None:
    path = tmp_path / "ref.csv"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=cause):
        read_reference(path, nodes=4)


def test_a_reference_is_read_in_si_units(tmp_path: Path) -> None:
    path = tmp_path / "ref.csv"
    path.write_text("time_ms,force_n,node\n500,1,1\n1500,2,3\n")
    found = read_reference(path, nodes=4, area_m2=1e-4)
    assert found.t_s.tolist() == [0.5, 1.5]
    assert found.pressure_pa == pytest.approx([1e4, 2e4])
    assert found.node is not None and found.node.tolist() == [1, 3]
