# SPDX-License-Identifier: Apache-2.0

"""Doubt about single words, and the health of a node from many words."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.separate import NodeLevels
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.readings.status import Status
from tactile_cdma.words.decode import Words, decode
from tactile_cdma.words.health import JUDGE_FRAMES, NodeHealth, NodeState
from test.support.correlations import read_chips, separate
from test.support.examples import examples

SPEC = FrameSpec()
PARITY = FrameSpec(parity=True)
SWING = 0.3


def levels_of(codes: np.ndarray, spec: FrameSpec) -> NodeLevels:
    return separate(line_chips(spec, codes), spec)


def noisy(codes: np.ndarray, spec: FrameSpec, rho: float, rng: np.random.Generator) -> NodeLevels:
    chips = line_chips(spec, codes)
    sigma = SWING * np.sqrt(spec.order) / rho
    return separate(chips + rng.normal(0, sigma, chips.shape).astype(np.float32), spec)


@examples(50)
@given(st.integers(8, 16), st.sampled_from([1, -1]), st.integers(0, 2**32 - 1))
def test_parity_changes_no_word(bits: int, polarity: int, seed: int) -> None:
    spec = FrameSpec(bits=bits, parity=True, polarity=polarity, frame_period_s=0.1)
    codes = np.random.default_rng(seed).integers(0, 1 << bits, spec.nodes)
    words = decode(levels_of(codes, spec), spec)
    assert words.active.all() and not words.doubtful.any()
    assert np.array_equal(words.codes, codes)


@given(st.integers(0, 10), st.integers(0, 15), st.integers(0, 2**32 - 1))
def test_parity_mends_the_weakest_bit_and_says_so(bit: int, node: int, seed: int) -> None:
    codes = np.random.default_rng(seed).integers(0, 1024, 16)
    levels = levels_of(codes, PARITY)
    levels.values[bit, node] *= -0.1  # the noise has just turned it
    words = decode(levels, PARITY)
    assert np.array_equal(words.codes, codes)
    assert np.flatnonzero(words.doubtful).tolist() == [node]


def test_parity_takes_nearly_all_wrong_words_at_low_snr() -> None:
    rng, rho = np.random.default_rng(7), 3.3
    wrong = {}
    for spec in (SPEC, PARITY):
        count = 0
        for _ in range(600):
            codes = rng.integers(0, 1024, 16)
            words = decode(noisy(codes, spec, rho, rng), spec)
            count += int((words.codes != codes)[words.active].sum())
        wrong[spec.parity] = count / (600 * 16)
    # k·Q(ρ) = 4.8e-3 without; with, at least two bits must be wrong: C(11, 2)·Q(√2·ρ)·… < 1e-4.
    assert wrong[False] > 3e-3
    assert wrong[True] < 3e-4


def test_confidence_is_the_share_of_right_bits() -> None:
    """Among words of equal confidence p, the weakest bit is right in a share p of cases."""
    rng, rho = np.random.default_rng(8), 2.5
    spec = FrameSpec(nodes=64, chip_s=1e-5)
    expected = right = total = 0.0
    for _ in range(300):
        codes = rng.integers(0, 1024, spec.nodes)
        words = decode(noisy(codes, spec, rho, rng), spec)
        unsure = words.active & (words.confidence < 0.99)
        expected += float(words.confidence[unsure].sum())
        right += int((words.codes == codes)[unsure].sum())
        total += int(unsure.sum())
    assert total > 2000
    # The word is wrong somewhere else in a few cases, and amplitude and noise are estimates.
    assert right / total == pytest.approx(expected / total, abs=0.04)


def feed(health: NodeHealth, levels: list[NodeLevels], spec: FrameSpec = SPEC) -> Words:
    for one in levels:
        words = decode(one, spec, swing_v=health.swing_v)
        health.update(words)
    return words


def scenes(change: str, spec: FrameSpec = SPEC, frames: int = 2 * JUDGE_FRAMES) -> list[NodeLevels]:
    """Frames in which node 5 is not as it should be."""
    rng, result = np.random.default_rng(9), []
    for _ in range(frames):
        codes = rng.integers(0, 1024, 16)
        levels = noisy(codes, spec, 60.0, rng)
        if change == "weak":
            levels.values[:, 4] *= 0.35
        elif change == "doubled":
            other = levels_of(rng.integers(0, 1024, 16), spec)
            levels.values[:, 4] += other.values[:, 4]
        elif change == "doubled, same word":
            levels.values[:, 4] *= 2
        elif change == "broken":
            levels.values[::3, 4] *= 0.1
        elif change == "missing":
            levels.values[:, 4] *= 0.0
        result.append(levels)
    return result


@pytest.mark.parametrize("change", ["inverted", "other last bit"])
def test_parity_tells_of_a_node_whose_even_words_are_wrong(change: str) -> None:
    rng, health = np.random.default_rng(12), NodeHealth(PARITY)
    for _ in range(2 * JUDGE_FRAMES):
        levels = noisy(rng.integers(0, 1024, 16), PARITY, 60.0, rng)
        if change == "inverted":
            levels.values[:, 4] *= -1
        else:
            levels.values[-1, 4] *= rng.choice([-1, 1])
        health.update(decode(levels, PARITY))
    assert health.nodes(NodeState.FAULTY) == [5]
    assert np.flatnonzero(health.invalid).tolist() == [4]


def test_noise_that_parity_mends_makes_no_node_faulty() -> None:
    rng, health = np.random.default_rng(13), NodeHealth(PARITY)
    for _ in range(8 * JUDGE_FRAMES):
        health.update(decode(noisy(rng.integers(0, 1024, 16), PARITY, 3.5, rng), PARITY))
        assert not health.invalid.any()


@pytest.mark.parametrize(
    ("change", "state"),
    [
        ("none", NodeState.OK),
        ("weak", NodeState.WEAK),
        ("doubled", NodeState.DOUBLED),
        ("doubled, same word", NodeState.DOUBLED),
        ("broken", NodeState.FAULTY),
        ("missing", NodeState.UNHEARD),
    ],
)
@pytest.mark.parametrize("known", [True, False])
def test_a_node_that_is_not_as_it_should_be_is_named(
    change: str, state: NodeState, known: bool
) -> None:
    spec = SPEC if known else replace(SPEC, amplitude_v=None)
    health = NodeHealth(spec)
    feed(health, scenes(change, spec), spec)
    assert health.state[4] == state
    assert np.delete(health.state, 4).tolist() == [NodeState.OK] * 15
    assert health.nodes(state) == ([5] if state != NodeState.OK else list(range(1, 17)))


def test_a_node_that_only_tells_that_it_lives_is_sound() -> None:
    """Every node speaks once in 78 frames, as at rest."""
    rng, health = np.random.default_rng(11), NodeHealth(SPEC)
    for frame in range(78 * 12):
        active = np.arange(16) == frame % 78
        chips = line_chips(SPEC, rng.integers(0, 1024, 16), active)
        health.update(read_chips(chips, SPEC, swing_v=health.swing_v))
    assert health.nodes(NodeState.OK) == list(range(1, 17))


def test_a_node_that_died_is_missing() -> None:
    health = NodeHealth(SPEC)
    skin = Pipeline(SkinConfig.of({"stale_after_s": 1.0})).taxels
    for number, levels in enumerate(scenes("none") + scenes("missing")):
        skin.update(feed(health, [levels]), number / 32, health)
        assert skin.missing == ([5] if number / 32 > 3 - 1 / 32 else [])


def test_a_node_that_recovers_is_sound_again() -> None:
    for change in ("weak", "doubled", "broken"):
        health = NodeHealth(SPEC)
        feed(health, scenes(change))
        feed(health, scenes("none", frames=6 * JUDGE_FRAMES))
        assert health.state[4] == NodeState.OK, change


def test_a_weak_node_is_heard_once_it_is_known() -> None:
    health = NodeHealth(SPEC)
    levels = scenes("weak")
    assert not feed(health, levels[:1]).active[4]
    words = feed(health, levels)
    assert words.active[4] and not words.doubtful[4]


def test_noise_makes_no_weak_nodes() -> None:
    rng, health = np.random.default_rng(10), NodeHealth(SPEC)
    silence = np.zeros((10, 20), np.float32)
    for _ in range(500):
        noise = rng.normal(0, 0.4, silence.shape).astype(np.float32)
        health.update(read_chips(silence + noise, SPEC, swing_v=health.swing_v))
    assert not np.isin(health.state, [NodeState.WEAK, NodeState.DOUBLED, NodeState.FAULTY]).any()


def test_status_tells_and_contradictory_words_are_no_pressure() -> None:
    for change, flag, valid in (
        ("weak", Status.WEAK, True),
        ("doubled", Status.FAULTY, False),
        ("broken", Status.FAULTY, False),
    ):
        health = NodeHealth(SPEC)
        skin = Pipeline(SkinConfig.of({"stale_after_s": 1.0})).taxels
        words = feed(health, scenes(change))
        readings = skin.update(words, 1.0, health)
        assert readings.status[4] & flag
        assert np.isfinite(readings.pressure_pa[4]) == valid
        assert np.isfinite(np.delete(readings.pressure_pa, 4)).all()
        assert not (np.delete(readings.status, 4) & flag).any()


def said(codes: np.ndarray) -> NodeLevels:
    return noisy(codes, SPEC, 100.0, np.random.default_rng(12))


@given(st.integers(0, 9), st.floats(0.3, 20.0), st.integers(0, 2**32 - 1))
@examples(100)
def test_what_hits_one_bit_of_all_nodes_makes_no_certain_wrong_word(
    bit: int, size: float, seed: int
) -> None:
    """As a spike within one chip does: every row takes as much of it, with either sign."""
    codes = np.random.default_rng(seed).integers(0, 1024, 16)
    levels = said(codes)
    spike = SWING * size * SPEC.node_rows[:, seed % 20]
    # One of 2a that turns all bits but one looks like a single broken node.
    assume(np.count_nonzero(spike * levels.values[bit] > 0) > 1)
    levels.values[bit] += spike
    words = decode(levels, SPEC)
    assert (words.doubtful | ~words.active)[words.codes != codes].all()


def test_a_bit_that_something_has_hit_is_doubted_where_its_level_is_high() -> None:
    """What hits several chips reaches one row more than most."""
    codes = np.random.default_rng(14).integers(0, 1024, 16)
    levels = levels_of(codes, SPEC)
    levels.values[4] *= 1.22
    levels.values[4, 7] *= -0.8 / 1.22
    words = decode(levels, SPEC)
    assert words.codes[7] != codes[7] and words.doubtful[7]


def test_what_hits_one_row_in_one_bit_makes_its_word_doubtful() -> None:
    codes = np.random.default_rng(13).integers(0, 1024, 16)
    for size in (1.0, 1.5, 2.5, 4.0):
        levels = said(codes)
        levels.values[2, 7] -= np.sign(levels.values[2, 7]) * SWING * size
        words = decode(levels, SPEC)
        assert np.flatnonzero(words.doubtful).tolist() == [7]


def test_three_nodes_on_a_row_are_found() -> None:
    """Their levels are a or 3a: no bit cancels, and the mean is that of one node and a half."""
    rng, health = np.random.default_rng(14), NodeHealth(SPEC)
    for _ in range(2 * JUDGE_FRAMES):
        levels = said(rng.integers(0, 1024, 16))
        for _ in range(2):
            levels.values[:, 4] += levels_of(rng.integers(0, 1024, 16), SPEC).values[:, 4]
        feed(health, [levels])
    assert health.nodes(NodeState.DOUBLED) == [5]


def test_a_word_too_loud_for_one_node_is_doubtful() -> None:
    levels = said(np.arange(16))
    levels.values[:, 4] *= 2.0
    assert np.flatnonzero(decode(levels, SPEC).doubtful).tolist() == [4]
