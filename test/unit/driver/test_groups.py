# SPDX-License-Identifier: Apache-2.0

"""More nodes want to speak than a frame holds: groups of them do by turns, and then all at once."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.framing.load import groups_for_all
from tactile_cdma.readings.status import Status
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.scene import SCENES, SkinGeometry
from tactile_cdma.wire.messages import Groups as AskGroups
from tactile_cdma.wire.packets import PacketWriter
from tactile_cdma.words.groups import CALM_S, OVERLOADS, Groups, groups_of, out_of_turn
from test.support.simulated import Truth

SKIN = {
    "codes": "sparse", "nodes": 400, "order": 96, "chip_us": 5.0, "frame_period_ms": 8.0,
    "resync_chips": 96, "guard_chips": 20, "samples_per_chip": 1, "nodes_repeat": True,
}  # fmt: skip
HUG_S, RELEASE_S = 0.4, 1.2


def hug(t_s: float, skin: SkinGeometry) -> NDArray[np.float64]:
    """From 0 to 100 % touched within one frame, and back."""
    count = len(skin.positions_m)
    return np.full(count, 30e3 if HUG_S <= t_s < RELEASE_S else 0.0) * np.linspace(0.5, 1, count)


class Robot:
    """A driver and its digitizer, in steps of a frame."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, speaks: str = "rest", **changes: int | float
    ) -> None:
        monkeypatch.setitem(SCENES, "press", hug)
        self.now_s = 0.0
        options = f"sim://?scene=press&seed=1&noise=0.01&speaks={speaks}"
        self.digitizer = VirtualDigitizer(SimOptions.from_url(options), lambda: self.now_s)
        self.config = SkinConfig.of({**SKIN, **changes})
        self.pipeline = Pipeline(self.config)
        self.session = Session(self.config)
        self.digitizer.receive(self.session.open())

    def frames(self, until_s: float) -> list[TactileFrame]:
        frames: list[TactileFrame] = []
        while self.now_s < until_s:
            self.now_s += self.config.spec.frame_period_s
            self.digitizer.advance()
            frames += self.pipeline.feed(self.digitizer.take(1 << 20), self.now_s)
            self.digitizer.receive(self.session.watch(self.pipeline, self.now_s))
        return frames


def test_all_are_heard_within_a_round_and_none_is_told_wrong(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    robot = Robot(monkeypatch)
    frames = robot.frames(3.0)
    spec, truth = robot.config.spec, Truth(robot.digitizer)
    by_turns = [frame for frame in frames if truth[frame.sequence].turn]
    assert {groups_of(truth[frame.sequence].turn) for frame in by_turns} == {16, 8, 4, 2}
    heard_code = np.full(spec.nodes, -1)
    whole_from = None
    for frame in frames:
        true, words, status = truth[frame.sequence], frame.words, frame.readings.status
        sure = ~words.doubtful
        assert np.array_equal(words.active[sure], true.active[sure])
        spoke = words.active & sure
        assert np.array_equal(words.codes[spoke], true.codes[spoke])
        heard_code[spoke] = words.codes[spoke]
        certain = status & Status.LOW_SNR == 0
        assert not (certain & (heard_code >= 0) & (abs(heard_code - true.codes) > 1)).any()
        waits = out_of_turn(true.turn, spec.nodes)
        assert not (certain & waits & (status & Status.STALE == 0)).any()
        if true.start_s > HUG_S and whole_from is None and (heard_code == true.codes).all():
            whole_from = true.start_s
    assert whole_from is not None
    # Two frames tell that it is too many, two pass until that is obeyed, and one is each group's.
    assert whole_from - HUG_S <= (OVERLOADS + 3 + 16) * spec.frame_period_s
    last = truth[frames[-1].sequence]
    assert last.turn == 0 and robot.pipeline.groups.wanted_log2 == 0
    assert not any(
        frame.words.doubtful.any() for frame in frames if truth[frame.sequence].start_s > RELEASE_S
    )


def test_words_of_too_many_that_are_said_once_are_unknown_until_they_are_said_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    robot = Robot(monkeypatch, "change", nodes_repeat=False)
    robot.frames(HUG_S - 0.02)
    frames, truth = robot.frames(RELEASE_S + 1.2), Truth(robot.digitizer)
    spoke, unheard = np.zeros(robot.config.spec.nodes, bool), 0
    for frame in frames:
        true, status = truth[frame.sequence], frame.readings.status
        spoke = spoke | (frame.words.active & ~frame.words.doubtful)
        certain = status & (Status.LOW_SNR | Status.STALE) == 0
        off_v = abs(frame.readings.voltage_v - robot.config.adc.voltage(true.codes))
        assert not (certain & (off_v > 1.5 * robot.config.adc.lsb_v)).any()
        unheard = max(unheard, int((~certain).sum()))
    assert unheard == robot.config.spec.nodes and spoke.all() and certain.all()


def test_groups_whose_codes_are_not_told_apart_are_divided_until_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of 80 nodes four groups of 20 are fewer than 64 chips tell apart, but one adds up to 0."""
    robot = Robot(monkeypatch, nodes=80, order=64, resync_chips=64)
    frames, truth = robot.frames(RELEASE_S), Truth(robot.digitizer)
    assert groups_for_all(robot.config.spec) == 8
    assert {groups_of(truth[frame.sequence].turn) for frame in frames} == {1, 4, 8}
    heard = np.zeros(80, np.bool_)
    for frame in frames:
        true, words = truth[frame.sequence], frame.words
        sure = ~words.doubtful
        assert np.array_equal(words.active[sure], true.active[sure])
        assert np.array_equal(words.codes[sure & true.active], true.codes[sure & true.active])
        heard |= sure & true.active & (true.start_s > HUG_S)
    assert heard.all()


def test_a_lost_frame_leaves_no_value_of_its_group_certain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes are released while their turns are lost; those of other groups say so by themselves."""
    robot = Robot(monkeypatch)
    robot.frames(RELEASE_S - 0.02)
    robot.now_s += 20 * robot.config.spec.frame_period_s
    robot.digitizer.advance()
    lost = robot.digitizer.take(1 << 22)
    assert len(lost) > 20_000
    frames, truth = robot.frames(RELEASE_S + 0.4), Truth(robot.digitizer)
    assert frames[0].words.active.sum() < robot.config.spec.nodes // 8
    for frame in frames:
        valid = frame.readings.status & (Status.LOW_SNR | Status.STALE) == 0
        pressed = np.nan_to_num(frame.readings.pressure_pa) > 5e3
        assert not (valid & pressed & (truth[frame.sequence].pressure_pa < 1)).any()


def test_frames_lost_as_groups_change_leave_no_value_certain(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Who spoke in a turn of 16 groups, and told its release in a lost one of 8, is unheard."""
    robot = Robot(monkeypatch, nodes=64, order=128, resync_chips=128, frame_period_ms=9.0)
    robot.session = Session()  # which asks for no groups
    encode, period_s = PacketWriter().encode, robot.config.spec.frame_period_s
    for log2, frames_before in ((4, 24), (3, 4)):
        robot.frames(RELEASE_S - frames_before * period_s)
        robot.digitizer.receive(encode(AskGroups(log2)))
    robot.frames(RELEASE_S - period_s)
    robot.now_s += 6 * period_s
    robot.digitizer.advance()
    robot.digitizer.take(1 << 22)
    frames, truth = robot.frames(RELEASE_S + 0.3), Truth(robot.digitizer)
    assert {truth[frame.sequence].turn for frame in frames} == set(range(8, 16))
    for frame in frames:
        valid = frame.readings.status & (Status.LOW_SNR | Status.STALE) == 0
        pressed = np.nan_to_num(frame.readings.pressure_pa) > 5e3
        assert not (valid & pressed & (truth[frame.sequence].pressure_pa < 1)).any()


def test_a_digitizer_that_knows_no_groups_is_asked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Robot(monkeypatch)
    asked: list[bytes] = []
    monkeypatch.setattr(robot.digitizer, "receive", lambda data: asked.append(data))
    frames = robot.frames(1.0)
    assert all(frame.words.doubtful.all() for frame in frames[60:])
    assert sum(bool(data) for data in asked) <= 2


def test_how_many_groups_there_are_follows_from_how_many_speak() -> None:
    groups, who = Groups(800, 50, 0.01), np.zeros(800, np.bool_)

    def asked(turn: int, *speakers: int) -> int:
        for each in speakers:
            groups.take(turn, each, who)
        return groups.wanted_log2

    assert asked(0, 50, 51, 50, 51) == 0  # one frame is a disturbance
    assert asked(0, 100, 100) == 2  # 25 of 40 each; 50 would be more than is to be filled
    assert asked(4, 20, 30) == 2  # as wanted
    assert asked(4, 60, 60) == 3
    assert asked(8, 300, 300) == 4
    assert asked(16, *[60] * 99) == 4  # there are no more
    round_and_rest = round(CALM_S / 0.01 + 20)
    who[15:64:16] = True  # four of this group speak in every round, others once
    assert asked(16, *[12] * round_and_rest) == 4
    who[:] = False
    assert asked(16, *[12] * round_and_rest) == 3  # what was kept until now does not come at once
    assert [asked(1 << log2, *[12] * (1 << log2)) for log2 in (3, 2, 1)] == [2, 1, 0]


def test_one_of_four_groups_whose_codes_are_not_told_apart_divides_all() -> None:
    groups, who = Groups(80, 31, 0.01), np.zeros(80, np.bool_)
    for frame in range(16):
        assert groups.wanted_log2 == (3 if frame > 7 else 0)
        groups.take(4 + frame % 4, 20, who, crowded=frame % 4 == 3)
    for frame in range(round(2 * CALM_S / 0.01)):  # and for longer than where they are too many
        assert groups.wanted_log2 == 3
        groups.take(8 + frame % 8, 1, who)


@pytest.mark.parametrize("turn", [0, 2, 3, 5, 16, 31])
def test_every_node_has_one_turn(turn: int) -> None:
    groups = groups_of(turn)
    waits = [out_of_turn(groups + g if turn else 0, 100) for g in range(groups)]
    assert (np.sum(~np.array(waits), axis=0) == 1).all()
    number = np.flatnonzero(~out_of_turn(turn, 100))[0] + 1
    assert not turn or number % groups == turn - groups
