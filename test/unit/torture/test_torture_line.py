# SPDX-License-Identifier: Apache-2.0

"""The campaign "line": its corruption, its account of the damage, and the defects it must find."""

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from itertools import count
from typing import Any, TypeAlias

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver import driver as driver_module
from tactile_cdma.driver import pipeline as pipeline_module
from tactile_cdma.driver.driver import Driver
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.driver.stream import Event
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.messages import Received
from tactile_cdma.wire.packets import PacketParser
from test.support.damaged_frames import another_pressure, another_word, nobody
from torture.line import rig as rig_module
from torture.line.campaign import COMMANDS, harmed, spoilt_commands
from torture.line.damage import AGAIN, FLIPS, HELD, KINDS, LOST, Kind
from torture.line.judge import counted
from torture.line.man_in_the_middle import Counted, ManInTheMiddle, Schedule
from torture.line.rig import Rig, Stream
from torture.outcome import Plan, Tally, bad

CHIPS = Stream("chips", {"samples_per_chip": 1}, {"threshold": 0})
SILENCE = Stream("silence", {}, {"scene": "press"})


def carried(
    kind: Kind, times: int, seed: int, begin: Counted | None = None
) -> tuple[ManInTheMiddle, Schedule, bytes]:
    """What a host gets of a digitizer behind a man in the middle, without a tty."""
    digitizer = VirtualDigitizer(SimOptions(speed=0, threshold=0, seed=1), clock=lambda: 0.0)
    man = ManInTheMiddle(digitizer, begin)
    schedule = Schedule(kind, times, np.random.default_rng(seed))
    man.begin(schedule)
    man.receive(Session(SkinConfig.of(CHIPS.parameters)).open())
    data = b""
    while not man.over():
        man.advance(4096)
        data += man.take(4096)
    return man, schedule, data


def short(kind: Kind) -> Kind:
    """The same kind, tried on fewer bytes and without pauses."""
    return replace(kind, size=min(kind.size, 3000), hold_s=0.0)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_the_schedule_depends_on_the_seed_alone(kind: Kind) -> None:
    man, schedule, data = carried(short(kind), 1, 4)
    assert carried(short(kind), 1, 4)[2] == data
    assert schedule.tried == 1
    assert schedule.done or kind in FLIPS[:2] or kind == HELD
    assert man.ledger.counts.bytes == len(data)


def test_clumps_are_held_back() -> None:
    digitizer = VirtualDigitizer(SimOptions(speed=0), clock=lambda: 0.0)
    man = ManInTheMiddle(digitizer)
    man.begin(Schedule(replace(HELD, hold_s=3600.0), 1, np.random.default_rng(0)))
    man.receive(Session(SkinConfig.of({})).open())
    while 0.0 <= man.advance(1) < 1.0:
        man.take(1)
    assert man.advance(1) > 3000
    assert man.take(1) == b""


@settings(max_examples=12, deadline=None)
@given(st.sampled_from(KINDS), st.integers(0, 2**32 - 1))
@example(AGAIN, 13154)  # an INFO of before the CONFIGURE comes once more
def test_the_ledger_knows_what_any_receiver_must_count(kind: Kind, seed: int) -> None:
    """It compares bytes, the parser decodes them: they come to the same."""
    man, _, data = carried(short(kind), 3, seed)
    pipeline = Pipeline(SkinConfig.of(CHIPS.parameters))
    pipeline.feed(data, 0.0)
    assert counted(pipeline) == asdict(man.ledger.counts)
    assert man.ledger.counts.packets > 10


@pytest.mark.parametrize(
    "begin",
    [Counted(sequence=2**16 - 3), Counted(device_time_us=2**40), Counted(first_index=2**63)],
)
def test_counters_are_set_on(begin: Counted) -> None:
    plain, moved = (carried(LOST, 0, 0, begin)[2] for begin in (None, begin))
    before, after = PacketParser(), PacketParser()
    sent = [p for p in before.feed(plain) if hasattr(p, "first_index")]
    late = [p for p in after.feed(moved) if hasattr(p, "first_index")]
    assert after.counters.lost_packets == after.counters.jumps == 0
    for a, b in zip(sent, late, strict=True):
        assert b.device_time_us - a.device_time_us == begin.device_time_us
        assert b.first_index - a.first_index == begin.first_index
        assert (b.sequence - a.sequence - begin.sequence) % 2**16 == 0


def tortured(kind: Kind = LOST, patience_s: float = 5.0) -> Tally:
    """What is found while faults of a kind are put on a line."""
    with Rig(CHIPS, 1, patience_s) as rig:
        return rig.run(Schedule(kind, 4, np.random.default_rng(1)))


def test_a_sound_driver_bears_it() -> None:
    outcomes = {
        outcome.fault: outcome
        for outcome in harmed({CHIPS: 1, SILENCE: 1}, Plan(quick=True, seed=3))
    }
    assert not [outcome for outcome in outcomes.values() if not outcome.good]
    assert len(outcomes) == len(KINDS)
    assert sum(outcome.times for outcome in outcomes.values()) > len(KINDS)


def test_damaged_commands_are_sent_again() -> None:
    outcome = spoilt_commands(3, Plan(quick=True, seed=1))
    assert (outcome.fault, outcome.times, outcome.good) == (COMMANDS, 3, True)


Found: TypeAlias = TactileFrame | None


def plant(monkeypatch: pytest.MonkeyPatch, change: Callable[[Pipeline, Found], Found]) -> None:
    """The driver gets what a change makes of its pipeline's frames."""

    class Changed(Pipeline):
        def take(self, event: Event) -> Found:
            return change(self, super().take(event))

    monkeypatch.setattr(driver_module, "Pipeline", Changed)


@pytest.mark.parametrize(
    "change",
    [
        another_word,
        nobody,
        another_pressure,
        lambda frame: replace(frame, t_start=frame.t_start + 40e-6),
        lambda frame: replace(frame, t_host=frame.t_host - 1.0),
    ],
    ids=["another word", "nobody", "pressure", "too late", "too early"],
)
def test_a_false_word_time_or_pressure_is_found(
    monkeypatch: pytest.MonkeyPatch, change: Callable[[TactileFrame], TactileFrame]
) -> None:
    frames = count(1)
    plant(monkeypatch, lambda _, frame: change(frame) if frame and next(frames) == 7 else frame)
    assert bad(tortured()) == ["wrong_values"]


@pytest.mark.parametrize(
    "name", ["lost_packets", "repeated_packets", "crc_errors", "jumps", "framing_errors"]
)
def test_a_packet_that_is_not_counted_is_found(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    class Miscounting(PacketParser):
        def interpret(self, *found: Any) -> Received | None:
            if not hasattr(self, "done"):
                self.done = True
                setattr(self._refused, name, getattr(self._refused, name) + 1)
            return super().interpret(*found)

    monkeypatch.setattr(pipeline_module, "PacketParser", Miscounting)
    assert bad(tortured()) == ["uncounted_losses"]


@pytest.mark.parametrize("name", ["lost_samples", "lost_frames", "implausible_packets"])
def test_a_loss_that_is_not_counted_is_found(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    def forget(pipeline: Pipeline, frame: Found) -> Found:
        setattr(pipeline.counters, name, 0)
        return frame

    plant(monkeypatch, forget)
    kind = next(kind for kind in KINDS if kind.forges)
    assert "uncounted_losses" in bad(tortured(kind))


def test_a_frame_that_is_kept_back_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """It arrived whole, long after a fault, and is told as lost: streaming resumes too late."""
    lost = (3, 8, 13)
    plant(monkeypatch, lambda _, frame: frame if frame and frame.sequence not in lost else None)
    assert "hangs" in bad(tortured())


def test_a_driver_that_stops_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    plant(monkeypatch, lambda pipeline, frame: frame if pipeline.counters.frames <= 5 else None)
    assert "hangs" in bad(tortured(patience_s=0.5))


def test_a_driver_that_fails_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(pipeline: Pipeline, frame: Found) -> Found:
        if pipeline.counters.frames > 5:
            raise ZeroDivisionError
        return frame

    plant(monkeypatch, fail)
    assert "crashes" in bad(tortured(patience_s=3.0))


def test_a_driver_that_fails_in_the_end_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing but what it tells shows that, and it tells of it late."""

    class Failing(Pipeline):
        def take(self, event: Event) -> TactileFrame | None:
            frame = super().take(event)
            arrived = rig.man.ledger.counts.bytes
            if event.needs_bytes and rig.man.over() and self.packet_counts.bytes >= arrived:
                raise ZeroDivisionError
            return frame

    class Slow(Driver):
        def _report(self, problem: str | None) -> None:
            time.sleep(0.1)
            super()._report(problem)

    monkeypatch.setattr(driver_module, "Pipeline", Failing)
    monkeypatch.setattr(rig_module, "Driver", Slow)
    with Rig(CHIPS, 1, 3.0) as rig:
        assert "crashes" in bad(rig.run(Schedule(LOST, 4, np.random.default_rng(1))))
