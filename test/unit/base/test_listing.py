# SPDX-License-Identifier: Apache-2.0

"""Tests of lists in messages."""

from __future__ import annotations

import pytest

from tactile_cdma.base.listing import listed


@pytest.mark.parametrize(
    ("items", "noun", "text"),
    [
        ([], "", ""),
        ([3, 4, 9], "", "3, 4, 9"),
        ([3], "node", "node 3"),
        ([3, 4], "node", "nodes 3, 4"),
        (["a", "b", "c", "d", "e"], "", "a, b, c and 2 more"),
        ([1, 2, 3, 4], "line", "lines 1, 2, 3 and 1 more"),
    ],
)
def test_items_are_listed_up_to_a_limit(items: list[object], noun: str, text: str) -> None:
    assert listed(items, noun, most=3) == text


def test_items_are_shown_as_asked_and_only_those_shown() -> None:
    """Making the text of an item may take time."""

    def mark(item: int) -> str:
        made.append(item)
        return f"#{item}"

    made: list[int] = []
    assert listed([1, 2, 3], most=2, show=mark) == "#1, #2 and 1 more"
    assert made == [1, 2]
