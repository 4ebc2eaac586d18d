# SPDX-License-Identifier: Apache-2.0

"""tactile-cdma calibrate: from a table, a capture or live loads to a file for the driver."""

import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest

from tactile_cdma.base.errors import TactileError
from tactile_cdma.commands.cli import main
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.readings.calibration import AdcScale, PressureCurve
from tactile_cdma.readings.calibration_file import read_calibration
from tactile_cdma.readings.status import Status
from tactile_cdma.recording.offline import raw_frames
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.scene import SCENES, SkinGeometry
from test.support.boards import plugged
from test.support.command_line import Printed
from test.support.programs import started
from test.support.simulated import record
from test.support.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parents[3]
ADC = AdcScale()
SIMULATED = PressureCurve.two_stage()
"""The curve of the simulator's nodes."""
LOADS_KPA = [0, 4, 9, 14, 20, 30, 40, 47, 55, 70, 90, 110, 125, 140]
NODES = 16


def write_loads(path: Path, bad_node: int | None = None) -> dict[int, PressureCurve]:
    """Points of 16 nodes with different curves; the bad one does not feel the load."""
    rng = np.random.default_rng(4)
    curves = {
        node: PressureCurve.two_stage(
            2.95 * rng.uniform(0.9, 1.1), 50e3 * rng.uniform(0.9, 1.1), 140e3
        )
        for node in range(1, NODES + 1)
    }
    lines = ["node,pressure_kpa,voltage_v"]
    for load in np.linspace(0, 140, 36):
        for node, curve in curves.items():
            felt_pa = 0.0 if node == bad_node else load * 1e3
            lines.append(f"{node},{load:g},{ADC.voltage(ADC.code(curve.voltage(felt_pa))):.6f}")
    path.write_text("\n".join(lines) + "\n")
    return curves


def pairs(out: str) -> dict[str, str]:
    return dict(pair.split("=", 1) for pair in out.splitlines()[-1].split())


Program: TypeAlias = Callable[..., str]
"""Gives words to `tactile-cdma calibrate`; returns what it prints."""


@pytest.fixture
def calibrate(printed: Printed) -> Program:
    return lambda *words: printed("calibrate", *words).out


@pytest.fixture
def refusal(printed: Printed) -> Program:
    return lambda *words: printed("calibrate", *words, code=1).err


def test_points_become_a_file_that_the_driver_takes(tmp_path: Path, calibrate: Program) -> None:
    loads, output = tmp_path / "loads.csv", tmp_path / "skin.yaml"
    curves = write_loads(loads)
    values = pairs(calibrate(loads, "-o", output, "--skin", "palm"))
    assert (values["fitted"], values["uncalibrated"]) == ("16", "0")
    assert float(values["residual1_over_quantisation"]) < 1.1
    assert float(values["residual2_over_quantisation"]) < 1.1
    config = SkinConfig.of({"calibration_file": str(output), "skin": "palm"})
    assert config.calibration.identity == values["identity"]
    for node, curve in curves.items():
        fitted = config.calibration.curves[node - 1]
        assert fitted.pressure_pa == pytest.approx(curve.pressure_pa, abs=300)
        assert fitted.voltage_v == pytest.approx(curve.voltage_v, abs=ADC.lsb_v)
    assert (tmp_path / "skin.png").read_bytes().startswith(b"\x89PNG")
    output.write_text(output.read_text().replace("skin: palm", "skin: 'thumb'"))
    identity = pairs(calibrate("--seal", output))["identity"]
    assert read_calibration(output, NODES, ADC, SIMULATED, "thumb").identity == identity


def test_a_wrong_area_is_warned_of_and_a_far_too_small_one_refused(
    tmp_path: Path, calibrate: Program, refusal: Program
) -> None:
    loads, picture = tmp_path / "loads.csv", tmp_path / "picture.of.palm"
    write_loads(loads)
    loads.write_text(loads.read_text().replace("pressure_kpa", "force_n"))
    arguments = [loads, "-o", tmp_path / "skin.yaml", "--area-mm2"]
    assert "warning" not in calibrate(*arguments, 1000, "--png", picture)
    assert picture.read_bytes().startswith(b"\x89PNG"), "whatever its name"
    told = calibrate(*arguments, 100, "--force").replace("0.0996", "0.1")
    assert "warning: 0.1 times as sensitive" in told
    told = refusal(*arguments, 10, "--force")
    assert "1.4e+07 Pa" in told and "is --area-mm2 right?" in told


def test_a_bad_node_may_be_missing(tmp_path: Path, calibrate: Program, refusal: Program) -> None:
    loads, output = tmp_path / "loads.csv", tmp_path / "skin.yaml"
    write_loads(loads, bad_node=5)
    told = refusal(loads, "-o", output)
    assert "no sound curve for node 5 (see above); nothing is written" in told
    assert not output.exists()
    told = calibrate(loads, "-o", output, "--allow-missing")
    assert "node 5: no curve: the voltage changes by 0 mV only" in told
    config = SkinConfig.of({"calibration_file": str(output)})
    assert config.calibration.curves[4] == SIMULATED
    capture = tmp_path / "skin.raw"
    record(capture, SimOptions(scene="all", threshold=0), 0.2)
    readings = list(raw_frames(capture, Pipeline(config)))[-1].readings
    assert np.flatnonzero(readings.status & Status.UNCALIBRATED).tolist() == [4]
    for index in range(NODES):
        pressure_pa = config.calibration.curves[index].pressure(readings.voltage_v[index])
        assert readings.pressure_pa[index] == pytest.approx(pressure_pa, rel=1e-4, abs=1)


def test_what_cannot_be_meant_is_refused_at_first(tmp_path: Path, refusal: Program) -> None:
    loads, output = tmp_path / "loads.csv", tmp_path / "skin.yaml"
    write_loads(loads)
    assert "-o is missing" in refusal(loads)
    assert "which loads?" in refusal("-o", output)
    output.write_text("precious")
    assert "--force overwrites it" in refusal(loads, "-o", output)
    assert output.read_text() == "precious"
    for bad in ("--steps=0,ten", "--steps=-1", "--pieces=0", "--area-mm2=0", "--offset=nan"):
        with pytest.raises(SystemExit):
            main(["calibrate", str(loads), "-o", str(output), bad])


@pytest.mark.parametrize(
    ("options", "cause"),
    [
        (["-o", "no/skin.yaml"], "no such folder"),
        (["--port", "sim://", "--capture", "x.raw"], "loads come from one of them"),
        (["--capture", "no.raw"], "No such file"),
        (["--nodes", 9], "the skin has nodes 1…9"),
        (["--append"], "--append goes with --port only"),
        (["--steps", "0,10", "--capture", "x.raw"], "--steps goes with --port only"),
        (["--offset", 3], "--offset goes with --capture only"),
        (["--settle", 5], "--settle goes with --capture only"),
        (["--png", "no/skin.png"], "no/skin.png: there is no such folder"),
        (["-o", "."], "not a regular file, so it is not overwritten"),
        (["-o", "loads.csv"], "loads.csv: would overwrite another file of this command"),
        (["--png", "./loads.csv"], "loads.csv: would overwrite another"),
        (["--png", "skin.yaml"], "skin.yaml: would overwrite another"),
        (["-o", "skin.png"], "skin.png: would overwrite another"),
    ],
)
def test_no_option_is_ignored_and_no_file_lost(
    tmp_path: Path,
    refusal: Program,
    monkeypatch: pytest.MonkeyPatch,
    options: list[object],
    cause: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_loads(Path("loads.csv"))
    assert cause in refusal("loads.csv", "--force", "-o", "skin.yaml", *options)
    assert [path.name for path in tmp_path.iterdir()] == ["loads.csv"]


def staircase(t_s: float) -> float:
    """Loads one after the other, 3 s each with a short ramp between, from 1 s on; kPa."""
    starts = 1 + 3.0 * np.arange(len(LOADS_KPA))
    corners = np.stack([starts + 0.3, starts + 3.0], axis=1).ravel()
    return float(np.interp(t_s, corners, np.repeat(LOADS_KPA, 2)))


def test_a_reference_beside_a_capture(
    tmp_path: Path, calibrate: Program, refusal: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Through the real path of bytes; the reference's clock is 1000 s behind."""
    monkeypatch.setitem(
        SCENES, "all", lambda t_s, skin: np.full(len(skin.positions_m), 1e3 * staircase(t_s))
    )
    capture = tmp_path / "touch.raw"
    record(capture, SimOptions(scene="all", threshold=0), 1 + 3.0 * len(LOADS_KPA))
    t_s = np.arange(1.0, 1 + 3.0 * len(LOADS_KPA), 0.05)
    rows = [f"{t - 1000:.3f},{staircase(t):.4f}" for t in t_s]
    reference = tmp_path / "reference.csv"
    reference.write_text("\n".join(["time_s,pressure_kpa", *rows]) + "\n")
    output = tmp_path / "skin.yaml"
    arguments = [reference, "--capture", capture, "-o", output, "--settle", 0.5]
    out = calibrate(*arguments)
    found = re.search(r"offset of the clocks: ([\d.]+) ± ([\d.]+) s \(match [\d.]+\)", out)
    assert found is not None
    assert float(found[1]) == pytest.approx(1000, abs=float(found[2]) + 0.1)
    assert pairs(out)["points"] == str(NODES * len(LOADS_KPA))
    calibration = read_calibration(output, NODES, ADC, SIMULATED)
    for node in range(NODES):
        curve = calibration.curves[node]
        assert curve.pressure_pa == pytest.approx(SIMULATED.pressure_pa, abs=400)
        assert curve.voltage_v == pytest.approx(SIMULATED.voltage_v, abs=ADC.lsb_v)
    assert "0 loads rest for longer" in refusal(*arguments, "--force", "--offset", 0)


@dataclass
class Press:
    """The same pressure on all taxels of a simulated skin. moving_pa_s: its rate of change."""

    pressure_pa: float = 0.0
    moving_pa_s: float = 0.0

    def __call__(self, t_s: float, skin: SkinGeometry) -> np.ndarray:
        return np.full(len(skin.positions_m), self.pressure_pa + self.moving_pa_s * t_s)


@contextmanager
def pressed_skin(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, Press]]:
    """A digitizer behind a real tty, and the pressure on its skin, for the test to set."""
    press = Press()
    monkeypatch.setitem(SCENES, "all", press)
    options = SimOptions(scene="all", threshold=1, heartbeat=10)
    with plugged(lambda: VirtualDigitizer(options)) as tty:
        yield tty, press


@contextmanager
def dialogue(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "tactile_cdma", "calibrate", *map(str, arguments)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with started(command, cwd=ROOT, **pipes) as process:
        watchdog = threading.Timer(PATIENCE_S, process.kill)  # then `hear` ends, too
        watchdog.start()
        try:
            yield process
        finally:
            watchdog.cancel()


def hear(process: subprocess.Popen[str], end: str) -> str:
    """The program's output up to this text."""
    assert process.stdout is not None
    said = ""
    while not said.endswith(end):
        letter = process.stdout.read(1)
        assert letter, said
        said += letter
    return said


def interrupt(process: subprocess.Popen[str]) -> None:
    """Ctrl-C while the program waits for an answer.

    Python's input() loses one that comes while it flushes its prompt.
    """
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)


def rest(process: subprocess.Popen[str]) -> str:
    """The program's output until it ends, without further input.

    Not communicate(), which passes over what read() has already taken from the pipe.
    """
    assert process.stdin is not None and process.stdout is not None
    process.stdin.close()
    said = process.stdout.read()
    process.wait(timeout=PATIENCE_S)
    return said


def answer(process: subprocess.Popen[str], text: str = "") -> None:
    assert process.stdin is not None
    process.stdin.write(text + "\n")
    process.stdin.flush()


def test_step_by_step_on_a_live_skin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output, points = tmp_path / "skin.yaml", tmp_path / "points.csv"
    steps = ",".join(map(str, LOADS_KPA))
    with (
        pressed_skin(monkeypatch) as (tty, press),
        dialogue(points, "--port", tty, "--steps", steps, "--seconds", 0.4, "-o", output) as cal,
    ):
        for number, load in enumerate(LOADS_KPA, 1):
            hear(cal, f"load {number} of {len(LOADS_KPA)}: apply {load} kPa to all nodes, then ")
            hear(cal, "(e: end) ")
            if load == 30:
                press.moving_pa_s = 8e3
                answer(cal)
                assert "16 of 16 nodes still move, node" in hear(cal, "then answer again\n")
                press.moving_pa_s = 0.0
                hear(cal, "(e: end) ")
            press.pressure_pa = 1e3 * load
            said = take(cal)
            assert said.startswith(f"{load} kPa: ")
            if number > 2:  # the first is within two counts of the converter's end
                assert said.endswith("16 of 16 nodes moved\n")
        said = rest(cal)
        assert cal.returncode == 0, said
    assert f"{len(LOADS_KPA)} loads taken, kept in {points}" in said
    assert len(points.read_text().splitlines()) == 1 + NODES * len(LOADS_KPA)
    curve = read_calibration(output, NODES, ADC, SIMULATED).curves[7]
    assert curve.pressure_pa == pytest.approx(SIMULATED.pressure_pa, abs=700)
    assert curve.voltage_v == pytest.approx(SIMULATED.voltage_v, abs=2 * ADC.lsb_v)


def take(process: subprocess.Popen[str], text: str = "") -> str:
    """Answer until the load is taken: it needs a moment to pass through the tty."""
    time.sleep(0.25)
    answer(process, text)
    while "not taken" in (said := hear(process, "\n")):
        hear(process, "end) ")
        answer(process, text)
    return said


def test_answers_are_loads_none_is_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output, points = tmp_path / "skin.yaml", tmp_path / "skin.points.csv"
    with pressed_skin(monkeypatch) as (tty, press):
        common = ("--port", tty, "--node", 5, "--seconds", 0.2, "-o", output)
        with dialogue(*common) as cal:
            hear(cal, "load 1, in kPa, applied to node 5 (Enter: end) ")
            answer(cal, "hard")
            assert "'hard' is not a pressure in kPa" in hear(cal, "\n")
            answer(cal, "0")
            hear(cal, "0 kPa: 3.297 V\n")
            hear(cal, "(Enter: end) ")
            press.pressure_pa = 20e3
            assert "2.639 V, 1 of 1 nodes moved" in take(cal, "20,0")
            hear(cal, "(Enter: end) ")
            interrupt(cal)
            said = rest(cal)
            assert "interrupted" in said and "add to it with --append" in said
            assert cal.returncode == 1
        kept = points.read_text()
        assert [line.split(",")[:2] for line in kept.splitlines()[1:]] == [["5", "0"], ["5", "20"]]
        with dialogue(*common) as cal:
            assert "exists already: add to it with --append" in rest(cal)
        press.pressure_pa = 40e3
        with dialogue(*common, "--append") as cal:
            hear(cal, "(Enter: end) ")
            take(cal, "40")
            said = rest(cal)  # the end of input is the end of loads
        assert points.read_text().startswith(kept)
        assert "1 loads taken" in said
        assert "node 5: no curve: 2 different loads; a curve of 2 pieces needs 6" in said
        assert (
            "nodes 1, 2, 3, 4, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16: no curve: no points" in said
        )
        assert "no node has a sound curve; nothing is written" in said
    assert not output.exists()


def test_interrupted_before_the_first_load(tmp_path: Path) -> None:
    with dialogue("--port", "sim://", "-o", tmp_path / "skin.yaml") as cal:
        hear(cal, "(Enter: end) ")
        interrupt(cal)
        assert "interrupted; no load was taken" in rest(cal)
    assert not list(tmp_path.iterdir())


def test_no_load_is_said(tmp_path: Path, refusal: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("builtins.input", lambda question: "")
    nothing = ["--port", "sim://", "-o", tmp_path / "nothing.yaml"]
    assert "no load was taken" in refusal(*nothing)
    assert "not a regular file" in refusal("/dev/full", *nothing, "--append")
    assert not list(tmp_path.iterdir())


def test_a_port_that_is_not_there_is_told_of_before_a_load_and_leaves_no_file(
    tmp_path: Path, refusal: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unasked(question: str) -> str:
        raise AssertionError(question)

    monkeypatch.setattr("builtins.input", unasked)
    nowhere = ["--port", tmp_path / "none", "-o", tmp_path / "skin.yaml"]
    assert "no such port" in refusal(*nowhere)
    other = ["--port", "sim://?nodes=9", "-o", tmp_path / "other.yaml", "--node", "17"]
    assert "--node is 17; the skin has nodes 1…16" in refusal(*other)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("begun", ["node;pressure_bar;voltage_mv\n1;0;3200\n", "\n", "\ufffd"])
def test_points_follow_on_points_only(
    tmp_path: Path, refusal: Program, monkeypatch: pytest.MonkeyPatch, begun: str
) -> None:
    monkeypatch.setattr("builtins.input", lambda question: "0")
    points = tmp_path / "points.csv"
    points.write_text(begun)
    live = ["--port", "sim://", "-o", tmp_path / "skin.yaml", points, "--append"]
    assert "points can only follow the heading node,pressure_kpa,voltage_v" in refusal(*live)
    assert points.read_text() == begun


def test_points_begin_a_line(
    tmp_path: Path, refusal: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = iter(["0", ""])
    monkeypatch.setattr("builtins.input", lambda question: next(answers))
    points = tmp_path / "points.csv"
    points.write_text("node,pressure_kpa,voltage_v\n1,20,2.64")
    live = ["--port", "sim://?scene=idle", "--seconds", 0.2, "-o", tmp_path / "skin.yaml"]
    refusal(*live, points, "--append")
    lines = points.read_text().splitlines()
    assert lines[1:3] == ["1,20,2.64", "1,0,3.296777"]


def write_fsr(path: Path, nodes: tuple[int, ...], half_pa: float) -> None:
    """Weights on sensors of 7 cm² whose voltages rise, as a person's table has them."""
    lines, adc = ["Sensor,Weight [kg],Vout (mV)"], ADC
    for node in nodes:
        for weight_kg in (0, 0.2, 0.4, 0.8, 1.2, 1.6, 2, 2.5, 3, 4, 5, 6, 7, 8, 9, 10):
            load_pa = weight_kg * 9.80665 / 7e-4
            ratio = (load_pa / half_pa) ** 0.8
            volts = adc.voltage(adc.code(3.3 * ratio / (1 + ratio)))
            lines.append(f"{node},{weight_kg},{1e3 * volts:.1f}")
    path.write_text("\n".join(lines) + "\n")


def test_a_rising_table_is_fitted_updated_compared_read(tmp_path: Path, calibrate: Program) -> None:
    loads, output, old = tmp_path / "fsr.csv", tmp_path / "fsr.yaml", tmp_path / "old.yaml"
    write_fsr(loads, (1, 2, 3), 30e3)
    table = [loads, "--nodes", 3, "--area-mm2", 700, "-o"]
    told = calibrate(*table, old)
    assert "voltages rise with the pressure: all nodes" in told
    assert "advice: --power-law would be off by" in told and "expect errors, rms, of" in told
    assert float(pairs(calibrate(*table, output, "--power-law"))["error_kpa"]) < 0.5
    values = {"nodes": 3, "calibration_file": str(output)}
    curves = SkinConfig.of(values).calibration.curves
    load_pa = np.array([5e3, 50e3, 130e3])
    ratio = (load_pa / 30e3) ** 0.8
    found_pa = curves.pressure((3.3 * ratio / (1 + ratio)).astype(np.float32))
    assert found_pa == pytest.approx(load_pa, abs=0.005 * 140e3)
    before = read_calibration(output, 3, ADC, SIMULATED).curves
    write_fsr(loads, (2,), 40e3)
    calibrate(loads, "--area-mm2", 700, "--power-law", "--update", output)
    after = read_calibration(output, 3, ADC, SIMULATED).curves
    assert after[0] == before[0] and after[2] == before[2] and after[1] != before[1]
    compared = calibrate("--compare", old, output)
    assert compared.startswith("node 2: up to ")
    worst_pa = max(
        abs(after[1].pressure(one.voltage(load)) - load)
        for one in [read_calibration(old, 3, ADC, SIMULATED).curves[1]]
        for load in np.linspace(0, one.pressure_pa[-1], 300)
    )
    assert float(pairs(compared)["most_kpa"]) == pytest.approx(worst_pa / 1e3, rel=0.02)


def test_loads_out_of_range_need_force(
    tmp_path: Path, calibrate: Program, refusal: Program
) -> None:
    loads, output = tmp_path / "fsr.csv", tmp_path / "fsr.yaml"
    write_fsr(loads, (1,), 300e3)
    table = [loads, "--nodes", 1, "--area-mm2", 70, "-o", output, "--power-law"]
    assert "1401 kPa are 10 times range_kpa (140)" in refusal(*table)
    assert not output.exists()
    calibrate(*table, "--force")
    with pytest.raises(TactileError, match="10 times range_kpa"):
        SkinConfig.of({"nodes": 1, "calibration_file": str(output)})
    curve = {"range_kpa": 1400.0, "sensitivity1_v_per_kpa": 3e-3, "sensitivity2_v_per_kpa": 1e-3}
    SkinConfig.of({"nodes": 1, "calibration_file": str(output), **curve})
