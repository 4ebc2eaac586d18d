# SPDX-License-Identifier: Apache-2.0

"""The stream of marked frames, with a scripted recogniser."""

import numpy as np

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.framing.marked_timing import (
    CarriedTiming,
    MarkedFrame,
    MarkedLine,
    MarkedTiming,
    Verdict,
)
from tactile_cdma.framing.timing import MISFIT, QuietBlock, SampleBlock

SPEC = FrameSpec()
PERIOD = 1024  # samples, at 4 per chip


class Scripted:
    """Gives prepared verdicts, and keeps what it is asked."""

    def __init__(self, line: MarkedLine) -> None:
        self.line = line
        self.verdicts: list[Verdict] = []
        self.frames: list[tuple[int, int, bool]] = []
        self.asked: list[int] = []
        self.forgotten = 0
        self.carried = CarriedTiming(line.size)

    def recognise(self, frame: MarkedFrame) -> Verdict:
        self.frames.append((frame.start, frame.volts.size, frame.final))
        self.asked.append(frame.opened)
        if self.verdicts:
            return self.verdicts.pop(0)
        return self.line.gate(frame) or self.line.silent(frame, 0.0)

    def forget(self) -> None:
        self.forgotten += 1


def scripted() -> tuple[MarkedTiming, Scripted]:
    line = MarkedLine(SPEC, 4 / SPEC.chip_s, None)
    recogniser = Scripted(line)
    return MarkedTiming(line, recogniser), recogniser


def block(index: int, size: int = PERIOD) -> SampleBlock:
    return SampleBlock(index, np.zeros(size, np.float32), sync=True)


def test_a_recogniser_gets_the_samples_that_it_asks_for() -> None:
    timing, recogniser = scripted()
    recogniser.verdicts = [Verdict(due=900)]
    assert timing.feed(block(0, 850)) == []
    (frame,) = timing.feed(SampleBlock(850, np.zeros(174, np.float32)))
    assert recogniser.frames == [(0, timing.line.size, False), (0, 900, False)]
    assert frame.start == -0.5 and timing.rejections.total == 0


def test_the_next_mark_ends_a_frame_that_waits() -> None:
    timing, recogniser = scripted()
    recogniser.verdicts = [Verdict(due=2000)]
    assert timing.feed(block(0)) == []
    assert [frame.start for frame in timing.feed(block(PERIOD, 10))] == [-0.5]
    assert recogniser.frames[-1] == (0, PERIOD, True)
    assert timing.flush() == [] and timing.rejections.total == 1  # ten samples are no frame


def test_rejections_are_counted_and_told() -> None:
    timing, recogniser = scripted()
    recogniser.verdicts = [Verdict(rejected=MISFIT)]
    assert timing.feed(block(0)) == []
    assert (timing.rejections.total, recogniser.forgotten) == (1, 1)


def test_a_recogniser_is_told_how_many_frames_it_was_not_asked_about() -> None:
    timing, recogniser = scripted()
    recogniser.verdicts = [Verdict(due=900)]
    timing.feed(block(0))
    for number in range(1, 4):
        timing.quiet(QuietBlock(number * PERIOD, PERIOD, 0.0, 1e-6, sync=True))
    timing.feed(block(4 * PERIOD))
    assert recogniser.asked == [1, 0, 4]


def test_level_and_noise_are_learnt_from_gaps_only() -> None:
    timing, _ = scripted()
    volts = np.full(PERIOD, 9.0, np.float32)
    volts[timing.line.size + 8 :] = 0.25
    for number in range(3):
        timing.feed(SampleBlock(number * PERIOD, volts, sync=True))
    assert timing.line.level_known
    assert timing.line.level_v == 0.25 and timing.line.noise < 1e-12
