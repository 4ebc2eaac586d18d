# SPDX-License-Identifier: Apache-2.0

"""Doubt about single words, and the health of a node from many words."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tactile_cdma.base.arrays import Floats32
from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.transform import chips_of, rows_of
from tactile_cdma.driver.pipeline import TactileFrame
from tactile_cdma.readings.status import Status
from tactile_cdma.words.health import JUDGE_FRAMES, NodeState
from test.support.chip_line import ChipLine, hear, read_chips
from test.support.examples import examples

SPEC = FrameSpec()
PARITY = FrameSpec(parity=True)
SWING = 0.3


def rows(codes: NDArray[np.int64], spec: FrameSpec = SPEC) -> Floats32:
    """What every row holds where these words are sent, (k, N), V."""
    return rows_of(line_chips(spec, codes).astype(np.float32), spec)


def sigma(rho: float, spec: FrameSpec = SPEC) -> float:
    return SWING * float(np.sqrt(spec.order)) / rho


def noisy(levels: Floats32, spec: FrameSpec, rho: float, rng: np.random.Generator) -> Floats32:
    chips = chips_of(levels, spec)
    return (chips + rng.normal(0, sigma(rho, spec), chips.shape)).astype(np.float32)


@examples(50)
@given(st.integers(8, 16), st.sampled_from([1, -1]), st.integers(0, 2**32 - 1))
def test_parity_changes_no_word(bits: int, polarity: int, seed: int) -> None:
    spec = FrameSpec(bits=bits, parity=True, polarity=polarity, frame_period_s=0.1)
    codes = np.random.default_rng(seed).integers(0, 1 << bits, spec.nodes)
    words = read_chips(line_chips(spec, codes), spec)
    assert words.active.all() and not words.doubtful.any()
    assert np.array_equal(words.codes, codes)


@given(st.integers(0, 10), st.integers(0, 15), st.integers(0, 2**32 - 1))
def test_parity_mends_the_weakest_bit_and_says_so(bit: int, node: int, seed: int) -> None:
    codes = np.random.default_rng(seed).integers(0, 1024, 16)
    levels = rows(codes, PARITY)
    levels[bit, PARITY.first_row + node] *= -0.1  # the noise has just turned it
    words = read_chips(chips_of(levels, PARITY), PARITY)
    assert np.array_equal(words.codes, codes)
    assert words.doubtful[node]
    assert np.flatnonzero(words.odd).tolist() == [node]


def test_parity_takes_nearly_all_wrong_words_at_low_snr() -> None:
    rng, rho = np.random.default_rng(7), 3.3
    wrong = {}
    for spec in (SPEC, PARITY):
        count = 0
        for _ in range(600):
            codes = rng.integers(0, 1024, 16)
            words = read_chips(noisy(rows(codes, spec), spec, rho, rng), spec, sigma(rho, spec))
            count += int((words.codes != codes)[words.active].sum())
        wrong[spec.parity] = count / (600 * 16)
    # k·Q(ρ) = 4.8e-3 without; with, at least two bits must be wrong: C(11, 2)·Q(√2·ρ)·… < 1e-4.
    assert wrong[False] > 3e-3
    assert wrong[True] < 3e-4


def test_confidence_is_the_share_of_right_bits() -> None:
    """Among words of equal confidence p, the weakest bit is right in a share p of cases."""
    rng, rho = np.random.default_rng(8), 2.7
    spec = FrameSpec(nodes=64, chip_s=1e-5)
    expected = right = total = 0.0
    for _ in range(300):
        codes = rng.integers(0, 1024, spec.nodes)
        words = read_chips(noisy(rows(codes, spec), spec, rho, rng), spec, sigma(rho, spec))
        unsure = words.active & (words.confidence < 0.99)
        expected += float(words.confidence[unsure].sum())
        right += int((words.codes == codes)[unsure].sum())
        total += int(unsure.sum())
    assert total > 2000
    # The word is wrong somewhere else in a few cases, and amplitude and noise are estimates.
    assert right / total == pytest.approx(expected / total, abs=0.04)


def show(line: ChipLine, change: str, frames: int = 4 * JUDGE_FRAMES) -> TactileFrame:
    """Send frames in which node 5 is not as it should be; returns the last one."""
    rng, spec = np.random.default_rng(9), line.spec
    own = spec.first_row + 4
    for _ in range(frames):
        levels = rows(rng.integers(0, 1024, 16), spec)
        if change == "weak":
            levels[:, own] *= 0.35
        elif change in ("doubled", "tripled"):
            for _ in range(2 if change == "tripled" else 1):
                levels[:, own] += rows(rng.integers(0, 1024, 16), spec)[:, own]
        elif change == "doubled, same word":
            levels[:, own] *= 2
        elif change == "broken":
            levels[::3, own] *= 0.1
        elif change == "missing":
            levels[:, own] *= 0.0
        elif change == "inverted":
            levels[:, own] *= -1
        elif change == "other last bit":
            levels[-1, own] *= rng.choice([-1, 1])
        frame = line.frame(noisy(levels, spec, 60.0, rng))
    return frame


@pytest.mark.parametrize("change", ["inverted", "other last bit"])
def test_parity_tells_of_a_node_whose_even_words_are_wrong(change: str) -> None:
    line = ChipLine(PARITY)
    show(line, change)
    assert line.pipeline.health.nodes(NodeState.FAULTY) == [5]
    assert np.flatnonzero(line.pipeline.health.invalid).tolist() == [4]


def test_noise_that_parity_mends_makes_no_node_faulty() -> None:
    rng, line = np.random.default_rng(13), ChipLine(PARITY)
    for _ in range(8 * JUDGE_FRAMES):
        line.frame(noisy(rows(rng.integers(0, 1024, 16), PARITY), PARITY, 3.5, rng))
        assert not line.pipeline.health.invalid.any()


@pytest.mark.parametrize(
    ("change", "state"),
    [
        ("none", NodeState.OK),
        ("weak", NodeState.WEAK),
        ("doubled", NodeState.DOUBLED),
        ("tripled", NodeState.DOUBLED),
        ("doubled, same word", NodeState.DOUBLED),
        ("broken", NodeState.FAULTY),
        ("missing", NodeState.UNHEARD),
    ],
)
@pytest.mark.parametrize("known", [True, False])
def test_a_node_that_is_not_as_it_should_be_is_named(
    change: str, state: NodeState, known: bool
) -> None:
    line = ChipLine(SPEC if known else replace(SPEC, amplitude_v=None))
    show(line, change)
    health = line.pipeline.health
    assert health.state[4] == state
    assert np.delete(health.state, 4).tolist() == [NodeState.OK] * 15
    assert health.nodes(state) == ([5] if state != NodeState.OK else list(range(1, 17)))


def test_a_node_that_only_tells_that_it_lives_is_sound() -> None:
    """Every node speaks once in 78 frames, as at rest."""
    rng, line = np.random.default_rng(11), ChipLine(SPEC)
    for frame in range(78 * 12):
        active = np.arange(16) == frame % 78
        line.frame(line_chips(SPEC, rng.integers(0, 1024, 16), active))
    assert line.pipeline.health.nodes(NodeState.OK) == list(range(1, 17))


def test_a_node_that_died_is_missing() -> None:
    line = ChipLine(SPEC, stale_after_s=0.5)
    show(line, "none", 64)
    assert line.pipeline.taxels.missing == []
    show(line, "missing", 64)
    assert line.pipeline.taxels.missing == [5]


@pytest.mark.parametrize("change", ["weak", "doubled", "broken"])
def test_a_node_that_recovers_is_sound_again(change: str) -> None:
    line = ChipLine(SPEC)
    show(line, change)
    show(line, "none", 6 * JUDGE_FRAMES)
    assert line.pipeline.health.state[4] == NodeState.OK


def test_a_weak_node_is_heard_once_it_is_known() -> None:
    line = ChipLine(SPEC)
    assert not show(line, "weak", 1).words.active[4]
    words = show(line, "weak").words
    assert words.active[4] and not words.doubtful[4]


def test_a_broken_node_costs_only_its_own_words_once_it_is_known() -> None:
    """So does one whose row another one shares."""
    for change in ("broken", "doubled"):
        line = ChipLine(SPEC)
        assert show(line, change, 1).words.doubtful.any()
        words = show(line, change).words
        assert line.pipeline.health.invalid[4]
        assert words.active.all() and not np.delete(words.doubtful, 4).any()


def test_noise_makes_no_weak_nodes() -> None:
    rng, line = np.random.default_rng(10), ChipLine(SPEC)
    for _ in range(500):
        line.frame(rng.normal(0, 0.15, (10, 20)))
    state = line.pipeline.health.state
    assert not np.isin(state, [NodeState.WEAK, NodeState.DOUBLED, NodeState.FAULTY]).any()


@pytest.mark.parametrize(
    ("change", "flag", "valid"),
    [
        ("weak", Status.WEAK, True),
        ("doubled", Status.FAULTY, False),
        ("broken", Status.FAULTY, False),
    ],
)
def test_status_tells_and_contradictory_words_are_no_pressure(
    change: str, flag: Status, valid: bool
) -> None:
    readings = show(ChipLine(SPEC), change).readings
    assert readings.status[4] & flag
    assert np.isfinite(readings.pressure_pa[4]) == valid
    assert np.isfinite(np.delete(readings.pressure_pa, 4)).all()
    assert not (np.delete(readings.status, 4) & flag).any()


@given(st.integers(0, 9), st.integers(0, 19), st.floats(-20.0, 20.0), st.integers(0, 2**32 - 1))
@examples(100)
def test_what_hits_one_chip_makes_no_certain_wrong_word(
    bit: int, place: int, size: float, seed: int
) -> None:
    """Every row takes as much of it, with either sign. size: times what turns a bit of one."""
    rng = np.random.default_rng(seed)
    codes = rng.integers(0, 1024, 16)
    chips = noisy(rows(codes), SPEC, 100.0, rng)
    chips[bit, place] += SPEC.order * SWING * size
    frame = hear(chips, SPEC, sigma(100.0))
    if frame is not None and frame.words is not None:
        words = frame.words
        assert (words.doubtful | (words.active & (words.codes == codes))).all()


def test_what_hits_one_row_in_one_bit_makes_its_word_doubtful() -> None:
    rng = np.random.default_rng(13)
    codes = rng.integers(0, 1024, 16)
    for size in (1.0, 1.5, 2.5, 4.0):
        levels = rows(codes)
        own = SPEC.first_row + 7
        levels[2, own] -= np.sign(levels[2, own]) * SWING * size
        assert read_chips(noisy(levels, SPEC, 100.0, rng), SPEC, sigma(100.0)).doubtful[7]


def test_a_word_too_loud_for_one_node_is_doubtful() -> None:
    levels = rows(np.arange(16))
    levels[:, SPEC.first_row + 4] *= 2.0
    assert np.flatnonzero(read_chips(chips_of(levels, SPEC), SPEC).doubtful).tolist() == [4]
