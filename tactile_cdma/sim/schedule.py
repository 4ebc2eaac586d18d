# SPDX-License-Identifier: Apache-2.0

"""The digitizer's clock, and what is due by it: a report every second, and a stream's packets."""

import math
from collections import deque
from collections.abc import Callable, Iterator

from .packets import Block

REPORT_S = 1.0
"""INFO and STATUS are repeated at this interval (docs/protocol.md)."""
_PREPARE_S = 1e-3
"""Pause after a packet before the samples of the next one are computed, which takes time, so that
the transport hands on the first one meanwhile; chosen, well below a frame period."""


class Schedule:
    """One clock for all that a digitizer does.

    now_s: s since power-up, at `speed` times the host's pace. At speed 0, while streaming, the
    clock stands until something is asked for, and then steps to when that is due.
    started_s: when the stream began, s; later by the duration of frames lost since.
    report_s: when the next report is due. born_s: host time of power-up, s.
    streaming: between start and stop. hurried: packets are then made as they are asked for.
    """

    def __init__(self, clock: Callable[[], float], speed: float) -> None:
        """clock: host time, s."""
        self.host_clock, self._speed = clock, speed
        self.born_s = self._host_s = clock()
        self.now_s = self.started_s = self.report_s = 0.0
        self.streaming = self.hurried = False
        self._blocks: Iterator[Block] = iter(())
        self._ready = deque[Block]()  # computed, and not sent yet
        self._compute_s = math.inf  # when the next ones are to be computed, s since START
        self._begins = False  # those are of a new frame, where frames are marked

    @property
    def due_s(self) -> float:
        due_s = self._ready[0].due_s if self._ready else self._compute_s
        return min(self.report_s, self.started_s + due_s)

    @property
    def frame_is_due(self) -> bool:
        """Tell whether what is due next is to compute a new frame; where frames are marked."""
        return not self._ready and self._begins and self.due_s != self.report_s

    @property
    def wait_s(self) -> float:
        """Host time until something is due, s."""
        return max(0.0, self.due_s - self.now_s) / (self._speed or 1.0)

    def pass_time(self) -> float:
        """Follow the host's clock; returns its time."""
        host_s = self.host_clock()
        if not self.hurried:
            self.now_s += (host_s - self._host_s) * (self._speed or 1.0)
        self._host_s = host_s
        return host_s

    def start(self, blocks: Iterator[Block]) -> None:
        self._blocks, self._compute_s, self._begins = blocks, 0.0, True
        self._ready.clear()
        self.started_s = self.now_s
        self.streaming, self.hurried = True, self._speed == 0

    def stop(self) -> None:
        self._ready.clear()
        self._compute_s, self._begins = math.inf, False
        self.streaming = self.hurried = False

    def skip(self, seconds: float) -> None:
        """Let the stream stand still for so long; no more than one report of that time is due."""
        self.started_s += seconds
        self.report_s = max(self.report_s, self.now_s)

    def take(self) -> Block | None:
        """Take what is due next of the stream: a packet, or None after computing the next ones.

        With a block that waits comes the one that it waits for. Where packets are made as they are
        asked for nothing waits: no frame is computed before.
        """
        if self._ready:
            return self._ready.popleft()
        self._ready.append(next(self._blocks))
        while self._ready[-1].waits and self._speed:
            self._ready.append(next(self._blocks))
        last = self._ready[-1]
        self._compute_s = last.due_s + (_PREPARE_S if self._speed else 0.0)
        self._begins = last.last
        return None
