# SPDX-License-Identifier: Apache-2.0

"""The RP2040's image with another digitizer's sync line at GPIO17: pulses, phase, disturbances."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rp2040 import PIN_HEARD
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.wire._protocol import SyncMode
from tactile_cdma.wire.messages import Configure, FrameLayout, Info, Start
from test.support.rp2040_bench import Bench

PERIOD_S, FRAME_S, RESTART_S = 0.02, 32e-6, 16e-6
SPEC = FrameSpec(nodes=16, order=20, chip_s=50e-6, frame_period_s=PERIOD_S)
LAYOUT = FrameLayout.of(SPEC, 4)
SAMPLE_US = 12.5
SETTLED = 6
"""Frames: the stream's first ones, and those in which another phase is believed in."""


def pulses(begins_s: NDArray[np.float64], length_s: float) -> list[tuple[float, bool]]:
    return [edge for s in begins_s for edge in ((float(s), True), (float(s) + length_s, False))]


def apart_us(bench: Bench, begins_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """From every frame's pulse to the nearest one that was heard, µs."""
    own_s = np.array([up_ns * 1e-9 for up_ns, length_ns in bench.pulses if length_ns > 24e3])
    return np.array([(s - begins_s[np.abs(begins_s - s).argmin()]) * 1e6 for s in own_s])


@pytest.mark.parametrize("ppm", [-60, 60])
def test_its_frames_are_those_that_it_hears(bench: Bench, ppm: float) -> None:
    """Though digits, restarts and glitches are on that line, too."""
    begins_s = 0.061 + PERIOD_S * (1 + ppm * 1e-6) * np.arange(45)
    others = pulses(begins_s - 128e-6, RESTART_S) + pulses(begins_s + 4.321e-3, RESTART_S)
    glitches = pulses(begins_s + 7e-3, 60e-6) + pulses(begins_s + 9e-3, 3e-6)
    bench.board.drive(PIN_HEARD, sorted(pulses(begins_s, FRAME_S) + others + glitches))
    bench.run(0.09)
    bench.stream(Configure(LAYOUT, SyncMode.HEAR), 0.8)
    away_us = apart_us(bench, begins_s)
    assert away_us.size >= 38
    assert np.abs(away_us).max() <= SAMPLE_US + 2
    assert bench.of(Info)[-1].sync_mode == SyncMode.HEAR
    assert bench.check(bench.line) > 60_000, "and samples are where they were"


def test_a_clock_that_was_started_anew_is_followed(bench: Bench) -> None:
    before_s = 0.061 + PERIOD_S * np.arange(15)
    after_s = before_s[-1] + 0.027 + PERIOD_S * np.arange(20)
    bench.board.drive(PIN_HEARD, pulses(np.concatenate((before_s, after_s)), FRAME_S))
    bench.run(0.03)
    bench.send(Configure(LAYOUT, SyncMode.HEAR), Start())
    bench.run(after_s[-1] - bench.board.now)
    away_us = apart_us(bench, np.concatenate((before_s, after_s)))
    is_near = np.abs(away_us) <= SAMPLE_US + 2
    assert is_near[:12].all() and is_near[-10:].all()
    assert 1 <= np.sum(~is_near) <= SETTLED, "a frame elsewhere is not believed at once"
    bench.run(1.5)
    assert 50 <= bench.status.sync_faults <= 65, "then that one fell silent"
