# SPDX-License-Identifier: Apache-2.0

"""The digitizer's C core: commands, reports, pulses, a slow host, overruns."""

import ctypes
import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.driver.timeline import sample_count
from tactile_cdma.wire._protocol import (
    SYNC_FRAME,
    SYNC_LEAD,
    SYNC_RESTART,
    SYNC_UNIT_US,
    TURN_MOST_LOG2,
    PacketType,
    Result,
    SyncMode,
    SyncWire,
)
from tactile_cdma.wire.messages import (
    Ack,
    Ask,
    Configure,
    FrameLayout,
    GetInfo,
    Groups,
    Info,
    Number,
    Pack,
    Packet,
    Quiet,
    Samples,
    Start,
    Status,
    Stop,
)
from tactile_cdma.wire.packets import PacketParser, PacketWriter, wrap
from test.support.core_digitizer import Board, CoreDigitizer, Pulse, of_kind, streaming
from test.support.examples import examples

LAYOUT = FrameLayout.of(FrameSpec(scramble=True), 4)
REFUSED = Result.UNSUPPORTED


@pytest.fixture
def digitizer(core: ctypes.CDLL) -> CoreDigitizer:
    return CoreDigitizer(core)


def awake(digitizer: CoreDigitizer) -> CoreDigitizer:
    """A digitizer whose reports of power-up have been read."""
    digitizer.time(0)
    assert [type(packet) for packet in digitizer.packets()] == [Info, Status]
    return digitizer


def answers(digitizer: CoreDigitizer, *commands: Any) -> list[Packet]:
    digitizer.send(*commands)
    return digitizer.packets()


def samples_of(digitizer: CoreDigitizer, size: int) -> list[Packet]:
    digitizer.samples(np.arange(size) % 4096)
    return digitizer.packets(Samples)


# Conversation


def test_it_begins_with_a_delimiter_and_says_what_it_is(digitizer: CoreDigitizer) -> None:
    assert digitizer.take(1) == b"\0"
    digitizer.time(0)
    info, status = digitizer.packets()
    assert info == Info(
        frame=LAYOUT,
        sample_rate_uhz=80_000_000_000,
        volts_per_count=2**-10,
        zero_count=2048,
        min_count=0,
        max_count=4095,
        sync_mode=SyncMode.DRIVE,
        digitizer_id=b"core\0\1\2\3",
        firmware_major=1,
    )
    assert status == Status(0)
    assert [info.sequence, status.sequence] == [0, 1]


def test_every_command_is_acknowledged_once_and_in_order(digitizer: CoreDigitizer) -> None:
    awake(digitizer)
    digitizer.writer.sequence = 65_534
    got = answers(digitizer, Configure(LAYOUT), GetInfo(), Start(), Pack(), Stop(), Stop())
    assert [(a.command, a.command_sequence, a.result) for a in of_kind(got, Ack)] == [
        (PacketType.CONFIGURE, 65_534, Result.OK),
        (PacketType.GET_INFO, 65_535, Result.OK),
        (PacketType.START, 0, Result.OK),
        (PacketType.PACK, 1, Result.OK),
        (PacketType.STOP, 2, Result.OK),
        (PacketType.STOP, 3, Result.OK),
    ]
    assert [type(packet) for packet in got] == [Ack, Info, Ack, Info, Ack, Ack, Ack, Ack]


def test_a_command_that_comes_twice_is_obeyed_and_answered_twice(digitizer: CoreDigitizer) -> None:
    start = PacketWriter(7).encode(Start())
    awake(digitizer).receive(start + start)
    assert digitizer.packets() == [Ack(PacketType.START, 7), Ack(PacketType.START, 7)]
    assert digitizer.running


def test_what_is_set_is_reported_back(digitizer: CoreDigitizer) -> None:
    frame = replace(
        LAYOUT, nodes=900, first_row=3, sign_seed=77, order=64, chip_ns=20_000, drive=1, polarity=-1
    )
    asked = Configure(frame, SyncMode.HEAR, True, 123_456)
    _, info = answers(awake(digitizer), asked)
    assert (info.frame, info.integrated, info.quiet_uv) == (frame, True, 123_456)
    assert info.sync_mode == SyncMode.DRIVE  # which it takes HEAR for
    assert info.sample_rate_uhz == 50_000 * 10**6  # of chips
    # Means are in eighths of a count.
    assert (info.volts_per_count, info.zero_count) == (2**-13, 8 * 2048)
    assert (info.min_count, info.max_count) == (0, 8 * 4095)
    assert answers(digitizer, GetInfo())[1] == info


def test_sync_on_the_data_wire_is_told_and_ends_with_the_next_configure(
    digitizer: CoreDigitizer,
) -> None:
    """A CONFIGURE without the field, as older hosts send it, means a wire of its own."""
    _, info = answers(awake(digitizer), Configure(LAYOUT, sync_wire=SyncWire.DATA))
    assert info.sync_wire == SyncWire.DATA
    _, info = answers(digitizer, Configure(LAYOUT))
    assert info.sync_wire == SyncWire.OWN


def test_without_marks_there_is_no_data_wire_to_pull(digitizer: CoreDigitizer) -> None:
    gap = Configure(LAYOUT, SyncMode.NONE, sync_wire=SyncWire.DATA)
    ack, info = answers(awake(digitizer), gap)
    assert (ack.result, info.sync_wire) == (Result.UNSUPPORTED, SyncWire.OWN)


BAD = [
    (wrap(b"\x81\1\0X"), PacketType.GET_INFO, Result.BAD_LENGTH),
    (wrap(b"\x82\1\0X"), PacketType.START, Result.BAD_LENGTH),
    (wrap(b"\x83\1\0" + bytes(16_401)), PacketType.STOP, Result.BAD_LENGTH),
    (wrap(b"\x84\1\0" + bytes(35)), PacketType.CONFIGURE, Result.BAD_LENGTH),
    (wrap(b"\x84\1\0" + bytes(38)), PacketType.CONFIGURE, Result.BAD_LENGTH),
    (wrap(b"\x86\1\0X"), PacketType.PACK, Result.BAD_LENGTH),
    (wrap(b"\x84\1\0" + bytes(36)), PacketType.CONFIGURE, Result.OUT_OF_RANGE),
    (wrap(b"\x80\1\0"), 0x80, Result.UNKNOWN_COMMAND),
    (wrap(b"\xff\1\0" + bytes(900)), 0xFF, Result.UNKNOWN_COMMAND),
]


@pytest.mark.parametrize(("wire", "command", "result"), BAD)
def test_a_bad_command_is_refused_and_changes_nothing(
    digitizer: CoreDigitizer, wire: bytes, command: int, result: Result
) -> None:
    answers(awake(digitizer), Start())
    digitizer.receive(wire)
    assert digitizer.packets() == [Ack(command, 1, result)]
    assert digitizer.running
    status = digitizer.status()
    assert (status.commands_refused, status.command_errors, status.streaming) == (1, 0, True)


@examples(60)
@given(st.lists(st.binary(max_size=60), max_size=6), st.integers(1, 50))
def test_whatever_is_received_is_answered_or_counted(
    core: ctypes.CDLL, bodies: list[bytes], piece: int
) -> None:
    digitizer = awake(CoreDigitizer(core))
    data = b"".join(wrap(body) if body[:1] > b"@" else body + b"\0" for body in bodies)
    for start in range(0, len(data), piece):
        digitizer.receive(data[start : start + piece])
    acks = digitizer.packets(Ack)
    runs = sum(1 for run in data.split(b"\0") if run)
    status = digitizer.status()
    assert len(acks) + status.command_errors == runs
    assert status.commands_refused == sum(ack.result != Result.OK for ack in acks)


def test_its_own_packets_coming_back_are_errors(digitizer: CoreDigitizer) -> None:
    awake(digitizer).receive(PacketWriter().encode(Status(0)))
    assert digitizer.status().command_errors == 1


def test_reports_come_each_second_streaming_or_not(digitizer: CoreDigitizer) -> None:
    awake(digitizer)
    times = []
    for now_us in range(0, 5_000_000, 130_000):
        digitizer.time(now_us)
        if now_us == 2_600_000:
            digitizer.send(Start())
        reports = digitizer.packets(Info, Status)
        assert [type(packet) for packet in reports] in ([], [Info, Status])
        times += [(s.uptime_us, s.streaming) for s in of_kind(reports, Status)]
    assert times == [(1_040_000, False), (2_080_000, False), (3_120_000, True), (4_030_000, True)]
    digitizer.time(60_500_000)  # nobody asked for long
    digitizer.time(60_900_000)
    assert len(digitizer.packets(Status)) == 1
    digitizer.time(61_000_000)
    assert len(digitizer.packets(Status)) == 1


def test_start_begins_anew_and_stop_ends(digitizer: CoreDigitizer) -> None:
    assert not samples_of(digitizer, 1000)
    digitizer.now_us = 3_000_000
    digitizer.send(Start())
    first = samples_of(digitizer, 900)
    assert [packet.first_index for packet in first] == [0, 80]
    assert first[0].device_time_us == 3_000_006
    digitizer.now_us = 4_000_000
    digitizer.send(Start())
    again = samples_of(digitizer, 900)
    assert [packet.first_index for packet in again] == [0, 80]
    assert again[0].device_time_us == 4_000_006
    digitizer.send(Stop())
    assert not digitizer.running
    assert not samples_of(digitizer, 1000)


def test_a_refused_configure_leaves_the_stream_alone(digitizer: CoreDigitizer) -> None:
    digitizer.send(Start())
    digitizer.samples(np.zeros(100))
    digitizer.packets()
    impossible = Configure(replace(LAYOUT, chip_ns=1000))
    ack, info = answers(digitizer, impossible)
    assert (ack.result, info.frame) == (REFUSED, LAYOUT)
    assert digitizer.running
    (packet,) = samples_of(digitizer, 792)
    assert packet.first_index == 80
    digitizer.send(Configure(LAYOUT))
    assert not digitizer.running


def test_the_board_is_told_once_of_every_change(
    core: ctypes.CDLL, digitizer: CoreDigitizer
) -> None:
    for command, changes in (
        (Stop(), False),
        (Start(), True),
        (Start(), True),
        (GetInfo(), False),
        (of_frame(chip_ns=1000), False),
        (Stop(), True),
        (of_frame(), False),
        (Start(), True),
        (of_frame(), True),
    ):
        data = digitizer.writer.encode(command)
        core.dg_receive(digitizer._shim, data, len(data), 0)
        told = [core.dg_restarted(digitizer._shim) for _ in range(2)]
        assert told == [changes, False]
    assert not digitizer.running


def test_samples_before_the_stream_begins_are_none_of_it(
    core: ctypes.CDLL, digitizer: CoreDigitizer
) -> None:
    data = digitizer.writer.encode(Start())
    core.dg_receive(digitizer._shim, data, len(data), 0)
    assert digitizer.running
    digitizer.samples(np.zeros(500))
    digitizer.lost(5)
    assert core.dg_restarted(digitizer._shim)
    assert not core.dg_restarted(digitizer._shim)
    core.dg_begin(digitizer._shim, 0)
    assert samples_of(digitizer, 80)[0].first_index == 0


# What it can do


def accepts(core: ctypes.CDLL, *asked: Configure, **board: Any) -> list[bool]:
    digitizer = awake(CoreDigitizer(core, Board.of(**board)))
    results = digitizer.results(*asked)
    assert set(results) <= {Result.OK, REFUSED}
    return [result == Result.OK for result in results]


def of_frame(
    sync: SyncMode = SyncMode.DRIVE, integrated: bool = False, **changes: Any
) -> Configure:
    return Configure(replace(LAYOUT, **changes), sync, integrated)


def test_rates_are_those_of_the_converter(core: ctypes.CDLL) -> None:
    # 50 µs are 2400 ticks; the converter takes 96 to 65,536.
    raw = [of_frame(samples_per_chip=n) for n in (1, 24, 25, 26, 1000)]
    assert accepts(core, *raw) == [True, True, True, False, False]
    slow = [
        of_frame(chip_ns=ns, samples_per_chip=1, frame_period_us=4_000_000)
        for ns in (1_365_333, 1_365_344)  # 65,536 and 65,537 ticks
    ]
    assert accepts(core, *slow) == [True, False]


def test_a_rate_is_right_to_one_percent(core: ctypes.CDLL) -> None:
    chips = range(30_000, 34_000, 61)  # 14.4 to 16.3 ticks per sample
    asked = [of_frame(chip_ns=ns, samples_per_chip=100) for ns in chips]
    wanted = [ns * 48 / 1000 / 100 for ns in chips]
    right = [abs(round(ticks) - ticks) <= 0.01 * ticks for ticks in wanted]
    assert {True, False} == set(right)
    assert accepts(core, *asked, min_ticks=8) == right


def test_means_take_all_that_the_converter_gives(core: ctypes.CDLL) -> None:
    digitizer = CoreDigitizer(core)
    for chip_ns, least, ticks in (
        (50_000, 1, 96),  # 25 to a chip
        (50_000, 25, 96),
        (53_000, 1, 97),  # 2544 ticks: 26 to a chip
        (20_833, 1, 99),  # 999.98 ticks: 10 to a chip
        (1_000_000_000, 1, 11_718),  # no more than 4096
    ):
        period_us = max(12_800, 201 * chip_ns // 1000)
        frame = replace(LAYOUT, chip_ns=chip_ns, samples_per_chip=least, frame_period_us=period_us)
        assert digitizer.results(Configure(frame, integrated=True)) == [Result.OK]
        assert digitizer.ticks_per_sample == ticks
    assert accepts(core, of_frame(integrated=True, samples_per_chip=26)) == [False]
    slow = of_frame(integrated=True, chip_ns=1_000_000_000, frame_period_us=201_000_000)
    assert accepts(core, slow, max_ticks=11_718) == [True]
    assert accepts(core, slow, max_ticks=11_717) == [False]


def test_frames_must_fit_their_period_and_leave_time_for_pulses(core: ctypes.CDLL) -> None:
    assert accepts(core, of_frame(frame_period_us=10_000), of_frame(frame_period_us=9_999)) == [
        True,
        False,
    ]
    third_ns = -(-2 * SYNC_LEAD * SYNC_UNIT_US * 1000 // 3)
    slots: dict[str, Any] = {"resync_chips": 2, "chip_ns": third_ns, "frame_period_us": 100_000}
    short, long = (of_frame(**slots, guard_chips=chips) for chips in (0, 1))
    assert accepts(core, short, long) == [False, True]
    # Whose last sub-slot is one chip long: the frame's end is close behind its pulse.
    last: dict[str, Any] = {"resync_chips": 199, "guard_chips": 1}
    ends = [of_frame(**last, frame_period_us=10_000 + us) for us in (49, 50, 127, 128)]
    assert accepts(core, *ends) == [False, False, False, True]
    even = of_frame(resync_chips=100, guard_chips=1, frame_period_us=10_110)
    assert accepts(core, even) == [True]  # its last sub-slot is as long as the first
    one: dict[str, Any] = {"order": 1, "bits": 8, "chip_ns": 10_000, "resync_chips": 8}
    assert accepts(core, of_frame(**one)) == [True]  # which has no pulse within the frame
    tiny: dict[str, Any] = {"order": 1, "bits": 8, "chip_ns": 10_000}
    assert accepts(
        core,
        of_frame(**tiny, frame_period_us=127),
        of_frame(**tiny, frame_period_us=128),
        of_frame(**tiny, frame_period_us=80, sync=SyncMode.NONE),
    ) == [False, True, True]


def test_what_needs_marks_needs_marks(core: ctypes.CDLL) -> None:
    unmarked = SyncMode.NONE
    resync: dict[str, Any] = {"resync_chips": 50, "guard_chips": 1}
    assert accepts(
        core,
        of_frame(unmarked),
        of_frame(unmarked, integrated=True),
        of_frame(unmarked, **resync),
        of_frame(**resync),
    ) == [True, False, False, True]


def test_the_largest_and_the_strangest_layouts_do_no_harm(core: ctypes.CDLL) -> None:
    huge: dict[str, Any] = {"bits": 16, "parity": True, "order": 65_536, "chip_ns": 1_000_000_000}
    guards: dict[str, Any] = {"resync_chips": 1, "guard_chips": 255}
    longest: dict[str, Any] = {"frame_period_us": 2**32 - 1, "samples_per_chip": 65_535}
    assert accepts(core, of_frame(**huge, **guards, **longest)) == [False]
    assert accepts(core, of_frame(**longest, integrated=True)) == [False]
    assert accepts(core, of_frame(chip_ns=10)) == [False]


# Pulses


@pytest.mark.parametrize("integrated", [False, True])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"chip_ns": 48_611, "frame_period_us": 12_347},
        {"resync_chips": 32, "guard_chips": 4, "frame_period_us": 14_001},
        {"resync_chips": 32, "guard_chips": 3, "frame_period_us": 14_001, "chip_ns": 51_237},
        {"resync_chips": 199, "guard_chips": 1, "frame_period_us": 20_000},
        {"resync_chips": 200, "guard_chips": 9, "frame_period_us": 20_000},
        {"order": 2, "bits": 8, "resync_chips": 8, "guard_chips": 0},
    ],
)
def test_pulses_lead_frames_and_restarts(
    core: ctypes.CDLL, changes: dict[str, int], integrated: bool
) -> None:
    asked = of_frame(integrated=integrated, **changes)
    digitizer = streaming(core, asked)
    frame = asked.frame
    sample = digitizer.ticks_per_sample
    first = -(-48_000 // sample) * sample
    chips = frame.bits * frame.order
    expected = []
    for number in range(4):
        mark = first + number * frame.frame_period_us * 48
        expected.append(Pulse(mark - 64 * 48, SYNC_FRAME))
        for chip in range(frame.resync_chips or chips, chips, frame.resync_chips or chips):
            place = chip + chip // frame.resync_chips * frame.guard_chips
            tick = mark + (place * frame.chip_ns * 48 + 500) // 1000
            expected.append(Pulse(tick - 64 * 48, SYNC_RESTART))
    assert digitizer.pulses(len(expected)) == expected
    assert expected[0].announces == first


def test_there_are_no_pulses_where_there_is_no_stream_or_no_mark(core: ctypes.CDLL) -> None:
    digitizer = CoreDigitizer(core)
    assert not digitizer.pulses(1)
    digitizer.send(Start())
    assert len(digitizer.pulses(9)) == 9
    digitizer.send(Stop())
    assert not digitizer.pulses(1)
    digitizer.send(of_frame(SyncMode.NONE), Start())
    assert not digitizer.pulses(1)
    digitizer.send(of_frame(), Start())
    assert digitizer.pulses(1) == [Pulse(48_000 - 64 * 48, SYNC_FRAME)]


def begun(core: ctypes.CDLL, **changes: int) -> CoreDigitizer:
    """A digitizer whose first frame is announced."""
    digitizer = streaming(core, of_frame(**changes))
    digitizer.samples(np.zeros(80))
    digitizer.pulses(1)
    return digitizer


def turn_of(digitizer: CoreDigitizer) -> int:
    """The digits before the next frame's pulse."""
    digits = []
    while (pulse := digitizer.pulses(1)[0]).units == SYNC_RESTART:
        digits.append(pulse.tick)
    assert pulse.units == SYNC_FRAME
    places = [(pulse.tick - tick) / (48 * 128) - 1 for tick in digits]
    assert all(place.is_integer() for place in places)
    digitizer.samples(np.zeros(1024))
    return sum(1 << round(place) for place in places)


def test_turns_are_told_in_binary_before_the_frame(core: ctypes.CDLL) -> None:
    """From the page: digit d of G + g, (d + 1) · 128 µs before the frame's pulse, 16 µs long."""
    digitizer, turns = begun(core), []
    for log2 in (3, 3, 1, 4, 0):
        digitizer.send(Groups(log2))
        turns += [turn_of(digitizer) for _ in range(2**log2 + 1)]
    assert turns[:18] == [*range(8, 16), 8, *range(9, 16), 8, 9]
    assert turns[18:21] == [2, 3, 2]
    assert turns[21:38] == [*range(16, 32), 16]
    assert turns[38:] == [0, 0]
    told = [p.turn for p in digitizer.packets(Samples) if p.sync]
    assert told[1:] == turns[: len(told) - 1]


@pytest.mark.parametrize(("command", "gap_us"), [(Groups, 832), (Ask, 960)])
def test_what_nodes_could_not_hear_is_refused(
    core: ctypes.CDLL, command: type[Groups | Ask], gap_us: int
) -> None:
    digitizer = CoreDigitizer(core)
    frame_us = LAYOUT.order * LAYOUT.bits * LAYOUT.chip_ns // 1000
    assert digitizer.results(command(1), Start(), command(4)) == [REFUSED, Result.OK, Result.OK]
    for asked, result in (
        (of_frame(SyncMode.NONE), REFUSED),
        (of_frame(frame_period_us=frame_us + gap_us - 1), REFUSED),
        (of_frame(frame_period_us=frame_us + gap_us), Result.OK),
    ):
        assert digitizer.results(asked, Start(), command(1)) == [Result.OK, Result.OK, result]
    digitizer.receive(wrap(bytes([command.TYPE, 1, 0, TURN_MOST_LOG2 + 1])))
    assert digitizer.packets()[-1].result == Result.OUT_OF_RANGE


def test_a_stream_begins_with_one_group(digitizer: CoreDigitizer) -> None:
    digitizer.send(Start(), Groups(1))
    digitizer.pulses(10)
    assert [pulse.units for pulse in digitizer.pulses(2)] != [SYNC_FRAME] * 2
    digitizer.send(Start())
    assert [pulse.units for pulse in digitizer.pulses(2)] == [SYNC_FRAME] * 2


def test_digit_5_asks_all_to_speak(core: ctypes.CDLL) -> None:
    """In one frame, or by turns; in the groups there are, if these are more; once."""
    digitizer, turns = begun(core), []
    for command, frames in ((Ask(0), 3), (Ask(2), 6), (Groups(1), 3), (Ask(0), 4), (Ask(2), 6)):
        digitizer.send(command)
        turns += [turn_of(digitizer) for _ in range(frames)]
    ask = 32
    assert turns[:3] == [ask, 0, 0]
    assert turns[3:9] == [ask + 4, ask + 5, ask + 6, ask + 7, 0, 0]
    assert turns[9:16] == [2, 3, 2, ask + 2, ask + 3, 2, 3]
    assert turns[16:] == [ask + 4, ask + 5, ask + 6, ask + 7, 2, 3]
    told = [(p.turn, p.asked) for p in digitizer.packets(Samples) if p.sync]
    assert told[1:] == [(turn & 31, turn >= ask) for turn in turns[: len(told) - 1]]
    digitizer.send(Ask(4), Start())  # nobody is asked in another stream
    assert [pulse.units for pulse in digitizer.pulses(2)] == [SYNC_FRAME] * 2


def test_a_request_to_speak_waits_for_a_number(core: ctypes.CDLL) -> None:
    """Digit 5 is a number's then: of 1 as of 3."""
    digitizer = begun(core, frame_period_us=15_000)
    assert digitizer.results(Number(3), Ask(0)) == [Result.OK, Result.OK]
    assert [turn_of(digitizer) for _ in range(3)] == [3 << 5 | 1] * 3
    assert not any(p.asked for p in digitizer.packets(Samples) if p.sync)
    digitizer.send(Number(0))
    assert [turn_of(digitizer) for _ in range(2)] == [32, 0]


# A slow host


def test_packets_without_room_are_dropped_whole_and_told_of(core: ctypes.CDLL) -> None:
    digitizer = CoreDigitizer(core, capacity=900, output=6000)
    digitizer.send(Start())
    digitizer.samples(np.full(80, 2048))
    for _ in range(20):  # 20 frames at 2 kB: the host reads nothing
        digitizer.samples(np.arange(1024))
    digitizer.time(1_000_000)
    digitizer.send(GetInfo(), Stop())
    got = digitizer.packets()
    assert [type(packet) for packet in got[-5:]] == [Info, Status, Ack, Info, Ack]
    sent = of_kind(got, Samples)
    status = of_kind(got, Status)[-1]
    made = [0, *(80 + 1024 * n + part for n in range(20) for part in (0, 812))]
    indices = [packet.first_index for packet in sent]
    assert indices[:5] == made[:5]  # the oldest are kept
    assert set(indices) < set(made)
    assert not any(packet.overrun for packet in sent)
    assert status.packets_dropped == len(made) - len(sent) > 30
    assert digitizer.parser.counters.lost_packets == status.packets_dropped


def test_a_host_that_was_away_for_long_is_answered(core: ctypes.CDLL) -> None:
    """Reports leave room for answers when samples have filled the ring."""
    digitizer = CoreDigitizer(core, capacity=900, output=6000)
    digitizer.send(Start())
    digitizer.samples(np.arange(20 * 1024) % 4096)
    for second in range(1, 60):
        digitizer.time(second * 1_000_000)
    digitizer.send(Configure(LAYOUT), GetInfo(), Start())
    assert [type(packet) for packet in digitizer.packets()[-5:]] == [Ack, Info, Ack, Info, Ack]


def test_reports_that_find_no_room_are_counted_too(core: ctypes.CDLL) -> None:
    digitizer = CoreDigitizer(core, capacity=16, output=2000)
    for _ in range(100):
        digitizer.send(GetInfo())
    got, status = digitizer.packets(), digitizer.status()
    assert len(of_kind(got, Ack)) < 100
    assert len(got) + status.packets_dropped == 2 * 100 + 2


@examples(40)
@given(st.lists(st.integers(0, 3000), min_size=1, max_size=12), st.integers(0, 3))
def test_what_is_sent_is_whole_however_it_is_taken(
    core: ctypes.CDLL, takes: list[int], quick: int
) -> None:
    digitizer = CoreDigitizer(core, capacity=300, output=3000)
    digitizer.send(Start())
    parser, noise = PacketParser(), np.random.default_rng(len(takes))
    for turn, most in enumerate(itertools.islice(itertools.cycle(takes), 60)):
        digitizer.samples(noise.integers(0, 4096, 200))
        digitizer.time(turn * 100_000)
        parser.feed(digitizer.take(most + quick * 400))
    parser.feed(digitizer.take())
    digitizer.time(100_000_000)
    status = of_kind(parser.feed(digitizer.take()), Status)[-1]
    seen = parser.counters
    assert not seen.crc_errors + seen.framing_errors + seen.malformed + seen.jumps
    assert seen.lost_packets == status.packets_dropped


def test_packets_may_end_where_the_ring_ends(core: ctypes.CDLL) -> None:
    for size in range(1300, 1400):
        digitizer = CoreDigitizer(core, capacity=16, output=size)
        for _ in range(30):
            digitizer.send(GetInfo())
            digitizer.packets()
        assert digitizer.parser.counters.packets == 2 + 2 * 30


def test_the_sequence_wraps(digitizer: CoreDigitizer) -> None:
    digitizer.set_sequence(65_530)
    digitizer.send(Start())
    samples_of(digitizer, 20_000)
    assert digitizer.parser.counters.packets > 10
    assert digitizer.parser.counters.lost_packets == digitizer.parser.counters.jumps == 0


# Overruns


def test_a_frame_with_a_hole_is_never_quiet(core: ctypes.CDLL) -> None:
    digitizer = streaming(core, Configure(LAYOUT, quiet_uv=100_000))
    digitizer.samples(np.full(80 + 1024, 2048))
    digitizer.samples(np.full(300, 2048))
    digitizer.lost(1)
    digitizer.samples(np.full(511 + 100, 2048))
    digitizer.lost(12)  # in the gap, which nobody waits for after such a frame
    digitizer.samples(np.full(100 + 812 + 50, 2048))
    digitizer.lost(62)  # in a gap that might have been one QUIET
    digitizer.samples(np.full(100 + 1024, 2048))
    got = digitizer.packets(Samples, Quiet)
    sizes = [(type(p), p.first_index, sample_count(p)) for p in got]
    assert sizes == [
        (Quiet, 0, 80),
        (Quiet, 80, 812),
        (Quiet, 892, 212),
        (Samples, 1104, 300),
        (Samples, 1405, 511),
        (Quiet, 1916, 100),
        (Quiet, 2028, 100),
        (Quiet, 2128, 812),
        (Quiet, 2940, 50),
        (Quiet, 3052, 100),
        (Quiet, 3152, 812),
    ]
    assert [p.first_index for p in got if p.overrun] == [1405, 2028, 3052]
    assert [p.first_index for p in got if p.sync] == [80, 1104, 2128, 3152]
