# SPDX-License-Identifier: Apache-2.0

"""A body on three computers, which are network namespaces here."""

import re

import pytest

from torture.hosts.campaign import run
from torture.hosts.network import why_not
from torture.outcome import Plan

pytestmark = pytest.mark.slow


def test_a_body_on_three_computers_bears_loss_a_cut_and_wrong_clocks() -> None:
    if reason := why_not():
        pytest.skip(reason)
    outcomes = list(run(Plan(quick=True, seed=1)))
    assert [outcome for outcome in outcomes if not outcome.good] == []
    _, lossy, cut, clocks = outcomes
    assert lossy.times > 0
    assert (lost := re.search(r"(\d+) frames lost and counted", cut.said))
    assert int(lost[1]) > 25  # the network was cut, for more than a second
    assert clocks.times == 2
