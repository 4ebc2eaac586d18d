# SPDX-License-Identifier: Apache-2.0

"""The examples of recording and learning run, and what they print is true."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tactile_cdma.commands.cli import main

EXAMPLES = Path(__file__).resolve().parents[3] / "examples"


def run(name: str, *words: str) -> dict[str, float]:
    """The figures that the last line of an example's output names."""
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / name), *words],
        env=os.environ | {"MPLBACKEND": "Agg", "PYTHONPATH": str(EXAMPLES.parent)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    last = done.stdout.splitlines()[-1]
    return {name: float(value) for name, value in re.findall(r"(\w+)=([\d.]+)", last)}


@pytest.mark.skipif(not find_spec("pyarrow"), reason="the extra [datasets] is not installed")
def test_every_frame_is_logged_while_the_picture_lives(tmp_path: Path) -> None:
    import pyarrow.parquet

    output, picture = tmp_path / "touch.parquet", tmp_path / "touch.png"
    port = "sim://?scene=press&seed=1"
    figures = run("live_parquet.py", port, str(output), "--seconds", "3", "--picture", str(picture))
    table = pyarrow.parquet.read_table(output).to_pydict()
    sequence, time_s = table["sequence"], table["unix_time_s"]
    assert len(sequence) == figures["frames"] > 50
    passed = sequence[-1] - sequence[0]
    assert passed + 1 - len(sequence) <= figures["dropped"]  # a busy machine may drop some
    assert (time_s[-1] - time_s[0]) / passed == pytest.approx(
        0.0128, rel=0.3
    )  # first stamps waited
    assert max(max(row) for row in table["pressure_pa"][50:]) > 1e3
    assert picture.read_bytes().startswith(b"\x89PNG")
    before = output.read_bytes()
    with pytest.raises(AssertionError, match="exists already; --force overwrites it"):
        run("live_parquet.py", port, str(output), "--seconds", "1")
    assert output.read_bytes() == before


@pytest.mark.skipif(not find_spec("torch"), reason="torch is not installed")
def test_a_network_answers_every_frame_from_shared_memory() -> None:
    figures = run("live_torch.py", "sim://?scene=moving", "--seconds", "3")
    assert figures["shared"] == 1
    assert figures["answers"] > 50
    assert 0 < figures["network_ms"] < figures["latency_ms"]


@pytest.mark.skipif(
    not (find_spec("torch") and find_spec("pyarrow")), reason="torch or pyarrow is not installed"
)
def test_a_network_learns_from_a_dataset(tmp_path: Path) -> None:
    recording, dataset = str(tmp_path / "touch.skin"), str(tmp_path / "touch")
    port = "sim://?scene=moving&seed=1"
    assert main(["record", port, recording, "--seconds", "3", "--nodes", "16"]) == 0
    episodes = ["--episode", "0:1.3", "--episode", "1.4:2.7"]
    assert main(["export", recording, "--lerobot", dataset, "--fps", "30", *episodes]) == 0
    figures = run("dataset_torch.py", dataset)
    assert figures["episodes"] == 2
    assert 50 < figures["pairs"] <= 2 * (39 - 1)
    assert figures["last"] < 0.5 * figures["first"]
