# SPDX-License-Identifier: Apache-2.0

"""Judges a driver across digitizers and connections: words, stamps, and the sequence."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from tactile_cdma.driver.pipeline import TactileFrame
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from test.support.oracle import Stream, Verdict

from ..judge import Judge

MOST_MISSING = 1
"""Frames after a START that may be missing: the second one has to be published."""
CLOCK_S = 0.05
"""Tolerance of stamps, s: clock rates are trusted to 1e-3 over a window of 30 s, with a margin."""
LONG_AGO = Stream(SimOptions(), SimOptions().setup(), math.inf)
"""A stream without frames, in place of streams that are over."""


class Digitizer(VirtualDigitizer):
    """A virtual digitizer, powered up now, that reports every START it obeys to a judge."""

    def __init__(
        self, options: SimOptions, clock: Callable[[], float], judge: ConnectionJudge
    ) -> None:
        """clock: its time, s; may stand still at times, but is never faster than the host's."""
        self.powered_s, self._power_s = judge.clock(), clock()
        super().__init__(options, clock)
        self._clock, self._judge = clock, judge
        self._told = (False, 0.0)

    @property
    def now_s(self) -> float:
        """Its own time, s."""
        return self._clock() - self._power_s

    def receive(self, data: bytes) -> None:
        """See VirtualDigitizer."""
        super().receive(data)
        state = (self.streaming, self.started_s)
        if self.streaming and state != self._told:
            self._judge.began(self)
        self._told = state


@dataclass(frozen=True, slots=True)
class _Published:
    """A published frame that was judged.

    connection: number of the driver's. device_s: device time of its middle. true_s: earliest
    possible host time of that. late_s: largest possible error of its stamp.
    """

    sequence: int
    stream: int
    connection: int
    device_s: float
    true_s: float
    late_s: float


class ConnectionJudge(Judge):
    """Follows one driver.

    Wrong values are words that were not sent, frames that never were, and, as long as the
    digitizer's time does not stand still, stamps before the frame or after its publication.
    missing: for every published stream, number of frames at its beginning that were not published.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """clock: host time, s."""
        super().__init__()
        self.clock = clock
        self.missing: list[int] = []
        self._queue: deque[tuple[TactileFrame, int, float]] = deque()
        self._powered_s: list[float] = []  # of each stream's digitizer, host s
        self._digitizer: Digitizer | None = None
        self._last: _Published | None = None
        self._first_sequence = 0

    def take(self, frame: TactileFrame, connection: int = 0) -> None:
        """Queue a published frame; in the driver's thread. connection: number of the driver's."""
        self._queue.append((frame, connection, self.clock()))

    def began(self, digitizer: Digitizer) -> None:
        """Note a START: all frames published so far belong to earlier ones."""
        self.settle()
        # Frames of older streams will not come any more: free their memory.
        self.oracle.streams[:-2] = [LONG_AGO] * len(self.oracle.streams[:-2])
        self.oracle.began(digitizer.options, digitizer.setup, digitizer.started_s, digitizer.turns)
        self._powered_s.append(digitizer.powered_s)
        self._digitizer = digitizer

    @property
    def streams(self) -> int:
        """Number of STARTs."""
        return len(self._powered_s)

    def hears(self, device: object) -> bool:
        """Whether the newest stream is this digitizer's, and frames of it were published."""
        return self._heard_s(device) is not None

    def reached(self, digitizer: Digitizer, device_s: float) -> bool:
        """Whether a frame of its newest stream after this device time was published."""
        heard_s = self._heard_s(digitizer)
        return heard_s is not None and heard_s > device_s

    def _heard_s(self, device: object) -> float | None:
        """Device time of the last frame; None if not of the newest stream and this digitizer."""
        self.settle()
        if not isinstance(device, Digitizer) or self._last is None:
            return None
        newest = self._last.stream == self.streams - 1
        ours = newest and self._powered_s[-1] == device.powered_s
        return self._last.device_s if ours else None

    @property
    def late(self) -> int:
        """How often more frames were missing after a START than allowed."""
        return sum(missing > MOST_MISSING for missing in self.missing)

    def settle(self) -> None:
        """Judge all queued frames."""
        while self._queue:
            self._judge(*self._queue.popleft())

    @property
    def _keeps_pace(self) -> bool:
        """Whether the digitizer's time has not stood still, which a real one's never does."""
        digitizer = self._digitizer
        return digitizer is not None and (
            self.clock() - digitizer.powered_s - digitizer.now_s < CLOCK_S
        )

    def account(self, lost_frames: int) -> int:
        """Error of the driver's count of lost frames, at the end."""
        self.settle()
        if self._last is None:
            return lost_frames
        passed = self._last.sequence - self._first_sequence + 1
        return abs(passed - self.tally.frames - lost_frames)

    def _judge(self, frame: TactileFrame, connection: int, published_s: float) -> None:
        verdict = self.check(frame)
        if verdict.number is None:
            self.tally.wrong_values += not verdict.wrong.any()  # at least one for the frame
            return
        period_s = self.oracle.streams[verdict.stream].setup.spec.frame_period_s
        true_s = self._powered_s[verdict.stream] + frame.t_middle
        if self._keeps_pace:
            self.tally.wrong_values += not true_s - CLOCK_S < frame.t_host < published_s + CLOCK_S
        late_s = frame.t_host - true_s
        now = _Published(frame.sequence, verdict.stream, connection, frame.t_middle, true_s, late_s)
        self._follow(now, verdict, period_s)
        self._last = now

    def _follow(self, now: _Published, verdict: Verdict, period_s: float) -> None:
        """Compare a frame with the one before it."""
        last = self._last
        if last is None:
            self._first_sequence = now.sequence
        elif (now.stream, now.connection) == (last.stream, last.connection):
            self.tally.uncounted_losses += verdict.uncounted
        else:  # only the host's clock tells how many periods passed, and stamps may be late
            passed = (now.true_s - last.true_s) / period_s
            slack = 1 + (abs(now.late_s) + abs(last.late_s)) / period_s
            self.tally.uncounted_losses += (
                abs(now.sequence - last.sequence - max(1, passed)) > slack
            )
        if last is None or now.stream != last.stream:
            assert verdict.number is not None
            self.missing.append(verdict.number)
