# SPDX-License-Identifier: Apache-2.0

"""How many nodes each pair of boards reads in 20 ms, beside the table of docs/results.md."""

import re
from pathlib import Path

import pytest

from benchmarks.paper.scaling import PAIRS, most_nodes

ROOT = Path(__file__).resolve().parents[3]
DRIFT = 0.1
"""Largest error of a chip's place at the end of a bit, chips: `make bench-timing` loses nothing."""


@pytest.mark.parametrize("boards", PAIRS)
def test_boards_read_as_many_nodes_as_the_document_says(boards: str) -> None:
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    [told] = re.findall(rf"^\| {re.escape(boards)} \| ([\d,]+) \|", page, re.MULTILINE)
    assert most_nodes(PAIRS[boards]) == int(told.replace(",", ""))


@pytest.mark.parametrize(("order", "ppm"), [(1024, 49), (4096, 12)])
def test_crystals_are_as_accurate_as_the_document_says(order: int, ppm: int) -> None:
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert f"{ppm} ppm at {order:,}" in " ".join(page.split())
    assert round(1e6 * DRIFT / 2 / order) == ppm  # digitizer and node may be off either way
