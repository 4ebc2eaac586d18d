# SPDX-License-Identifier: Apache-2.0

"""Samples of one frame → its timing and words, or why nothing is said of it."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.doubt.words import RAW, play
from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.framing.frame_reader import FrameReader
from tactile_cdma.framing.frames import LineFrame, Rejections
from test.support.independent_line import Line, Skin, Talk, render

SPEC = FrameSpec()
A = 0.3
RAILS = -2.0, 2.0
OTHERS = FrameSpec(nodes=3, order=20, first_row=17)
"""Nodes of another skin on the same wire."""
PER_CHIP = 4


def reader_of(spec: FrameSpec = SPEC, per_chip: float = PER_CHIP) -> FrameReader:
    reader = FrameReader(spec, per_chip / spec.chip_s, RAILS)
    reader.learn_rest(0.0, 1e-4)
    return reader


def samples_of(
    codes: np.ndarray, start: float = -0.5, chip: float = PER_CHIP, spec: FrameSpec = SPEC
) -> np.ndarray:
    """The line at whole instants; start and chip in samples; six chips of rest after the frame."""
    levels = np.concatenate((line_chips(spec, codes).ravel(), np.zeros(8)))
    edges = start + chip * np.arange(levels.size + 1)
    instants = np.arange(int(edges[-2]))
    return levels[np.searchsorted(edges, instants, side="right") - 1].astype(np.float32)


def words_of(frame: LineFrame | None) -> np.ndarray:
    assert frame is not None and frame.words is not None
    assert frame.words.active.all() and not frame.words.doubtful.any()
    return frame.words.codes


@pytest.mark.parametrize("per_chip", [2.0, 4.0, 7.3, 40.0])
def test_timing_is_recovered_within_a_twentieth_of_a_chip(per_chip: float) -> None:
    """Or half a sample where these are few and in step: all edges lie at one place between two."""
    rng = np.random.default_rng(1)
    for _ in range(30):
        codes, start = rng.integers(0, 1024, 16), rng.uniform(-1.0, 0.0)
        chip = per_chip * (1 + (per_chip > 5) * rng.uniform(1e-3, 3e-3))
        volts = samples_of(codes, start, chip)
        volts += rng.normal(0, 0.01, volts.size).astype(np.float32)
        frame = reader_of(per_chip=per_chip).read(volts, first_index=5000)
        np.testing.assert_array_equal(words_of(frame), codes)
        assert frame is not None
        off, most = frame.start - 5000 - start, max(0.05 * chip, 0.5)
        assert abs(off) < most
        assert abs(off + SPEC.chips * (frame.chip_samples - chip)) < most


def test_a_timing_is_carried_to_the_next_frame() -> None:
    """Chips 0.3 % long end 0.6 chip late: each frame begins where its words are found already."""
    reader, rng = reader_of(), np.random.default_rng(2)
    for _ in range(5):
        codes = rng.integers(0, 1024, 16)
        frame = reader.read(samples_of(codes, chip=PER_CHIP * 1.003))
        np.testing.assert_array_equal(words_of(frame), codes)
        assert frame is not None
        assert frame.chip_samples == pytest.approx(PER_CHIP * 1.003, rel=2e-4)


def test_chips_that_last_much_longer_are_not_found_unless_they_are_proposed() -> None:
    codes, chip = np.arange(16) * 64 + 7, PER_CHIP * 1.08
    volts = samples_of(codes, chip=chip)
    frame = reader_of().read(volts)
    assert frame is None or (frame.words is not None and frame.words.doubtful.all())
    reader = reader_of()
    reader.propose(-0.5, chip)
    np.testing.assert_array_equal(words_of(reader.read(volts)), codes)


@pytest.mark.parametrize("stretch", [0.02, 0.06, 0.1])
def test_stretched_chips_are_searched_for_and_found(stretch: float) -> None:
    """By the independent line: the nodes' board is slower than it should be."""
    recording = render(Skin(), Talk(share=0.8), Line(stretch=stretch), RAW, 30, seed=3)
    true = {round(truth.start_chips): truth for truth in recording.frames}
    found = searches = 0
    for frame, pipeline in play(recording):
        searches = pipeline.decisions.searches
        near = min(true, key=lambda start: abs(start - frame.t_start / 50e-6))
        assert abs(frame.t_start / 50e-6 - true[near].start_chips) < 0.5
        if frame.words.active.any():
            assert frame.chip_s == pytest.approx(50e-6 * true[near].chip, rel=1e-3)
            found += 1
    assert found > 20 and searches >= 1


def test_a_scrambled_frame_with_a_node_on_row_0_is_read_before_its_level_is_known() -> None:
    spec = FrameSpec(order=16, first_row=0, scramble=True)
    reader = FrameReader(spec, PER_CHIP / spec.chip_s, RAILS)
    codes = np.arange(16) * 60 + 11
    volts = samples_of(codes, spec=spec)
    volts += np.random.default_rng(6).normal(0, 0.01, volts.size).astype(np.float32)
    np.testing.assert_array_equal(words_of(reader.read(volts)), codes)


def test_words_count_from_another_share_on_while_it_runs() -> None:
    reader, volts = reader_of(), 0.7 * samples_of(np.arange(16) * 60 + 11)
    heard = reader.read(volts)
    assert heard is not None and heard.speakers == 16
    reader.count_above(0.9)
    heard = reader.read(volts)
    assert heard is None or heard.speakers == 0


def test_nobody_speaks() -> None:
    reader, rng = reader_of(), np.random.default_rng(4)
    for noise_v in (0.0, 0.01, 0.02):
        frame = reader.read(rng.normal(0, noise_v, 840).astype(np.float32))
        assert frame is not None and frame.words is None and frame.speakers == 0
        assert frame.noise_rms_v == pytest.approx(noise_v / PER_CHIP**0.5, rel=0.1, abs=1e-6)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda volts: volts[:790], "incomplete"),
        (lambda volts: volts[:0], "incomplete"),
        (lambda volts: np.where(np.arange(volts.size) == 400, np.nan, volts), "absurd"),
        (lambda volts: np.full_like(volts, np.nan), "absurd"),
        (lambda volts: np.full_like(volts, 2.0), "at_rail"),
        (lambda volts: np.where(np.arange(volts.size) % 8 < 5, -2.0, volts), "at_rail"),
        (lambda volts: 2 * samples_of(np.array([1, 700, 400]), spec=OTHERS), "misfit"),
    ],
)
def test_what_cannot_be_read_is_rejected_for_its_reason(spoil: object, reason: str) -> None:
    reader = reader_of()
    volts = samples_of(np.arange(16) * 60 + 11)
    assert reader.read(np.asarray(spoil(volts), np.float32)) is None  # type: ignore[operator]
    assert reader.rejections == replace(Rejections(), **{reason: 1})


def test_an_absurd_sample_at_the_end_of_a_long_frame_is_found() -> None:
    """Chips 8 % long: the frame has 864 samples, of which a nominal one has 800."""
    reader, chip = reader_of(), PER_CHIP * 1.08
    volts = samples_of(np.arange(16) * 60 + 11, chip=chip)
    volts[840] = np.nan
    reader.propose(-0.5, chip)
    assert reader.read(volts) is None
    assert reader.rejections == Rejections(absurd=1)


def test_noise_that_would_hide_words_is_no_silence() -> None:
    reader, rng = reader_of(), np.random.default_rng(5)
    for _ in range(20):
        frame = reader.read(rng.normal(0, 2.5, 840).clip(-1.9, 1.9).astype(np.float32))
        assert frame is None or (frame.words is not None and frame.words.doubtful.all())
    assert reader.rejections.total > 5


def test_a_quarter_at_the_rail_makes_all_doubtful() -> None:
    reader, volts = reader_of(), samples_of(np.arange(16) * 60 + 11)
    volts[:800][np.argsort(-np.abs(volts[:800]))[:250]] = 2.0
    frame = reader.read(volts)
    assert frame is None or (frame.words is not None and frame.words.doubtful.all())


@pytest.mark.parametrize("per_chip", [0.5, 1.1, 1.8])
def test_too_few_samples_for_a_chip_are_refused(per_chip: float) -> None:
    with pytest.raises(SpecError, match="samples per chip: line timing takes one integrated"):
        reader_of(per_chip=per_chip)
