# SPDX-License-Identifier: Apache-2.0

"""Samples → packets in C, compared with the virtual digitizer and the rules in exact fractions."""

import ctypes
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.timeline import sample_count
from tactile_cdma.sim.nodes import Turns
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.packets import stream
from tactile_cdma.wire._protocol import (
    MAX_SAMPLES,
    SYNC_RESTART,
    TAIL_CHIPS,
    Drive,
    PacketType,
    Polarity,
    Signs,
    SyncMode,
)
from tactile_cdma.wire.messages import (
    Ask,
    Configure,
    FrameLayout,
    Groups,
    Pack,
    Quiet,
    Samples,
    Start,
)
from tactile_cdma.wire.packets import cobs_decode
from test.support.core_digitizer import Board, CoreDigitizer, of_kind, streaming
from test.support.examples import examples
from test.support.firmware import FIRMWARE

MIDDLE = 2048  # count of the middle of the converter's range, which the simulator calls 0
FIRST_MARK_US = 1000
START_US = 5_000_000


def place(packet: Samples | Quiet, index: int, time_us: int) -> Samples | Quiet:
    """The packet, later by this many samples and µs."""
    moved = {"first_index": packet.first_index + index}
    return replace(packet, device_time_us=packet.device_time_us + time_us, **moved)


# Options of the simulator; quiet_uv; kinds of packets, S or Q, of frames and of gaps.
SETUPS = {
    "usual": ("", 0, "S", "S"),
    "all talk": ("scene=all&threshold=0", 0, "S", "S"),
    "parity": ("parity=1", 0, "S", "S"),
    "other chips": ("samples_per_chip=6&chip_us=25&frame_period_ms=9", 0, "S", "S"),
    "resync": ("resync_chips=32&guard_chips=4&frame_period_ms=20&clock_spread=0.005", 0, "S", "S"),
    "long frames": ("nodes=200&chip_us=20&frame_period_ms=60", 0, "S", "S"),
    "no gap": ("chip_us=60&frame_period_ms=12", 0, "S", ""),
    "unmarked": ("timing=gap&stretch=0.1", 0, "", "S"),
    "quiet": ("heartbeat=40&scene=idle", 150_000, "QS", "Q"),
    "quiet, noisy": ("heartbeat=40&scene=idle&noise=0.02", 130_000, "QS", "QS"),
    "quiet, short gap": ("heartbeat=40&scene=idle&frame_period_ms=10.3", 150_000, "QS", "Q"),
    "quiet, long gap": (
        "heartbeat=40&scene=idle&frame_period_ms=80&noise=0.017",
        120_000,
        "QS",
        "QS",
    ),
    "quiet, stretched": ("heartbeat=20&scene=idle&stretch=0.1", 150_000, "QS", "QS"),
    "quiet, resync": (
        "resync_chips=32&guard_chips=4&frame_period_ms=20&scene=idle&heartbeat=40",
        150_000,
        "QS",
        "Q",
    ),
    "quiet, but loud": ("scene=all&threshold=0", 150_000, "S", "Q"),
    "quiet, but unmarked": ("timing=gap&scene=idle", 150_000, "", "S"),
}


GROUPS = {2: 1, 19: 3, 21: 2, 22: 0, 23: 3}
"""log2_groups that are asked for in these frames."""
ASKS = {4: 0, 9: 2, 10: 1, 24: 0, 34: 4, 36: 0}
"""log2_groups with which all are asked to speak in these frames; some rounds are cut short."""


@pytest.mark.parametrize("name", SETUPS)
@pytest.mark.parametrize("chunk", [None, 37])
def test_packets_are_those_of_the_virtual_digitizer(
    core: ctypes.CDLL, name: str, chunk: int | None
) -> None:
    query, quiet_uv, *kinds = SETUPS[name]
    options = SimOptions.from_url(f"sim://?seed=3&{query}")
    setup = replace(options.setup(), quiet_uv=quiet_uv)
    turns, turn = Turns(groups_log2=0), 0
    layout = FrameLayout.of(setup.spec, setup.samples_per_chip)
    asked = Configure(layout, setup.sync, False, quiet_uv)
    board = Board.of(volts_per_count=options.channel.volts_per_count(setup.spec))
    marked = setup.sync != SyncMode.NONE
    digitizer = streaming(core, asked, board=board, now_us=START_US)
    before = -(-48 * FIRST_MARK_US // digitizer.ticks_per_sample) if marked else 0
    first_mark_us, rest = divmod(before * digitizer.ticks_per_sample, 48)
    assert rest == 0
    digitizer.samples(np.full(before, MIDDLE))
    digitizer.pulses(1 if not setup.spec.resync_chips else 0)
    expected = []
    whole = marked and not setup.spec.resync_chips
    grouping = whole and setup.spec.frame_period_s - setup.spec.frame_s > 960e-6
    for block in itertools.islice(stream(options, setup, turns), 150):
        if block.sync:
            turn += 1
            if turn > 1 and whole:
                while digitizer.pulses(1)[0].units == SYNC_RESTART:
                    pass  # of the frame's turn
            if turn in GROUPS and grouping:  # the next frame's pulse is not given out yet
                digitizer.send(Groups(GROUPS[turn]))
                turns.groups_log2 = GROUPS[turn]
            if turn in ASKS and grouping and turn not in GROUPS:
                digitizer.send(Ask(ASKS[turn]))
                turns.words_log2 = ASKS[turn]
        counts = block.counts + np.int16(MIDDLE)
        marks: Any = {"sync": block.sync, "turn": block.turn, "asked": block.asked}
        kind = Quiet.of if block.quiet else Samples
        time_us = math.floor(block.begin_s * 1e6 + 0.5 + 1e-6)
        expected.append(kind(time_us, block.first_index, counts, **marks))
        for part in (
            [counts] if chunk is None else np.split(counts, range(chunk, len(counts), chunk))
        ):
            digitizer.samples(part)
    got = [p for p in digitizer.packets(Samples, Quiet) if p.first_index >= before]
    assert got[-1].first_index >= expected[-3].first_index  # little is held back
    assert got == [
        place(packet, before, START_US + first_mark_us) for packet in expected[: len(got)]
    ]
    for sync, letters in zip((True, False), kinds, strict=True):
        sent = {type(packet).__name__[0] for packet in got if packet.sync == sync}
        assert sent == set(letters)
    assert any(packet.turn for packet in got) == grouping
    assert any(packet.asked for packet in got) == grouping
    assert not digitizer.parser.counters.lost_packets


GAP = FrameLayout.of(FrameSpec(frame_period_s=21.4e-3), 4)  # of 900 samples; the frame has 812


def sizes(digitizer: CoreDigitizer) -> list[tuple[type, int]]:
    return [(type(packet), sample_count(packet)) for packet in digitizer.packets(Samples, Quiet)]


def test_a_gap_after_silence_waits_if_it_can_be_held_and_while_it_is_silent(
    core: ctypes.CDLL,
) -> None:
    for capacity, sent in (  # once the frame, the gap but for a sample, that and most of a frame…
        (900, ([80, 812], [], [], [900, 812])),
        (899, ([80, 812], [240, 240, 240], [180], [812])),
    ):
        digitizer = streaming(core, Configure(GAP, quiet_uv=100_000), capacity=capacity)
        for size, expected in zip((80 + 812, 899, 1 + 811, 1), sent, strict=True):
            digitizer.samples(np.full(size, MIDDLE))
            assert sizes(digitizer) == [(Quiet, each) for each in expected]


def test_a_gap_that_becomes_loud_is_sent_at_once(core: ctypes.CDLL) -> None:
    digitizer = streaming(core, Configure(GAP, quiet_uv=100_000))
    digitizer.samples(np.full(80 + 812 + 500, MIDDLE))
    assert sizes(digitizer) == [(Quiet, 80), (Quiet, 812)]
    digitizer.samples(np.full(1, 3000))
    assert sizes(digitizer) == [(Quiet, 240), (Quiet, 240)]
    digitizer.samples(np.full(219 + 180, MIDDLE))
    assert sizes(digitizer) == [(Samples, 240), (Quiet, 180)]


@pytest.mark.parametrize(
    ("asked", "held", "sent"),
    [
        (Configure(GAP), 80 + 300, [(Samples, 80), (Samples, 300)]),
        (Configure(GAP, quiet_uv=100_000), 80 + 812 + 300, [(Quiet, 240), (Quiet, 60)]),
        (Configure(GAP, quiet_uv=100_000), 80 + 812 + 900, [(Quiet, 900)]),
        (Configure(GAP, integrated=True), 500 + 25 * 10 + 5, [(Samples, 10)]),
    ],
)
def test_a_stream_that_the_board_ends_is_sent_to_its_end(
    core: ctypes.CDLL, asked: Configure, held: int, sent: list[tuple[type, int]]
) -> None:
    digitizer = streaming(core, asked)
    digitizer.samples(np.full(held, MIDDLE))
    digitizer.end()
    got = sizes(digitizer)
    assert got[-len(sent) :] == sent
    digitizer.samples(np.full(1000, MIDDLE))
    assert not sizes(digitizer)


# The rules, in exact fractions of a µs


@dataclass(frozen=True)
class Rules:
    """Packets by docs/protocol.md for one set-up, at 48 ticks per µs, in exact fractions."""

    asked: Configure
    ticks_per_sample: int
    capacity: int

    @property
    def frame(self) -> FrameLayout:
        return self.asked.frame

    @property
    def sample_us(self) -> Fraction:
        return Fraction(self.ticks_per_sample, 48)

    @property
    def chip_us(self) -> Fraction:
        return Fraction(self.frame.chip_ns, 1000)

    @property
    def places(self) -> list[int]:
        """Starts of the chips, in chips after the mark."""
        frame = self.frame
        chips = range((frame.bits + frame.parity) * frame.order)
        if not frame.resync_chips:
            return list(chips)
        return [chip + chip // frame.resync_chips * frame.guard_chips for chip in chips]

    def first_sample(self, time_us: Fraction) -> int:
        """Number of the first sample taken at or after a time."""
        return math.ceil(time_us / self.sample_us - Fraction(1, 2))

    def marks_us(self) -> Iterator[Fraction]:
        first = math.ceil(FIRST_MARK_US / self.sample_us) * self.sample_us
        return (first + number * self.frame.frame_period_us for number in itertools.count())

    def raw(self, counts: NDArray[np.uint16], lost: set[int]) -> list[Samples]:
        """The packets of raw samples, of which those of some numbers are lost."""
        span = (self.places[-1] + 1 + TAIL_CHIPS) * self.chip_us
        longest_gap = min(self.capacity, max(1, math.floor(3000 / self.sample_us)))
        starts: dict[int, int] = {0: longest_gap}  # of sections, and the longest packet in each
        marks = set()
        for mark_us in self.marks_us():
            mark = self.first_sample(mark_us)
            if mark >= len(counts):
                break
            marks.add(mark)
            starts[mark] = self.capacity
            end = mark + math.ceil(span / self.sample_us)
            if end < self.first_sample(mark_us + self.frame.frame_period_us):
                starts[end] = longest_gap
        packets: list[Samples] = []
        longest, begin = 0, 0
        for number in range(len(counts)):
            longest = starts.get(number, longest)
            if number in lost:
                continue
            after_loss = number - 1 in lost
            if number in starts or after_loss or number - begin == longest:
                time_us = START_US + math.floor((number + Fraction(1, 2)) * self.sample_us + HALF)
                few = counts[number : number + 1].astype(np.int16)
                packets.append(
                    Samples(time_us, number, few, sync=number in marks, overrun=after_loss)
                )
                begin = number
            else:
                few = counts[begin : number + 1].astype(np.int16)
                packets[-1] = replace(packets[-1], counts=few)
        return packets

    def integrated(
        self, counts: NDArray[np.uint16], lost: set[int], quiet_counts: int
    ) -> list[Samples | Quiet]:
        """The packets of means of chips; one that misses a sample is lost."""
        packets: list[Samples | Quiet] = []
        index, overrun = 0, False
        for mark_us in self.marks_us():
            words: list[int] = []
            begun: list[Samples] = []
            for chip, at in enumerate(self.places):
                begin_us = mark_us + at * self.chip_us
                samples = range(
                    self.first_sample(begin_us), self.first_sample(begin_us + self.chip_us)
                )
                if samples.stop > len(counts):
                    break
                index += 1
                if not lost.isdisjoint(samples):
                    overrun, words = True, []
                    continue
                total = sum(int(count) for count in counts[samples.start : samples.stop])
                if not words or len(words) == self.capacity:
                    time_us = START_US + math.floor(begin_us + HALF)
                    one = np.zeros(1, np.int16)
                    begun.append(Samples(time_us, index - 1, one, sync=chip == 0, overrun=overrun))
                    overrun, words = False, []
                words.append(math.floor(Fraction(8 * total, len(samples)) + HALF))
                begun[-1] = replace(begun[-1], counts=np.array(words, np.int16))
            whole = begun and len(begun[0].counts) == len(self.places)
            if whole and 0 < quiet_counts >= int(np.ptp(begun[0].counts)):
                one = begun[0]
                place = one.device_time_us, one.first_index, one.counts
                packets.append(Quiet.of(*place, sync=True, overrun=one.overrun))
            else:
                packets += begun
            if samples.stop > len(counts):
                return packets
        raise AssertionError("marks never end")


HALF = Fraction(1, 2)


@st.composite
def layouts(draw: st.DrawFn) -> FrameLayout:
    """Frames of any awkward length, in which pulses of the sync line have time."""
    short = draw(st.booleans())  # 2000 ns is the shortest period of samples: a chip has but one
    chip_ns = draw(
        st.sampled_from([2000, 2000, 2125, 3875, 3999]) if short else st.integers(20_000, 60_000)
    )
    resync_chips = draw(st.sampled_from([0, 0, 7, 11]))
    frame = FrameLayout(
        nodes=3,
        bits=draw(st.integers(8, 10)),
        order=draw(st.integers(1, 8)),
        chip_ns=chip_ns,
        frame_period_us=1,
        first_row=1,
        sign_seed=1,
        signs=Signs.SEEDED,
        drive=Drive.BIPOLAR,
        polarity=Polarity.NORMAL,
        samples_per_chip=1 if short else draw(st.integers(1, 7)),
        parity=draw(st.booleans()),
        resync_chips=resync_chips,
        guard_chips=draw(st.integers(0, 3)) + 64 * short if resync_chips else 0,
    )
    span = Rules(Configure(frame), 1, 1).places[-1] + 1
    rest_us = draw(st.integers(0, 200) | st.integers(0, 20_000))
    return replace(frame, frame_period_us=math.ceil(span * chip_ns / 1000) + rest_us)


SHORT_NS = 4 * 2000
"""Chips shorter than this are not averaged but sampled once."""


def drifts(frame: FrameLayout) -> bool:
    """Whether such a chip's sample would not stay in its place, as 48 ticks per µs do not fit."""
    return frame.chip_ns < SHORT_NS and frame.chip_ns * 48 % 1000 > 0


@dataclass(frozen=True)
class Course:
    """How samples come: in chunks of these sizes by turns; some are lost: begin and length."""

    size: int
    chunks: list[int]
    losses: list[tuple[int, int]]
    seed: int


courses = st.builds(
    Course,
    size=st.integers(1, 4000),
    chunks=st.lists(st.integers(1, 700), min_size=1, max_size=4),
    losses=st.lists(st.tuples(st.integers(0, 4000), st.integers(1, 600)), max_size=3),
    seed=st.integers(0, 2**32 - 1),
)


@examples(150)
@given(
    frame=layouts(),
    integrated=st.booleans(),
    packs=st.booleans(),
    quiet=st.booleans(),
    capacity=st.integers(1, 300) | st.just(8192),
    course=courses,
)
def test_packets_follow_the_rules_exactly(
    core: ctypes.CDLL,
    frame: FrameLayout,
    integrated: bool,
    packs: bool,
    quiet: bool,
    capacity: int,
    course: Course,
) -> None:
    size, chunks, losses = course.size, course.chunks, course.losses
    quiet_uv = 100_000 if quiet and integrated else 0
    asked = Configure(frame, SyncMode.DRIVE, integrated, quiet_uv)
    digitizer = CoreDigitizer(core, capacity=capacity, output=1 << 20, now_us=START_US)
    accepted = not any(digitizer.results(asked, *[Pack()] * packs, Start()))
    assert not (accepted and integrated and drifts(frame))
    assume(accepted)
    size *= 1 + 9 * integrated
    rules = Rules(asked, digitizer.ticks_per_sample, capacity)
    rng = np.random.default_rng(course.seed)
    counts = rng.integers(0, 4096, size).astype(np.uint16)
    if quiet_uv:  # some silence
        level = rng.integers(0, 2, -(-size // 500)).repeat(500)[:size]
        counts = np.where(level, counts, 2048 + counts % 2).astype(np.uint16)
    lost = {number for begin, length in losses for number in range(begin, begin + length)}
    lost = {number for number in lost if number < size}
    digitizer.lost(0)  # is nothing
    number, turn = 0, 0
    while number < size:
        end = min(size, number + chunks[turn % len(chunks)])
        turn += 1
        missing = number in lost
        while number < end:
            stop = number
            while stop < end and (stop in lost) == missing:
                stop += 1
            if missing:
                digitizer.lost(stop - number)
            else:
                digitizer.samples(counts[number:stop])
            number, missing = stop, not missing
    sent = digitizer.take()
    fits = not integrated or frame.chip_ns < SHORT_NS
    kinds = {body[0] for body in map(cobs_decode, sent.split(b"\0")[:-1]) if body}
    assert kinds <= {PacketType.QUIET, PacketType.PACKED if packs and fits else PacketType.SAMPLES}
    got = of_kind(digitizer.parser.feed(sent), Samples, Quiet)
    assert not digitizer.parser.counters.malformed
    assert integrated or digitizer.status(START_US + 10**9).samples_lost == len(lost)
    if integrated:
        quiet_counts = int(quiet_uv * 1e-6 / (digitizer.board.volts_per_count / 8))
        expected = rules.integrated(counts, lost, quiet_counts)
    else:
        expected = rules.raw(counts, lost)
    assert got == expected[: len(got)]
    assert len(expected) - len(got) <= 1  # the last one may wait for more
    assert all(isinstance(p, Quiet) or len(p.counts) <= MAX_SAMPLES for p in got)


THOUSAND_FILE = FIRMWARE.parent / "config" / "thousand_skin.yaml"
THOUSAND = FrameLayout.of(SkinConfig.of(read_file(THOUSAND_FILE)).spec, 1)
WHOLE = 9120


@pytest.mark.parametrize("packs", [False, True])
def test_a_frame_longer_than_a_packet(core: ctypes.CDLL, packs: bool) -> None:
    """Where there is room to hold it, it is quiet as a whole; if not, packets are full."""
    asked = Configure(THOUSAND, SyncMode.DRIVE, True, 2 * round(3.3 / 4096 * 1e6))
    capacity = 2 * MAX_SAMPLES
    digitizer = streaming(core, asked, *[Pack()] * packs, capacity=capacity, now_us=START_US)
    period, first = 9980, 500
    line = 2048 + (np.arange(first + 6 * period) % 2)
    touched = first + 2 * period
    line[touched + 9000] = 3000  # beyond the first packet, within a chip of the last bit
    line[touched + period + 10] = 3000
    line[touched + 2 * period + 920] = 3000  # in a guard, which is not sent
    digitizer.samples(line.astype(np.uint16))
    packets = digitizer.packets(Samples, Quiet)
    sizes = [sample_count(packet) for packet in packets]
    assert [type(packet) for packet in packets] == [Quiet] * 2 + [Samples] * 4 + [Quiet] * 2
    assert sizes == [WHOLE] * 2 + [MAX_SAMPLES, WHOLE - MAX_SAMPLES] * 2 + [WHOLE] * 2
    assert [packet.sync for packet in packets] == [True] * 3 + [False, True, False, True, True]
    assert [packet.first_index for packet in packets] == [*np.cumsum([0, *sizes[:-1]])]
    words = np.concatenate([packet.counts for packet in of_kind(packets, Samples)])
    chips = np.array([line[touched + place] for place in Rules(asked, 96, 1).places])
    np.testing.assert_array_equal(words[:WHOLE], 8 * chips)
    mark_us = START_US + 2 * touched
    second = Rules(asked, 96, 1).places[MAX_SAMPLES]
    assert [p.device_time_us for p in packets[2:4]] == [mark_us, mark_us + 2 * second]


def test_pack_lasts_until_a_configuration_is_accepted(core: ctypes.CDLL) -> None:
    """So a host that does not know of it never gets what it cannot read."""
    asked = Configure(FrameLayout.of(FrameSpec(), 4))

    def kinds(digitizer: CoreDigitizer) -> set[int]:
        digitizer.samples(np.full(2000, MIDDLE, np.uint16))
        bodies = map(cobs_decode, digitizer.take().split(b"\0")[:-1])
        return {body[0] for body in bodies if body} & {PacketType.SAMPLES, PacketType.PACKED}

    digitizer = streaming(core, asked)
    assert kinds(digitizer) == {PacketType.SAMPLES}
    digitizer.send(Pack())
    assert kinds(digitizer) == {PacketType.PACKED}
    digitizer.send(Start())
    assert kinds(digitizer) == {PacketType.PACKED}
    digitizer.send(replace(asked, frame=replace(asked.frame, chip_ns=10)))  # refused
    assert kinds(digitizer) == {PacketType.PACKED}
    digitizer.send(asked, Start())
    assert kinds(digitizer) == {PacketType.SAMPLES}


def test_a_chips_only_sample_is_taken_late(core: ctypes.CDLL) -> None:
    """At 7/8 of it, by pulses that are earlier than those for a sample in the middle."""
    digitizer = streaming(core, Configure(THOUSAND, SyncMode.DRIVE, True), Pack())
    announced = [pulse.announces for pulse in digitizer.pulses(11)]
    first = 48 * FIRST_MARK_US - 3 * 96 // 8
    places = Rules(Configure(THOUSAND), 96, 1).places[::912]
    assert announced[:10] == [first + 96 * place for place in places]
    assert announced[10] == first + 48 * 19_960
    several = replace(THOUSAND, chip_ns=8000, frame_period_us=80_000)
    digitizer.send(Configure(several, SyncMode.DRIVE, True), Start())
    assert digitizer.pulses(1)[0].announces == 48 * FIRST_MARK_US
    assert digitizer.ticks_per_sample == 96
    digitizer.send(Configure(replace(several, chip_ns=6000), SyncMode.DRIVE, True), Start())
    assert digitizer.ticks_per_sample == 288


@pytest.mark.parametrize(
    ("chip_ns", "result"),
    [
        (2000, 0),
        (2001, 4),
        (2100, 4),  # 100.8 ticks: of 9120 chips the last ones would be sampled 72 chips early
        (2125, 0),
        (3999, 4),
        (7999, 4),
        (8001, 0),  # the mean of four samples, which need not stay in their places
    ],
)
def test_a_chips_only_sample_stays_in_its_place(
    core: ctypes.CDLL, chip_ns: int, result: int
) -> None:
    frame = replace(THOUSAND, chip_ns=chip_ns, frame_period_us=100_000)
    assert drifts(frame) == bool(result)
    assert CoreDigitizer(core).results(Configure(frame, SyncMode.DRIVE, True)) == [result]


def test_the_sums_of_a_long_silent_frame(core: ctypes.CDLL) -> None:
    """Of 81,920 words of nearly 2¹⁵: the sum is beyond 2³¹."""
    frame = replace(THOUSAND, order=8192, resync_chips=0, guard_chips=0, frame_period_us=200_000)
    digitizer = streaming(core, Configure(frame, SyncMode.DRIVE, True, 5000), capacity=90_000)
    digitizer.samples(np.full(500 + 81_920, 4095))
    (quiet,) = digitizer.packets(Samples, Quiet)
    assert isinstance(quiet, Quiet)
    level = 8 * 4095
    sums = (quiet.count, quiet.sum, quiet.sum_of_squares)
    assert sums == (81_920, 81_920 * level, 81_920 * level**2)
