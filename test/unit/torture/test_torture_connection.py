# SPDX-License-Identifier: Apache-2.0

"""A short run of the campaign of unplugging, resets and stalls; the defects it must find."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.sim.options import SimOptions
from test.support.damaged_frames import another_word, nobody
from torture.connection import interruptions, wrong_port
from torture.connection.judge import ConnectionJudge, Digitizer
from torture.connection.plug import Host, Plug, Tty
from torture.connection.trial import Trial, Turns, outcomes, side_by_side
from torture.connection.wrong_port import misread
from torture.outcome import Plan

PLAN = Plan(quick=True, seed=1)
CONFIG = SkinConfig.of({})
PERIOD_S = CONFIG.spec.frame_period_s


def test_a_slice_of_the_campaign(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    reset = interruptions.again_and_again(interruptions.reset_once, rng, 3, 0.25)
    vanish = interruptions.again_and_again(interruptions.vanish, rng, 1, 0.05)
    line = interruptions.stalls(interruptions.line_stalls, rng, 0.9, 1)
    consumer = interruptions.stalls(interruptions.consumer_stalls, rng, 0.9, 1)
    kinds: list[tuple[Plug, Callable[[Trial], Turns]]] = [
        (Tty(tmp_path / "reset"), reset),
        (Tty(tmp_path / "line"), line),
        (Tty(tmp_path / "consumer"), consumer),
        (Tty(tmp_path / "text"), wrong_port.visits("text", rng, 1)),
        (Host(), vanish),
    ]
    found = list(outcomes([Trial(plug.url, PLAN, plug, faults) for plug, faults in kinds]))
    plug = Tty(tmp_path / "replugged")  # alone, because it counts what the process holds
    replugs = Trial("replugs", PLAN, plug, lambda trial: interruptions.replugs(trial, rng, 8))
    found += outcomes([replugs])
    assert [outcome for outcome in found if not outcome.good] == []
    assert sum(outcome.times for outcome in found) == 16
    assert not found[1].said.startswith("0 packets")


def test_garbage_on_a_steady_port_is_told_and_the_driver_can_be_stopped(tmp_path: Path) -> None:
    """All strangers at once, who speak on while the driver stops."""
    trials = []
    for number, (name, (make, _)) in enumerate(wrong_port.STRANGERS.items()):
        rng = np.random.default_rng(number)
        faults = partial(wrong_port.usurps, stranger=make(rng), rng=rng)
        plug = Tty(tmp_path / str(number))
        trials.append(Trial(name, PLAN, plug, faults, {"frame_period_ms": 50.0}))
    side_by_side([trial.run() for trial in trials], at_once=len(trials))
    assert [trial.outcome() for trial in trials if not trial.outcome().good] == []


class Line:
    """Digitizers one after the other, decoded in a time of their own."""

    def __init__(self) -> None:
        self.now_s, self._powered_up = 0.0, 0
        self.judge, self._pipeline = ConnectionJudge(lambda: self.now_s), Pipeline(CONFIG)

    def publish(
        self, count: int, damage: Callable[[list[TactileFrame]], list[TactileFrame]]
    ) -> ConnectionJudge:
        """Frames of a digitizer that was powered up just now, with something wrong."""
        self._powered_up += 1
        options = SimOptions(scene="all", seed=self._powered_up)  # or their noise would be the same
        digitizer = Digitizer(options, lambda: self.now_s, self.judge)
        digitizer.receive(Session(CONFIG).open())
        frames: list[TactileFrame] = []
        while len(frames) < count:
            self.now_s += 1e-3
            digitizer.advance()
            frames += self._pipeline.feed(digitizer.take(1 << 16), self.now_s)
        for frame in damage(frames[:count]):
            self.judge.take(frame)
        self.judge.settle()
        return self.judge


def nothing(frames: list[TactileFrame]) -> list[TactileFrame]:
    return frames


def at_sixth(damage: Callable[[TactileFrame], TactileFrame]) -> Callable[..., list[TactileFrame]]:
    return lambda frames: [*frames[:5], damage(frames[5]), *frames[6:]]


def out_of_nowhere(frames: list[TactileFrame]) -> list[TactileFrame]:
    return [*frames, replace(frames[-1], t_start=frames[-1].t_start + 0.4 * PERIOD_S)]


def renumbered(frames: list[TactileFrame], by: int) -> list[TactileFrame]:
    return [replace(frame, sequence=frame.sequence + by) for frame in frames]


@pytest.mark.parametrize(
    ("damage", "wrong", "uncounted", "late"),
    [
        (nothing, 0, 0, 0),
        (at_sixth(another_word), 1, 0, 0),
        (at_sixth(nobody), 16, 0, 0),
        (out_of_nowhere, 16, 0, 0),
        (at_sixth(lambda frame: replace(frame, t_host=frame.t_host - 0.1)), 1, 0, 0),
        (at_sixth(lambda frame: replace(frame, t_host=frame.t_host + 1000)), 1, 0, 0),
        (lambda frames: frames[:3] + frames[5:], 0, 0, 0),
        (lambda frames: frames[:3] + renumbered(frames[5:], -2), 0, 2, 0),
        (lambda frames: frames[:3] + renumbered(frames[3:], 1), 0, 1, 0),
        (lambda frames: frames[1:], 0, 0, 0),
        (lambda frames: frames[2:], 0, 0, 1),
    ],
    ids=[
        *("sound", "another word", "nobody", "out of nowhere", "too early", "in the future"),
        *("lost, as the sequence tells", "lost, and nothing tells", "a loss that was none"),
        *("one left out after a start", "two left out after a start"),
    ],
)
def test_wrong_values_untold_losses_and_late_starts_are_found(
    damage: Callable[[list[TactileFrame]], list[TactileFrame]],
    wrong: int,
    uncounted: int,
    late: int,
) -> None:
    judge = Line().publish(10, damage)
    tally = judge.tally
    assert (tally.wrong_values, tally.uncounted_losses, judge.late) == (wrong, uncounted, late)


@pytest.mark.parametrize(("by", "uncounted"), [(0, 0), (-5, 1), (5, 1)])
def test_over_a_reset_the_sequence_goes_by_the_time_that_passed(by: int, uncounted: int) -> None:
    line = Line()
    line.publish(10, nothing)
    line.now_s += 20 * PERIOD_S
    judge = line.publish(10, lambda frames: renumbered(frames, by))
    assert judge.tally.uncounted_losses == uncounted
    assert judge.missing == [0, 0]
    lost = line.judge.account(0)
    assert 20 + by <= lost <= 26 + by
    assert judge.account(lost) == 0


def one_trial(tmp_path: Path, faults: Callable[[Trial], Turns]) -> Trial:
    trial = Trial("planted", PLAN, Tty(tmp_path / "port"), faults)
    trial.limit_s = 0.5
    side_by_side([trial.run()])
    return trial


def test_a_driver_that_ends_is_found(tmp_path: Path) -> None:
    def faults(trial: Trial) -> Turns:
        trial.driver.stop()
        trial.plug.plug(trial.digitizer(SimOptions()))
        yield from trial.resumes()

    outcome = one_trial(tmp_path, faults).outcome()
    assert (outcome.hangs, outcome.crashes) == (1, 1)


def test_an_exception_in_the_driver_is_found(tmp_path: Path) -> None:
    def faults(trial: Trial) -> Turns:
        trial.plug.plug(trial.digitizer(SimOptions()))
        yield from trial.resumes()
        trial.driver.pipeline.taxels = None  # type: ignore[assignment]
        yield from trial.told("internal error")

    outcome = one_trial(tmp_path, faults).outcome()
    assert outcome.hangs == 0 and outcome.crashes >= 1


def test_packets_lost_and_not_counted_are_found(tmp_path: Path) -> None:
    def faults(trial: Trial) -> Turns:
        yield from trial.counted(lambda: 3, lambda: 5)

    assert one_trial(tmp_path, faults).outcome().uncounted_losses == 2


def test_a_driver_that_mostly_resumes_late_is_found(tmp_path: Path) -> None:
    trial = Trial("planted", PLAN, Tty(tmp_path / "port"), lambda trial: trial.after(0))
    trial.resumed_s = 20 * [0.1, 0.1, 5.0]
    assert trial.outcome().good
    trial.resumed_s = [0.1, 1.2, 1.3]
    assert trial.outcome().good, "too few to tell"
    trial.resumed_s *= 20
    assert trial.outcome().hangs == 1


@settings(deadline=None)
@given(st.binary(max_size=300), st.floats(0.98, 1.02))
def test_a_uart_of_nearly_the_same_rate_reads_what_was_sent(data: bytes, ratio: float) -> None:
    assert misread(data, ratio) == data


def test_a_uart_of_twice_the_rate_sees_every_bit_twice() -> None:
    assert misread(b"\xff\xff", 2.0) == b"\xfe\xfe"  # the start bit, and the first bit of the byte
    assert misread(b"\x00", 2.0) == b"\x00"  # no stop bit, and no edge after it
