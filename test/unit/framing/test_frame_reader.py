# SPDX-License-Identifier: Apache-2.0

"""Samples of one frame → its timing and words, or why it is none."""

import numpy as np
import pytest

from tactile_cdma.base.arrays import Floats32
from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.framing.frame_reader import FrameReader
from tactile_cdma.framing.proposals import Proposer

SPEC = FrameSpec()
PER_CHIP = 8.13
NOISE_V = 0.02
CODES = np.random.default_rng(1).integers(0, 1024, 16)


def reader(rails_v: tuple[float, float] | None = None) -> FrameReader:
    made = FrameReader(SPEC, PER_CHIP / SPEC.chip_s, rails_v)
    made.learn_rest(0.0, NOISE_V**2 / PER_CHIP)
    return made


def samples(start: float = -0.5, chip: float = PER_CHIP, seed: int = 1) -> Floats32:
    """A frame whose first chip begins at a sample, and the line at rest after it."""
    chips = line_chips(SPEC, CODES).ravel()
    instants = np.arange(round(1.13 * chips.size * PER_CHIP))
    number = np.floor((instants - start) / chip).astype(int)
    volts = np.where((number >= 0) & (number < chips.size), chips[number % chips.size], 0.0)
    volts += np.random.default_rng(seed).normal(0, NOISE_V, volts.size)
    return volts.astype(np.float32)


@pytest.mark.parametrize("start", [-1.0, -0.7, 0.3])
@pytest.mark.parametrize("stretch", [0.9995, 1.0, 1.0005])
def test_begin_and_chips_are_found_within_a_twentieth_of_a_chip(
    start: float, stretch: float
) -> None:
    frame = reader().read(samples(start, stretch * PER_CHIP))
    assert frame is not None and frame.words is not None
    assert frame.start == pytest.approx(start, abs=0.05 * PER_CHIP)
    end = frame.start + SPEC.chips * frame.chip_samples
    true_end = start + SPEC.chips * stretch * PER_CHIP
    assert end == pytest.approx(true_end, abs=0.05 * PER_CHIP)
    np.testing.assert_array_equal(frame.words.codes, CODES)


@pytest.mark.parametrize("stretch", [1.03, 1.07, 1.1])
def test_stretched_chips_are_found_by_a_proposal(stretch: float) -> None:
    volts, one = samples(-0.5, stretch * PER_CHIP), reader()
    chip = Proposer(SPEC, PER_CHIP).propose(volts, NOISE_V**2 / PER_CHIP, 1)
    assert chip == pytest.approx(stretch * PER_CHIP, rel=2e-3)
    one.propose(-0.5, chip)
    for _ in range(2):  # the next one is read by what was carried over
        frame = one.read(volts)
        assert frame is not None and frame.words is not None
        assert not frame.words.doubtful.any()
        np.testing.assert_array_equal(frame.words.codes, CODES)


def test_a_frame_without_words_is_silent() -> None:
    noise = np.random.default_rng(2).normal(0, NOISE_V, 1800).astype(np.float32)
    frame = reader().read(noise)
    assert frame is not None
    assert frame.words is None and frame.certificate is None


@pytest.mark.parametrize("reason", ["incomplete", "absurd", "at_rail", "misfit"])
def test_what_is_no_frame_is_rejected_for_its_reason(reason: str) -> None:
    one, volts = reader((-6.0, 6.0)), samples()
    if reason == "incomplete":
        volts = volts[:1500]
    elif reason == "absurd":
        volts[700] = np.nan
    elif reason == "at_rail":
        volts[:900] = 6.0
    else:
        spare = SPEC.book.rows([SPEC.spare_rows.start])[0].astype(np.float32)
        chips = np.tile(spare, SPEC.line_bits)  # of a row that no node has
        number = np.floor((np.arange(volts.size) + 0.5) / PER_CHIP).astype(int)
        volts = np.where(number < chips.size, chips[number % chips.size], 0).astype(np.float32)
    assert one.read(volts) is None
    counts = one.rejections
    assert counts.total == 1
    assert counts.leading == reason


def test_noise_that_would_hide_words_is_no_silence() -> None:
    one = reader()
    one.learn_rest(0.0, 1.0)
    assert one.read(np.zeros(1800, np.float32)) is None
    assert one.rejections.noisy == 1


def test_a_rate_at_which_chips_cannot_be_told_apart_is_refused() -> None:
    with pytest.raises(SpecError, match=r"1\.4 samples per chip"):
        FrameReader(SPEC, 1.4 / SPEC.chip_s)
