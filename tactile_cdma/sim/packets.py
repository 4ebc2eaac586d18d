# SPDX-License-Identifier: Apache-2.0

"""How a digitizer divides the line among packets, and what of it it leaves unsaid."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..wire._protocol import MAX_PACKET_US, MAX_SAMPLES, TAIL_CHIPS, SyncMode
from .options import Setup


class Cut(NamedTuple):
    """Samples of a frame period that make one packet; quiet: sent as Quiet; waits: for the next."""

    start: int
    stop: int
    quiet: bool = False
    waits: bool = False


class Cutter:
    """Cuts one frame period after the other; see docs/protocol.md for the rules."""

    def __init__(self, setup: Setup, quiet_counts: int) -> None:
        """quiet_counts: largest difference of samples in a Quiet; 0: there are none."""
        spec = setup.spec
        self.gap_size = min(MAX_SAMPLES, max(1, MAX_PACKET_US * round(setup.rate_hz) // 10**6))
        """Most samples in a packet outside of frames."""
        self.frame_size = spec.chips
        """Samples of a frame: its coded chips, or if raw its whole span and the tail."""
        if not setup.integrated:
            self.frame_size = (spec.span_chips + TAIL_CHIPS) * setup.samples_per_chip
        self._quiet_counts = 0 if setup.sync == SyncMode.NONE else quiet_counts

    def cuts(self, counts: NDArray[np.int16], marked: bool) -> Iterator[Cut]:
        """The packets of the samples from one frame's start to the next one's.

        marked: the first sample is a frame's, and known to be.
        """
        end = len(counts)
        frame_size = min(self.frame_size, end) if marked else 0
        silent = frame_size > 0 and self._quiet(counts[:frame_size])
        if silent:
            yield Cut(0, frame_size, quiet=True)
        else:
            for start in range(0, frame_size, MAX_SAMPLES):
                yield Cut(start, min(start + MAX_SAMPLES, frame_size))
        gap = counts[frame_size:]
        if silent and gap.size and self._quiet(gap):
            yield Cut(frame_size, end, quiet=True, waits=True)
        else:
            for start in range(frame_size, end, self.gap_size):
                stop = min(start + self.gap_size, end)
                yield Cut(start, stop, self._quiet(counts[start:stop]))

    def _quiet(self, counts: NDArray[np.int16]) -> bool:
        return 0 < self._quiet_counts >= int(counts.max()) - int(counts.min())
