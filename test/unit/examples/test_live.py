# SPDX-License-Identifier: Apache-2.0

"""The examples for a running skin run, and know what they lost."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

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
    assert (time_s[-1] - time_s[0]) / passed == pytest.approx(0.0128, rel=0.05)
    assert max(max(row) for row in table["pressure_pa"][50:]) > 1e3
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.skipif(not find_spec("torch"), reason="torch is not installed")
def test_a_network_answers_every_frame_from_shared_memory() -> None:
    figures = run("live_torch.py", "sim://?scene=moving", "--seconds", "3")
    assert figures["shared"] == 1
    assert figures["answers"] > 50
    assert 0 < figures["network_ms"] < figures["latency_ms"]
