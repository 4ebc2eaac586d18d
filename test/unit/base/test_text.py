# SPDX-License-Identifier: Apache-2.0

"""Text for people: lists that stay short, untrusted text made harmless, misspelt names."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import LayoutError, PortError, TactileError
from tactile_cdma.base.text import MOST_SHOWN, closest, listed, plain, suggestion
from tactile_cdma.wire.discovery import SerialPort


@given(st.text())
def test_what_is_shown_can_be_printed_and_is_bounded(text: str) -> None:
    assert plain(text).isprintable()
    assert len(plain(text * 1000)) <= MOST_SHOWN
    if text.isprintable():
        assert plain(text) == text


def test_errors_escape_what_they_quote() -> None:
    for error in (TactileError, PortError, LayoutError):
        assert str(error("a\x1b[2Jb\n\u202ec µ…")) == r"a\x1b[2Jb\n\u202ec µ…"
    assert "\x1b" not in str(SerialPort("/dev/ttyACM0", "a \x1b]0;board", "1\x07"))


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


KNOWN = ("nodes", "node_clocks", "port")


@pytest.mark.parametrize(
    ("name", "meant"), [("nodez", "nodes"), ("PROT", "port"), ("node_clock", "node_clocks")]
)
def test_a_name_that_resembles_a_known_one_is_suggested(name: str, meant: str) -> None:
    assert closest(name, iter(KNOWN)) == meant
    assert suggestion(name, KNOWN, "known: all") == f"; did you mean {meant!r}?"


def test_for_any_other_the_message_ends_otherwise() -> None:
    assert closest("zebra", KNOWN) is None
    assert suggestion("zebra", KNOWN) == ""
    assert closest("code", ["node"]) == "node"
    assert closest("code", ["node"], alike=0.8) is None
    assert suggestion("zebra", KNOWN, "known: all") == "; known: all"
