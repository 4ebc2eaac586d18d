# SPDX-License-Identifier: Apache-2.0

"""A short run of the campaign with orders of calls, and the defects that it must find."""

import time

import pytest

from tactile_cdma import Decoder, Frame
from torture.calls import campaign
from torture.outcome import Plan

QUICK = Plan(quick=True, seed=2)


def test_a_call_that_breaks_an_object_for_good_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a flush before a description once did."""
    flush = Decoder.flush

    def flushed(decoder: Decoder) -> list[Frame]:
        if decoder.problem is not None:
            decoder.feed = lambda data, t_host: []  # type: ignore[method-assign]
        return flush(decoder)

    assert campaign.tried("Decoder", 10, QUICK).good
    monkeypatch.setattr(Decoder, "flush", flushed)
    assert campaign.tried("Decoder", 10, QUICK).crashes == 1


def test_a_call_that_hangs_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(campaign.LONGEST_S, True, 3.0)
    monkeypatch.setattr(Decoder, "flush", lambda decoder: time.sleep(99))
    assert campaign.tried("Decoder", 5, QUICK).hangs == 1
