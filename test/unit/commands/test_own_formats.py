# SPDX-License-Identifier: Apache-2.0

"""Writers, readers and viewers of another package, installed as its example says."""

import json
import lzma
import os
import re
import shutil
from pathlib import Path

import pytest

from tactile_cdma.sim.options import SimOptions
from test.support.command_line import Refused
from test.support.programs import run_python
from test.support.simulated import recording

EXAMPLE = Path(__file__).resolve().parents[3] / "examples/own_formats.py"
GROUP = re.compile(r'\[project\.entry-points\."(.*)"\]\n    (.*) = "(.*)"')


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """As after `pip install` of the module, and of what its docstring says of pyproject.toml."""
    shutil.copy(EXAMPLE, tmp_path)
    about = tmp_path / "own_formats-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: own_formats\nVersion: 1.0\n")
    groups = GROUP.findall(EXAMPLE.read_text(encoding="utf-8"))
    assert len(groups) == 3
    points = "".join(f"[{group}]\n{name} = {place}\n" for group, name, place in groups)
    (about / "entry_points.txt").write_text(points)
    root = str(EXAMPLE.parents[1])
    return os.environ | {"PYTHONPATH": os.pathsep.join((str(tmp_path), root))}


def test_they_are_used_like_those_that_are_built_in(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    def run(*words: str | Path) -> str:
        done = run_python("-m", "tactile_cdma", *words, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    plain = recording(tmp_path / "touch.skin", SimOptions(scene="all", dead="5"), 0.5)
    packed = tmp_path / "touch.skin.xz"
    packed.write_bytes(lzma.compress(plain.read_bytes()))
    said = run("export", packed, "-o", tmp_path / "touch.jsonl")
    lines = [json.loads(line) for line in (tmp_path / "touch.jsonl").open(encoding="utf-8")]
    assert said.startswith(f"frames={len(lines)} ") and len(lines) > 20
    assert lines[-1]["pa"][4] is None and None not in lines[-1]["pa"][5:]
    shown = run("view", "sim://?scene=all", "--viewer", "peak").splitlines()
    assert len(shown) == 10 and re.fullmatch(r"\d+\.\d kPa of 16 taxels", shown[-1])
    failed = run_python(
        "-m", "tactile_cdma", "export", plain, "-o", tmp_path / "touch.odd", env=environment
    )
    assert "*.zarr, *.mp4, *.gif, *.pdf, *.svg, *.png, *.jsonl, or ask" in failed.stderr


def test_without_them_they_are_unknown(tmp_path: Path, refused: Refused) -> None:
    plain = recording(tmp_path / "touch.skin", SimOptions(), 0.2)
    assert "name it *.npz" in refused("export", plain, "-o", tmp_path / "touch.jsonl")
    said = refused("view", "sim://", "--viewer", "peak")
    assert "no installed package has a viewer 'peak'; there are: none" in said
