# SPDX-License-Identifier: Apache-2.0

"""What constants are worth, by `python -m benchmarks.doubt --ablate`."""

from pathlib import Path

import pytest

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
from benchmarks.doubt.tally import Tally
from benchmarks.doubt.trial import Overrides, Run, Task, TrialError, try_out
from tools.constants import Constant, heart

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
    overrides = {LIMITS: {"Limits.low_rho": 1e6}}
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
