# SPDX-License-Identifier: Apache-2.0

"""Stamps of frames beside the true times of a model of digitizer, clock and link."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass

from test.support.clock_model import Clock, reads
from test.support.stamped import silent_pipeline, stamped

from .tally import Tally

FRAMES = 25
"""Frames here for each of a line's, which take longer to decode."""
STEPS_MS = (-45, -20, -5, -2, 2, 5, 20, 45)
ERRORS = (-0.05, -0.009, -0.003, 0.003, 0.009)
"""Errors of the clock's rate: ceramic resonators, and worse."""


@dataclass(frozen=True)
class StampCondition:
    """Puts the driver to a clock and a link."""

    name: str
    clock: Clock
    rough: bool = False

    def run(self, frames: int, seed: int) -> tuple[Tally, list[str]]:
        """Count the stamps that are off by more than they say."""
        sent = reads(self.clock, FRAMES * frames, zlib.crc32(self.name.encode()) + seed)
        found = stamped(*silent_pipeline(), sent)
        off = [one for one in found if abs(one.off_s) > one.claimed_s]
        return Tally(stamps_off=len(off)), [
            f"  at {one.true_s:.3f} s: {1e3 * one.off_s:+.2f} ms off, of {1e3 * one.claimed_s:.2f}"
            for one in off
        ]


def conditions() -> Iterator[StampCondition]:
    """Clocks that step, stand still or are slow; hosts and links that hold packets up."""
    for name, clock in {
        "two crystals": Clock(error=1e-4),
        **{f"device time steps by {ms:+d} ms": Clock(steps=((4.0, 1e-3 * ms),)) for ms in STEPS_MS},
        "device time steps by +20 ms ten times": Clock(
            steps=tuple((2.0 + at, 0.02) for at in range(10))
        ),
        **{f"stands still for {s:g} s": Clock(halts=((4.0, s),)) for s in (0.02, 0.5, 5.0)},
        "stands still for 0.5 s ten times": Clock(halts=tuple((2.0 + at, 0.5) for at in range(10))),
        **{f"clock {100 * e:+.1f} %": Clock(error=e) for e in ERRORS},
        "clock -0.3 %, 10 ms of delay": Clock(error=-0.003, delay_s=0.01),
        "bus stalls for 1 and 3 s": Clock(stalls=((4.0, 1.0), (9.0, 3.0))),
        "host lags by 0.8 s": Clock(lags=((4.0, 6.0, 0.8),)),
        "10 ms of delay": Clock(delay_s=0.01),
        "a link that polls every 16 ms": Clock(latency_s=0.0159),
        "the same, stands still for 0.5 s": Clock(latency_s=0.0159, halts=((4.0, 0.5),)),
        "a replay at half the pace": Clock(pace=2.0),
    }.items():
        yield StampCondition(f"stamps: {name}", clock)
