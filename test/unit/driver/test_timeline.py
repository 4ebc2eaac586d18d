# SPDX-License-Identifier: Apache-2.0

"""Packets of samples on a clock: continuation, loss, restart, and stamps beside true times."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.driver.clock import TICK_S, DeviceClock, StreamCounters
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
from test.support.clock_model import BEGIN_S, PERIOD_S, Clock, reads
from test.support.stamped import recorded, silent_pipeline, stamped

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


def test_packets_in_a_row_continue_and_a_short_loss_is_counted_at_once() -> None:
    line = Line()
    [place] = line.hears(samples(10))
    assert (place.index, place.step) == (10 * COUNT, Step.CONTINUES)
    assert line.counters == StreamCounters(samples=11 * COUNT)
    stamp = line.timeline.times.stamp(heard_at(10 * COUNT + 8.0), RATE_HZ, SPEC)
    assert stamp.t_start == pytest.approx(5.0 + 10 * COUNT_US * 1e-6 + 8 / RATE_HZ)
    assert stamp.chip_s == pytest.approx(SPEC.chip_s)
    assert stamp.t_middle - stamp.t_start == pytest.approx(SPEC.frame_s / 2)
    assert stamp.t_host == pytest.approx(stamp.t_middle - 5.0 + HOST_S - COUNT / RATE_HZ)
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
def test_what_does_not_go_on_begins_anew_once_confirmed(change: dict[str, int], step: Step) -> None:
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


def test_a_young_status_tells_a_reset_and_one_odd_packet_costs_itself() -> None:
    line = Line()
    line.timeline.hear_status(Status(uptime_us=BEGAN_US + 9 * COUNT_US))  # as old as the last ones
    assert line.hears(samples(10, index=0)) == []
    line.timeline.hear_status(Status(uptime_us=100))
    [place] = line.hears(samples(10, index=0))
    assert (place.index, place.step) == (0, Step.RESET)
    assert line.counters.implausible_packets == 1  # the one held back
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
def test_silence_lasts_and_varies_as_announced(count: int, variance: int, plausible: bool) -> None:
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


AT_S = 4.0
"""When it happens; all is known of the clock by then."""
FRAMES = 700
SOON_S = 1.5
"""After a step, until stamps are right again: a second, and the frames until the first knot."""
STEPS = [Clock(steps=((AT_S, 1e-3 * ms),)) for ms in (-45, -20, -5, -2, 2, 5, 20, 45)]
HALTS = [Clock(halts=((AT_S, s),)) for s in (0.02, 0.5, 5.0)]
SLOW = [Clock(error=error) for error in (-0.05, -0.009, -0.003, 0.003, 0.009)]
HELD_UP = [
    Clock(stalls=((AT_S, 1.0),)),
    Clock(stalls=((AT_S, 3.0),)),
    Clock(lags=((AT_S, 3.0, 0.8),)),
    Clock(delay_s=0.01),
    Clock(latency_s=0.0159),
    Clock(error=1e-4),
]


def found(
    clock: Clock, frames: int = FRAMES, seed: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Times since the event, errors and claims of all stamps, s; how many steps were counted."""
    pipeline, writer = silent_pipeline()
    rows = np.array(stamped(pipeline, writer, reads(clock, frames, seed)))
    true_s, off_s, claimed_s = rows.T
    assert (np.abs(off_s) <= claimed_s).all()
    return true_s - BEGIN_S - AT_S, np.abs(off_s), claimed_s, pipeline.counters.clock_steps


def test_the_first_second_is_a_guess_and_says_so() -> None:
    since_s, off_s, claimed_s, steps = found(Clock())
    assert np.isinf(claimed_s[since_s < -AT_S + 0.5]).all()
    assert np.isfinite(claimed_s[since_s > -AT_S + 1.1]).all()
    assert np.median(claimed_s[since_s > 0]) < 2e-3
    assert off_s[since_s > -AT_S + 1.1].max() < 0.5e-3
    assert steps == 0


@pytest.mark.parametrize("clock", STEPS + HALTS, ids=str)
def test_a_step_is_told_and_over_in_a_second(clock: Clock) -> None:
    since_s, off_s, claimed_s, steps = found(clock)
    stood_s = sum(s for _, s in clock.halts)
    after = since_s > stood_s + SOON_S
    assert off_s[after].max() < 0.5e-3
    assert np.median(claimed_s[after]) < 6.1e-3
    assert steps == 1


@pytest.mark.parametrize("clock", SLOW, ids=str)
def test_a_clock_that_is_no_crystal_is_followed(clock: Clock) -> None:
    since_s, off_s, claimed_s, _ = found(clock)
    assert off_s[since_s > 0].max() < 2e-3
    assert np.median(claimed_s[since_s > 0]) < 6.1e-3


@pytest.mark.parametrize("clock", HELD_UP, ids=str)
def test_what_host_and_link_hold_up_is_no_step(clock: Clock) -> None:
    """Stamps stay where they are; meanwhile they may be off, for all that a driver can know."""
    _, off_s, claimed_s, steps = found(clock)
    assert off_s[100:].max() < 2e-3
    assert np.isfinite(claimed_s[100:]).all()
    assert steps == 0


@pytest.mark.parametrize("seed", [*range(4), 104, 111, 116, 118, 131, 139, 222])
def test_jitter_of_30_ms_is_in_what_stamps_say(seed: int) -> None:
    _, _, claimed_s, _ = found(Clock(delay_s=30e-3), 892, seed)
    assert np.isfinite(claimed_s[100:]).all() and np.median(claimed_s[100:]) < 0.1


SHORT_S = 1.5, 2.0, 3.0, 4.2, 5.0, 7.5
"""Lengths of recordings."""


@pytest.mark.parametrize("halt_s", [0.02, 0.25, 0.4, 0.7, 3.0])
@pytest.mark.parametrize("at_s", [0.3, 0.5, 1.0, 2.0, 3.0, 6.8])
def test_a_halt_in_a_short_recording_is_in_what_stamps_say(halt_s: float, at_s: float) -> None:
    """Wherever it does, and though nothing may be known of it."""
    for length_s in SHORT_S:
        clock = Clock(error=3e-5, halts=((at_s, halt_s),))
        rows = np.array(recorded(reads(clock, round(length_s / PERIOD_S), seed=1)))
        _, off_s, claimed_s = rows.T
        assert len(rows) > 0.95 * length_s / PERIOD_S
        assert (np.abs(off_s) <= claimed_s).all(), length_s


@pytest.mark.parametrize("seed", range(6))
def test_jitter_of_30_ms_is_in_what_stamps_of_recordings_say(seed: int) -> None:
    for length_s, stalls in ((1.5, ()), (4.0, ((1.0, 1.0),)), (11.4, ()), (40.0, ())):
        clock = Clock(error=3e-5, delay_s=30e-3, stalls=stalls)
        rows = np.array(recorded(reads(clock, round(length_s / PERIOD_S), seed)))
        assert (np.abs(rows[:, 1]) <= rows[:, 2]).all(), length_s
        assert stalls or np.median(rows[:, 2]) < 0.1


@pytest.mark.parametrize("clock", [Clock(), Clock(error=1e-4), Clock(error=-1e-4)], ids=str)
@pytest.mark.parametrize("length_s", [1.5, 5.0, 40.0])
def test_a_good_link_s_recordings_are_stamped_within_2_ms(clock: Clock, length_s: float) -> None:
    """So that the tests above are not passed by stamps that say nothing."""
    rows = np.array(recorded(reads(clock, round(length_s / PERIOD_S), seed=2)))
    assert np.abs(rows[:, 1]).max() <= rows[:, 2].min() + 1.5e-3
    assert np.median(rows[:, 2]) < 2.5e-3


# The clock alone


@pytest.mark.parametrize("drift", [0.0, 80e-6, -80e-6])
@pytest.mark.parametrize("start", [0.0, 3e6])
def test_offset_and_rate_are_found_through_bus_jitter(drift: float, start: float) -> None:
    """USB-like delays of 0.2 ms plus up to 4 ms; device time up to a month."""
    rng, clock = np.random.default_rng(0), DeviceClock()
    for i in range(20_000):
        device = start + i * 2e-3
        delay = 0.2e-3 + rng.exponential(1e-3)
        clock.observe(device, 1000 + (device - start) * (1 + drift) + delay)
    now = start + 40.0
    truth = 1000 + (now - start) * (1 + drift) + 0.2e-3
    assert clock.to_host(now) == pytest.approx(truth, abs=0.1e-3)


def test_a_clock_is_never_later_than_arrivals_nor_slow_for_a_backlog() -> None:
    rng, clock = np.random.default_rng(1), DeviceClock()
    for i in range(3000):
        device, arrival = i * 5e-3, 7 + i * 5e-3 + rng.exponential(2e-3)
        clock.observe(device, arrival)
        assert clock.to_host(device) <= arrival + 1e-9
    # A reader that was stopped for 6 s and then reads at three times the pace.
    clock, worst_s = DeviceClock(), 0.0
    for i in range(6000):
        device = i * 0.01
        clock.observe(device, max(device, 26 + (device - 20) / 3 if device > 20 else 0.0))
        worst_s = max(worst_s, abs(clock.to_host(device) - device))
    assert worst_s < 0.1e-3


@pytest.mark.parametrize("backlog", [True, False])
def test_a_reader_that_falls_behind_ever_more_is_told_by_what_waits(backlog: bool) -> None:
    """At three quarters of the pace, for 12 s; else it is taken for a device of that pace."""
    clock, worst_s = DeviceClock(), 0.0
    for i in range(3200):
        device = i * 0.01
        late_s = max(0.0, (device - 20) / 3)
        clock.observe(device, device + late_s, backlog and late_s > 0)
        worst_s = max(worst_s, abs(clock.to_host(device) - device))
    assert (worst_s < 1e-3) == backlog


@pytest.mark.parametrize("speed", [0.1, 0.5, 0.9])
def test_a_device_slower_than_real_time_is_followed_at_its_pace(speed: float) -> None:
    """A replay at half the speed: what was sent now is stamped now, a minute later as well."""
    rng, clock = np.random.default_rng(3), DeviceClock()
    ages_s = []
    for i in range(6000):
        device, arrival = i * 10e-3, 5 + i * 10e-3 / speed + rng.exponential(1e-3)
        clock.observe(device, arrival)
        ages_s.append(arrival - clock.to_host(device))
    assert min(ages_s) > -0.01
    assert max(ages_s[1000:]) < 0.05


@pytest.mark.parametrize("drift", [0.0, 80e-6, -300e-6])
def test_the_drift_is_told_once_it_is_known(drift: float) -> None:
    """A device's clock that is faster by `drift`, through delays of up to 4 ms."""
    rng, clock = np.random.default_rng(2), DeviceClock()
    for i in range(10_000):
        host = i * 2e-3
        clock.observe(host * (1 + drift), host + rng.exponential(1e-3))
        clock.to_host(host)
        if host < 9.5:
            assert np.isnan(clock.drift_ppm)
    assert clock.drift_ppm == pytest.approx(drift * 1e6, abs=10)
