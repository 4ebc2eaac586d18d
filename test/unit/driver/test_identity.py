# SPDX-License-Identifier: Apache-2.0

"""Which digitizer is accepted: spellings of an id, and what is sent to the wrong board."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from benchmarks.line_packets import introduction, packets
from tactile_cdma.base.errors import ParameterError, SpecError
from tactile_cdma.commands.cli import main
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.digitizer import Origin, SourceWatch
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.identity import is_simulated, parse_id, shown_id
from tactile_cdma.wire.introduction import described_info
from tactile_cdma.wire.messages import Configure, GetInfo, Info, Start, Stop
from tactile_cdma.wire.packets import PacketWriter
from test.support.boards import board, board_id, plugged
from test.support.hosts import Talk
from test.support.independent_line import Digitizer, Line, Skin, render
from test.support.independent_line import Talk as Saying

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


def test_the_right_board_is_started_once_it_is_known() -> None:
    talk = Talk(board_id(0))
    assert len(talk.exchange(1.5)) > 100
    assert talk.sent == [GetInfo, Configure, GetInfo, Start, Stop]
    assert talk.session.problem is None


def test_a_wrong_board_is_neither_configured_nor_started_nor_stopped() -> None:
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


@pytest.fixture
def two_boards(tmp_path: Path) -> Iterator[tuple[str, str]]:
    """Ports of boards 1 and 2."""
    with plugged(board(1), tmp_path / "a") as first, plugged(board(2), tmp_path / "b") as second:
        yield first, second


def test_a_recording_is_of_the_right_board_only(
    two_boards: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    params = tmp_path / "params.yaml"
    params.write_text(f'/**:\n  ros__parameters:\n    digitizer_id: "{board_id(2)}"\n')
    options = [str(tmp_path / "skin.raw"), "--params", str(params), "--seconds", "1.5", "--force"]
    assert main(["record", two_boards[1], *options]) == 0
    out = capsys.readouterr().out
    packets = int(out.split(" packets=")[1].split()[0])
    assert packets > 50  # it was started
    main(["record", two_boards[0], *options])
    assert "wrong digitizer" in capsys.readouterr().err


def test_values_of_one_board_are_not_those_of_another() -> None:
    """It answers in mid-stream, on a cable that was moved: its nodes have not spoken yet."""
    config, digitizer, writer = SkinConfig.of({}), Digitizer(), PacketWriter()
    info, pipeline = introduction(config, digitizer), Pipeline(config)
    valid = []
    for number, share in ((1, 1.0), (2, 0.0)):
        said = render(Skin(), Saying(share=share), Line(), digitizer, 5, seed=1)
        pipeline.feed(writer.encode(replace(info, digitizer_id=bytes(7) + bytes([number]))), 0.0)
        length = said.runs[-1].first_index + said.runs[-1].counts.size
        offset = (number - 1) * length
        for _, t_host, data in packets(said, writer, offset, offset / digitizer.samples_per_chip):
            for frame in pipeline.feed(data, t_host):
                valid.append(np.isfinite(frame.readings.pressure_pa).all())
    assert valid[:5] == [True] * 5
    assert len(valid) >= 9 and not any(valid[5:])
