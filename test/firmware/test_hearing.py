# SPDX-License-Identifier: Apache-2.0

"""A digitizer that hears another one's frames begins its own with them; in samples, and in time."""

import ctypes
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.wire._protocol import Result, SyncMode
from tactile_cdma.wire.messages import Ack, Ask, Configure, FrameLayout, Info, Samples, Start
from test.support.core_digitizer import Board, CoreDigitizer

PERIOD_US = 20_000
CHIPS = 40
LAYOUT = replace(
    FrameLayout.of(FrameSpec(nodes=3, bits=10, order=4, chip_s=50e-6), 4), frame_period_us=PERIOD_US
)
SLOTS = replace(LAYOUT, resync_chips=4, guard_chips=2)
SAMPLE_US, PER_PERIOD = 12.5, 1600
START_US = 7_000_000
Hearing = Callable[..., CoreDigitizer]


@pytest.fixture
def hearing(core: ctypes.CDLL) -> Hearing:
    """Make a digitizer that is set to hear and started, and has heard a frame at this time."""

    def make(
        heard_us: int | None, layout: FrameLayout = LAYOUT, integrated: bool = False
    ) -> CoreDigitizer:
        digitizer = CoreDigitizer(core, Board.of(hears=True), now_us=START_US)
        if heard_us is not None:
            digitizer.heard(heard_us)
        digitizer.send(Configure(layout, SyncMode.HEAR, integrated), Start())
        return digitizer

    return make


def listen(
    digitizer: CoreDigitizer, master: Callable[[int], float], frames: int, layout: FrameLayout
) -> tuple[list[int], list[int], list[Samples]]:
    """When its pulses say that frames begin, the marked packets' times, and all packets, µs.

    master: begins of the other one's frames, of which those that are over are told of.
    """
    slots = -(-CHIPS // layout.resync_chips) if layout.resync_chips else 1
    pulsed, marked, packets, told = list[int](), list[int](), list[Samples](), 0
    ticks, now_us = digitizer.ticks_per_sample, float(START_US)
    (pulse,) = digitizer.pulses(1)
    for _ in range(frames):
        pulsed.append(START_US + round(pulse.announces / 48))
        *_, pulse = digitizer.pulses(slots)  # those left, and the next frame's, as boards do
        while now_us < pulsed[-1] + PERIOD_US / 2:
            while master(told) <= now_us:
                digitizer.heard(round(master(told)))
                told += 1
            digitizer.samples(np.full(40, 2048))
            now_us += 40 * ticks / 48
        packets += digitizer.packets(Samples)
    marked = [p.device_time_us - ticks / 96 for p in packets if p.sync]
    return pulsed, marked, packets


@pytest.mark.parametrize("layout", [LAYOUT, SLOTS], ids=["one slot", "slots"])
@pytest.mark.parametrize("ppm", [-60, -7, 0, 33, 60])
def test_frames_stay_with_those_that_are_heard(
    hearing: Hearing, layout: FrameLayout, ppm: float
) -> None:
    period_us = PERIOD_US * (1 + ppm * 1e-6)
    first_us = START_US - 5_432

    def master(number: int) -> float:
        return first_us + period_us * (number + 1)

    pulsed, marked, packets = listen(hearing(first_us, layout), master, 200, layout)
    begins = np.array([first_us + period_us * n for n in range(300)])
    away = np.array([us - begins[np.abs(begins - us).argmin()] for us in pulsed])
    assert np.abs(away).max() <= SAMPLE_US + 2
    assert marked == pytest.approx(pulsed[: len(marked)], abs=1)
    assert len(marked) >= 199
    ends = [p.first_index + len(p.counts) for p in packets]
    assert ends[:-1] == [p.first_index for p in packets[1:]], "no sample is left out"
    at_us = [START_US + (p.first_index + 0.5) * SAMPLE_US - p.device_time_us for p in packets]
    assert np.abs(at_us).max() <= 1, "samples are where they were: only marks have moved"


def test_the_first_frame_begins_with_one_that_was_heard(hearing: Hearing) -> None:
    for before_us in (0, 900, 5_000, 19_999, 60_000):
        (pulse,) = hearing(START_US - before_us).pulses(1)
        begin_us = pulse.announces / 48
        assert 1000 <= begin_us < 1000 + PERIOD_US + SAMPLE_US
        assert (begin_us + before_us) % PERIOD_US < SAMPLE_US + 1e-6


def test_without_another_one_it_goes_on_by_itself_and_says_so(hearing: Hearing) -> None:
    digitizer = hearing(None)
    pulses = digitizer.pulses(6)
    assert [p.tick for p in pulses] == [pulses[0].tick + n * PERIOD_US * 48 for n in range(6)]
    assert digitizer.status(START_US + 1_000_000).sync_faults == 5
    assert not digitizer.strayed


def test_one_frame_elsewhere_is_a_disturbance_three_are_another_phase(hearing: Hearing) -> None:
    digitizer = hearing(START_US)
    (first,) = digitizer.pulses(1)
    begin_us = START_US + round(first.announces / 48)
    digitizer.heard(begin_us + 700)
    ((second),) = digitizer.pulses(1)
    assert second.tick == first.tick + PERIOD_US * 48, "nodes would take it for a disturbance, too"
    assert not digitizer.strayed
    digitizer.heard(begin_us + PERIOD_US)
    digitizer.pulses(1)
    for number in range(2, 5):
        assert not digitizer.strayed
        digitizer.heard(begin_us + number * PERIOD_US + 700)
        digitizer.pulses(1)
    assert digitizer.strayed
    digitizer.send(Start())
    assert not digitizer.strayed


def test_it_is_reported_and_asks_by_itself(hearing: Hearing, core: ctypes.CDLL) -> None:
    digitizer = hearing(START_US)
    packets = digitizer.packets(Ack, Info)
    assert [p.sync_mode for p in packets if isinstance(p, Info)][-1] == SyncMode.HEAR
    digitizer.pulses(1)
    assert digitizer.results(Ask(0)) == [Result.OK]
    deaf = CoreDigitizer(core, Board.of(), now_us=START_US)
    deaf.send(Configure(LAYOUT, SyncMode.HEAR))
    assert deaf.packets(Info)[-1].sync_mode == SyncMode.DRIVE


@pytest.mark.parametrize("period_us", [2_155, 8_000])
def test_a_period_without_room_to_move_is_refused(core: ctypes.CDLL, period_us: int) -> None:
    """A frame and its tail take 43 chips of 50 µs; 1/512 of 8 ms is 15.6 µs, a sample and 3 µs."""
    tight = replace(LAYOUT, frame_period_us=period_us)
    digitizer = CoreDigitizer(core, Board.of(hears=True))
    assert digitizer.results(Configure(tight)) == [Result.OK]
    assert digitizer.results(Configure(tight, SyncMode.HEAR)) == [Result.UNSUPPORTED]
    roomy = replace(LAYOUT, frame_period_us=9_000)
    assert digitizer.results(Configure(roomy, SyncMode.HEAR)) == [Result.OK]
