# SPDX-License-Identifier: Apache-2.0

"""docs/paper.md: its tables are those of the last run, and what is quick to redo is the same."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.paper import scaling, sensor, words
from benchmarks.paper.claims import DIFFERS, EXCEEDED, REPRODUCED, Claim, at_most, equals, says

ROOT = Path(__file__).resolve().parents[2]
TABLES: list[list[list[Any]]] = json.loads((ROOT / "docs" / "results.json").read_text())["paper"][
    "tables"
]


@pytest.mark.parametrize("table", TABLES, ids=["claims", "other ways"])
def test_the_page_has_the_tables_of_the_last_run(table: list[list[Any]]) -> None:
    page = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    head, *rows = ["| " + " | ".join(map(str, row)) + " |" for row in table]
    assert "\n".join([head, "|" + "---|" * len(table[0]), *rows]) in page


def test_claims_that_are_quick_to_redo_are_as_the_page_says() -> None:
    redone = [*scaling.claims(), *sensor.claims(), *words.Words().claims()]
    kept = [row for row in TABLES[0] if row[0][0] != "7"][1:]
    assert [claim.row for claim in redone] == kept


def test_the_capture_is_the_one_that_is_made(tmp_path: Path) -> None:
    words.write(tmp_path / "scope.csv")
    assert (tmp_path / "scope.csv").read_text() == words.CAPTURE.read_text()


@pytest.mark.parametrize(
    ("claim", "verdict"),
    [
        (equals("", "", 100.0, 101.0, "", 0.02, "why"), REPRODUCED),
        (equals("", "", 100.0, 103.0, "", 0.02, "why"), f"{DIFFERS}: why"),
        (at_most("", "", 10.0, 9.0, "", "why"), EXCEEDED),
        (at_most("", "", 10.0, 11.0, "", "why"), f"{DIFFERS}: why"),
        (says("", "", "1010", "1010", ""), REPRODUCED),
        (says("", "", "1010", "1011", ""), DIFFERS),
    ],
)
def test_a_verdict_follows_from_the_numbers(claim: Claim, verdict: str) -> None:
    assert claim.row[-1] == verdict
