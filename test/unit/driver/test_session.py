# SPDX-License-Identifier: Apache-2.0

"""The conversation with a digitizer: when commands are repeated, what is reported on failure."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.driver.session import PATIENCE_S, SOON_S, Session
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.wire._protocol import Result
from tactile_cdma.wire.messages import Ack, Command, Configure, GetInfo, Pack, Packet, Start, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.hosts import CONFIG, Talk

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
def test_one_that_never_streams_is_named_though_it_is_asked_again(
    answer: Ack, problem: str
) -> None:
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


THOUSAND = read_file(Path(__file__).resolve().parents[3] / "config" / "thousand_skin.yaml")


def test_a_busy_link_is_asked_to_pack() -> None:
    asked = PacketParser().feed(Session(SkinConfig.of(THOUSAND)).open())
    assert [type(command) for command in asked] == [Configure, Pack, GetInfo, Start]
    assert [type(p) for p in PacketParser().feed(Session(CONFIG).open())] == OPENING


def test_a_digitizer_that_cannot_pack_streams_all_the_same() -> None:
    """One of before: it refuses the command, and that is no problem of anybody's."""
    talk = Talk("", SkinConfig.of(THOUSAND))
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
