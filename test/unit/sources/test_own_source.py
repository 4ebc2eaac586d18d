# SPDX-License-Identifier: Apache-2.0

"""A source of another package, installed as its example says, is a port like any other."""

import os
import shutil
from pathlib import Path

import pytest

from tactile_cdma import PortError, Skin
from test.support.programs import run_python

EXAMPLE = Path(__file__).resolve().parents[3] / "examples/own_source.py"
PROGRAM = """
import numpy as np
from tactile_cdma import Skin, Status

with Skin("finger://left", nodes=4, contacts=True) as skin:
    frames = [skin.read() for _ in range(60)]
frame = frames[-1]
assert frame.codes[:3].tolist() == [round(v / 3.3 * 1024) for v in (3.0, 2.5, 2.0)]
assert not np.isfinite(frame.pressure_pa[3]) and frame.status[3] & Status.STALE
assert [after.sequence - before.sequence for before, after in zip(frames, frames[1:])] == [1] * 59
print("read", len(frames))
"""


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder as `pip install` leaves it: the module, and what its pyproject.toml says."""
    text = EXAMPLE.read_text(encoding="utf-8")
    assert '[project.entry-points."tactile_cdma.sources"]\n    finger = "own_source:Finger"' in text
    shutil.copy(EXAMPLE, tmp_path)
    about = tmp_path / "own_source-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: own_source\nVersion: 1.0\n")
    points = "[tactile_cdma.sources]\nfinger = own_source:Finger\n"
    (about / "entry_points.txt").write_text(points)
    return tmp_path


def test_an_installed_source_is_read(installed: Path) -> None:
    root = str(EXAMPLE.parents[1])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(installed), root))}
    (installed / "program.py").write_text(PROGRAM)
    done = run_python(installed / "program.py", env=environment)
    assert (done.stdout, done.stderr) == ("read 60\n", "")


def test_without_it_the_kind_of_port_is_unknown() -> None:
    with pytest.raises(PortError, match="unknown kind of port"):
        Skin("finger://left", nodes=4).open()


def test_the_example_runs_by_itself() -> None:
    root = str(EXAMPLE.parents[1])
    done = run_python(EXAMPLE, env=os.environ | {"PYTHONPATH": root})
    assert (done.stdout.split(), done.stderr) == (["[3.", "2.5", "2.", "nan]"], "")
