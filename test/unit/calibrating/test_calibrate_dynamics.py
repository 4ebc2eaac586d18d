# SPDX-License-Identifier: Apache-2.0

"""tactile-cdma calibrate --rising and --dynamics: curves and dynamics from two recordings."""

import sys
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.base.errors import CalibrationError
from tactile_cdma.calibrating.dynamics_fit import find_dynamics
from tactile_cdma.calibrating.plateaus import Recording, Reference
from tactile_cdma.commands.cli import main
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.calibration import AdcScale, Calibration, PressureCurve
from tactile_cdma.readings.calibration_file import read_content
from tactile_cdma.readings.dynamics import Lag
from tactile_cdma.recording.offline import described_parameters, raw_frames
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.scene import DWELL_S, LOADS, SCENES, STEPS_KPA, SkinGeometry
from tactile_cdma.sim.sensor import PAPER_DYNAMICS
from test.support.simulated import record

pytestmark = pytest.mark.xdist_group("recordings")  # they are made once
ADC = AdcScale()
NODES, STUCK = 4, 3
SKIN = (
    f"nodes={NODES}&frame_period_ms=40&stuck={STUCK}&threshold=0&seed=3"
    "&sensor=paper&mismatch=0.05&sensor_noise=0.001"
)
STEPS_S = DWELL_S * len(STEPS_KPA)
CYCLES_S = 60.0
UNSEEN_S = 30.0
BEHIND_S = 500.0
"""Clock of the reference, behind that of the digitizer."""


def unseen(t_s: float, skin: SkinGeometry) -> np.ndarray:
    """Loads that are in neither recording: from one random turn to the next, some held."""
    rng = np.random.default_rng(11)
    turns_s = np.cumsum(rng.uniform(0.3, 2.5, 60))
    loads = rng.uniform(0, 130e3, 60)
    loads[::3] = loads[1::3]
    loads[0] = 0.0
    return np.full(len(skin.positions_m), np.interp(t_s, turns_s, loads))


def reference(path: Path, scene: Callable[[float, SkinGeometry], np.ndarray], end_s: float) -> Path:
    """Readings of a reference sensor, 50 per second, with a clock of its own."""
    one = SkinGeometry.of(Layout.grid(1, 1, 1, 1e-3, 1e-3), 1)
    times_s = np.arange(0.5, end_s, 0.02)
    rows = [f"{t - BEHIND_S:.3f},{scene(t, one)[0] / 1e3:.4f}" for t in times_s.tolist()]
    path.write_text("time_s,pressure_kpa\n" + "\n".join(rows) + "\n")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of a skin under a staircase of loads and under cycles, and their references."""
    folder = tmp_path_factory.mktemp("recorded")
    for scene, seconds in (("steps", STEPS_S), ("cycles", CYCLES_S)):
        record(
            folder / f"{scene}.raw", SimOptions.from_url(f"sim://?scene={scene}&{SKIN}"), seconds
        )
        reference(folder / f"{scene}.csv", LOADS[scene], seconds)
    return folder


@pytest.fixture(scope="module")
def curves(folder: Path) -> Path:
    """Curves of rising loads, the stuck node without one."""
    path = folder / "curves.yaml"
    options = ["--capture", folder / "steps.raw", "--rising", "--settle", 1, "--allow-missing"]
    assert calibrate(folder / "steps.csv", *options, "--skin", "palm", "-o", path) == 0
    return path


def calibrate(*arguments: object) -> int:
    return main(["calibrate", *map(str, arguments)])


def cycles_of(folder: Path, curves: Path, *more: object) -> list[object]:
    capture = ["--capture", folder / "cycles.raw"]
    return [folder / "cycles.csv", *capture, "--dynamics", curves, *more]


def pairs(out: str) -> dict[str, str]:
    return dict(pair.split("=", 1) for pair in out.splitlines()[-1].split())


def error_pa(config: SkinConfig, capture: Path, options: SimOptions) -> np.ndarray:
    """(n,) rms error of every node's pressure."""
    frames = list(raw_frames(capture, Pipeline(config, background=False)))
    true_pa = [frame.pressure_pa for frame in islice(truth(options, options.setup()), len(frames))]
    read_pa = np.array([frame.readings.pressure_pa for frame in frames])
    return np.asarray(np.sqrt(np.mean(np.square(read_pa - np.array(true_pa)), axis=0)))


def test_what_two_recordings_teach_holds_for_loads_never_seen(
    folder: Path,
    curves: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By commands and driver parameters alone; the reference has another clock."""
    output = tmp_path / "skin.yaml"
    capsys.readouterr()
    assert calibrate(*cycles_of(folder, curves), "-o", output) == 0
    out = capsys.readouterr().out
    values = pairs(out)
    assert float(values["rise_ms"]) == pytest.approx(PAPER_DYNAMICS.rise_s * 1e3, rel=0.1)
    assert float(values["hysteresis_removed"]) >= 0.7
    assert "dynamics from 8 loading cycles, which move the offset of the clocks by -" in out
    assert output.with_suffix(".png").read_bytes().startswith(b"\x89PNG")

    before, after = (read_content(path, NODES, ADC) for path in (curves, output))
    assert after.curves == before.curves and after.uncalibrated == [STUCK]
    assert after.skin == "palm"
    assert (before.source, after.source) == ("steps.csv", "steps.csv, dynamics: cycles.csv")
    assert before.dynamics is None

    monkeypatch.setitem(SCENES, "all", unseen)
    options = SimOptions.from_url(f"sim://?scene=all&{SKIN}")
    record(tmp_path / "unseen.raw", options, UNSEEN_S)
    parameters = described_parameters(tmp_path / "unseen.raw")
    parameters |= {"calibration_file": str(output), "skin": "palm"}
    errors_pa = []
    for compensation in (False, True):
        config = SkinConfig.of({**parameters, "compensation": compensation})
        assert config.calibration.identity == values["identity"]
        errors_pa.append(error_pa(config, tmp_path / "unseen.raw", options))
    known = np.delete(np.arange(NODES), STUCK - 1)
    static_pa, compensated_pa = (np.sqrt(np.mean(e[known] ** 2)) for e in errors_pa)
    assert compensated_pa <= 0.4 * static_pa


def test_rising_loads_alone_count(
    folder: Path, curves: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Falling loads read more, so a curve through both branches lies above that of rising loads."""
    both = tmp_path / "both.yaml"
    options = ["--capture", folder / "steps.raw", "--settle", 1, "--allow-missing"]
    assert calibrate(folder / "steps.csv", *options, "-o", both) == 0
    assert "loop" in pairs(capsys.readouterr().out)
    true = SimOptions.from_url(f"sim://?scene=steps&{SKIN}").sensors.curves(NODES)
    off_v = {}
    for path in (curves, both):
        found = read_content(path, NODES, ADC).curves
        off_v[path] = [found[n].voltage(30e3) - true[n - 1].voltage(30e3) for n in found]
    assert np.abs(off_v[curves]).max() < 1.5 * ADC.lsb_v
    assert np.max(off_v[both]) < -3 * ADC.lsb_v


def test_what_does_not_go_together_is_refused(
    folder: Path, curves: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def refusal(*arguments: object) -> str:
        capsys.readouterr()
        assert calibrate(*arguments, "-o", tmp_path / "out.yaml") == 1
        return capsys.readouterr().err

    for option in (
        ["--rising"],
        ["--pieces", 3],
        ["--settle", 1],
        ["--allow-missing"],
        ["--port", "sim://"],
        ["--append"],
    ):
        said = refusal(*cycles_of(folder, curves, *option))
        assert f"{option[0]} is for curves; --dynamics adds to those of {curves}" in said
    assert "give --capture" in refusal(folder / "cycles.csv", "--dynamics", curves)
    assert "made for skin palm" in refusal(*cycles_of(folder, curves, "--skin", "thumb"))
    missing = tmp_path / "none.yaml"
    assert f"{missing}: No such file" in refusal(*cycles_of(folder, missing))

    short = tmp_path / "short.raw"
    record(short, SimOptions.from_url(f"sim://?scene=cycles&{SKIN}"), 10.0)
    at = ["--capture", short, "--dynamics", curves, "--offset"]
    assert "0.0 s of it lie within the capture" in refusal(folder / "cycles.csv", *at, 0)
    own = tmp_path / "reference.csv"
    lines = (folder / "cycles.csv").read_text().splitlines()
    own.write_text("\n".join(lines[:300] + lines[350:]))
    assert "line 301: 1 s from the reading before" in refusal(own, *at, BEHIND_S)
    own.write_text("\n".join(["node," + lines[0], *("1," + line for line in lines[1:])]))
    assert "there is a column node" in refusal(own, *at, BEHIND_S)
    own.write_text("\n".join(lines))
    assert f"{own}: the loads rise and fall" in refusal(own, *at, BEHIND_S)
    assert not (tmp_path / "out.yaml").exists()


def test_without_scipy_the_command_says_how_to_install_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "scipy.optimize", None)
    output = tmp_path / "out.yaml"
    assert calibrate("c.csv", "--capture", "c.raw", "--dynamics", "c.yaml", "-o", output) == 1
    said = capsys.readouterr().err
    assert "--dynamics needs scipy" in said
    assert "apt install python3-scipy, or pip install 'tactile_cdma[calibrate]'" in said


@pytest.mark.parametrize(("late_s", "sure"), [(0.05, True), (0.32, False)])
def test_an_offset_that_is_too_far_off_is_refused(late_s: float, sure: bool) -> None:
    t_s = 0.02 * np.arange(1500)
    load_pa = 50e3 * (1 - np.cos(2 * t_s)) * (0.6 + 0.4 * np.sin(0.3 * t_s))
    curve = PressureCurve.two_stage()
    lag = Lag(PAPER_DYNAMICS.rise_s, PAPER_DYNAMICS.fall_s)
    felt_pa = np.array([lag.update(load_pa[[i]], 0.02) for i in range(1500)])
    volts = curve.voltage(felt_pa).astype(np.float32)
    reference = Reference(Path("cycles.csv"), np.arange(1500) + 2, t_s + late_s, load_pa)
    arguments = Calibration.default(curve, 1), reference, Recording(t_s, volts), 0.0, 0.3
    if sure:
        assert find_dynamics(*arguments).late_s == pytest.approx(late_s, abs=0.005)
    else:
        with pytest.raises(CalibrationError, match=r"^cycles.csv: the clocks differ by 0\.3 s or"):
            find_dynamics(*arguments)
