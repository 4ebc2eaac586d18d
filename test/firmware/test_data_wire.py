# SPDX-License-Identifier: Apache-2.0

"""Sync pulses on the data wire: what the digitizer makes of samples while it pulls that low.

Truth is arithmetic: pulses begin 64 µs before what they announce (docs/protocol.md), and a sample
is taken in the middle of its period.
"""

import ctypes

import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.wire._protocol import SyncWire
from tactile_cdma.wire.messages import Ask, Configure, FrameLayout, Quiet, Samples
from test.support.core_digitizer import CoreDigitizer, Pulse, streaming

LEAD_US, UNIT_US, SAMPLE_US = 64, 16, 6.25
RESTING, PULLED = 2048, 90
QUIET_UV = 20_000  # 20 counts of this board
MARK_US, PERIOD_US, FRAME_US = 1000, 12_800, 8000
FRAMES = 4
DIGIT_US = 128


def digitizer_on(core: ctypes.CDLL, wire: SyncWire, integrated: bool = False) -> CoreDigitizer:
    layout = FrameLayout.of(FrameSpec(), samples_per_chip=1 if integrated else 8)
    asked = Configure(layout, integrated=integrated, quiet_uv=QUIET_UV, sync_wire=wire)
    return streaming(core, asked)


def line_with(
    pulses_us: list[tuple[float, float]], level: int, sample_us: float = SAMPLE_US
) -> NDArray[np.uint16]:
    """Counts of a resting line with hum: `level` in a pulse, half of it for 10 µs after that."""
    times_us = (np.arange(int(FRAMES * PERIOD_US / sample_us)) + 0.5) * sample_us
    counts = RESTING + np.round(2 * np.sin(times_us / 3183)).astype(int)
    for begin_us, length_us in pulses_us:
        counts[(times_us >= begin_us) & (times_us < begin_us + length_us)] = level
        back = (times_us >= begin_us + length_us) & (times_us < begin_us + length_us + 10)
        counts[back] = (level + RESTING) // 2
    return counts.astype(np.uint16)


def in_us(pulses: list[Pulse]) -> list[tuple[float, float]]:
    """When pulses begin, and how long they are."""
    return [(pulse.tick / 48, pulse.units * UNIT_US) for pulse in pulses]


def pulses_of(digitizer: CoreDigitizer) -> list[tuple[float, float]]:
    """Frames' pulses and those of the digits before the third frame, which is asked to speak."""
    pulses = digitizer.pulses(2)
    digitizer.send(Ask())
    pulses += digitizer.pulses(FRAMES + 1 - 2)
    taken = in_us(pulses)
    mark_us = MARK_US + 2 * PERIOD_US - LEAD_US
    assert (mark_us - 6 * DIGIT_US, 16) in taken
    return taken


@pytest.mark.parametrize("chunk", [None, 7])
@pytest.mark.parametrize("level", [PULLED, 4020])
def test_no_pulse_is_taken_for_a_signal(core: ctypes.CDLL, level: int, chunk: int | None) -> None:
    """Neither where the line falls, nor where its amplifier rises to its rail."""
    sent = {}
    for wire in SyncWire:
        digitizer = digitizer_on(core, wire)
        pulses = pulses_of(digitizer)
        counts = line_with(pulses, level)
        for part in np.split(counts, range(chunk, len(counts), chunk)) if chunk else [counts]:
            digitizer.samples(part)
        sent[wire] = digitizer.packets(Samples, Quiet)
        assert digitizer.status(2_000_000).sync_faults == 0
    assert all(isinstance(packet, Quiet) for packet in sent[SyncWire.DATA])
    assert max(packet.variance for packet in sent[SyncWire.DATA]) < 4
    # On a wire of its own this would be a signal: nothing is held back.
    assert any(level in packet.counts for packet in sent[SyncWire.OWN] if type(packet) is Samples)


def test_only_the_samples_of_a_pulse_repeat_the_last_one_before(core: ctypes.CDLL) -> None:
    digitizer = digitizer_on(core, SyncWire.DATA)
    pulses = pulses_of(digitizer)
    size = round(FRAMES * PERIOD_US / SAMPLE_US)
    counts = np.random.default_rng(1).integers(1000, 3000, size)  # nothing is quiet
    digitizer.samples(counts)
    times_us = (np.arange(size) + 0.5) * SAMPLE_US
    expected = counts.copy()
    for begin_us, _ in pulses:
        hidden = np.flatnonzero((times_us >= begin_us) & (times_us < begin_us + LEAD_US))
        assert len(hidden) == pytest.approx(LEAD_US / SAMPLE_US, abs=1)
        expected[hidden] = counts[hidden[0] - 1]
    got = np.concatenate([packet.counts for packet in digitizer.packets(Samples)])
    np.testing.assert_array_equal(got, expected[: len(got)])
    assert len(got) > size - 800


@pytest.mark.parametrize("integrated", [False, True])
@pytest.mark.parametrize(
    ("level", "faults"),
    [
        (PULLED, 0),
        (RESTING, FRAMES),  # the pull-down is not connected
        (RESTING - 600, FRAMES),  # hum of 0.5 V is no pulse
    ],
)
def test_a_pulse_that_the_line_does_not_follow_is_counted(
    core: ctypes.CDLL, level: int, faults: int, integrated: bool
) -> None:
    digitizer = digitizer_on(core, SyncWire.DATA, integrated)
    pulses = in_us(digitizer.pulses(FRAMES + 1))
    digitizer.samples(line_with(pulses, level, digitizer.ticks_per_sample / 48))
    assert digitizer.status(2_000_000).sync_faults == faults


def test_a_line_that_is_stuck_low_is_counted_and_lost_samples_are_not(core: ctypes.CDLL) -> None:
    digitizer = digitizer_on(core, SyncWire.DATA)
    digitizer.pulses(FRAMES + 1)
    digitizer.samples(np.full(round(2 * PERIOD_US / SAMPLE_US), PULLED))
    assert digitizer.status(2_000_000).sync_faults == 2
    digitizer.lost(round(2 * PERIOD_US / SAMPLE_US))
    assert digitizer.status(3_000_000).sync_faults == 2
