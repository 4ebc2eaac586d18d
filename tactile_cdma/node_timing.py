"""Line timing for nodes with clocks of their own: roll calls, and decorrelation where it is needed.

Until a roll call has shown otherwise, all nodes are taken to share one clock. Afterwards their
clocks decide: where plain correlation is good enough it stays, else a decorrelator is built, beside
the stream, and takes over; it follows the clocks and is built anew when they have moved.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from .clock_tracking import REBUILD, ClockTracker
from .decorrelate import Decorrelator
from .errors import SpecError
from .fit import Floats
from .frame import FrameSpec
from .line_timing import MAX_SPREAD, LineTiming
from .node_clocks import NodeClocks, needs_decorrelation
from .roll_call import RollCallListener
from .sampling import Sampling
from .separate import NodeLevels
from .timing import FrameLevels, QuietBlock, SampleBlock

TRACKED_FRAMES = 4
"""Clocks are followed in one of so many frames, a few nodes each time."""


@dataclass(frozen=True, slots=True)
class ClockReport:
    """What is known of the nodes' clocks.

    heard: nodes that a roll call has measured. spread_chips: largest difference of two nodes within
    a frame, chips. decorrelated: whether frames are taken apart by least squares.
    unresolved: nodes, from 1 on, that cannot be told from others. problem: why the clocks are not
    made use of, or None.
    """

    heard: int = 0
    spread_chips: float = 0.0
    decorrelated: bool = False
    unresolved: tuple[int, ...] = ()
    problem: str | None = None


class NodeTiming(LineTiming):
    """Line timing of raw samples that learns the nodes' clocks from roll calls.

    report: what is known of the clocks just now.
    """

    def __init__(
        self,
        spec: FrameSpec,
        rate_hz: float,
        rails_v: tuple[float, float] | None = None,
        background: bool = True,
    ) -> None:
        """See Timing. background: long work is done in a thread beside the stream; else at once,
        so that the same samples always give the same frames.
        """
        super().__init__(spec, rate_hz, rails_v)
        self.report = ClockReport()
        self._sampling = Sampling(self._nominal)
        self._period = rate_hz * spec.frame_period_s
        self._called = self._next_called = False
        self._listener: RollCallListener | None = None
        self._first_call = 0
        self._decorrelator: Decorrelator | None = None
        self._tracker: ClockTracker | None = None
        self._frames = 0
        self._worker = ThreadPoolExecutor(1, "node clocks") if background else None
        self._building: Future[Decorrelator | None] | None = None

    def feed(self, block: SampleBlock) -> list[FrameLevels]:
        """Take samples in; return the frames that they complete."""
        self._next_called = block.called
        return super().feed(block)

    def quiet(self, block: QuietBlock) -> list[FrameLevels]:
        """Take in what nobody spoke in."""
        self._next_called = block.called
        return super().quiet(block)

    def _open(self, index: int) -> None:
        super()._open(index)
        self._called = self._next_called
        if self._called:
            if self._listener is None:
                self._listener = RollCallListener(self.spec, self._sampling)
                self._first_call = index
            self._due = index + self._listener.samples
            return
        if self._listener is not None:
            listener, self._listener = self._listener, None
            self._building = self._later(self._judge, listener)
        self._adopt()
        if self._decorrelator is not None:
            self._due = index + self._decorrelator.samples

    def _decide(self, start: int, end: int, final: bool) -> list[FrameLevels]:
        if not self._called:
            return super()._decide(start, end, final)
        listener, volts = self._listener, self._samples.take(start, end)
        assert listener is not None, "a called frame has opened it"
        if volts.size < listener.samples or math.isnan(volts.sum()):
            self._reject()
            return []
        # By the samples passed, since frames may have been lost.
        node = round((start - self._first_call) / self._period)
        noise_rms_v = self._sample_noise_v
        if 0 <= node < self.spec.nodes:
            line = (volts - self._level_v).astype(np.float32)
            self._later(listener.hear, node, line, noise_rms_v)
        frames = self._idle_frame(start, self._nominal_fit, noise_rms_v**2)
        self._gap_begin = start + listener.samples
        return frames

    def _loud_frame(self, start: int, end: int, volts: Floats, final: bool) -> list[FrameLevels]:
        decorrelator = self._decorrelator
        if decorrelator is None:
            return super()._loud_frame(start, end, volts, final)
        if volts.size < decorrelator.samples:
            self._reject()
            return []
        line = (volts - self._level_v).astype(np.float32)
        values = decorrelator.estimate(line)
        level = np.abs(values)
        amplitude = level.mean(axis=0)
        if self._silent(amplitude):
            return self._idle_frame(start, self._nominal_fit, self._sample_power(volts))
        words = np.where(amplitude > 0.5 * amplitude.max(), np.sign(values) * amplitude, 0)
        spread = np.square((level - amplitude) * (words != 0)).sum() / np.square(words).sum()
        if spread > MAX_SPREAD:
            self._reject(start + decorrelator.samples)
            return []
        self._frames += 1
        if self._frames % TRACKED_FRAMES == 0:
            self._track(decorrelator, line, words.astype(np.float32))
        gain = float(np.sqrt(np.square(decorrelator.noise_gain).mean()))
        levels = NodeLevels(values, gain * self._sample_noise_v, tuple(decorrelator.unresolved))
        frames = self._emit(start, self._nominal_fit, levels, volts)
        self._gap_begin = start + decorrelator.samples
        return frames

    @property
    def _sample_noise_v(self) -> float:
        return math.sqrt(self._noise * self._nominal)

    def _judge(self, listener: RollCallListener) -> Decorrelator | None:
        """What a roll call has shown: a decorrelator, if it takes one."""
        clocks = listener.clocks()
        heard, spread = int(clocks.known.sum()), clocks.spread_chips(self.spec)
        if heard < self.spec.nodes:
            missing = ", ".join(map(str, (np.flatnonzero(~clocks.known)[:10] + 1).tolist()))
            self.report = ClockReport(
                heard, spread, problem=f"not heard alone in the roll call: nodes {missing}"
            )
            if not heard:
                return None
        if not needs_decorrelation(self.spec, clocks):
            self.report = ClockReport(heard, spread, problem=self.report.problem)
            return None
        self._tracker = ClockTracker(clocks)
        return self._build(clocks)

    def _build(self, clocks: NodeClocks) -> Decorrelator | None:
        heard, spread = int(clocks.known.sum()), clocks.spread_chips(self.spec)
        try:
            decorrelator = Decorrelator(self.spec, clocks, self._sampling)
        except SpecError as error:
            self.report = ClockReport(heard, spread, problem=str(error))
            return None
        unresolved = tuple((decorrelator.unresolved + 1).tolist())
        self.report = ClockReport(heard, spread, True, unresolved, self.report.problem)
        return decorrelator

    def _track(self, decorrelator: Decorrelator, line: Any, words: Any) -> None:
        """Follow the clocks; where they have moved too far, build anew."""
        tracker = self._tracker
        if tracker is None or self._building is not None:
            return
        tracker.update(decorrelator, line, words, self._sample_noise_v)
        if tracker.clocks.moved_chips(decorrelator.clocks, self.spec) > REBUILD:
            self._building = self._later(self._build, tracker.clocks)

    def _adopt(self) -> None:
        """Use the decorrelator that was being built, if it is ready."""
        if self._building is not None and self._building.done():
            self._decorrelator, self._building = self._building.result(), None

    def _later(self, work: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Have work done, one piece after the other, beside the stream or at once."""
        if self._worker is not None:
            return self._worker.submit(work, *arguments)
        done: Future[Any] = Future()
        done.set_result(work(*arguments))
        return done
