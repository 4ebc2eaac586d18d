# SPDX-License-Identifier: Apache-2.0

"""A node's clock from a frame in which it transmits alone."""

import tracemalloc

import numpy as np
import pytest

from tactile_cdma.base.errors import SpecError
from tactile_cdma.clocks.roll_call import HeardClock, RollCallListener
from tactile_cdma.code.frame import UNIPOLAR, FrameSpec

NOISE = 1e-3


def spec_of(nodes: int, order: int, **others) -> FrameSpec:
    return FrameSpec(nodes=nodes, order=order, chip_s=1e-6, frame_period_s=16e-6 * order, **others)


def lone(roll: RollCallListener, node: int, delay: float, rate: float, seed: int = 0) -> np.ndarray:
    """What instants see of one node: sample s is taken at s + ½, chips change like steps."""
    spec, row = roll.spec, roll.spec.book.rows(roll.spec.rows)[node]
    bits = np.random.default_rng(seed).choice([-1, 1], spec.bits)
    chip = np.floor(((np.arange(roll.samples) + 0.5) / roll.per_chip - delay) / (1 + rate))
    inside = (chip >= 0) & (chip < spec.chips)
    chip = np.where(inside, chip, 0).astype(int)
    line = bits[chip // spec.order] * row[chip % spec.order]
    if spec.drive == UNIPOLAR:
        line = line + 1
    return np.where(inside, 0.3 * line, 0.0)


def hear(roll: RollCallListener, node: int, line: np.ndarray, noise: float = NOISE) -> HeardClock:
    noisy = line + noise * np.random.default_rng(1).normal(size=line.size)
    return roll.hear(node, noisy.astype(np.float32), noise)


@pytest.mark.parametrize(("nodes", "order"), [(16, 20), (63, 64), (255, 256), (1000, 1024)])
def test_clocks_are_found_as_exactly_as_decorrelation_needs(nodes: int, order: int) -> None:
    """0.03 chip of delay and 0.08/N of rate at ρ = 12, on rows with enough level changes."""
    spec = spec_of(nodes, order)
    roll = RollCallListener(spec, 4.0)
    rng, noise = np.random.default_rng(order), 0.3 * np.sqrt(order * 4) / 12
    changes = np.count_nonzero(np.diff(spec.book.rows(spec.rows)), axis=1)
    for node in rng.choice(np.flatnonzero(changes > order / 3), 4, replace=False):
        delay, rate = rng.uniform(0, 0.5), rng.choice([-1, 1]) * rng.uniform(0.005, 0.02)
        heard = hear(roll, int(node), lone(roll, int(node), delay, rate), noise)
        assert not heard.refusal
        assert heard.delay_chips == pytest.approx(delay, abs=0.06 if order < 64 else 0.03)
        assert heard.rate_error == pytest.approx(rate, abs=0.08 / order)
        assert heard.rho == pytest.approx(12, rel=0.3)
    known = roll.clocks().known
    assert np.count_nonzero(known) == 4


@pytest.mark.parametrize("rate", [0.0, 1e-4])
def test_where_samples_cannot_tell_the_estimate_lies_in_the_middle(rate: float) -> None:
    """At 2 instants per chip and without drift, delays from 0.25 to 0.75 look the same."""
    roll = RollCallListener(spec_of(16, 20), 2.0)
    heard = hear(roll, 5, lone(roll, 5, 0.45, rate))
    assert heard.delay_chips == pytest.approx(0.5, abs=0.1)
    assert not heard.refusal


def test_unipolar_nodes_are_heard() -> None:
    roll = RollCallListener(spec_of(16, 20, drive=UNIPOLAR), 4.0)
    heard = hear(roll, 3, lone(roll, 3, 0.2, 0.01))
    assert not heard.refusal
    assert heard.rate_error == pytest.approx(0.01, abs=0.004)


def test_a_residual_offset_does_no_harm() -> None:
    roll = RollCallListener(spec_of(16, 20), 4.0)
    line = lone(roll, 3, 0.2, 0.01)
    clean, shifted = hear(roll, 3, line), hear(roll, 3, line + 0.03)
    assert not shifted.refusal
    assert shifted.delay_chips == pytest.approx(clean.delay_chips, abs=0.02)
    assert shifted.rate_error == pytest.approx(clean.rate_error, abs=2e-4)


@pytest.mark.parametrize("order", [20, 256])
def test_nobody_somebody_else_and_two_are_refused(order: int) -> None:
    roll = RollCallListener(spec_of(order - 4, order), 2.0)
    line = lone(roll, 7, 0.2, 0.003)
    noise = 0.3 * np.sqrt(order * 2) / 20
    assert "nobody" in hear(roll, 7, 0 * line, noise).refusal
    assert "another" in hear(roll, 7, line + lone(roll, 9, 0.4, -0.004, 1), noise).refusal
    assert hear(roll, 8, line, noise).refusal
    assert not roll.clocks().known.any()
    assert not hear(roll, 7, line, noise).refusal
    assert roll.clocks().known.tolist() == [node == 7 for node in range(order - 4)]


def test_unknown_nodes_take_the_median() -> None:
    roll = RollCallListener(spec_of(4, 8), 2.0)
    assert not roll.clocks().delay_chips.any()
    for node, delay, rate in ((0, 0.1, 0.01), (2, 0.2, 0.0), (3, 0.6, 0.002)):
        roll.heard[node] = HeardClock(delay, rate, 12.0, "")
    clocks = roll.clocks()
    assert clocks.known.tolist() == [True, False, True, True]
    assert clocks.delay_chips.tolist() == [0.1, 0.2, 0.2, 0.6]
    assert clocks.rate_error.tolist() == [0.01, 0.002, 0.0, 0.002]


def test_misuse_is_refused() -> None:
    with pytest.raises(SpecError, match="2 per chip"):
        RollCallListener(spec_of(16, 20), 1.0)


def test_a_listener_to_many_nodes_does_not_hold_all_their_rows() -> None:
    spec = FrameSpec(nodes=16_000, order=16_384, chip_s=1e-7, frame_period_s=0.1)
    tracemalloc.start()
    RollCallListener(spec, 4.0)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1 << 20  # all rows are 262 MB, and of a skin of 65,000 nodes 4 GB
