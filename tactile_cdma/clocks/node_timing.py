# SPDX-License-Identifier: Apache-2.0

"""Line timing for nodes with clocks of their own: roll calls, and decorrelation where it is needed.

Until a roll call has shown otherwise, all nodes are taken to share one clock. Afterwards their
clocks decide: where plain correlation is good enough it stays, else frames are taken apart by
least squares.
"""

from __future__ import annotations

import math

import numpy as np

from ..code.frame import FrameSpec
from ..code.separate import NodeLevels
from ..framing.fit import MAX_SPREAD, Floats, word_floor
from ..framing.line_timing import LineTiming
from ..framing.timing import FrameLevels, QuietBlock, SampleBlock
from .clock_keeper import ClockKeeper
from .sampling import Sampling

TRACKED_FRAMES = 4
"""Clocks are followed in one of so many frames, a few nodes each time."""
MOST_REJECTED = 50
"""After so many frames in a row that the clocks do not explain, they must have changed."""


class NodeTiming(LineTiming):
    """Line timing of raw samples that learns the nodes' clocks from roll calls."""

    def __init__(
        self,
        spec: FrameSpec,
        rate_hz: float,
        rails_v: tuple[float, float] | None = None,
        background: bool = True,
    ) -> None:
        """See Timing; background: see ClockKeeper."""
        super().__init__(spec, rate_hz, rails_v)
        self.clocks = ClockKeeper(spec, Sampling(self._nominal), background)
        self._period = rate_hz * spec.frame_period_s
        self._called = self._next_called = False
        self._first_call: int | None = None  # where the roll call under way began
        self._before: int | None = None  # where the frame before began, if no hole followed
        self._frames = self._rejected_on_end = 0

    @property
    def rest_known(self) -> bool:
        """Whether a gap has shown the line at rest."""
        return self._level_known

    def feed(self, block: SampleBlock) -> list[FrameLevels]:
        """Take samples in; return the frames that they complete."""
        self._next_called = block.called
        return super().feed(block)

    def quiet(self, block: QuietBlock) -> list[FrameLevels]:
        """Take in what nobody spoke in."""
        self._next_called = block.called
        return super().quiet(block)

    def reset(self) -> None:
        """The stream has a hole: forget the frame in progress."""
        super().reset()
        self._before = None

    def _open(self, index: int) -> None:
        super()._open(index)
        was_called, self._called = self._called, self._next_called
        if self._called:
            if not was_called and self._first_call is None:
                self._begin_roll_call(index)
            self._due = index + self.clocks.listener.samples
        else:
            if self._first_call is not None:
                self._first_call = None
                self.clocks.conclude()
            self.clocks.adopt()
            if self.clocks.decorrelator is not None:
                self._due = index + self.clocks.decorrelator.samples
        self._before = index

    def _begin_roll_call(self, index: int) -> None:
        """Node 1 speaks, if this is the first called frame: none may be missing before it.

        Rows may be shifts of each other, so a frame taken for the next node's would be believed.
        """
        if self._before is not None and abs(index - self._before - self._period) < self._period / 2:
            self._first_call = index
            self.clocks.begin()

    def _decide(self, start: int, end: int, final: bool) -> list[FrameLevels]:
        if not self._called:
            return super()._decide(start, end, final)
        listener, volts = self.clocks.listener, self._samples.take(start, end)
        if volts.size < listener.samples or math.isnan(volts.sum()):
            self._reject()
            return []
        if self._first_call is not None:
            # By the samples passed, since frames may have been lost.
            node = round((start - self._first_call) / self._period)
            if node < self.spec.nodes:
                line = (volts - self._level_v).astype(np.float32)
                self.clocks.hear(node, line, self._sample_noise_v)
        frames = self._idle_frame(start, self._nominal_fit, self._sample_noise_v**2)
        self._gap_begin = start + listener.samples
        return frames

    def _loud_frame(self, start: int, end: int, volts: Floats, final: bool) -> list[FrameLevels]:
        decorrelator = self.clocks.decorrelator
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
        spoken = amplitude > word_floor(amplitude, self.spec)
        words = np.where(spoken, np.sign(values) * amplitude, 0)
        scatter = np.square((level - amplitude) * (words != 0)).sum()
        spread = float(scatter / np.square(words).sum()) / len(level)
        if spread > MAX_SPREAD:
            self._reject(start + decorrelator.samples)
            self._rejected_on_end += 1
            if self._rejected_on_end == MOST_REJECTED:
                self.clocks.give_up("the nodes' clocks are no longer those of the roll call")
            return []
        self._rejected_on_end = 0
        gain = float(np.sqrt(np.square(decorrelator.noise_gain).mean()))
        scatter_v = math.sqrt(spread * float(np.square(words).sum() / np.count_nonzero(words)))
        doubted = np.union1d(decorrelator.unresolved, np.flatnonzero(~decorrelator.clocks.known))
        levels = NodeLevels(
            values, max(gain * self._sample_noise_v, scatter_v), tuple(doubted.tolist())
        )
        frames = self._emit(start, self._nominal_fit, levels, volts)
        self._gap_begin = start + decorrelator.samples
        self._frames += 1
        if self._frames % TRACKED_FRAMES == 0:
            noise_rms_v = self._sample_noise_v
            self.clocks.follow(decorrelator, line, words.astype(np.float32), noise_rms_v)
        return frames

    @property
    def _sample_noise_v(self) -> float:
        return math.sqrt(self._noise * self._nominal)
