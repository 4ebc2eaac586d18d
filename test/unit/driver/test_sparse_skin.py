# SPDX-License-Identifier: Apache-2.0

"""Skins of more nodes than chips: words against what was sent, and groups of nodes by turns."""

import math
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_cdma.base.arrays import Bools, Floats, Floats32
from tactile_cdma.commands.calibrate import read_recording
from tactile_cdma.commands.cli import main
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver import checkup
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.driver.vitals import Vitals
from tactile_cdma.framing.load import Load, capacity, groups_for_all
from tactile_cdma.readings.status import Status
from tactile_cdma.recording.offline import RawCapture
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.line import Disturbance, Waveform
from tactile_cdma.sim.nodes import NodeFrame
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.scene import SCENES, SkinGeometry
from tactile_cdma.wire.messages import Groups as AskGroups
from tactile_cdma.wire.packets import PacketWriter
from tactile_cdma.words.groups import CALM_S, OVERLOADS, Groups, groups_of, out_of_turn
from test.support.hosts import Talk
from test.support.simulated import Truth, stream, truth_of

SKIN = {
    "codes": "sparse",
    "nodes": 400,
    "order": 96,
    "bits": 9,
    "parity": True,
    "chip_us": 5.0,
    "frame_period_ms": 8.0,
    "resync_chips": 96,
    "guard_chips": 20,
    "samples_per_chip": 1,
}


def test_how_many_speak_is_told_and_that_it_is_too_many() -> None:
    config, vitals = SkinConfig.of(SKIN), Vitals()
    most = capacity(config.spec)
    for url, frames in (("sim://?scene=moving", 40), ("sim://?scene=all&threshold=0", 10)):
        pipeline = Pipeline(config)
        vitals.take(pipeline)
        decoded = pipeline.feed(stream(config, url, frames), 0.0)
        truth = truth_of(config, url)
        speakers = [int(truth[frame.sequence].active.sum()) for frame in decoded]
        load, window = pipeline.load, vitals.take(pipeline)
        assert load is not None
        found = [each for each in checkup.stream(pipeline, window, None) if each.key == "overload"]
        if max(speakers) <= most:
            assert load == Load(most, speakers[-1], max(speakers), 0)
            assert not found
        else:
            assert load.now == pytest.approx(speakers[-1], rel=0.2)
            assert load.overloads == window.rises.overloads == len(decoded)
            assert f"{len(decoded)} frames are flagged" in found[0].text
            assert f"the {most} that their codes tell apart" in found[0].text


def test_what_is_in_doubt_is_no_reading_to_calibrate_by(tmp_path: Path) -> None:
    capture = tmp_path / "touch.raw"
    capture.write_bytes(stream(SkinConfig.of(SKIN), "sim://?scene=all&threshold=0", 10))
    assert np.isnan(read_recording(capture, SkinConfig.of(SKIN)).voltage_v).all()


def heard_of(frame: TactileFrame, true: NodeFrame) -> Bools:
    """Who spoke for certain, (n,); of what is certain nothing is wrong."""
    words, sure = frame.words, ~frame.words.doubtful
    assert np.array_equal(words.active[sure], true.active[sure])
    spoke: Bools = words.active & sure
    assert np.array_equal(words.codes[spoke], true.codes[spoke])
    return spoke


def assert_no_press_outlives_its_release(frames: list[TactileFrame], truth: Truth) -> None:
    for frame in frames:
        valid = frame.readings.status & (Status.LOW_SNR | Status.STALE) == 0
        pressed = np.nan_to_num(frame.readings.pressure_pa) > 5e3
        assert not (valid & pressed & (truth[frame.sequence].pressure_pa < 1)).any()


class NoiseEnds(Disturbance):
    """Noise of 1.14 amplitudes in the first 40 frames."""

    def added(self, frame: NodeFrame, edges_s: Floats) -> Iterator[Waveform]:
        return iter(())

    def disturbed(self, frame: NodeFrame, volts: Floats32, t_s: Floats) -> Floats32:
        noise_v = 0.342 * np.random.default_rng(frame.number).normal(size=volts.shape)
        return volts + np.float32(noise_v) if frame.number < 40 else volts


def test_a_node_that_speaks_as_noise_ends_is_not_claimed_to_be_silent() -> None:
    config, now_s = SkinConfig.of(SKIN | {"nodes": 100}), [0.0]
    options = SimOptions.from_url("sim://?scene=idle&heartbeat=100&noise=0.005")
    digitizer = VirtualDigitizer(options, lambda: now_s[0], NoiseEnds())
    digitizer.receive(Session(config).open())
    pipeline, truth = Pipeline(config), Truth(digitizer)
    for now_s[0] in np.arange(60) * config.spec.frame_period_s:
        digitizer.advance()
        for frame in pipeline.feed(digitizer.take(1 << 20), now_s[0]):
            heard_of(frame, truth[frame.sequence])
    assert not frame.words.doubtful.any() and pipeline.counters.frames > 55


def test_a_capture_that_begins_before_the_digitizer_was_set_is_decoded(tmp_path: Path) -> None:
    capture = tmp_path / "touch.raw"
    capture.write_bytes(stream(SkinConfig.of(SKIN), "sim://?scene=moving", 10))
    assert len(list(RawCapture(capture, {"amplitude_mv": 300.0}).frames())) >= 9


def test_info_tells_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "touch.skin"
    skin = "--codes sparse --nodes 120 --order 32 --samples-per-chip 1 --frame-period-ms 20"
    port = "sim://?scene=all&threshold=0"
    assert main(["record", port, str(path), "--seconds", "0.2", *skin.split()]) == 0
    capsys.readouterr()
    assert main(["info", str(path)]) == 0
    told = capsys.readouterr().out
    said = re.search(r"at once: (\d+) at most, capacity 13, (\d+) fr", told)
    assert "50 µs chips, sparse codes" in told
    assert said and 100 < int(said[1]) < 140 and int(said[2]) > 2


REPEATED = {"bits": 10, "parity": False, "nodes_repeat": True}
HUG_S, RELEASE_S = 0.4, 1.2


def hug(t_s: float, skin: SkinGeometry) -> NDArray[np.float64]:
    """From 0 to 100 % touched within one frame, and back."""
    count = len(skin.positions_m)
    return np.full(count, 30e3 if HUG_S <= t_s < RELEASE_S else 0.0) * np.linspace(0.5, 1, count)


class Robot(Talk):
    """A driver and its digitizer, in steps of a frame."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, speaks: str = "rest", **changes: int | float
    ) -> None:
        monkeypatch.setitem(SCENES, "press", hug)
        super().__init__("", SkinConfig.of({**SKIN, **REPEATED, **changes}))
        self.power_up(SimOptions.from_url(f"sim://?scene=press&seed=1&noise=0.01&speaks={speaks}"))
        self.open()

    def frames(self, until_s: float) -> list[TactileFrame]:
        period_s = self.config.spec.frame_period_s
        return self.go_on(period_s * math.ceil((until_s - self.now_s) / period_s), period_s)


def test_all_are_heard_within_a_round_and_none_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Robot(monkeypatch)
    frames = robot.frames(3.0)
    spec, truth = robot.config.spec, Truth(robot.digitizer)
    by_turns = [frame for frame in frames if truth[frame.sequence].turn]
    assert {groups_of(truth[frame.sequence].turn) for frame in by_turns} == {16, 8, 4, 2}
    heard_code = np.full(spec.nodes, -1)
    whole_from = None
    for frame in frames:
        true, status = truth[frame.sequence], frame.readings.status
        spoke = heard_of(frame, true)
        heard_code[spoke] = frame.words.codes[spoke]
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


def test_words_of_too_many_are_unknown_until_said_anew(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_groups_of_codes_too_alike_are_divided(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 80 nodes four groups of 20 are fewer than 64 chips tell apart, but one adds up to 0."""
    robot = Robot(monkeypatch, nodes=80, order=64, resync_chips=64)
    frames, truth = robot.frames(RELEASE_S), Truth(robot.digitizer)
    assert groups_for_all(robot.config.spec) == 8
    assert {groups_of(truth[frame.sequence].turn) for frame in frames} == {1, 4, 8}
    heard = np.zeros(80, np.bool_)
    for frame in frames:
        true = truth[frame.sequence]
        heard |= heard_of(frame, true) & (true.start_s > HUG_S)
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
    assert_no_press_outlives_its_release(frames, truth)


def test_frames_lost_as_groups_change_leave_none_certain(monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert_no_press_outlives_its_release(frames, truth)


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
