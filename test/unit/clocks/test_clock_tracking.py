# SPDX-License-Identifier: Apache-2.0

"""Drifting clocks are tracked on ordinary frames, and nothing else changes the estimate."""

import numpy as np
import pytest

from tactile_cdma.clocks.clock_tracking import ClockTracker
from tactile_cdma.clocks.decorrelate import Decorrelator
from tactile_cdma.clocks.node_clocks import NodeClocks
from tactile_cdma.clocks.sampling import row_samples
from tactile_cdma.code.frame import FrameSpec

SPEC = FrameSpec(nodes=15, order=32, chip_s=25e-6)
PER_CHIP = 4.0
NOISE = 0.01


def drawn(seed: int) -> NodeClocks:
    rng = np.random.default_rng(seed)
    return NodeClocks(rng.uniform(0, 0.5, 15), rng.uniform(-0.005, 0.005, 15), np.ones(15, bool))


def moved(clocks: NodeClocks, begin: np.ndarray, end: np.ndarray) -> NodeClocks:
    return NodeClocks(
        clocks.delay_chips + begin, clocks.rate_error + (end - begin) / SPEC.chips, clocks.known
    )


def line_of(clocks: NodeClocks, words: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    line = NOISE * rng.normal(size=round(SPEC.frame_period_s / SPEC.chip_s * 4))
    chip = 1 + clocks.rate_error
    for bit, values in enumerate(words):
        begin = clocks.delay_chips + bit * SPEC.order * chip
        rows = SPEC.book.rows(SPEC.rows)
        line += values @ row_samples(rows, begin, chip, 0, line.size, PER_CHIP)
    return line.astype(np.float32)


def errors(clocks: NodeClocks, true: NodeClocks) -> np.ndarray:
    """Displacements of begin and end beside the true ones, (n, 2) chips."""
    at = [0, SPEC.chips]
    return clocks.displacement(at) - true.displacement(at)


@pytest.mark.slow
@pytest.mark.parametrize("same_words", [False, True])
def test_wrong_clocks_are_corrected_and_drift_is_followed(same_words: bool) -> None:
    rng, true = np.random.default_rng(1), drawn(0)
    scatter = rng.normal(size=(2, 15)) * 0.06
    start = moved(true, *scatter)
    tracker = ClockTracker(start)
    decorrelator = Decorrelator(SPEC, tracker.clocks, PER_CHIP)
    drift = rng.uniform(-0.004, 0.004, 15)  # chips per frame, at the frame's end
    words = 0.3 * rng.choice([-1, 1], (10, 15))
    for frame in range(40):
        true = moved(true, 0 * drift, drift)
        if not same_words:
            words = 0.3 * rng.choice([-1, 1], (10, 15))
        line = line_of(true, words, rng)
        decided = 0.3 * np.sign(decorrelator.estimate(line))
        assert tracker.update(decorrelator, line, decided.astype(np.float32), NOISE)
        if frame % 10 == 9:
            decorrelator = Decorrelator(SPEC, tracker.clocks, PER_CHIP)
    left, lost = errors(tracker.clocks, true), errors(start, true)
    assert np.linalg.norm(left) < 0.6 * np.linalg.norm(lost)
    assert np.median(np.abs(left)) < 0.3 * np.median(np.abs(lost))


def test_silent_nodes_keep_their_clocks() -> None:
    rng, true = np.random.default_rng(2), drawn(1)
    known = moved(true, np.full(15, 0.05), np.full(15, -0.05))
    tracker, decorrelator = ClockTracker(known), Decorrelator(SPEC, known, PER_CHIP)
    speaks = np.arange(15) % 2 == 0
    for _ in range(5):
        words = (0.3 * rng.choice([-1, 1], (10, 15)) * speaks).astype(np.float32)
        tracker.update(decorrelator, line_of(true, words, rng), words, NOISE)
    after, before = np.abs(errors(tracker.clocks, true)), np.abs(errors(known, true))
    assert np.allclose(after[~speaks], before[~speaks], atol=1e-12)
    assert after[speaks].mean() < 0.7 * before[speaks].mean()


def test_frames_that_are_not_understood_move_nothing() -> None:
    rng, true = np.random.default_rng(3), drawn(2)
    tracker, decorrelator = ClockTracker(true), Decorrelator(SPEC, true, PER_CHIP)
    words = (0.3 * rng.choice([-1, 1], (10, 15))).astype(np.float32)
    line = line_of(true, words, rng)
    wrong = words.copy()
    wrong[:, ::3] *= -1
    for some, decided in ((line + rng.normal(size=line.size), words), (line, wrong)):
        assert not tracker.update(decorrelator, some.astype(np.float32), decided, NOISE)
    assert not tracker.update(decorrelator, 0 * line, 0 * words, NOISE)
    assert tracker.clocks is true


def test_one_frame_moves_clocks_by_little() -> None:
    rng, true = np.random.default_rng(4), drawn(3)
    off = moved(true, np.full(15, 0.3), np.full(15, 0.3))
    tracker, decorrelator = ClockTracker(off), Decorrelator(SPEC, off, PER_CHIP)
    for _ in range(20):
        words = (0.3 * rng.choice([-1, 1], (10, 15))).astype(np.float32)
        before = tracker.clocks
        tracker.update(decorrelator, line_of(true, words, rng), words, 0.0)
        assert tracker.clocks.moved_chips(before, SPEC) < 0.15
