# SPDX-License-Identifier: Apache-2.0

"""A late node speaks on another one's row: nobody's word or silence is taken for certain then."""

import numpy as np
import pytest

from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import DEFAULT_AMPLITUDE_V, FrameSpec
from tactile_cdma.framing.line_timing import LineTiming
from tactile_cdma.framing.timing import SampleBlock
from tactile_cdma.words.decode import Words, decode
from tactile_cdma.words.lateness import out_of_place
from test.support.correlations import read_chips, separate

SPEC = FrameSpec()


def heard(
    codes: np.ndarray, active: np.ndarray, node: int, late: float, rng: np.random.Generator
) -> Words | None:
    """What means over chips say of a frame in which one node is late by so many chips.

    None where the frame is rejected.
    """
    alone = np.arange(SPEC.nodes) == node
    chips = np.append(line_chips(SPEC, codes, alone & active).ravel(), np.zeros(8))
    whole, share = int(late // 1), late % 1
    chips = (1 - share) * np.roll(chips, whole) + share * np.roll(chips, whole + 1)
    chips = chips[: SPEC.chips].reshape(SPEC.line_bits, SPEC.order)
    chips = chips + line_chips(SPEC, codes, active & ~alone)
    chips += rng.normal(0, 0.003, chips.shape)
    timing = LineTiming(SPEC, 1 / SPEC.chip_s)
    frames = timing.feed(SampleBlock(0, chips.ravel().astype(np.float32), sync=True))
    if not frames:
        return None
    assert frames[0].levels is not None
    words = decode(frames[0].levels, SPEC)
    return words.doubted(~words.active) if words.disturbed(np.zeros(SPEC.nodes, bool)) else words


@pytest.mark.parametrize("others", [0, 1, 5])
@pytest.mark.parametrize(("late", "told"), [(0.6, 0.05), (1.0, 0.25), (2.0, 0.3), (3.0, 0.45)])
def test_words_of_a_late_node_are_not_told_for_certain(
    late: float, told: float, others: int
) -> None:
    """Whole chips late it is another node, but for few chips."""
    rng, unflagged, wrong = np.random.default_rng(others), 0, 0
    for _ in range(100):
        nodes = rng.choice(SPEC.nodes, others + 1, replace=False)
        active = np.isin(np.arange(SPEC.nodes), nodes)
        codes = rng.integers(0, 1024, SPEC.nodes)
        words = heard(codes, active, int(nodes[0]), late, rng)
        if words is None:
            continue
        off = (words.active != active) | (words.active & (words.codes != codes))
        wrong += bool(off.any())
        unflagged += bool((off & ~words.doubtful).any())
    assert wrong > 25
    # A word whose bits hardly change leaves little to tell by.
    assert unflagged <= told * wrong


@pytest.mark.parametrize(("weak", "share", "late"), [(0.6, 0.06, 0.0), (1.0, 0.0, 0.5)])
def test_a_weak_word_is_no_part_of_a_late_one_if_all_chips_hold_a_share_of_the_one_before(
    weak: float, share: float, late: float
) -> None:
    """As where samples are taken while levels change. Of a node half a chip late half is left."""
    rng = np.random.default_rng(1)
    for _ in range(50):
        nodes = rng.choice(SPEC.nodes, 3, replace=False)
        codes, everybody = rng.integers(0, 1024, SPEC.nodes), np.arange(SPEC.nodes)
        chips = weak * line_chips(SPEC, codes, everybody == nodes[0]).ravel()
        chips = (1 - late) * chips + late * np.append(0, chips[:-1])
        chips += line_chips(SPEC, codes, np.isin(everybody, nodes[1:])).ravel()
        chips = (1 - share) * chips + share * np.append(0, chips[:-1])
        chips = (chips + rng.normal(0, 1e-3, chips.size)).astype(np.float32)
        words = read_chips(chips.reshape(SPEC.line_bits, SPEC.order), SPEC)
        assert words.active[nodes[1:]].all()
        assert words.doubtful[nodes[0]] if late else not words.doubtful.any()


@pytest.mark.parametrize("order", [1, 2, 4, 8])
def test_the_smallest_books_are_read(order: int) -> None:
    """Their bits are too short for edges that tell."""
    spec = FrameSpec(nodes=1, order=order, first_row=order > 1, frame_period_s=5e-3)
    rng = np.random.default_rng(order)
    chips = line_chips(spec, np.array([618]), np.array([True])) + rng.normal(0, 0.05, (10, order))
    words = read_chips(chips, spec)
    assert words.active.all() and words.codes.tolist() == [618]


@pytest.mark.parametrize("others", [0, 5, 15])
def test_words_on_time_are_not_called_late(others: int) -> None:
    rng = np.random.default_rng(others)
    for _ in range(200):
        nodes = rng.choice(SPEC.nodes, others + 1, replace=False)
        active = np.isin(np.arange(SPEC.nodes), nodes)
        codes = rng.integers(0, 1024, SPEC.nodes)
        words = heard(codes, active, int(nodes[0]), 0.1, rng)
        assert words is not None and np.array_equal(words.active, active)
        assert not words.doubtful.any()


@pytest.mark.parametrize("chip", [0, 1, 7, 18, 19])
def test_a_chip_that_was_clipped_is_no_late_word_nor_turns_any(chip: int) -> None:
    """All nodes agree in it, and the sum ends at 3·√n·A."""
    rng, everybody = np.random.default_rng(chip), np.ones(SPEC.nodes, bool)
    nodes = np.eye(SPEC.nodes, dtype=bool)
    for bit in range(1, 9):
        codes = rng.integers(0, 1024, SPEC.nodes)
        sent = np.array([line_chips(SPEC, codes, node)[bit, chip] for node in nodes])
        codes ^= (sent < 0) << (9 - bit)
        chips = line_chips(SPEC, codes, everybody) + rng.normal(0, 0.01, (10, 20))
        assert chips[bit, chip] > 15 * DEFAULT_AMPLITUDE_V, "it has something to lose"
        words = read_chips(chips.clip(max=12 * DEFAULT_AMPLITUDE_V), SPEC)
        assert np.array_equal(words.codes, codes)
        changes = np.bitwise_count((codes ^ codes >> 1) & 0x1FF)
        assert not words.doubtful[changes > 1].any(), "of others only that place tells"


@pytest.mark.parametrize("late", [0, 1])
def test_an_unknown_offset_of_scrambled_chips_is_nobody_out_of_place(late: int) -> None:
    """Not even if all speak, whose amplitudes hold a part of it; a node that is late is."""
    spec = FrameSpec(60, order=64, frame_period_s=0.04, scramble=True)
    rng, everybody = np.random.default_rng(1), np.arange(spec.nodes)
    codes = rng.integers(0, 1024, spec.nodes)
    last = np.roll(line_chips(spec, codes, everybody == 59).ravel(), late)
    chips = line_chips(spec, codes, everybody < 59)
    chips = chips + last.reshape(chips.shape) + rng.normal(0, 0.003, chips.shape)
    chips += 1.2 * DEFAULT_AMPLITUDE_V
    levels = separate(chips.astype(np.float32), spec)
    amplitude = np.abs(levels.values).mean(axis=0)
    found = out_of_place(levels, amplitude, everybody >= 0, DEFAULT_AMPLITUDE_V, spec)
    assert (found is None) == (not late)


@pytest.mark.parametrize("other", [0.0, 0.4])
def test_a_few_words_late_by_a_part_of_a_chip_are_all_doubtful(other: float) -> None:
    """The delay of the other one, chips: both may lack what is on another's row."""
    everybody = np.arange(SPEC.nodes)
    for seed in range(60):
        rng = np.random.default_rng(seed)
        codes, nodes = rng.integers(0, 1024, 16), rng.choice(16, 2, replace=False)
        chips = rng.normal(0, 1e-3, SPEC.chips)
        for node, by in zip(nodes, (0.4, other), strict=True):
            word = line_chips(SPEC, codes, everybody == node).ravel()
            chips += (1 - by) * word + by * np.append(0, word[:-1])
        words = read_chips(chips.reshape(SPEC.line_bits, SPEC.order), SPEC)
        assert words.doubtful[nodes].all()
