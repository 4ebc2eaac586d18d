# SPDX-License-Identifier: Apache-2.0

"""A silent skin whose digitizer's clock, and the way from there to the host, are known exactly.

    for read in reads(Clock(halts=((3.0, 0.5),)), frames=800, seed=1): …

The true time of every frame is that of the model, in s of the host's clock; nothing of the package
takes part in it. Each frame is one packet, which a driver can decode at next to no cost.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

FRAME_S, PERIOD_S = 0.01, 0.0128
"""s; nominal."""
SAMPLES, SAMPLES_PER_PERIOD = 812, 1024
"""Of a frame with what follows it, and from frame to frame."""
RATE_HZ = 80_000
BEGIN_S = 100.0
"""The host's time when the stream begins."""
LATE_S = 1e-3
"""Least delay of a read that had waited, s."""


@dataclass(frozen=True)
class Clock:
    """What the digitizer's clock and the link do.

    error: rate of the clock less 1. pace: true seconds that a second of the device takes, as of a
    replay.
    Events, at a time of the stream, s: steps: device time is off by so much from then on, and the
    count of samples is not. halts: the digitizer, with its clock, stands still for so long.
    stalls: the bus gives nothing for so long, then all that was sent. lags: for so long everything
    is read late, (at, duration, by), after it had waited.
    delay_s: mean of each packet's random delay beside the shortest. latency_s: the link hands
    packets on only so often.
    """

    error: float = 0.0
    pace: float = 1.0
    steps: tuple[tuple[float, float], ...] = ()
    halts: tuple[tuple[float, float], ...] = ()
    stalls: tuple[tuple[float, float], ...] = ()
    lags: tuple[tuple[float, float, float], ...] = ()
    delay_s: float = 1e-3
    latency_s: float = 0.0


class Read(NamedTuple):
    """A frame's packet: its first sample, device time, µs; when it was read, s, and had waited.

    true_s: middle of the frame on the host's clock.
    """

    first_index: int
    device_us: int
    t_host: float
    had_waited: bool
    true_s: float


def reads(clock: Clock, frames: int, seed: int) -> Iterator[Read]:
    """The packets in their order."""
    rng, read_s = np.random.default_rng(seed), 0.0
    second_s = clock.pace / (1 + clock.error)  # true time of a device's second
    for number in range(frames):
        at_s = number * PERIOD_S
        stood_s = sum(by for when, by in clock.halts if at_s >= when)
        stepped_s = sum(by for when, by in clock.steps if at_s >= when)
        true_s = BEGIN_S + at_s * second_s + stood_s
        sent_s = true_s + SAMPLES / RATE_HZ * second_s
        came_s = sent_s + 0.2e-3 + rng.exponential(clock.delay_s)
        if clock.latency_s:
            came_s = np.ceil(came_s / clock.latency_s) * clock.latency_s
        for when, by in clock.stalls:
            if BEGIN_S + when <= came_s < BEGIN_S + when + by:
                came_s = BEGIN_S + when + by
        had_waited = False
        for when, duration, by in clock.lags:
            if when <= at_s < when + duration:
                came_s, had_waited = came_s + min(by, 0.8 * (at_s - when)), True
        had_waited |= came_s < read_s
        read_s = max(read_s, came_s)
        device_us = round((50 + at_s + stepped_s) * 1e6)
        middle_s = true_s + FRAME_S / 2 * second_s
        index = number * SAMPLES_PER_PERIOD
        yield Read(index, device_us, read_s, had_waited, middle_s)
