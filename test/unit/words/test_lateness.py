# SPDX-License-Identifier: Apache-2.0

"""A late node speaks on another one's row: nobody's word or silence is taken for certain then."""

from __future__ import annotations

import numpy as np
import pytest

from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.separate import separate
from tactile_cdma.words.decode import Words, decode

SPEC = FrameSpec()


def heard(
    codes: np.ndarray, active: np.ndarray, node: int, late: float, rng: np.random.Generator
) -> Words:
    """Means over chips of a frame in which one node's chips come late by so many chips."""
    alone = np.arange(SPEC.nodes) == node
    chips = np.append(line_chips(SPEC, codes, alone & active).ravel(), np.zeros(8))
    whole, share = int(late // 1), late % 1
    chips = (1 - share) * np.roll(chips, whole) + share * np.roll(chips, whole + 1)
    chips = chips[: SPEC.chips].reshape(SPEC.line_bits, SPEC.order)
    chips = chips + line_chips(SPEC, codes, active & ~alone)
    chips += rng.normal(0, 0.003, chips.shape)
    return decode(separate(chips.astype(np.float32), SPEC), SPEC)


@pytest.mark.parametrize("late", [0.6, 1.0, 2.0, 3.0])
@pytest.mark.parametrize("others", [0, 1, 5])
def test_words_of_a_late_node_are_not_told_for_certain(others: int, late: float) -> None:
    rng, unflagged, wrong = np.random.default_rng(others), 0, 0
    for _ in range(200):
        nodes = rng.choice(SPEC.nodes, others + 1, replace=False)
        active = np.isin(np.arange(SPEC.nodes), nodes)
        codes = rng.integers(0, 1024, SPEC.nodes)
        words = heard(codes, active, int(nodes[0]), late, rng)
        off = (words.active != active) | (words.active & (words.codes != codes))
        wrong += bool(off.any())
        unflagged += bool((off & ~words.doubtful).any())
    assert wrong > 100
    # A word whose bits hardly change leaves little to tell by.
    assert unflagged <= 6


@pytest.mark.parametrize("others", [0, 5, 15])
def test_words_on_time_are_not_called_late(others: int) -> None:
    rng = np.random.default_rng(others)
    for _ in range(200):
        nodes = rng.choice(SPEC.nodes, others + 1, replace=False)
        active = np.isin(np.arange(SPEC.nodes), nodes)
        codes = rng.integers(0, 1024, SPEC.nodes)
        words = heard(codes, active, int(nodes[0]), 0.1, rng)
        assert np.array_equal(words.active, active)
        assert not words.doubtful.any()
