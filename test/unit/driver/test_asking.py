# SPDX-License-Identifier: Apache-2.0

"""All nodes are asked to speak at the start and after a loss, so that nothing stays unheard."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver import checkup
from tactile_cdma.driver.asking import ANSWER_FRAMES, DOUBLED, LEAST_S, Asking
from tactile_cdma.driver.vitals import Vitals
from tactile_cdma.readings.status import Status
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.messages import Groups
from test.support.boards import plugged
from test.support.hosts import Watch
from test.support.lost_frames import SKINS, DamagedDigitizer, LossyLink, blind, is_blind
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
