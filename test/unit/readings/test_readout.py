# SPDX-License-Identifier: Apache-2.0

"""The kernel reads plain frames as numpy does, and leaves the odd ones to it untouched."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.code.amplitude import ACTIVE_SHARE
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.separate import NodeLevels, node_levels
from tactile_cdma.code.transform import correlate, spread
from tactile_cdma.places.layout import Layout
from tactile_cdma.readings.baseline import Baseline, RestRules
from tactile_cdma.readings.calibration import AdcScale, Calibration, Curves, PressureCurve
from tactile_cdma.readings.drift import DriftTracker, nodes_beside
from tactile_cdma.readings.pressure import PressureChain
from tactile_cdma.readings.taxels import Readings, Taxels
from tactile_cdma.words.decode import Words, decode
from tactile_cdma.words.health import JUDGE_FRAMES, NodeHealth, NodeState
from test.support.correlations import lines
from test.support.examples import examples

STALE_S = 1.0


class Side:
    """A skin that is read by the kernel where that can, or by numpy only."""

    def __init__(self, spec: FrameSpec, seed: int, by_kernel: bool) -> None:
        rng = np.random.default_rng(seed)
        self.spec, self.by_kernel, self.at_once = spec, by_kernel, 0
        self.health = NodeHealth(spec)
        nodes = spec.nodes
        layout = Layout.grid(nodes, 1, nodes, 7e-3, 5e-3)
        if seed % 3 and nodes > 3:  # taxels in another order, one without a node, one masked
            number = rng.permutation(nodes).astype(np.int32) + 1
            layout = replace(
                layout, nodes=np.where(number == 2, 0, number), masked=(3,), unplaced=(2,)
            )
        curves = []
        for _ in range(nodes):
            corners_pa = np.cumsum(rng.uniform(1e3, 5e4, rng.integers(1, 4)))
            corners_v = 3.2 - np.cumsum(rng.uniform(0.1, 0.8, len(corners_pa) + 1))
            corners_v = corners_v if rng.random() < 0.5 else 3.1 - corners_v
            curves.append(PressureCurve((0.0, *corners_pa.tolist()), tuple(corners_v.tolist())))
        calibration = Calibration(Curves.of(curves), rng.random(nodes) < 0.2)
        baseline, adc = Baseline(nodes), AdcScale(spec.bits)
        baseline.tare_pa = rng.uniform(0, 500, nodes).astype(np.float32)
        baseline.drift_v = rng.uniform(-0.1, 0.1, nodes).astype(np.float32)
        tracker = DriftTracker(adc, nodes_beside(layout, nodes), RestRules(5e3, 1e3, 500.0))
        chain = PressureChain(calibration, baseline, tracker)
        self.taxels = Taxels(nodes, adc, chain, layout, STALE_S)

    def read(self, levels: NodeLevels, threshold: float, t_s: float) -> tuple[Words, Readings]:
        if self.by_kernel:
            both = self.taxels.read(levels, self.spec, threshold, t_s, self.health)
            if both is not None:
                self.at_once += 1
                return both
        words = decode(levels, self.spec, threshold, self.health.swing_v)
        self.health.update(words)
        return words, self.taxels.update(words, t_s, self.health)


def compare(
    spec: FrameSpec,
    frames: np.ndarray,
    seed: int,
    threshold: float = ACTIVE_SHARE,
    faulty: tuple[int, ...] = (),
) -> int:
    """Read frames (f, k, N) both ways; returns how many the kernel read.

    faulty: nodes, from 0 on, that were faulty before.
    """
    rng, t_s = np.random.default_rng(seed), 0.0
    sides = Side(spec, seed, True), Side(spec, seed, False)
    for side in sides:
        side.health.state[[*faulty]] = NodeState.FAULTY
        side.health.invalid[[*faulty]] = True
    for rows in frames:
        t_s += float(rng.choice([0.02, 0.2, 1.5 * STALE_S]))
        levels = node_levels(rows, spec)
        if spec.sparse:
            spoke = rng.permutation(np.flatnonzero(levels.values.any(axis=0)).astype(np.int32))
            own = np.ascontiguousarray(levels.values[:, spoke])
            levels = NodeLevels(own, 2e-3, spoke=spoke)
        rms = float(np.sqrt(np.mean(np.square(rows))))
        (words, readings), (other_words, others) = (
            side.read(levels, threshold, t_s) for side in sides
        )
        for name in Words.__slots__:
            some, other = np.asarray(getattr(words, name)), np.asarray(getattr(other_words, name))
            assert some.dtype == other.dtype and some.shape == other.shape, name
            if some.dtype.kind == "f":  # of one node numpy adds the bits in another order
                np.testing.assert_allclose(some, other, rtol=2e-6, atol=1e-6 * rms, err_msg=name)
            else:
                np.testing.assert_array_equal(some, other, err_msg=name)
        for name in Readings.__slots__:
            np.testing.assert_array_equal(getattr(readings, name), getattr(others, name), name)
    ours, theirs = (side.taxels for side in sides)
    for kept, other in zip(ours._kept, theirs._kept, strict=True):
        np.testing.assert_array_equal(kept, other)
    np.testing.assert_allclose(sides[0].health.sums, sides[1].health.sums, rtol=1e-5)
    assert ours.missing == theirs.missing
    for look, other_look in zip(ours.baseline._looks, theirs.baseline._looks, strict=True):
        for kept, other in zip(look, other_look, strict=True):
            np.testing.assert_array_equal(kept, other)
    np.testing.assert_array_equal(ours.baseline.drift_v, theirs.baseline.drift_v)
    return sides[0].at_once


@examples(60)
@given(lines(4), st.integers(0, 99), st.sampled_from([0.3, 0.5, 0.9]))
def test_frames_are_read_as_by_numpy(
    line: tuple[FrameSpec, np.ndarray], seed: int, threshold: float
) -> None:
    compare(*line, seed, threshold)


def sound(spec: FrameSpec, frames: int, noise_v: float, silent: float = 0.3) -> np.ndarray:
    """Frames of which each node says something else, or nothing, (f, k, N) float32."""
    rng = np.random.default_rng(1)
    rows = rng.normal(0, noise_v, (frames, spec.line_bits, spec.order)).astype(np.float32)
    spoken = rng.choice([-0.3, 0.3], (frames, spec.line_bits, spec.nodes))
    rows[..., spec.node_slice] += spoken * (rng.random((frames, 1, spec.nodes)) >= silent)
    return rows


@pytest.mark.parametrize("noise_v", [0.0, 2e-3])
@pytest.mark.parametrize(
    ("nodes", "options"),
    [(2, {}), (16, {}), (16, {"amplitude_v": None}), (16, {"scramble": True}), (256, {})],
)
def test_the_kernel_reads_sound_frames(nodes: int, noise_v: float, options: dict) -> None:
    """Else the comparison would not compare."""
    spec = FrameSpec(
        nodes=nodes, order=264 if nodes > 16 else 20, chip_s=1e-7, frame_period_s=1.0, **options
    )
    frames = 2 * JUDGE_FRAMES + 5
    assert compare(spec, sound(spec, frames, noise_v), seed=1) >= frames - 5 * (nodes == 2)


@pytest.mark.parametrize("silent", [0.3, 0.97])
def test_of_sparse_frames_the_kernel_reads_those_who_spoke(silent: float) -> None:
    """In some frames a few of them are in doubt, with a weak bit."""
    spec = FrameSpec(
        nodes=300, order=200, chip_s=1e-7, frame_period_s=1.0, codes="sparse", amplitude_v=0.3
    )
    rng, frames = np.random.default_rng(2), 2 * JUDGE_FRAMES + 5
    rows = np.zeros((frames, spec.line_bits, spec.row_count), np.float32)
    spoken = rng.choice([-0.3, 0.3], (frames, spec.line_bits, spec.nodes))
    spoken += rng.normal(0, 2e-3, spoken.shape)
    spoken[::7, 3, ::9] *= 0.2
    rows[..., spec.node_slice] = spoken * (rng.random((frames, 1, spec.nodes)) >= silent)
    assert compare(spec, rows, seed=1) >= 0.8 * frames


def test_a_verdict_counts_from_its_own_frame_on() -> None:
    """Of nodes that were faulty and are sound; readings of all frames are as by numpy."""
    spec = FrameSpec(nodes=16, order=20, chip_s=1e-7, frame_period_s=1.0)
    frames = 2 * JUDGE_FRAMES + 5
    assert compare(spec, sound(spec, frames, 0.0), seed=1, faulty=(4, 9)) == frames


def test_words_that_are_late_are_left_to_numpy() -> None:
    """Of nodes that are late by chips, whose words show on other rows."""
    spec = FrameSpec(nodes=40, order=44, chip_s=1e-7, frame_period_s=1.0)
    rows = sound(spec, 12, 1e-4)
    late = rows.copy()
    late[..., spec.node_slice][..., 3:] = 0
    rows = rows - late + correlate(np.roll(spread(late, spec.book), 1, axis=-1), spec.book)
    assert compare(spec, rows, seed=3) == 0


def test_arrays_that_do_not_fit_are_refused() -> None:
    spec = FrameSpec(nodes=5, order=8, chip_s=1e-7, frame_period_s=1.0)
    side = Side(spec, 1, True)
    levels = node_levels(sound(spec, 1, 0.0)[0], spec)
    side.read(levels, 0.5, 0.0)
    with pytest.raises(ValueError, match=r"shape \(10, 8\), not \(9, 8\)"):
        side.read(replace(levels, rows=levels.rows[:9]), 0.5, 0.1)
    side.taxels._kept.codes[0] = 1 << 10
    side.health.state = side.health.state.copy()
    with pytest.raises(ValueError, match="struct readout of the kernel: what it is made of"):
        side.read(levels, 0.5, 0.1)
