# SPDX-License-Identifier: Apache-2.0

"""Frames that are lost: what is said of nodes meanwhile, and that all are asked to speak again."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.doubt.touches import conditions
from benchmarks.doubt.words import play
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver import checkup
from tactile_cdma.driver.asking import ANSWER_FRAMES, DOUBLED, LEAST_S, Asking
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.vitals import Vitals
from tactile_cdma.readings.contact import ContactThresholds, ContactTracker
from tactile_cdma.readings.status import Status
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.messages import Groups, Quiet, Received, Samples
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.boards import plugged
from test.support.hosts import Watch
from test.support.independent_line import Digitizer, Line, Skin, Talk, render
from test.support.lost_frames import SKINS, DamagedDigitizer, LossyLink, blind, is_blind
from test.support.simulated import stream
from test.support.waiting import wait_for

MOST_BLIND = {"16": 2, "900": 2, "sparse": 9}
"""Frames after a lost one with values in doubt; all are sure in the third, or after 8 turns."""
SETTLED_S = {"16": 0.2, "900": 0.2, "sparse": 0.6}
SLOW = {"frame_period_ms": 100.0}
"""So that a busy computer answers within a frame, or a few."""
BUSY = 3
HEARTBEAT_FRAMES = 78


@pytest.mark.parametrize("name", MOST_BLIND)
def test_after_a_loss_that_stands_alone_all_is_heard_at_once(name: str) -> None:
    link = LossyLink(name)
    first = link.go_on(SETTLED_S[name])
    assert blind(first) == blind(first[: MOST_BLIND[name] + 1]), "the first full picture"
    for pause_s in (0.0, 0.013, 0.007):
        assert not blind(link.go_on(pause_s))
        link.line.harmed = 1
        frames = link.go_on(SETTLED_S[name])
        assert frames[-1].sequence - link.frames[-len(frames) - 1].sequence == len(frames) + 1
        assert 1 <= blind(frames) <= MOST_BLIND[name], "what may have been said unheard is told"
    assert len(link.line.asked_s) == 4
    assert Groups not in link.line.kinds, "that all speak is no reason to divide them"
    assert link.wrong == link.unflagged == 0


def test_a_request_that_is_lost_is_made_again_when_allowed() -> None:
    link = LossyLink("16")
    link.go_on(1.0)
    link.line.harmed, link.line.deaf = 1, True
    deaf = link.go_on(0.09)
    assert is_blind(deaf[-1])
    assert len(link.line.asked_s) == 2
    link.line.deaf = False
    assert blind(link.go_on(0.2)) <= 4, "0.1 s after the request that was lost"
    assert len(link.line.asked_s) == 3
    link.line.harmed = 2  # the frame in which all are asked is lost, too
    assert blind(link.go_on(0.5)) <= 0.1 / 12.8e-3 + 2
    assert link.wrong == link.unflagged == 0


def test_an_answer_that_is_in_doubt_is_none() -> None:
    link = LossyLink("16", "idle", heartbeat=0)
    link.go_on(1.0)
    link.line.harmed = link.line.noisy = 1
    frames = link.go_on(0.5)
    assert frames[1].words.doubtful.all() and frames[1].words.active.all()
    assert 4 < blind(frames) <= 0.1 / 12.8e-3 + 2, "until the next request is allowed"
    link.line.harmed, link.line.noisy = 1, DOUBLED + 1
    assert blind(link.go_on(4.0)) > 300
    assert not is_blind(link.go_on(4.0)[-1]), "it is not given up, even in the longest pauses"
    assert link.wrong == link.unflagged == 0


def test_requests_back_off_while_the_line_stays_disturbed() -> None:
    link = LossyLink("16")
    link.go_on(1.0)
    link.line.asked_s.clear()
    for _ in range(100):  # every third frame
        link.line.harmed = 1
        link.go_on(0.038)
    waits_s = np.diff(link.line.asked_s)
    assert waits_s.min() >= LEAST_S
    assert waits_s.max() == pytest.approx(LEAST_S * 2**DOUBLED, abs=0.06)
    assert (np.diff(waits_s[:DOUBLED]) > 0).all()
    link.go_on(2 * LEAST_S * 2**DOUBLED)
    link.line.harmed = 1
    assert blind(link.go_on(0.2)) <= MOST_BLIND["16"], "it is forgotten once the line is calm"
    assert link.wrong == link.unflagged == 0


def test_firmware_that_knows_no_such_command_is_asked_once_and_named() -> None:
    """Its nodes are unheard until they speak by themselves, and nobody claims anything else."""
    link, vitals = LossyLink("16", "idle", knows=False), Vitals()
    link.go_on(1.5)
    assert len(link.line.asked_s) == 1
    vitals.take(link.pipeline)
    assert not list(checkup.stream(link.pipeline, vitals.take(link.pipeline), None))[1:]
    link.line.harmed = 1
    frames = link.go_on(1.5)
    assert HEARTBEAT_FRAMES - 10 < blind(frames) <= HEARTBEAT_FRAMES
    assert np.any(frames[0].readings.status & Status.UNHEARD == Status.UNHEARD)
    found = checkup.stream(link.pipeline, vitals.take(link.pipeline), None)
    assert any("unknown command" in each.text and each.key == "unasked" for each in found)
    assert len(link.line.asked_s) == 1
    assert link.session.problem is None
    assert link.wrong == link.unflagged == 0


def test_nodes_that_do_not_answer_are_given_up() -> None:
    """Two of them are dead: they are asked for as long as they may only be late."""
    link = LossyLink("16")
    link.line.options = SimOptions(scene="presses", seed=3, dead="2,5")
    link.line.receive(link.session.open())
    link.go_on(10.0)
    asked = len(link.line.asked_s)
    assert 2 <= asked <= DOUBLED + 3
    link.go_on(10.0)
    assert len(link.line.asked_s) == asked


@given(
    turns=st.sampled_from([1, 2, 16]),
    period_s=st.floats(1e-3, 0.5),
    waits_s=st.lists(st.floats(0.0, 3.0), min_size=1, max_size=60),
)
def test_requests_keep_their_distance(turns: int, period_s: float, waits_s: list[float]) -> None:
    """However often values are in doubt; and one that is calm by then is never kept waiting."""
    asking, now_s, asked_s = Asking(turns, period_s), 0.0, list[float]()
    least_s = max(LEAST_S, (turns + ANSWER_FRAMES) * period_s)
    for wait_s in waits_s:
        now_s += wait_s
        asking.doubt()
        before_s = asked_s[-1] if asked_s else -np.inf
        if asking.request(now_s):
            asked_s.append(now_s)
        assert asked_s[-1] == now_s or now_s - before_s < least_s * 2**DOUBLED
    assert all(after_s - before_s >= least_s for before_s, after_s in pairwise(asked_s))
    for turn in range(turns, 2 * turns) if turns > 1 else [0]:
        assert asking.wanted
        if asking.hear(turn):
            asking.settle(False)
    assert not asking.wanted
    assert not asking.request(now_s + 1e3)


@pytest.mark.parametrize("name", MOST_BLIND)
def test_a_running_driver_asks_on_a_tty(name: str) -> None:
    digitizer, watch = DamagedDigitizer(SimOptions(scene="press")), Watch()
    config, most = SkinConfig.of(SKINS[name] | SLOW), MOST_BLIND[name] + BUSY
    with plugged(lambda: digitizer) as path, watch.driver(path, config):
        wait_for(lambda: watch.frames and not is_blind(watch.frames[-1]))
        assert len(watch.frames) < HEARTBEAT_FRAMES / 2
        alone = len(watch.frames) + 2 * (most + ANSWER_FRAMES)
        wait_for(lambda: len(watch.frames) >= alone and not is_blind(watch.frames[-1]))
        before = len(watch.frames)
        digitizer.harmed = 1
        wait_for(lambda: len(watch.frames) >= before + most + 3)
        frames = watch.frames[before : before + most + 3]
    assert frames[-1].sequence - watch.frames[before - 1].sequence == len(frames) + 1
    assert 1 <= blind(frames) <= most


def test_nodes_that_stay_in_doubt_are_given_up() -> None:
    asking = Asking(1, 0.01)
    for hundredth in range(3000):
        if asking.request(hundredth * 1e-2):
            assert asking.hear(0)
            asking.settle(True)
    assert asking.requests == DOUBLED + 1
    assert not asking.wanted


HEARTBEAT = 20
IDLE = f"sim://?seed=1&scene=idle&heartbeat={HEARTBEAT}"
Edit = Callable[[int, Samples | Quiet], Samples | Quiet | None]


def heard(
    edit: Edit, url: str = IDLE, frames: int = 80, **parameters: object
) -> list[TactileFrame]:
    """Frames of a stream whose packets of samples are edited, by the number of the frame."""
    config = SkinConfig.of(parameters)  # type: ignore[arg-type]
    pipeline, writer = Pipeline(config), PacketWriter()
    found, number = [], -1
    for packet in PacketParser().feed(stream(config, url, frames)):
        kept: Received | None = packet
        if isinstance(packet, (Samples, Quiet)):
            number += packet.sync
            kept = edit(number, packet)
        data = writer.encode(packet if kept is None else kept)
        found += [] if kept is None else pipeline.feed(data, packet_s(packet))
    return found + pipeline.flush()


def packet_s(packet: object) -> float:
    return getattr(packet, "device_time_us", 0) * 1e-6


def is_unheard(status: np.ndarray) -> np.ndarray:
    """Both bits of UNHEARD are set."""
    return np.asarray(status & Status.UNHEARD == Status.UNHEARD)


def unheard(frame: TactileFrame) -> int:
    return int(np.count_nonzero(is_unheard(frame.readings.status)))


@pytest.mark.parametrize("lost", [40, 47])
def test_after_a_lost_frame_every_node_is_unheard_until_its_heartbeat(lost: int) -> None:
    frames = heard(lambda n, packet: None if n == lost else packet)
    tracker = ContactTracker(SkinConfig.of({}).layout, ContactThresholds(1000, 500))
    untouched = {f.sequence: tracker.update(f.readings, f.t_middle).untouched for f in frames}
    [gap] = [b.sequence for a, b in pairwise(frames) if b.sequence > a.sequence + 1]
    spoken = np.zeros(16, bool)
    for frame in frames:
        status = frame.readings.status
        if HEARTBEAT <= frame.sequence < gap:
            assert untouched[frame.sequence]
        if frame.sequence >= gap:
            spoken |= frame.words.active
            assert np.array_equal(is_unheard(status), ~spoken)
            assert np.isfinite(frame.readings.pressure_pa).all()
            assert untouched[frame.sequence] == spoken.all()
    assert spoken.all()


def test_where_nodes_repeat_only_those_are_unheard_that_spoke_before_the_loss() -> None:
    """A press ends in the lost frames: its nodes speak in every frame until then."""
    url = "sim://?seed=1&scene=moving&heartbeat=20"
    frames = heard(lambda n, packet: None if 40 <= n < 60 else packet, url, nodes_repeat=True)
    [(last, first)] = [(a, b) for a, b in pairwise(frames) if b.sequence > a.sequence + 1]
    silent = ~first.words.active
    assert (last.words.active & silent).any()
    assert np.array_equal(is_unheard(first.readings.status), last.words.active & silent)


def test_by_change_a_touch_is_held_and_what_was_said_unheard_is_unknown() -> None:
    """The press gets to its load, and rests there, in frames that are lost."""
    url = "sim://?seed=1&scene=press&heartbeat=60&speaks=change"
    whole = {frame.sequence: frame for frame in heard(lambda n, packet: packet, url, 200)}
    frames = heard(lambda n, packet: None if 80 <= n < 100 else packet, url, 200)
    held = hidden = 0
    spoken = np.zeros(16, bool)
    for frame in frames[60:]:
        true_pa, status = whole[frame.sequence].readings.pressure_pa, frame.readings.status
        off = np.abs(frame.readings.pressure_pa - true_pa) > 250
        certain = status & (Status.LOW_SNR | Status.STALE) == 0
        if frame.sequence >= 100:
            spoken |= frame.words.active
            assert np.array_equal(certain, spoken)
        assert not (certain & off).any()
        hidden += np.count_nonzero(off)
        held += np.count_nonzero(certain & ~frame.words.active & (true_pa > 5e3))
    assert hidden > 20, "nothing was there"
    assert held > 50 and spoken.all()


def test_where_every_node_speaks_in_every_frame_none_is_unheard() -> None:
    url = "sim://?seed=1&scene=moving&threshold=0"
    frames = heard(lambda n, packet: None if n % 5 == 4 else packet, url, 40)
    assert len(frames) > 25
    assert not any(map(unheard, frames))


def test_after_a_restart_of_the_stream_every_node_is_unheard() -> None:
    """Also where time goes on and no frame seems to be missing."""

    def begins_anew(number: int, packet: Samples | Quiet) -> Samples | Quiet:
        return packet if number < 40 else replace(packet, first_index=packet.first_index - 20_000)

    frames = heard(begins_anew)
    assert [unheard(f) for f in frames[25:38]] == [0] * 13
    assert max(map(unheard, frames[38:45])) >= 14
    assert unheard(frames[-1]) == 0


def test_a_clock_that_begins_anew_leaves_nothing_held() -> None:
    def reset(number: int, packet: Samples | Quiet) -> Samples | Quiet:
        moved_us = 10_000_000 if number < 40 else 0
        return replace(packet, device_time_us=packet.device_time_us + moved_us)

    frames = heard(reset)
    assert np.count_nonzero(np.isnan(frames[42].readings.pressure_pa)) >= 12


@pytest.mark.parametrize(
    "condition",
    [some for some in conditions() if "20%" in some.name or "spikes" in some.name],
    ids=lambda some: some.name,
)
def test_no_claim_outlives_what_was_heard(condition: object) -> None:
    """Promise 1 of docs/reliability.md, of packets that are lost or not as they were sent.

    Hum of 2 A leaves no frame certain, and nothing is claimed.
    """
    tally, complaints = condition.run(40, 7)  # type: ignore[attr-defined]
    assert tally.claims > 100 or "hum of 2 A" in condition.name  # type: ignore[attr-defined]
    assert tally.unclaimed > 5, "it was blind"
    assert tally.stale_claims == 0, complaints[:3]


@pytest.mark.parametrize("hit", [False, True], ids=["packets", "impulses"])
@pytest.mark.parametrize("period", [1.0, 1.2, 1.5, 2.0, 3.0])
def test_lost_frames_are_counted_by_how_they_come(period: float, hit: bool) -> None:
    """And not by how often they would come as told, once that has been seen."""
    skin = Skin()
    line = Line(impulses_hz=100.0, impulse_v=50.0, impulse_chips=20.0) if hit else Line()
    recording = render(skin, Talk(share=0.15), line, Digitizer(), 150, 0)
    told_ms = 1e3 * skin.chip_s * skin.period_chips * period
    starts = np.array([frame.start_chips for frame in recording.frames])
    played = play(recording, lost=0.05 * (not hit), frame_period_ms=told_ms)
    found = [(np.argmin(np.abs(starts - f.t_start / skin.chip_s)), f.sequence) for f, _ in played]
    numbers, sequence = np.array(found[8:]).T
    assert np.array_equal(np.diff(numbers), np.diff(sequence))
    assert (np.diff(numbers) > 1).sum() > 4, "none was lost"


def test_silence_that_is_lost_between_frames_leaves_nobody_unheard() -> None:
    """On a line whose frames come as told, where no frame can have been there."""
    frames = heard(lambda n, packet: packet if n % 7 or packet.sync else None)
    assert not any(unheard(frame) for frame in frames[HEARTBEAT:])
