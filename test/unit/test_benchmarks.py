# SPDX-License-Identifier: Apache-2.0

"""The report of a benchmark: where quick and full runs write."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from benchmarks import report


class Figure:
    """Stands in for matplotlib's."""

    def savefig(self, path: Path, **_: object) -> None:
        path.write_bytes(b"png")


@pytest.mark.parametrize(
    ("quick", "folder"), [(True, "build/benchmarks"), (False, "docs")], ids=["quick", "full"]
)
def test_quick_runs_write_nothing_that_is_tracked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick: bool, folder: str
) -> None:
    monkeypatch.setattr(report, "ROOT", tmp_path)
    benchmark = report.Report("speed", "Run time", quick)
    benchmark.table(["order", "us"], [[16, 1.5]])
    benchmark.finish(Figure(), us_16=1.5)  # type: ignore[arg-type]
    written = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*")}
    assert written == {f"{folder}/img/speed.png", f"{folder}/results.json"}
    report.Report("skip", "Silence", quick).finish(Figure(), us_1024=2.5)  # type: ignore[arg-type]
    kept = json.loads((tmp_path / folder / "results.json").read_text())
    assert kept["speed"]["tables"] == [{"headers": ["order", "us"], "rows": [[16, 1.5]]}]
    assert (kept["speed"]["quick"], kept["speed"]["results"]) == (quick, {"us_16": 1.5})
    assert kept["skip"]["results"] == {"us_1024": 2.5}


def test_what_quick_runs_write_is_ignored_by_git() -> None:
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        pytest.skip("not a git checkout")
    ignored = ["git", "-C", str(root), "check-ignore", "build/benchmarks/results.json"]
    assert subprocess.run(ignored, capture_output=True).returncode == 0
