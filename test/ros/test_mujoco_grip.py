# SPDX-License-Identifier: Apache-2.0

"""examples/mujoco_grip.py: grips by touch, drops without its cue, stops when it goes blind."""

import re
from pathlib import Path

import pytest

from tactile_cdma.rest.rest_file import rest_path
from test.support.programs import run_python

pytest.importorskip("mujoco", reason="MuJoCo (pip install mujoco) is not installed")

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("mujoco")]
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "mujoco_grip.py"


def outcome(*arguments: str) -> dict[str, str]:
    """What the last line says."""
    done = run_python(EXAMPLE, *arguments, timeout=240)
    assert done.returncode == 0, done.stderr
    assert "rest.yaml" not in done.stderr, "it reads the state of another simulation"
    return dict(re.findall(r"(\w+)=(\S+)", done.stdout.splitlines()[-1]))


def test_it_grips_lifts_and_regains_a_grip_that_slips(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And takes no tare of another simulation: of a damaged file of one its driver would tell."""
    monkeypatch.setenv("ROS_HOME", str(tmp_path))
    other = rest_path("", "/skin", simulated=True)
    other.parent.mkdir()
    other.write_text("damaged")
    found = outcome()
    assert other.read_text() == "damaged"
    assert [found["gripped"], found["lifted"], found["dropped"]] == ["1", "1", "0"]
    assert 5.0 <= float(found["peak_kpa"]) < 20.0
    assert 20 < float(found["reaction_ms"]) < 300


def test_without_the_cue_it_drops_the_same_thing() -> None:
    found = outcome("--blind")
    assert [found["gripped"], found["lifted"], found["dropped"]] == ["0", "1", "1"]
    assert found["reaction_ms"] == "none"


@pytest.mark.parametrize(("dead_after_s", "lifted"), [(0.6, "0"), (2.0, "0"), (6.5, "1")])
def test_with_nodes_that_die_no_grip_is_claimed(dead_after_s: float, lifted: str) -> None:
    """While it closes, lifts (and then no further) and holds."""
    found = outcome("--dead-after", str(dead_after_s))
    assert [found["gripped"], found["lifted"], found["dropped"]] == ["0", lifted, "0"]
