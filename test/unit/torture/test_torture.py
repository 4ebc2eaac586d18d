# SPDX-License-Identifier: Apache-2.0

"""The oracle, the sums and the orders of calls of `make torture` detect planted defects."""

import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from tactile_cdma import Decoder, Frame
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from test.support.oracle import Oracle
from torture.calls import campaign
from torture.outcome import PAGE, Outcome, Plan, summary, updated

CONFIG = SkinConfig.of({})


def published(count: int, oracle: Oracle, scene: str) -> list[TactileFrame]:
    """Frames of a sound line, and what the oracle has to know of them."""
    digitizer = VirtualDigitizer(SimOptions(scene=scene, speed=0, threshold=0))
    digitizer.receive(Session(CONFIG).open())
    oracle.began(digitizer.options, digitizer.setup, digitizer.started_s, digitizer.turns)
    pipeline, frames = Pipeline(CONFIG), []
    while len(frames) < count:
        digitizer.advance(4096)
        frames += pipeline.feed(digitizer.take(4096), 0.0)
    return frames[:count]


def test_streams_are_told_apart() -> None:
    """Clocks that start anew, after a reset, make the frames of both plausible."""
    oracle = Oracle()
    before, after = published(5, oracle, "all"), published(5, oracle, "press")
    verdicts = [oracle.check(frame) for frame in before + after]
    assert [verdict.stream for verdict in verdicts] == 5 * [0] + 5 * [1]
    assert not any(verdict.wrong.any() for verdict in verdicts)


def test_outcomes_add_up() -> None:
    outcomes = [
        Outcome("bit flips", 100, uncounted_losses=1),
        Outcome("a day", 1, wrong_values=2, rss_slope_kb_per_h=3.4),
        Outcome("an hour", 1, crashes=3, hangs=4, rss_slope_kb_per_h=-20.0),
    ]
    assert summary(outcomes) == (
        "faults=102 wrong_values=2 uncounted_losses=1 crashes=3 hangs=4 rss_slope_kb_per_h=3"
    )
    assert [outcome.good for outcome in outcomes] == [False, False, False]
    assert Outcome("nothing", 1).good


def test_the_page_has_what_was_kept() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert updated(text) == text


def test_a_driver_that_gets_no_processor_has_more_time_but_not_for_ever(tmp_path: Path) -> None:
    loaded_skin = pytest.importorskip("torture.load.loaded_skin", reason="no ROS 2")
    skin = loaded_skin.LoadedSkin(tmp_path, 1, patience_s=0.02)
    skin.process = SimpleNamespace(poll=lambda: None)
    begin_s, passed_s = time.monotonic(), lambda: time.monotonic() - begin_s
    assert not skin.waits_for(lambda: False) and skin.hangs == 1
    skin.judge.waited_s = passed_s
    assert skin.waits_for(lambda: passed_s() > 0.15) and skin.hangs == 1
    assert not skin.waits_for(lambda: False) and skin.hangs == 2
    assert passed_s() < 5


def test_a_call_that_breaks_an_object_for_good_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a flush before a description once did."""
    flush = Decoder.flush

    def flushed(decoder: Decoder) -> list[Frame]:
        if decoder.problem is not None:
            decoder.feed = lambda data, t_host: []  # type: ignore[method-assign]
        return flush(decoder)

    assert campaign.tried("Decoder", 10, Plan(quick=True, seed=2)).good
    monkeypatch.setattr(Decoder, "flush", flushed)
    assert campaign.tried("Decoder", 10, Plan(quick=True, seed=2)).crashes == 1


def test_a_call_that_hangs_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(campaign.LONGEST_S, True, 3.0)
    monkeypatch.setattr(Decoder, "flush", lambda decoder: time.sleep(99))
    assert campaign.tried("Decoder", 5, Plan(quick=True, seed=2)).hangs == 1
