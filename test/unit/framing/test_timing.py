# SPDX-License-Identifier: Apache-2.0

"""Line timing on a synthetic line: right words and times, or the frame is rejected."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.transform import correlate
from tactile_cdma.framing.line_timing import LineTiming
from tactile_cdma.framing.timing import FrameLevels, SampleBlock
from test.support.examples import examples
from test.support.synthetic_line import DEFAULT, PAPER, SPECS, Wire, garbage, same, words_of


def test_too_few_samples_are_refused() -> None:
    with pytest.raises(SpecError, match="line timing"):
        LineTiming(PAPER, 1.4 / PAPER.chip_s)


def feed_marked(
    timing: LineTiming, volts: np.ndarray, starts: list[int], cuts: Sequence[int] = ()
) -> list[FrameLevels]:
    frames = []
    bounds = sorted({0, *starts, *cuts, volts.size})
    for begin, end in pairwise(bounds):
        frames += timing.feed(SampleBlock(begin, volts[begin:end], begin in starts))
    return frames + timing.flush()


def marked(
    spec: FrameSpec,
    samples_per_chip: float,
    stretch: float,
    seed: int = 0,
    frames: int = 6,
    nodes: int | None = None,
) -> tuple[Wire, list[int]]:
    """Random frames, and where their marks are."""
    wire = Wire(spec, samples_per_chip, seed)
    wire.send_random(frames, nodes, wander=0)
    for sent in wire.sent:
        sent.start = math.ceil(sent.start) - (0.0 if stretch == 0 else wire.rng.uniform(0, 0.9))
        sent.chip = samples_per_chip * (1 + stretch)
    return wire, [math.ceil(sent.start) for sent in wire.sent]


@pytest.mark.slow
@pytest.mark.parametrize("rate", [4.0, 8.0, 8.13])
@pytest.mark.parametrize("stretch", [0.0, 0.004, 0.06, 0.11])
@pytest.mark.parametrize("name", SPECS)
def test_marked_frames(name: str, stretch: float, rate: float) -> None:
    wire, starts = marked(SPECS[name], rate, stretch, seed=20)
    timing = LineTiming(wire.spec, wire.rate_hz)
    frames = feed_marked(timing, wire.volts(), starts)
    assert [words_of(f, wire.spec) for f in frames] == [s.words for s in wire.sent]
    assert [f.start for f in frames] == pytest.approx(starts, abs=1.0)
    assert timing.rejections.total == 0


def test_a_marked_frame_comes_three_chips_after_its_end() -> None:
    wire, (start, *_) = marked(PAPER, 8.0, 0.0)
    volts, timing = wire.volts(), LineTiming(PAPER, wire.rate_hz)
    end = start + 8 * PAPER.chips
    assert timing.feed(SampleBlock(start, volts[start:end], sync=True)) == []
    assert len(timing.feed(SampleBlock(end, volts[end : end + 3 * 8 + 2]))) == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", SPECS)
@pytest.mark.parametrize("rate", [4.0, 8.13])
def test_stretched_marked_frames_are_right_or_rejected(name: str, rate: float) -> None:
    """With one or two nodes few level changes tell the stretch: a wrong one must not pass."""
    spec = SPECS[name]
    for stretch, nodes in itertools.product((0.005, 0.03, 0.1), (1, 2)):
        wire, starts = marked(spec, rate, stretch, seed=31, frames=40, nodes=nodes)
        timing = LineTiming(spec, wire.rate_hz)
        frames = feed_marked(timing, wire.volts(), starts)
        sent = {start: one.words for start, one in zip(starts, wire.sent, strict=True)}
        wrong = 0
        for frame in frames:
            nearest = min(starts, key=lambda start, frame=frame: abs(start - frame.start))
            wrong += words_of(frame, spec) != sent[nearest]
        assert wrong <= 1  # waveforms can tie
        assert len(frames) + timing.rejections.total == len(starts)
        assert len(frames) >= 38


def test_words_of_more_bits_than_specified_are_rejected() -> None:
    wire, starts = marked(DEFAULT, 8.0, 0.0, seed=32, frames=60, nodes=8)
    timing = LineTiming(replace(DEFAULT, bits=9), wire.rate_hz)
    frames = feed_marked(timing, wire.volts(), starts)
    assert len(frames) <= 4  # the sum of the nodes may cancel for three chips
    assert timing.rejections.total >= 56


def test_integrated_chips_of_stretched_frames_are_rejected() -> None:
    """One value per chip cannot follow a stretch; what does not fit the book is not believed."""
    rng = np.random.default_rng(33)
    timing, index = LineTiming(DEFAULT, 1 / DEFAULT.chip_s), 0
    for _ in range(30):
        chips = line_chips(DEFAULT, rng.integers(0, 1024, 16)).ravel()
        late = np.interp(np.arange(chips.size) / 1.05, np.arange(chips.size), chips)
        timing.feed(SampleBlock(index, late.astype(np.float32), sync=True))
        index += chips.size
    assert timing.rejections.total >= 29


@pytest.mark.parametrize("spec", [PAPER, DEFAULT], ids=["paper", "default"])
def test_integrated_chips(spec: FrameSpec) -> None:
    """No gap is sent, so that the line's level cannot be known where row 0 is in use."""
    rng = np.random.default_rng(21)
    codes = rng.integers(0, 1024, (3, 16))
    level_v = 0.0 if spec.first_row == 0 else 0.25
    chips = [line_chips(spec, row) for row in codes]
    line = np.concatenate([c.ravel() for c in chips]) + level_v
    starts = [i * spec.chips for i in range(3)]
    timing = LineTiming(spec, 1 / spec.chip_s)
    frames = feed_marked(timing, line.astype(np.float32), starts, [7, 100, 333])
    assert [f.offset_v for f in frames] == pytest.approx([level_v] * 3, abs=1e-6)
    for frame, sent in zip(frames, chips, strict=True):
        expected = correlate(sent, spec.book)[:, spec.rows]
        np.testing.assert_allclose(frame.levels.values, expected, atol=1e-5)
    assert [words_of(frame, spec) for frame in frames] == [
        dict(enumerate(c.tolist())) for c in codes
    ]


@examples(25)
@given(st.lists(st.integers(0, 7000), max_size=20), st.sampled_from([0.0, 0.07]))
def test_chunking_is_invisible_with_marks(cuts: list[int], stretch: float) -> None:
    wire, starts = marked(PAPER, 4.0, stretch, seed=22)
    volts = wire.volts(rho=15)
    whole = feed_marked(LineTiming(PAPER, wire.rate_hz), volts, starts)
    cuts = [cut for cut in cuts if cut < volts.size]
    same(feed_marked(LineTiming(PAPER, wire.rate_hz), volts, starts, cuts), whole)


def test_a_mark_within_a_frame_rejects_it() -> None:
    wire, starts = marked(PAPER, 8.0, 0.0, seed=23)
    timing = LineTiming(PAPER, wire.rate_hz)
    frames = feed_marked(timing, wire.volts(), [starts[0] - 300, *starts])
    assert timing.rejections.total == 1
    assert [words_of(f, PAPER) for f in frames] == [s.words for s in wire.sent]


def test_marked_silence_and_garbage() -> None:
    rng = np.random.default_rng(24)
    starts = list(range(100, 18_000, 2048))
    quiet = rng.normal(0, 0.01, 20_000).astype(np.float32)
    frames = feed_marked(LineTiming(PAPER, 8 / PAPER.chip_s), quiet, starts)
    assert len(frames) == len(starts)
    assert all(frame.levels is None for frame in frames)
    for kind in ("nan", "huge", "walk"):
        timing = LineTiming(DEFAULT, 8 / PAPER.chip_s)  # a drifting line is a word on row 0
        frames = feed_marked(timing, garbage(kind)[:20_000], starts)
        assert all(frame.levels is None for frame in frames)
        assert timing.rejections.total >= len(starts) - 1


def test_a_hole_forgets_the_marked_frame() -> None:
    timing = LineTiming(PAPER, 1 / PAPER.chip_s)
    timing.feed(SampleBlock(0, np.ones(50, np.float32), sync=True))
    assert timing.feed(SampleBlock(60, np.ones(200, np.float32))) == []
    assert timing.rejections.total == 1
