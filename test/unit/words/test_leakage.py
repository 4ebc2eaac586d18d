# SPDX-License-Identifier: Apache-2.0

"""What chips leave in their neighbours is not taken for a node, and a weak node is still found."""

import numpy as np
import pytest

from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import DEFAULT_AMPLITUDE_V, FrameSpec
from tactile_cdma.words.words import Words
from tactile_cdma.words.health import JUDGE_FRAMES, NodeHealth, NodeState
from test.support.correlations import read_chips

SPEC = FrameSpec()


def low_pass(chips: np.ndarray, tau: float) -> np.ndarray:
    """Means over each chip behind a first-order low-pass of this time constant, chips.

    The output decays towards each chip's level: its mean over the chip lies a share of
    τ·(1 − e^(−1/τ)) of the way back to where it began.
    """
    result, state = np.empty(chips.size), 0.0
    for index, level in enumerate(chips.ravel()):
        result[index] = level + (state - level) * tau * (1 - np.exp(-1 / tau))
        state = level + (state - level) * np.exp(-1 / tau)
    return result.reshape(chips.shape)


def heard(codes: np.ndarray, active: np.ndarray, tau: float, rng: np.random.Generator) -> Words:
    chips = low_pass(line_chips(SPEC, codes, active), tau)
    chips += rng.normal(0, 0.003, chips.shape)
    return read_chips(chips, SPEC)


@pytest.mark.parametrize("tau", [0.1, 0.3, 0.4])
@pytest.mark.parametrize("speaker", range(0, SPEC.nodes, 5))
def test_one_node_behind_a_low_pass_makes_no_others(speaker: int, tau: float) -> None:
    rng, health = np.random.default_rng(speaker), NodeHealth(SPEC)
    active = np.arange(SPEC.nodes) == speaker
    for _ in range(4 * JUDGE_FRAMES):
        words = heard(rng.integers(0, 1024, SPEC.nodes), active, tau, rng)
        assert np.array_equal(words.active, active)
        health.update(words)
    assert health.nodes(NodeState.WEAK) == [] or health.nodes(NodeState.WEAK) == [speaker + 1]
    unheard = np.flatnonzero(health.state == NodeState.UNHEARD).tolist()
    assert unheard == np.flatnonzero(~active).tolist()


@pytest.mark.parametrize("share", [0.35, 0.45])
def test_a_weak_node_beside_loud_ones_is_found_and_doubtful_until_then(share: float) -> None:
    rng, health, weak = np.random.default_rng(1), NodeHealth(SPEC), 3
    loud = np.isin(np.arange(SPEC.nodes), (0, 4, 9))
    for frame in range(2 * JUDGE_FRAMES + 1):
        codes = rng.integers(0, 1024, SPEC.nodes)
        chips = line_chips(SPEC, codes, loud)
        alone = np.arange(SPEC.nodes) == weak
        chips = chips + line_chips(SPEC, codes, alone, share * DEFAULT_AMPLITUDE_V)
        chips = low_pass(chips, 0.2) + rng.normal(0, 0.003, chips.shape)
        words = read_chips(chips, SPEC, swing_v=health.swing_v)
        assert words.active[loud].all()
        if frame < JUDGE_FRAMES:
            assert not words.active[weak] and words.doubtful[weak]
        health.update(words)
    assert health.nodes(NodeState.WEAK) == [weak + 1]
    assert words.active[weak] and words.codes[weak] == codes[weak]


def test_on_a_line_that_weakens_all_words_faint_ones_are_not_called_silent() -> None:
    """Of words at 0.45 and 0.22 of the amplitude, none is certain to be silence."""
    speaks, rng = np.isin(np.arange(SPEC.nodes), (0, 4, 9, 12)), np.random.default_rng(2)
    faint = np.arange(SPEC.nodes) == 6
    for _ in range(20):
        codes = rng.integers(0, 1024, SPEC.nodes)
        chips = line_chips(SPEC, codes, speaks, 0.45 * DEFAULT_AMPLITUDE_V)
        chips = chips + line_chips(SPEC, codes, faint, 0.22 * DEFAULT_AMPLITUDE_V)
        chips += rng.normal(0, 0.003, chips.shape)
        words = read_chips(chips, SPEC)
        assert np.array_equal(words.doubtful, speaks | faint)
