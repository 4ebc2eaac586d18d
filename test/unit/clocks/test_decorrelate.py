# SPDX-License-Identifier: Apache-2.0

"""The decorrelator compared with dense least squares, and its bound on noise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import SpecError
from tactile_cdma.clocks.decorrelate import MAX_GAIN, Decorrelator
from tactile_cdma.clocks.node_clocks import NodeClocks
from tactile_cdma.clocks.sampling import row_samples
from tactile_cdma.code.frame import UNIPOLAR, FrameSpec
from test.support.examples import examples


def clocks_of(nodes: int, delay: float, rate: float, seed: int = 0) -> NodeClocks:
    rng = np.random.default_rng(seed)
    return NodeClocks(
        rng.uniform(0, delay, nodes), rng.uniform(-rate, rate, nodes), np.ones(nodes, bool)
    )


def nominal(nodes: int) -> NodeClocks:
    """Clocks that agree with the digitizer's."""
    return NodeClocks(np.zeros(nodes), np.zeros(nodes), np.zeros(nodes, bool))


def dense(spec: FrameSpec, clocks: NodeClocks, per_chip: float, samples: int) -> np.ndarray:
    """All waveforms of a frame, (samples, k·(n + 1)), the pedestal of each bit last."""
    rows, columns = spec.book.rows(spec.rows), []
    for bit in range(spec.bits):
        begin = clocks.delay_chips + bit * spec.order * (1 + clocks.rate_error)
        for some in (rows, np.ones_like(rows)):
            shown = row_samples(some, begin, 1 + clocks.rate_error, 0, samples, per_chip)
            columns += list(shown) if some is rows else [shown.mean(axis=0)]
    return np.array(columns, dtype=float).T


def line_of(spec: FrameSpec, clocks: NodeClocks, words: np.ndarray, per_chip: float) -> np.ndarray:
    """Samples at instants of nodes that put steps on the line; words: (k, n) amplitudes."""
    instants = (np.arange(int(spec.frame_period_s / spec.chip_s * per_chip)) + 0.5) / per_chip
    line = np.zeros(instants.size)
    for node, row in enumerate(spec.book.rows(spec.rows)):
        rate = 1 + clocks.rate_error[node]
        chip = np.floor((instants - clocks.delay_chips[node]) / rate).astype(int)
        inside = (chip >= 0) & (chip < spec.chips)
        chip = chip[inside]
        level = words[chip // spec.order, node] * row[chip % spec.order]
        if spec.drive == UNIPOLAR:
            level = level + np.abs(words[:, node]).mean()
        line[inside] += level
    return line.astype(np.float32)


@examples(10)
@given(st.sampled_from([2.0, 3.0, 4.5]), st.floats(0, 1), st.floats(0, 0.02), st.integers(0, 99))
def test_block_elimination_is_regularised_least_squares(
    per_chip: float, delay: float, rate: float, seed: int
) -> None:
    spec = FrameSpec(nodes=11, order=12, bits=8)
    clocks = clocks_of(11, delay, rate, seed)
    decorrelator = Decorrelator(spec, clocks, per_chip)
    A = dense(spec, clocks, per_chip, decorrelator.samples)
    K = np.linalg.inv(A.T @ A + decorrelator.ridge * np.eye(A.shape[1]))
    line = np.random.default_rng(seed).normal(size=decorrelator.samples).astype(np.float32)
    expected = (K @ A.T @ line).reshape(8, 12)[:, :11]
    assert np.allclose(decorrelator.estimate(line), expected, atol=1e-3)
    kept = (1 - decorrelator.ridge * np.diag(K)).reshape(8, 12)[:, :11]
    assert np.allclose(decorrelator.resolution, kept.min(axis=0), atol=1e-3)
    noise = np.linalg.norm(K @ A.T, axis=1).reshape(8, 12)[:, :11]
    assert np.all(decorrelator.noise_gain > 0.999 * noise)
    resolved = np.setdiff1d(np.arange(11), decorrelator.unresolved)
    assert np.all(decorrelator.noise_gain[:, resolved] < 1.5 * noise[:, resolved])
    words = np.random.default_rng(seed).normal(size=(8, 12))
    words[:, 11] = 0
    modelled = decorrelator.line(words[:, :11].astype(np.float32))
    assert np.allclose(modelled, A @ words.ravel(), atol=1e-4)


def test_the_line_of_unipolar_nodes_has_the_pedestal_of_all_that_speak() -> None:
    """Nodes that put 0 or A on the line raise its level by half of each one's swing."""
    spec, clocks = FrameSpec(nodes=11, order=12, bits=8, drive=UNIPOLAR), clocks_of(11, 0.5, 0.002)
    decorrelator = Decorrelator(spec, clocks, 2.0)
    A = dense(spec, clocks, 2.0, decorrelator.samples)
    words = np.random.default_rng(0).normal(size=(8, 12))
    words[:, 11] = np.abs(words[:, :11]).sum(axis=1)
    modelled = decorrelator.line(words[:, :11].astype(np.float32))
    assert np.allclose(modelled, A @ words.ravel(), atol=1e-4)


@pytest.mark.parametrize(
    ("nodes", "order", "delay", "rate"),
    [(15, 16, 0.5, 0.003), (31, 64, 0.5, 0.01), (63, 64, 0.0, 0.01)],
)
def test_words_of_nodes_with_clocks_of_their_own_are_separated(
    nodes: int, order: int, delay: float, rate: float
) -> None:
    spec = FrameSpec(nodes=nodes, order=order, chip_s=1e-6, frame_period_s=16e-6 * order)
    clocks = clocks_of(nodes, delay, rate)
    rng = np.random.default_rng(0)
    words = 0.3 * rng.choice([-1, 1], (10, nodes)) * (rng.random(nodes) < 0.7)
    decorrelator = Decorrelator(spec, clocks, 2.0)
    line = line_of(spec, clocks, words, 2.0)
    found = decorrelator.estimate(line)
    assert np.abs(found - words).max() < 0.12
    shifted = decorrelator.estimate(line + np.float32(0.1))
    assert np.abs(shifted - found).max() < 0.03  # an offset of a third of a node
    plain = line[: 2 * spec.chips].reshape(10, -1) @ np.repeat(spec.book.rows(spec.rows), 2, 1).T
    assert np.abs(plain / (2 * order) - words).max() > 0.3


def test_unipolar_nodes_are_separated() -> None:
    spec = FrameSpec(
        nodes=31, order=32, chip_s=1e-6, frame_period_s=600e-6, drive=UNIPOLAR, amplitude_v=0.6
    )
    clocks = clocks_of(31, 0.3, 0.003)
    words = 0.3 * np.random.default_rng(0).choice([-1, 1], (10, 31))
    found = Decorrelator(spec, clocks, 2.0).estimate(line_of(spec, clocks, words, 2.0))
    assert np.abs(found - words).max() < 0.2


def test_noise_is_bounded_and_twins_are_named() -> None:
    """Sylvester's rows 2 and 3 are one chip apart: ++−− and +−−+."""
    spec = FrameSpec(nodes=7, order=8, bits=8)
    delay = np.zeros(7)
    delay[2] = -1.0  # row 3 begins a chip early
    twins = NodeClocks(delay, np.zeros(7), np.ones(7, bool))
    decorrelator = Decorrelator(spec, twins, 2.0)
    assert MAX_GAIN / 2 < decorrelator.gain.max() <= MAX_GAIN
    assert {1, 2} <= set(decorrelator.unresolved.tolist())
    apart = Decorrelator(spec, nominal(7), 2.0)
    assert not apart.unresolved.size
    assert apart.gain == pytest.approx(np.ones(7), abs=0.01)


def test_misuse_is_refused() -> None:
    with pytest.raises(SpecError, match="slide"):
        Decorrelator(FrameSpec(frame_period_s=12.812e-3), nominal(16), 2.0)
    with pytest.raises(SpecError, match="slowest node"):
        slow = NodeClocks(np.zeros(16), np.full(16, 0.02), np.ones(16, bool))
        Decorrelator(FrameSpec(frame_period_s=10e-3), slow, 2.0)
    with pytest.raises(SpecError, match="chips apart"):
        apart = NodeClocks(np.array([0.0, 4.0]), np.array([0, 0.02]), np.ones(2, bool))
        Decorrelator(FrameSpec(nodes=2, order=4), apart, 2.0)
    with pytest.raises(SpecError, match="MiB"):
        large = FrameSpec(nodes=2047, chip_s=1e-7, frame_period_s=4e-3)
        Decorrelator(large, nominal(2047), 2.0)
