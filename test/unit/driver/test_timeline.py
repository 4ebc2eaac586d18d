# SPDX-License-Identifier: Apache-2.0

"""How the timeline classifies packets of samples: continuation, loss, restart, reset, invalid."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.driver.clock import TICK_S, StreamCounters
from tactile_cdma.driver.timeline import (
    MAX_LEAP_S,
    Answer,
    Arrival,
    Pace,
    Step,
    Timeline,
    sample_count,
)
from tactile_cdma.framing.frames import LineFrame, words_memory
from tactile_cdma.wire._protocol import MAX_GAP
from tactile_cdma.wire.messages import FrameLayout, Info, Quiet, Samples, Status

SPEC = FrameSpec()
RATE_HZ = 80_000
COUNT, COUNT_US = 100, 1250
"""Samples of a packet, and how long they take, µs."""
FIRST, BEGAN_US, HOST_S = 2**63, 5_000_000, 40.0
"""The digitizer has been up for 5 s when the first packet comes; its index is no exact float."""
INFO = Info(
    frame=FrameLayout.of(SPEC, 4),
    sample_rate_uhz=RATE_HZ * 10**6,
    volts_per_count=1e-3,
    quiet_uv=2000,
)
PACE = Pace(INFO, SPEC)


def samples(number: int, late_us: int = 0, index: int | None = None, gap: int = 0) -> Samples:
    """Packet `number` of a stream; its device time, index and sequence number may be off."""
    first = FIRST + number * COUNT if index is None else index
    time_us = BEGAN_US + number * COUNT_US + late_us
    return Samples(time_us, first, np.zeros(COUNT, np.int16), sequence=(number + gap) % 2**16)


class Accepted(NamedTuple):
    """A packet that was accepted: its index in the stream, and how it relates to the one before."""

    index: int
    step: Step


class Line:
    """A timeline that is asked about every packet, as they come at the device's pace."""

    def __init__(self) -> None:
        self.counters = StreamCounters()
        self.timeline = Timeline(self.counters)
        self.held: Arrival | None = None
        self.hears(*map(samples, range(10)))

    def hears(self, *packets: Samples | Quiet, late_s: float = 0.0) -> list[Accepted]:
        accepted: list[Accepted] = []
        for packet in packets:
            t_host = HOST_S + (packet.device_time_us - BEGAN_US) * 1e-6 + late_s
            accepted += self.hears_at(Arrival(packet, t_host))
        return accepted

    def hears_at(self, arrival: Arrival) -> list[Accepted]:
        """What a stream does with an answer."""
        answer, origin, step = self.timeline.place(arrival, PACE)
        taken, held = arrival, self.held
        if answer is Answer.IGNORE:
            return []
        self.held = arrival if answer is Answer.HOLD else None
        if answer is Answer.HOLD:
            return []
        if answer is Answer.TAKE_HELD:
            assert held is not None
            taken = held
        packet = taken.packet
        index = packet.first_index - origin
        entry = (index, packet.device_time_us, sample_count(packet), packet.sequence)
        self.timeline.times.passed([(*entry, taken.t_host, taken.backlog)], RATE_HZ)
        again = self.hears_at(arrival) if answer is Answer.TAKE_HELD else []
        return [Accepted(index, step), *again]


def heard_at(index: float) -> LineFrame:
    return LineFrame(index, 4.0, None, None, 0, False, math.nan, 0.0, 0.0, words_memory(1))


def test_packets_in_a_row_continue_from_index_zero() -> None:
    line = Line()
    [place] = line.hears(samples(10))
    assert (place.index, place.step) == (10 * COUNT, Step.CONTINUES)
    assert line.counters == StreamCounters(samples=11 * COUNT)
    stamp = line.timeline.times.stamp(heard_at(10 * COUNT + 8.0), RATE_HZ, SPEC)
    assert stamp.t_start == pytest.approx(5.0 + 10 * COUNT_US * 1e-6 + 8 / RATE_HZ)
    assert stamp.chip_s == pytest.approx(SPEC.chip_s)
    assert stamp.t_middle - stamp.t_start == pytest.approx(SPEC.frame_s / 2)
    assert stamp.t_host == pytest.approx(stamp.t_middle - 5.0 + HOST_S - COUNT / RATE_HZ)


def test_a_short_loss_is_counted_at_once() -> None:
    line = Line()
    [place] = line.hears(samples(13))
    assert (place.index, place.step) == (13 * COUNT, Step.LOSS)
    assert line.counters.lost_samples == 3 * COUNT


@pytest.mark.parametrize("beyond", [-1, 1])
def test_a_long_loss_waits_for_a_second_packet(beyond: int) -> None:
    line, after = Line(), 10 + round(MAX_LEAP_S * 1e6 / COUNT_US) + beyond
    first = line.hears(samples(after))
    second = line.hears(samples(after + 1))
    assert len(first) == (beyond < 0)
    assert [place.step for place in first + second] == [Step.LOSS, Step.CONTINUES]
    assert line.counters.lost_samples == (after - 10) * COUNT


@pytest.mark.parametrize(
    ("change", "step"),
    [
        ({"index": 0}, Step.RESTART),
        ({"index": 0, "gap": MAX_GAP - 1}, Step.RESTART),
        ({"index": 0, "gap": MAX_GAP}, Step.RESET),
        ({"index": 0, "gap": -100}, Step.RESET),
        ({"index": 0, "late_us": -COUNT_US}, Step.RESET),  # no later than the packet before
        ({"index": 0, "late_us": -1_000_000}, Step.RESET),
    ],
    ids=str,
)
def test_what_does_not_continue_the_stream_begins_another_once_it_is_confirmed(
    change: dict[str, int], step: Step
) -> None:
    line = Line()
    first, second = samples(10, **change), samples(11, **change)
    if "index" in change:
        second = samples(11, **{**change, "index": COUNT})
    assert line.hears(first) == []
    places = line.hears(second)
    assert [(place.index, place.step) for place in places] == [(0, step), (COUNT, Step.CONTINUES)]
    assert (line.counters.restarts, line.counters.implausible_packets) == (1, 0)


@pytest.mark.parametrize("late_us", [-1100, -1000, 1000, 1100, 60_000, -60_000, -1_000_000])
def test_device_time_that_steps_against_the_count_begins_another_clock(late_us: int) -> None:
    """By more than one crystal can make of it: the count here is that of the same crystal."""
    line = Line()
    first, second = (line.hears(samples(number, late_us)) for number in (10, 11))
    if abs(late_us) == 1000:
        assert [place.step for place in first + second] == [Step.CONTINUES] * 2
        assert line.counters.clock_steps == 0
        return
    assert first == []
    assert [place.step for place in second] == [Step.RESET, Step.CONTINUES]
    counters = line.counters
    assert (counters.clock_steps, counters.restarts, counters.lost_samples) == (1, 0, 0)
    assert math.isinf(line.timeline.times.stamp(heard_at(0.0), RATE_HZ, SPEC).stamp_uncertainty_s)


MEANS = Pace(replace(INFO, integrated=True, sample_rate_uhz=round(1e6 / SPEC.chip_s)), SPEC)


@pytest.mark.parametrize(("sync", "missing"), [(False, 0), (True, 0), (False, 1)])
def test_only_a_gap_lets_time_pass_without_samples(sync: bool, missing: int) -> None:
    """Of integrated frames: before a mark, where it must pass, and perhaps in a loss."""
    before = Samples(0, 0, np.zeros(SPEC.order, np.int16))
    gap_s = SPEC.frame_period_s - SPEC.frame_s
    time_us = round(1e6 * ((SPEC.order + missing) * SPEC.chip_s + gap_s))
    packet = Samples(time_us, SPEC.order + missing, before.counts, sync=sync)
    assert MEANS.fits(before, packet) == (sync or missing > 0)
    at_once = replace(packet, device_time_us=round(time_us - 1e6 * gap_s))
    assert MEANS.fits(before, at_once) == (not sync), "the mark is that of a repeated packet"


@pytest.mark.parametrize("late_s", [1.9, 2.1])
def test_a_packet_that_is_read_too_late_is_one_of_another_clock(late_s: float) -> None:
    late = [samples(number, index=(number - 10) * COUNT) for number in (10, 11)]
    places = Line().hears(*late, late_s=late_s)
    assert places[0].step is (Step.RESTART if late_s < 2 else Step.RESET)


def test_a_status_younger_than_the_samples_tells_a_reset_at_once() -> None:
    line = Line()
    line.timeline.hear_status(Status(uptime_us=BEGAN_US + 9 * COUNT_US))  # as old as the last ones
    assert line.hears(samples(10, index=0)) == []
    line.timeline.hear_status(Status(uptime_us=100))
    [place] = line.hears(samples(10, index=0))
    assert (place.index, place.step) == (0, Step.RESET)
    assert line.counters.implausible_packets == 1  # the one held back


def test_one_odd_packet_is_implausible_and_costs_itself() -> None:
    line = Line()
    assert line.hears(samples(10, index=7)) == []
    [place] = line.hears(samples(11))
    assert place.step is Step.LOSS
    assert (line.counters.lost_samples, line.counters.implausible_packets) == (COUNT, 1)


@pytest.mark.parametrize(
    ("count", "variance", "plausible"),
    [
        (2048, 3, True),
        (2049, 3, False),  # two frame periods are 2048 samples
        (2048, 5, False),  # half of quiet_uv and one count are 2 counts
    ],
)
def test_silence_lasts_and_varies_no_more_than_the_digitizer_says(
    count: int, variance: int, plausible: bool
) -> None:
    line, time_us = Line(), BEGAN_US + 10 * COUNT_US
    quiet = Quiet(time_us, FIRST + 10 * COUNT, count, 0, count * variance, sequence=10)
    assert len(line.hears(quiet)) == plausible
    assert line.counters.implausible_packets == 1 - plausible


def test_stamps_rise_and_the_sequence_goes_on_over_a_reset() -> None:
    line = Line()
    before = line.timeline.times.stamp(heard_at(0.0), RATE_HZ, SPEC)
    again = line.timeline.times.stamp(heard_at(0.0), RATE_HZ, SPEC)
    assert (again.sequence, again.t_host) == (1, pytest.approx(before.t_host + TICK_S, abs=1e-9))
    line.timeline.hear_status(Status(uptime_us=100))
    reset = Samples(1000, 0, np.zeros(COUNT, np.int16))
    periods = 100
    t_host = again.t_host + periods * SPEC.frame_period_s
    line.hears_at(Arrival(reset, t_host))
    after = line.timeline.times.stamp(heard_at(0.0), RATE_HZ, SPEC)
    assert after.sequence - again.sequence == pytest.approx(periods, abs=1)
    assert line.counters.lost_frames == after.sequence - 2
    assert line.counters.frames == 3
