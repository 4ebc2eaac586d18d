# SPDX-License-Identifier: Apache-2.0

"""Benchmarks: where they write, what they count, the worth of constants, the page of the paper."""

import json
import re
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import pareto, report, ros, style
from benchmarks.doubt import printed
from benchmarks.doubt.ablate import (
    Bench,
    Price,
    Row,
    cheapest,
    kind,
    price,
    sampled,
    summed,
    together,
    values,
)
from benchmarks.doubt.kept import Kept
from benchmarks.doubt.tally import Tally, total
from benchmarks.doubt.trial import Overrides, Run, Task, TrialError, try_out
from benchmarks.paper import scaling, sensor, words
from benchmarks.paper.claims import (
    DIFFERS,
    EXCEEDED,
    INPUT,
    MET,
    REPRODUCED,
    Claim,
    at_most,
    equals,
    given,
    keeps,
)
from tactile_cdma.driver.clock import FrameTimes
from tactile_cdma.readings.taxels import Taxels
from tools.constants import Constant, heart

ROOT = Path(__file__).resolve().parents[2]


# Reports


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
    benchmark.finish(style.sheet(100), us_16=1.5)
    written = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*")}
    assert written == {f"{folder}/img/speed.png", f"{folder}/results.json"}
    report.Report("skip", "Silence", quick).finish(style.sheet(100), us_1024=2.5)
    kept = json.loads((tmp_path / folder / "results.json").read_text())
    assert kept["speed"]["tables"] == [[["order", "us"], [16, 1.5]]]
    assert kept["speed"].keys() >= {"machine", "date", "commit"}
    assert (kept["speed"]["quick"], kept["speed"]["results"]) == (quick, {"us_16": 1.5})
    assert kept["skip"]["results"] == {"us_1024": 2.5}


def test_what_quick_runs_write_is_ignored_by_git() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    ignored = ["git", "-C", str(ROOT), "check-ignore", "build/benchmarks/results.json"]
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


# What constants are worth, by `python -m benchmarks.doubt --ablate`

LIMITS = "tactile_cdma.words.limits"


def constant(name: str, value: float, module: str = LIMITS) -> Constant:
    return Constant(module, name, value, 1, False)


@pytest.mark.slow
def test_a_rule_that_is_always_on_flags_right_words_and_one_value_changes_what_follows_from_it(
    tmp_path: Path,
) -> None:
    names = ("marks: clean", "gap: clean")
    before = try_out(Task(str(tmp_path), names, 10))
    assert {run.tally.words for run in before.values()} == {160}
    overrides = {LIMITS: {"Limits.low_margin": 1e6}}
    after = try_out(Task(str(tmp_path), names, 10, 0, overrides))
    prices = [price(before[name], after[name]) for name in names]
    assert prices[0] == Price(0, 160, 0, 0)
    assert summed(prices).flagged == 320
    assert len(list(tmp_path.iterdir())) == 2  # rendered once


@pytest.mark.slow
def test_the_package_that_does_not_survive_a_value_fails_the_trial(tmp_path: Path) -> None:
    with pytest.raises(TrialError, match="KeyError: 'NO_RULE'"):
        try_out(Task(str(tmp_path), ("marks: clean",), 10, 0, {LIMITS: {"NO_RULE": 1.0}}))
    with pytest.raises(TrialError, match="takes more than 1 s"):
        try_out(Task(str(tmp_path), most_s=1))


def test_values_are_far_off_on_both_sides_and_none_for_what_is_no_rule() -> None:
    assert values(constant("LOW_RHO", 5.0)) == [5e-6, 5e6]
    assert values(constant("FEW", 12)) == [0, 12_000]
    assert values(constant("ORDERS", 0)) == []
    assert values(constant("MAX_ORDER", 65_536, "tactile_cdma.code.codes")) == []
    assert sum(bool(values(one)) for one in heart()) > 20


def test_conditions_are_drawn_from_every_kind_and_other_ones_of_each() -> None:
    tables = [f"{timing}: {number}" for timing in ("marks", "gap") for number in range(9)]
    names = [*tables, "mixture 3: gap, order 8, hum"]
    assert kind(names[-1]) == "mixture gap"
    assert sampled(names, 1) == names
    some = sampled(names, 3)
    assert some == ["marks: 0", "marks: 3", "marks: 6", "gap: 1", "gap: 4", "gap: 7"]


def test_flags_have_a_price_on_sound_lines_only() -> None:
    before, after = Tally(words=9, right=9), Tally(words=9, flagged=4, lost=3, wrong=2)
    assert price(Run(False, 0, before), Run(False, 0, after)) == Price(2, 4, 0, 3)
    assert price(Run(True, 0, before), Run(True, 0, after)) == Price(2, 0, 0, 3)


def test_a_constant_has_the_price_of_its_cheaper_value_and_the_dearest_comes_first() -> None:
    one, other, broken = constant("A", 1.0), constant("B", 2.0), constant("C", 3.0)
    dear, cheap = Row(one, 1e6, Price(1, 0, 0, 0), ""), Row(one, 1e-6, Price(0, 99, 0, 0), "")
    free, fails = Row(other, 0.0, Price(0, 0, -3, 0), ""), Row(broken, 0.0, None, "crash")
    assert cheapest([free, dear, fails, cheap]) == [fails, cheap, free]


class Company(Bench):
    """Of two rules that do the same, one is needed."""

    def __init__(self) -> None:
        self.asked = 0

    def price(self, overrides: Overrides) -> tuple[Price | None, str]:
        self.asked += 1
        gone = overrides[LIMITS]
        return Price(int("R1" in gone and "R6" in gone), 0, 0, 0), ""


def test_of_what_has_no_price_alone_the_most_that_have_none_together_are_found(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rows = [Row(constant(f"R{at}", 1.0), 0.0, Price(0, 0, 0, 0), "") for at in range(8)]
    bench = Company()
    assert [row.constant.name for row in together(bench, rows)] == [
        *(f"R{at}" for at in range(6)),
        "R7",
    ]
    assert bench.asked < 10
    assert "in company: limits.R6" in capsys.readouterr().out


# docs/paper.md: its tables are those of the last run, and what is quick to redo is the same

TABLES: list[list[list[Any]]] = json.loads((ROOT / "docs" / "results.json").read_text())["paper"][
    "tables"
]


@pytest.mark.parametrize("table", TABLES, ids=["claims", "other ways", "time slots"])
def test_the_page_has_the_tables_of_the_last_run(table: list[list[Any]]) -> None:
    page = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    head, *rows = ["| " + " | ".join(map(str, row)) + " |" for row in table]
    assert "\n".join([head, "|" + "---|" * len(table[0]), *rows]) in page


def test_claims_that_are_quick_to_redo_are_as_the_page_says() -> None:
    redone = [*scaling.claims(), *sensor.claims(), *words.Words().claims()]
    emulated = {"7(a)", "7(b)", "7(c)", "IV.C", "IV.C*"}
    kept = [row for row in TABLES[0][1:] if row[0] not in emulated and "SYNC=data" not in row[1]]
    assert [claim.row for claim in redone] == kept


def test_the_capture_is_the_one_that_is_made(tmp_path: Path) -> None:
    words.write(tmp_path / "scope.csv")
    assert (tmp_path / "scope.csv").read_text() == words.CAPTURE.read_text()


def test_only_what_the_paper_gives_in_figures_is_reproduced() -> None:
    by_paper = [row for row in TABLES[0][1:] if row[-1].startswith((REPRODUCED, EXCEEDED))]
    assert by_paper and all(re.fullmatch(r"[\d.,; ]+", row[2]) for row in by_paper)
    named = [row for row in TABLES[0][1:] if row[-1].startswith(MET)]
    assert named and not any(character.isdigit() for row in named for character in row[2])


def test_groups_of_nodes_have_a_cable_each_which_is_counted() -> None:
    """`make amplifier NODES=900 CHIP_US=2` wires 13 groups (docs/building.md counts them)."""
    by_size = {nodes: scaling.ways(nodes) for nodes in (16, 900)}
    assert [ways["this"][0] for ways in by_size.values() if ways["this"]] == [4, 4 * 13]
    assert [ways["time slots"] and ways["time slots"][0] for ways in by_size.values()] == [4, 52]


def test_one_amplifier_serves_as_many_nodes_as_the_pages_say() -> None:
    page = " ".join((ROOT / "firmware" / "README.md").read_text(encoding="utf-8").split())
    [most] = re.findall(r"One amplifier of 80 MHz is fast enough for (\d+) nodes", page)
    groups = [scaling.front_end(int(most) + more)[1].groups for more in (0, 1)]
    assert groups[0] == 1 < groups[1]
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    assert f"({most} computed)" in readme


def test_a_uart_takes_ten_bit_times_for_each_of_two_bytes() -> None:
    """By hand: 256 nodes at 2 Mbaud are 512 bytes of 5 µs."""
    assert scaling.ways(256)["UART, 2 Mbaud"] == (4, pytest.approx(512 * 5e-6))


def test_the_least_rho_of_the_papers_streams() -> None:
    """By hand: ±300 mV, noise of 10 mV, 16 chips of 8 samples."""
    assert pytest.approx(300 / 10 * np.sqrt(128)) == scaling.LEAST_RHO


def test_codes_gain_over_time_slots_where_amplitudes_are_alike_and_lose_where_ranges_are() -> None:
    """By hand: 908 chips; a line of ±1.5 V, of which a node of 900 has 8.96 mV."""
    gain, loss = scaling.over_time_slots_db(900)
    assert gain == pytest.approx(10 * np.log10(908))
    assert loss == pytest.approx(20 * np.log10(np.sqrt(908) * 8.96e-3 / 1.5), abs=0.1)


@pytest.mark.parametrize(
    ("claim", "verdict"),
    [
        (equals("", "", 100.0, 101.0, "", 0.02, "why"), REPRODUCED),
        (equals("", "", 100.0, 103.0, "", 0.02, "why"), f"{DIFFERS}: why"),
        (at_most("", "", 10.0, 9.0, "", "why"), EXCEEDED),
        (at_most("", "", 10.0, 10.0, "", "why"), REPRODUCED),
        (at_most("", "", 10.0, 11.0, "", "why"), f"{DIFFERS}: why"),
        (given("", "", -0.033, -0.0335, "", 0.05, "fitted"), f"{INPUT}: fitted"),
        (given("", "", -0.033, -0.0350, "", 0.05, "fitted"), DIFFERS),
        (keeps("", "", "minimal", 4.0, 5.0, ""), f"{MET}: at most 5"),
        (keeps("", "", "none", 0, 0, ""), MET),
        (keeps("", "", "none", 1, 0, "", "why"), f"{DIFFERS}: why"),
    ],
)
def test_a_verdict_follows_from_the_numbers(claim: Claim, verdict: str) -> None:
    assert claim.row[-1] == verdict
