# SPDX-License-Identifier: Apache-2.0

"""Line timing for nodes with clocks of their own: roll calls, and decorrelation where needed.

Until a roll call has shown otherwise, all nodes are taken to share one clock. Afterwards their
clocks decide between plain correlation, where that is good enough, and least squares.
"""

import math
from dataclasses import replace

import numpy as np

from ..base.arrays import Floats32
from ..code.frame import FrameSpec
from ..code.separate import NodeLevels
from ..framing.fit import word_floor
from ..framing.limits import LIMITS
from ..framing.line_timing import LineRecogniser
from ..framing.marked_timing import (
    CarriedTiming,
    MarkedFrame,
    MarkedLine,
    MarkedTiming,
    Recogniser,
    Verdict,
)
from ..framing.timing import ABSURD, INCOMPLETE, MISFIT, Rails
from .clock_keeper import ClockKeeper
from .decorrelate import Decorrelator

TRACKED_FRAMES = 4
"""Clocks are followed in one frame of so many, clock_tracking.NODES_PER_FRAME nodes each time.
Chosen: 16 nodes at 78 Hz are all looked at ten times a second."""
MOST_REJECTED = 50
"""Frames in a row that the clocks fail to explain before they are dropped. Chosen: 0.6 s at 78 Hz,
longer than disturbances that pass."""


class NodeTiming(MarkedTiming):
    """Line timing of raw samples that learns the nodes' clocks from roll calls.

    clocks: what is known of them.
    """

    def __init__(
        self, spec: FrameSpec, rate_hz: float, rails_v: Rails = None, background: bool = True
    ) -> None:
        """See MarkedLine; background: see ClockKeeper."""
        line = MarkedLine(spec, rate_hz, rails_v)
        self.clocks = ClockKeeper(spec, line.chip, background)
        super().__init__(line, NodeRecogniser(line, self.clocks))


class NodeRecogniser(Recogniser):
    """Listens to roll calls, and takes frames apart by the nodes' clocks."""

    def __init__(self, line: MarkedLine, clocks: ClockKeeper) -> None:
        super().__init__(line)
        self._clocks = clocks
        self._common = LineRecogniser(line)  # while correlation does
        self._period = line.spec.frame_period_s / line.spec.chip_s * line.chip
        self._called = False
        self._first_call: int | None = None  # where the roll call under way began
        self._frames = self._rejected_in_a_row = 0

    def open(self, start: int, called: bool, since: int | None) -> int:
        """Begin or conclude a roll call where the frame is its first, or the first after it."""
        samples = self._common.open(start, called, since)
        was_called, self._called = self._called, called
        if called:
            # Node 1 speaks, if no frame is missing before. Rows may be shifts of each other, so a
            # frame taken for the next node's would be believed.
            follows = since is not None and abs(since - self._period) < self._period / 2
            if follows and not was_called and self._first_call is None:
                self._first_call = start
                self._clocks.begin()
            return self._clocks.listener.samples
        if self._first_call is not None:
            self._first_call = None
            self._clocks.conclude()
        self._clocks.adopt()
        decorrelator = self._clocks.decorrelator
        return samples if decorrelator is None else decorrelator.samples

    def forget(self) -> None:
        """See Recogniser."""
        self._common.forget()

    @property
    def carried(self) -> CarriedTiming | None:
        """See Recogniser: none in roll calls, while one is evaluated, or by least squares."""
        clocks = self._clocks
        if self._called or self._first_call is not None or not clocks.settled:
            return None
        return None if clocks.decorrelator else self._common.carried

    def recognise(self, frame: MarkedFrame) -> Verdict:
        """See Recogniser."""
        if self._called:
            self._common.note(frame)
            return self._hear(frame)
        decorrelator = self._clocks.decorrelator
        if decorrelator is None:
            return self._common.recognise(frame)
        self._common.note(frame)
        return self._line.gate(frame) or self._decorrelate(frame, decorrelator)

    def _hear(self, frame: MarkedFrame) -> Verdict:
        """Learn from a frame in which one node was called; none of its words are published."""
        samples, line = self._clocks.listener.samples, self._line
        if frame.volts.size < samples:
            return Verdict(rejected=INCOMPLETE)
        if math.isnan(frame.volts.sum()):
            return Verdict(rejected=ABSURD)
        if self._first_call is not None:
            # By the samples passed, since frames may have been lost.
            node = round((frame.start - self._first_call) / self._period)
            if node < line.spec.nodes:
                volts = (frame.volts - line.level_v).astype(np.float32)
                self._clocks.hear(node, volts, line.sample_noise_v)
        verdict = line.silent(frame, line.sample_noise_v**2)
        if verdict.frame is not None:  # who was not called was silent in any case
            every = np.ones(line.spec.nodes, dtype=bool)
            verdict = verdict._replace(frame=replace(verdict.frame, doubtful=every))
        return verdict._replace(over=frame.start + samples)

    def _decorrelate(self, frame: MarkedFrame, decorrelator: Decorrelator) -> Verdict:
        """Decode a frame by least squares, and follow the clocks."""
        line, over = self._line, frame.start + decorrelator.samples
        if frame.volts.size < decorrelator.samples:
            return Verdict(rejected=INCOMPLETE)
        volts = (frame.volts - line.level_v).astype(np.float32)
        values = decorrelator.estimate(volts)
        gain = float(np.sqrt(np.square(decorrelator.noise_gain).mean()))
        level: Floats32 = np.abs(values)
        amplitude = level.mean(axis=0)
        if line.is_silent(amplitude):
            levels = NodeLevels(values, gain * line.sample_noise_v)
            return line.silent(frame, line.sample_power(frame.volts), levels)
        spoken = amplitude > word_floor(amplitude, line.spec)
        words = np.where(spoken, np.sign(values) * amplitude, 0)
        scatter = np.square((level - amplitude) * (words != 0)).sum()
        spread = float(scatter / np.square(words).sum()) / len(level)
        if spread > LIMITS.spread:
            self._rejected_in_a_row += 1
            if self._rejected_in_a_row == MOST_REJECTED:
                self._clocks.give_up("the nodes' clocks are no longer those of the roll call")
            return Verdict(over=over, rejected=MISFIT)
        self._rejected_in_a_row = 0
        scatter_v = math.sqrt(spread * float(np.square(words).sum() / np.count_nonzero(words)))
        doubted = np.union1d(decorrelator.unresolved, np.flatnonzero(~decorrelator.clocks.known))
        noise_v = max(gain * line.sample_noise_v, scatter_v)
        self._frames += 1
        if self._frames % TRACKED_FRAMES == 0:
            self._clocks.follow(decorrelator, volts, words.astype(np.float32), line.sample_noise_v)
        levels = NodeLevels(values, noise_v, tuple(doubted.tolist()))
        return line.heard(frame, line.nominal, levels)._replace(over=over)
