# SPDX-License-Identifier: Apache-2.0

"""The report of a benchmark: where quick and full runs write."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import pareto, report, ros
from benchmarks.doubt import printed
from benchmarks.doubt.kept import Kept
from benchmarks.doubt.tally import Tally, total
from tactile_cdma.driver.clock import FrameTimes
from tactile_cdma.readings.taxels import Taxels


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
    benchmark.table(["order", "us"], [[16, np.float64(1.5)]])
    benchmark.table(["N"], [[256]], keep=False)
    benchmark.finish(Figure(), us_16=1.5)  # type: ignore[arg-type]
    written = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*")}
    assert written == {f"{folder}/img/speed.png", f"{folder}/results.json"}
    report.Report("skip", "Silence", quick).finish(Figure(), us_1024=2.5)  # type: ignore[arg-type]
    kept = json.loads((tmp_path / folder / "results.json").read_text())
    assert kept["speed"]["tables"] == [[["order", "us"], [16, 1.5]]]
    assert kept["speed"].keys() >= {"machine", "date", "commit"}
    assert (kept["speed"]["quick"], kept["speed"]["results"]) == (quick, {"us_16": 1.5})
    assert kept["skip"]["results"] == {"us_1024": 2.5}


def test_what_quick_runs_write_is_ignored_by_git() -> None:
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        pytest.skip("not a git checkout")
    ignored = ["git", "-C", str(root), "check-ignore", "build/benchmarks/results.json"]
    assert subprocess.run(ignored, capture_output=True).returncode == 0


def test_a_run_that_was_cut_off_goes_on_where_it_was_unless_code_has_changed(
    tmp_path: Path,
) -> None:
    file, done, other = tmp_path / "new/doubt.jsonl", Tally(words=np.int64(7), wrong=1), Tally(2)
    with Kept(file, "code") as kept:
        kept.add("hum", 0, (done, ["frame 3"]))
        kept.add("hum", 1, (other, []))
    file.write_text(file.read_text()[:-9])  # killed in the last line
    with Kept(file, "code") as kept:
        assert kept.found == {("hum", 0): (done, ["frame 3"])}
        kept.add("noise", 2, (other, []))
    assert Kept(file, "code").found.keys() == {("hum", 0), ("noise", 2)}
    assert not Kept(file, "other code").found
    assert not Kept(file, "code").found


WAYS = [
    pareto.DEFAULT,
    pareto.Way("gap", timing="gap"),
    pareto.Way("parity, chip means", 1, parity=True),
    pareto.Way("dense", dense=True),
]


@pytest.mark.parametrize("way", WAYS, ids=[way.name for way in WAYS])
def test_pareto_counts_exactly_the_words_and_frames_that_are_wrong(
    way: pareto.Way, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pareto, "RHO", 30.0)  # no word is wrong by itself
    monkeypatch.setattr(pareto, "FRAMES", 6)
    stream = pareto.stream(way, 1)
    right = pareto.measure(stream)
    assert (right.bit_errors, right.unflagged, right.lost) == (0, 0, 0)
    assert right.codes.shape == (6, 16)
    first, *others = stream.truths
    codes = first.codes.copy()
    codes[3] ^= 0b101  # sent otherwise than was decoded
    wrong = pareto.measure(replace(stream, truths=(replace(first, codes=codes), *others)))
    assert (wrong.bit_errors, wrong.unflagged, wrong.lost) == (2, 1, 0)
    blind = pareto.measure(replace(stream, reads=[]))
    assert blind.lost >= 5  # all but one that the warm-up left to be flushed
    assert blind.bit_errors == 160 * blind.lost
    assert blind.unflagged == 0


def test_ros_counts_the_frames_that_did_not_arrive() -> None:
    sent = {1_000_000 + 20_000 * n: 10.0 + 0.02 * n for n in range(200)}
    arrived = [(us + 3, t_s + 1e-3) for us, t_s in sent.items()]
    whole = ros.match(sent, arrived, 20_000, 0.1)
    assert (whole.sent, whole.lost) == (149, 0)  # but for a second of warm-up
    assert whole.p50_ms == pytest.approx(1.0)
    assert ros.match(sent, arrived[:100] + arrived[103:], 20_000, 0.1).lost == 3
    with pytest.raises(ros.RunError, match="none of 0 frames"):
        ros.match({}, arrived, 20_000, 0.1)


def told(kind: type, frames: int = 40) -> Tally:
    """Count what the conditions of a kind claim."""
    chosen = [some for some in printed.conditions() if isinstance(some, kind)]
    return total(some.run(frames, 3)[0] for some in chosen[1::4])


def test_tares_that_add_up_over_restarts_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """As they did while the lowest zero was not kept on file."""
    tally = told(printed.TareCondition)
    assert tally.claims > 1000 and tally.false == 0
    restore = Taxels.restore
    monkeypatch.setattr(Taxels, "restore", lambda self, *kept: restore(self, *kept[:3]))
    assert told(printed.TareCondition).tares > 100


def test_losses_between_fast_frames_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """As they were not while only the sequence told them."""
    tally = told(printed.FastCondition, 150)
    assert tally.claims > 100 and tally.false == 0
    never = property(lambda self: False, lambda self, value: None)
    monkeypatch.setattr(FrameTimes, "missed", never, raising=False)
    assert told(printed.FastCondition, 150).fast_frames > 0


def test_silences_that_decode_does_not_doubt_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    tally = told(printed.DecodeCondition)
    assert tally.claims > 100 and tally.false == 0
    describe = printed.describe_frame
    sure = {"doubtful_silence": list[int]()}
    monkeypatch.setattr(printed, "describe_frame", lambda *about: describe(*about) | sure)
    assert told(printed.DecodeCondition).decode_silent > 10
