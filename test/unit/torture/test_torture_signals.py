# SPDX-License-Identifier: Apache-2.0

"""The campaign on broken nodes and lines must find wrong results of the driver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from torture.outcome import Outcome
from torture.signals import faulty_line, faulty_nodes
from torture.signals import trial as signal_trial
from torture.signals.campaign import trials
from torture.signals.trial import CHIPS, LINE, Kind, Skin

SKIN = Skin(LINE, {}, {"threshold": 0})
DEAD = Kind("dead", faulty_nodes.dead, length=80)
HUM = Kind("hum", line=faulty_line.hum(50, 3.0), length=10, pause=9)


def outcome(kind: Kind, skin: Skin = SKIN, frames: int = 1) -> Outcome:
    return trials(kind, [skin], frames, seed=1)


@pytest.mark.parametrize(
    ("kind", "skin"),
    [
        (DEAD, SKIN),
        (HUM, SKIN),
        (HUM, Skin(CHIPS, {"parity": True}, {"threshold": 0})),
        (Kind("at rail", line=faulty_line.at_rail, length=5, pause=9), SKIN),
        (Kind("40 dB", faulty_nodes.louder(100.0), length=40, range_v=40.0), SKIN),
    ],
)
def test_a_slice_of_the_campaign_has_no_fault(kind: Kind, skin: Skin) -> None:
    found = outcome(kind, skin)
    assert found.good, found
    assert found.times == 1


def planted(monkeypatch: pytest.MonkeyPatch, change: Callable[..., list[TactileFrame]]) -> Outcome:
    """What is found of a driver whose frames are changed like this; they come with its pipeline."""

    class Defective(Pipeline):
        def feed(self, data: bytes, t_host: float, backlog: bool = False) -> list[TactileFrame]:
            return change(self, super().feed(data, t_host, backlog))

    monkeypatch.setattr(signal_trial, "Pipeline", Defective)
    return outcome(HUM)


def test_a_wrong_word_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def change(_pipeline: Pipeline, frames: list[TactileFrame]) -> list[TactileFrame]:
        codes = [frame.words.codes ^ (np.arange(16) == 3) for frame in frames]
        words = [replace(f.words, codes=c) for f, c in zip(frames, codes, strict=True)]
        return [replace(f, words=w) for f, w in zip(frames, words, strict=True)]

    assert planted(monkeypatch, change).wrong_values > 10


def test_a_pressure_that_leaks_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def change(_pipeline: Pipeline, frames: list[TactileFrame]) -> list[TactileFrame]:
        for frame in frames:
            frame.readings.pressure_pa[5] = np.nan
        return frames

    assert planted(monkeypatch, change).wrong_values > 10


def test_losses_that_nothing_tells_of_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def change(pipeline: Pipeline, frames: list[TactileFrame]) -> list[TactileFrame]:
        kept = [frame for frame in frames if frame.sequence != 38]
        return [replace(f, sequence=f.sequence - (f.sequence > 38)) for f in kept]

    found = planted(monkeypatch, change)
    assert found.uncounted_losses == 1
    assert not found.wrong_values and not found.hangs


def test_a_driver_that_does_not_recover_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def change(_pipeline: Pipeline, frames: list[TactileFrame]) -> list[TactileFrame]:
        return [frame for frame in frames if frame.sequence < 40]

    assert planted(monkeypatch, change).hangs == 1


def test_a_traceback_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def change(_pipeline: Pipeline, frames: list[TactileFrame]) -> list[TactileFrame]:
        return [frames[0]]  # sometimes there is none

    assert planted(monkeypatch, change).crashes == 1


def test_a_broken_node_that_nobody_notices_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signal_trial, "BLAME", 0)
    assert outcome(DEAD).wrong_values == 1


def test_broken_nodes_say_what_they_say_they_do() -> None:
    """A turn's waveform, added to what is taken away, leaves the others' words as they are."""
    spec = SKIN.config.spec
    edges_s = np.arange(spec.span_chips + 1) * spec.chip_s
    draw = np.random.default_rng(1)
    turn = faulty_nodes.Turn(spec, 4, 7, 0b1011001110, edges_s, draw, draw)
    sound = faulty_nodes.spoken(spec, 0b1011001110, turn.row)
    (inverted,) = faulty_nodes.inverted(turn)
    assert np.array_equal(inverted[0], -sound)
    (half,) = faulty_nodes.half_twice(turn)
    assert np.array_equal(half[0], np.tile(sound[: sound.size // 2], 2))
    (other,) = faulty_nodes.other_row(turn)
    assert abs(float(other[0] @ sound)) < 1e-3
    assert len(list(faulty_nodes.doubled(2)(turn))) == 3
    assert not list(faulty_nodes.dead(turn))
