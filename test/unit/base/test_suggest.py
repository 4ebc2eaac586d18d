# SPDX-License-Identifier: Apache-2.0

"""Suggestions for misspelt names."""

import pytest

from tactile_cdma.base.suggest import closest, suggestion

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
