# SPDX-License-Identifier: Apache-2.0

"""The pytest plugin, used by tests outside of this repository."""

import importlib.metadata
import tomllib
from pathlib import Path

import pytest

from test.support.programs import run_python

ROOT = Path(__file__).resolve().parents[2]
TESTS = """
import math, signal, time
import pytest
from tactile_cdma.sim import Sphere

BALL = Sphere(radius_m=0.02, position_m=(0, 0, 0.019))

def test_pressed_without_ros(simulated_skin):
    assert simulated_skin.step().untouched
    assert simulated_skin.step(BALL).touched

@pytest.mark.simulated_skin(nodes=24, frame_period_ms=16.0, layout_file="a&b.yaml", sim="dead=3")
def test_another_skin(simulated_skin):
    frame = simulated_skin.step()
    assert frame.grid.shape == (4, 6) and math.isnan(frame.pressure_pa[2])
    assert not frame.touched and not frame.untouched

@pytest.mark.simulated_skin(pitch_mm=(7.0, 7.0), skin="7")
def test_a_node(simulated_driver):
    touch = simulated_driver.step(BALL)
    assert touch.is_sure and touch.touched and math.isclose(-touch.force_n[2], 0.62, abs_tol=0.05)
    assert not simulated_driver.step().touched
    simulated_driver.process.send_signal(signal.SIGSTOP)
    with pytest.raises(TimeoutError):
        simulated_driver.step(BALL, timeout_s=0.3)
    simulated_driver.process.send_signal(signal.SIGCONT)

@pytest.mark.simulated_skin(bits=99)
def test_wrong(simulated_driver):
    assert False, "the driver does not even start"

@pytest.mark.simulated_skin(port="sim://", sim="dead=3")
def test_other_port(simulated_skin):
    assert False, "it would not be dead there"
"""


LAYOUT = "{schema: tactile_cdma/layout, version: 1, shape: grid, rows: 4, columns: 6, pitch_mm: 5}"


@pytest.mark.slow
def test_its_fixtures_serve_tests_of_others(tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text(TESTS)
    (tmp_path / "a&b.yaml").write_text(LAYOUT)
    entry = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    plugin = entry["pytest11"]["tactile_cdma"]
    found = {point.value for point in importlib.metadata.entry_points(group="pytest11")}
    words = [] if plugin in found else ["-p", plugin]  # installed, or beside the package
    run = run_python("-m", "pytest", "-q", "--strict-markers", *words, tmp_path, cwd=tmp_path)
    assert "ERROR test_mine.py::test_wrong - tactile_cdma.base.errors.ParameterErr" in run.stdout
    assert "test_other_port - tactile_cdma.base.errors.ParameterError" in run.stdout
    assert "3 passed" in run.stdout and "2 errors" in run.stdout, run.stdout + run.stderr


def test_it_loads_neither_ros_nor_numpy_before_a_test_asks() -> None:
    probe = (
        "import sys, tactile_cdma.testing.plugin\n"
        "print('rclpy' in sys.modules, 'numpy' in sys.modules)"
    )
    answer = run_python("-c", probe, cwd=ROOT)
    assert answer.stdout == "False False\n", answer.stderr
