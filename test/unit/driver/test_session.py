# SPDX-License-Identifier: Apache-2.0

"""The conversation with a digitizer: who is accepted, what is repeated, recovery from any fault."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tactile_cdma.base.errors import ParameterError, SpecError
from tactile_cdma.commands.cli import main
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.digitizer import Origin, SourceWatch
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import PATIENCE_S, SOON_S, Session
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire._protocol import PacketType, Result, SyncMode
from tactile_cdma.wire.identity import is_simulated, parse_id, shown_id
from tactile_cdma.wire.introduction import described_info
from tactile_cdma.wire.messages import (
    Ack,
    Command,
    Configure,
    FrameLayout,
    GetInfo,
    Info,
    Pack,
    Packet,
    Samples,
    Start,
    Status,
    Stop,
)
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support import lost_frames
from test.support.boards import board, board_id, plugged
from test.support.hosts import CONFIG, Talk
from test.support.simulated import Truth

OPENING = [Configure, GetInfo, Start]


def test_a_digitizer_that_was_reset_is_started_at_once() -> None:
    talk = Talk("")
    talk.open()
    assert len(talk.go_on(0.5)) > 30
    talk.sent.clear()
    talk.digitizer = VirtualDigitizer(clock=lambda: talk.now_s)
    frames = talk.go_on(0.2)
    assert talk.sent == OPENING
    assert len(frames) > 12
    assert frames[0].t_start < talk.digitizer.started_s + 12.8e-3
    assert talk.session.problem is None


def test_a_digitizer_that_is_reset_in_the_handshake_is_started_soon() -> None:
    talk = Talk("")
    talk.open()
    talk.go_on(0.01)
    talk.digitizer = VirtualDigitizer(clock=lambda: talk.now_s)
    assert len(talk.go_on(2 * SOON_S + 0.2)) > 12


class Line:
    """A pipeline and a session that receive given packets at given times."""

    def __init__(self) -> None:
        self.pipeline, self.session = Pipeline(CONFIG), Session(CONFIG)
        self._writer = PacketWriter()
        self.session.open()

    def hears(self, now_s: float, *packets: Packet) -> bool:
        """Whether the digitizer is asked to stream after these packets."""
        self.pipeline.feed(b"".join(map(self._writer.encode, packets)), now_s)
        return bool(self.session.watch(self.pipeline, now_s))


def test_patience_begins_with_the_last_frame() -> None:
    """Not when the driver next looks, which may be later."""
    talk = Talk("")
    talk.open()
    talk.go_on(0.5)
    heard_s = talk.now_s + 0.01
    talk.now_s += 0.3
    talk.digitizer.advance()
    assert talk.pipeline.feed(talk.digitizer.take(1 << 20), talk.now_s)
    assert not talk.session.watch(talk.pipeline, talk.now_s, heard_s)
    assert talk.session.deadline_s == heard_s + PATIENCE_S


STARTED = Ack(command=Start.TYPE, command_sequence=2)
IDLE = Status(uptime_us=5)


def test_a_status_that_crossed_start_on_the_wire_is_none_of_a_reset() -> None:
    line = Line()
    assert not line.hears(0.0, IDLE)
    assert not line.hears(0.5 * SOON_S, STARTED)
    assert not line.hears(2 * SOON_S)
    assert line.hears(3 * SOON_S, IDLE)  # this one came after START was obeyed


@pytest.mark.parametrize("answer", [(), (STARTED,)])
def test_one_that_never_streams_is_not_asked_without_end(answer: tuple[Ack, ...]) -> None:
    """It says so 100 times a second, whether it obeys or not."""
    line, asked = Line(), 0
    for count in range(300):
        asked += line.hears(count * 1e-2, *answer, Status(uptime_us=count))
    assert 3 / PATIENCE_S <= asked <= 3 / SOON_S
    line, asked = Line(), 0
    for second in range(30):  # and as the protocol has it
        asked += line.hears(second, *answer, Status(uptime_us=second))
    assert asked <= 30


@pytest.mark.parametrize(
    ("answer", "problem"),
    [
        (STARTED, "answers but sends no frames"),
        (replace(STARTED, result=Result.BUSY), "refused command 0x82: busy"),
    ],
)
def test_one_that_never_streams_is_named_though_asked_again(answer: Ack, problem: str) -> None:
    line = Line()
    line.hears(0.0, VirtualDigitizer().info())
    for tenth in range(1, 50):
        said = [Status(uptime_us=tenth)] if tenth % 9 == 0 else []
        if line.hears(0.1 * tenth, *said):
            line.hears(0.1 * tenth, answer)
    assert problem in (line.session.problem or "")


def test_other_bytes_after_packets_are_said() -> None:
    line = Line()
    line.hears(0.0, STARTED)
    line.pipeline.feed(PacketWriter().encode(VirtualDigitizer().info()), 0.1)
    assert not line.hears(0.1)
    assert line.hears(2.0)
    line.pipeline.feed(b"hello" * 100, 2.1)
    assert line.hears(4.0)
    assert "another device" in (line.session.problem or "")


def test_packing_is_asked_of_busy_links_and_may_be_refused() -> None:
    asked = PacketParser().feed(Session(SkinConfig.of(lost_frames.SKINS["900"])).open())
    assert [type(command) for command in asked] == [Configure, Pack, GetInfo, Start]
    assert [type(p) for p in PacketParser().feed(Session(CONFIG).open())] == OPENING
    # One of before: it refuses the command, and that is no problem of anybody's.
    talk = Talk("", SkinConfig.of(lost_frames.SKINS["900"]))
    talk.digitizer._obey = partial(without_pack, talk.digitizer, talk.digitizer._obey)
    talk.open()
    assert len(talk.go_on(0.5)) > 20
    assert talk.digitizer.commands_refused == 1
    assert talk.pipeline.digitizer.refusal is None
    assert talk.session.problem is None


def without_pack(
    digitizer: VirtualDigitizer, obey: Callable[[Command], None], command: Command
) -> None:
    if not isinstance(command, Pack):
        obey(command)
        return
    digitizer.commands_refused += 1
    digitizer._send(command.ack(Result.UNKNOWN_COMMAND))


SEPARATORS = ("", ":", "-", "_", ".", " ")
ids = st.binary(min_size=8, max_size=8).filter(any)


@given(ids, st.sampled_from(SEPARATORS), st.booleans(), st.booleans())
def test_an_id_is_known_however_it_is_written(
    number: bytes, separator: str, upper: bool, prefixed: bool
) -> None:
    text = separator.join(f"{byte:02x}" for byte in number)
    text = ("0x" if prefixed else "") + (text.upper() if upper else text)
    assert parse_id(text) == number
    assert parse_id(shown_id(number)) == number


@pytest.mark.parametrize("text", ["1234", "zz" * 8, "00" * 9, "sim", "1" * 15, "0x", "é" * 16])
def test_what_is_no_id_is_refused_naming_it(text: str) -> None:
    with pytest.raises(ParameterError, match="16 hexadecimal digits") as caught:
        SkinConfig.of({"digitizer_id": text})
    assert repr(text) in str(caught.value)


def test_zeros_name_no_board() -> None:
    with pytest.raises(ParameterError, match="boards without an id"):
        parse_id("00" * 8)
    assert shown_id(bytes(8)) == "no id"


def test_only_the_right_board_is_configured_started_and_stopped() -> None:
    talk = Talk(board_id(0))
    assert len(talk.exchange(1.5)) > 100
    assert talk.sent == [GetInfo, Configure, GetInfo, Start, Stop]
    assert talk.session.problem is None
    talk = Talk(board_id(5))
    assert talk.exchange(4.5) == []
    assert set(talk.sent) == {GetInfo}
    assert not talk.digitizer.streaming
    assert board_id(0) in (talk.session.problem or "")
    assert board_id(5) in (talk.session.problem or "")


def test_a_board_that_takes_the_place_of_another_on_an_open_port_is_judged_anew() -> None:
    talk = Talk(board_id(5))
    assert talk.exchange(2.5) == []
    talk.digitizer = VirtualDigitizer(SimOptions(seed=5), lambda: talk.now_s)
    assert len(talk.exchange(2.0)) > 100
    talk.digitizer = VirtualDigitizer(SimOptions(seed=6), lambda: talk.now_s)
    talk.exchange(1.5)  # until it has said who it is
    assert talk.exchange(3.0) == []
    assert board_id(6) in (talk.pipeline.problem or "")


def introduced(number: bytes) -> Info:
    """What a digitizer with this id says of itself."""
    return replace(VirtualDigitizer().info(), digitizer_id=number)


@given(ids, st.sampled_from(["/dev/ttyACM0", "replay://touch.skin", "socket://a:1"]))
def test_simulated_is_who_says_so_whatever_the_port(number: bytes, port: str) -> None:
    assume(number[6:] not in (b"\x01\xde", b"\x02\xde"))  # demonstrators, see below
    watch = SourceWatch(port)
    assert watch.source.measured_by is Origin.UNKNOWN, "nobody has spoken"
    assert watch.unasked is None
    watch.hear(introduced(number))
    simulated = number[:4] == b"sim\0"
    assert (watch.source.measured_by is Origin.SIMULATED) == simulated
    watch = SourceWatch(port)
    warnings = watch.hear(introduced(b"sim\0" + number[4:]))
    replayed = port.startswith("replay")
    assert watch.source.measured_by is Origin.SIMULATED
    assert watch.source.origin is (Origin.REPLAYED if replayed else Origin.SIMULATED)
    assert warnings == ([] if replayed else [watch.unasked])


@pytest.mark.parametrize("end", ["01DE", "02DE"])
def test_a_demonstrator_is_neither_a_board_nor_a_simulator(end: str) -> None:
    """Nor is it for hosts that do not know demonstrators: to them it is simulated."""
    number = bytes.fromhex("73696D00" + "ABCD" + end)
    watch = SourceWatch("/dev/ttyACM0")
    [warning] = watch.hear(introduced(number)) or []
    assert "made up" in warning and "demonstrator" in warning
    assert watch.source.origin is watch.source.measured_by is Origin.DEMONSTRATOR
    assert is_simulated(number), "as hosts before this one find out"
    assert {"01DE": "wired", "02DE": "nothing wired"}[end] in described_info(introduced(number))
    replay = SourceWatch("replay://touch.skin")
    assert replay.hear(introduced(number)) == []
    assert replay.source.origin is Origin.REPLAYED
    assert replay.source.measured_by is Origin.DEMONSTRATOR
    with pytest.raises(SpecError):
        SimOptions(seed=int.from_bytes(number[4:], "little"))


@pytest.mark.parametrize("port", ["sim://", "SIM://?scene=hand"])
def test_who_asks_for_the_simulator_by_name_is_not_warned(port: str) -> None:
    watch = SourceWatch(port)
    assert watch.hear(VirtualDigitizer().info()) == []
    assert watch.unasked is None
    assert watch.source.origin is Origin.SIMULATED


def test_another_digitizer_is_told_of_once_and_the_same_one_never() -> None:
    watch = SourceWatch("/dev/ttyACM0")
    first, second = (introduced(b"board..%d" % number) for number in (1, 2))
    assert watch.hear(first) == []
    assert watch.hear(replace(first, quiet_uv=7)) is None, "the same board, set otherwise"
    assert watch.take_exchange() is None
    [warning] = watch.hear(second) or []
    assert f"{shown_id(second.digitizer_id)}, before {shown_id(first.digitizer_id)}" in warning
    assert watch.hear(second) is None
    assert watch.take_exchange() == warning
    assert watch.take_exchange() is None
    assert watch.changes == 1
    [back] = watch.hear(introduced(bytes(8))) or []
    assert "no id, before" in back


def test_a_recording_is_of_the_right_board_only(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    params = tmp_path / "params.yaml"
    params.write_text(f'/**:\n  ros__parameters:\n    digitizer_id: "{board_id(2)}"\n')
    options = [str(tmp_path / "skin.raw"), "--params", str(params), "--seconds", "1.5", "--force"]
    with plugged(board(1)) as wrong, plugged(board(2)) as right:
        assert main(["record", right, *options]) == 0
        out = capsys.readouterr().out
        packets = int(out.split(" packets=")[1].split()[0])
        assert packets > 50  # it was started
        main(["record", wrong, *options])
        assert "wrong digitizer" in capsys.readouterr().err


SKINS = {"raw": {"samples_per_chip": 4}, "integrated": {"samples_per_chip": 1}}
SMALL = {"nodes": 3, "bits": 8, "chip_us": 100.0, "frame_period_ms": 40.0}
STEP_S = 0.01
RECOVERY_S = 3.0
"""A STATUS per second, an answer that is waited for, and what may have been under way."""
LOOK_S = 0.4


class Trial:
    """A line and both its ends, from power-up on."""

    def __init__(self, config: SkinConfig) -> None:
        self.config, self.now_s, self.frames = config, 50.0, list[TactileFrame]()
        self.pipeline, self.session = Pipeline(config), Session(config)
        self.deaf_until_s = self.mute_until_s = self.delay_s = 0.0
        self._under_way: deque[tuple[float, bytes]] = deque()
        self._sent = b""
        self.reset()
        self.ask(self.session.open())

    def reset(self) -> None:
        """The digitizer's power fails for a moment."""
        self.began_s = self.now_s
        options = SimOptions(scene="all", threshold=0, seed=int(self.now_s))
        self.digitizer = VirtualDigitizer(options, lambda: self.now_s)

    def ask(self, data: bytes) -> None:
        if self.now_s >= self.mute_until_s:
            self.digitizer.receive(data)

    def say(self, data: bytes) -> None:
        """These bytes are on their way to the host."""
        self._under_way.append((self.now_s + self.delay_s, data))

    def say_again(self, count: int) -> None:
        self.say(self._sent[-count:])

    def go_on(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.now_s += STEP_S
            self.digitizer.advance()
            data = self.digitizer.take(self.digitizer.pending)
            self._sent = (self._sent + data)[-4096:]
            if self.now_s >= self.deaf_until_s:
                self.say(data)
            while self._under_way and self._under_way[0][0] <= self.now_s:
                self.frames += self.pipeline.feed(self._under_way.popleft()[1], self.now_s)
            self.ask(self.session.watch(self.pipeline, self.now_s))

    def reconnect(self) -> None:
        """As the driver does when the port was gone."""
        self._under_way.clear()
        self.pipeline.reconnected()
        self.session = Session(self.config)
        self.ask(self.session.open())

    def deafen(self, seconds: float) -> None:
        """For so long nothing reaches the host."""
        self.deaf_until_s = self.now_s + seconds

    def mute(self, seconds: float) -> None:
        """For so long nothing that the host says is heard."""
        self.mute_until_s = self.now_s + seconds

    def delay(self, seconds: float) -> None:
        """Whatever is said from now on takes so long to the host."""
        self.delay_s = seconds

    def mend(self) -> None:
        self.deaf_until_s = self.mute_until_s = self.delay_s = 0.0


Event = tuple[Any, ...]
"""What happens: the name of a method of Trial, and what that is given."""


def _numbered(packets: st.SearchStrategy[Packet]) -> st.SearchStrategy[bytes]:
    """An intact packet of another sender, or of the same one with a wrong number."""
    numbers = st.sampled_from([0, 1, 60, 65_535])
    return st.builds(lambda n, p: b"\0" + PacketWriter(n).encode(p), numbers, packets)


def events(config: SkinConfig) -> st.SearchStrategy[Event]:
    layout = FrameLayout.of(config.spec, config.samples_per_chip)
    integrated = config.samples_per_chip == 1
    configure = Configure(layout, SyncMode.DRIVE, integrated)
    other = replace(configure, frame=replace(layout, bits=9))
    digitizer = VirtualDigitizer(SimOptions(), lambda: 0.0)
    digitizer.receive(PacketWriter().encode(configure))
    info = digitizer.info()
    infos = st.sampled_from(
        [
            info,
            replace(info, volts_per_count=0.0),
            replace(info, sample_rate_uhz=2 * info.sample_rate_uhz),
            replace(info, frame=other.frame),
            replace(info, version=9),
        ]
    )
    counts = np.arange(200, dtype=np.int16) * np.int16(97)
    samples = st.builds(
        Samples,
        st.sampled_from([0, 10**6, 2**52, 2**63]),
        st.sampled_from([0, 10_000, 2**53, 2**64 - 1]),
        st.just(counts),
        sync=st.booleans(),
    )
    statuses = st.builds(Status, st.sampled_from([0, 10**6, 2**63]), streaming=st.booleans())
    kinds = st.sampled_from([PacketType.START, PacketType.CONFIGURE, PacketType.PACK])
    acks = st.builds(Ack, kinds, st.just(0), st.sampled_from(Result))
    commands = st.sampled_from([Stop(), Start(), GetInfo(), configure, other])
    spans = st.sampled_from([0.02, 0.1, 0.5, 1.2])
    return st.one_of(
        st.tuples(st.just("go_on"), spans),
        st.tuples(st.sampled_from(["deafen", "mute"]), spans),
        st.tuples(st.just("delay"), st.sampled_from([0.0, 0.1, 1.5])),
        st.tuples(st.sampled_from(["reset", "reconnect"])),
        st.tuples(st.sampled_from(["say", "ask"]), st.binary(max_size=40)),
        st.tuples(st.just("say"), _numbered(st.one_of(infos, samples, statuses, acks))),
        st.tuples(st.just("ask"), _numbered(commands)),
        st.tuples(st.just("say_again"), st.sampled_from([50, 4096])),
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", SKINS)
@settings(max_examples=4)
@given(data=st.data())
def test_frames_come_again_by_themselves(name: str, data: st.DataObject) -> None:
    config = SkinConfig.of(SMALL | SKINS[name])
    talk = Trial(config)
    for happens, *arguments in data.draw(st.lists(events(config), max_size=12)):
        getattr(talk, happens)(*arguments)
    talk.mend()
    talk.go_on(RECOVERY_S)
    before, lost = len(talk.frames), talk.pipeline.counters.lost_frames
    talk.go_on(LOOK_S)
    frames = talk.frames[before:]
    assert len(frames) == pytest.approx(LOOK_S / config.spec.frame_period_s, abs=1)
    assert talk.pipeline.problem is None
    assert talk.pipeline.counters.lost_frames == lost
    truth = Truth(talk.digitizer)
    for frame in frames:
        since_s = frame.t_start - talk.digitizer.started_s
        true = truth[round(since_s / config.spec.frame_period_s)]
        assert since_s == pytest.approx(true.start_s, abs=config.spec.chip_s)
        assert np.array_equal(frame.words.active, true.active)
        assert np.array_equal(frame.words.codes, true.codes)
        assert frame.t_host - talk.began_s == pytest.approx(frame.t_middle, abs=2 * STEP_S)
    assert (np.diff([frame.sequence for frame in frames]) == 1).all()
    assert (np.diff([frame.t_host for frame in talk.frames]) > 0).all()
