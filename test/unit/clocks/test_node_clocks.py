# SPDX-License-Identifier: Apache-2.0

"""Clocks of the nodes, and when they are too far apart for plain correlation."""

import numpy as np
import pytest

from tactile_cdma.base.errors import SpecError
from tactile_cdma.clocks.node_clocks import NodeClocks, crosstalk, needs_decorrelation
from tactile_cdma.clocks.sampling import row_samples
from tactile_cdma.code.frame import FrameSpec


def clocks(delay: list[float], rate: list[float]) -> NodeClocks:
    return NodeClocks(np.array(delay), np.array(rate), np.ones(len(delay), bool))


def test_displacement_grows_with_the_chips_counted() -> None:
    some = clocks([0.5, 0.0], [0.01, -0.02])
    assert np.allclose(some.displacement(100), [1.5, -2.0])
    assert np.allclose(some.displacement([0, 100]), [[0.5, 1.5], [0.0, -2.0]])
    spec = FrameSpec(nodes=2, order=4, frame_period_s=5e-3)
    assert some.spread_chips(spec) == pytest.approx(0.5 + 0.03 * 40)
    assert some.end_s(spec) == pytest.approx(40.9 * 50e-6)
    assert some.moved_chips(clocks([0, 0], [0, 0]), spec) == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("delay", "rate", "word"), [(9.0, 0.0, "node 1 is 9"), (0.0, float("nan"), "rate_error")]
)
def test_what_no_node_has_is_refused(delay: float, rate: float, word: str) -> None:
    with pytest.raises(SpecError, match=word):
        clocks([delay], [rate])


@pytest.mark.parametrize("order", [64, 68])
def test_crosstalk_is_what_correlation_sees(order: int) -> None:
    """Against the correlations that displaced rows really have, over random words."""
    rng = np.random.default_rng(0)
    spec = FrameSpec(nodes=60, order=order, frame_period_s=50e-3)
    some = clocks(rng.uniform(0, 0.5, 60), np.zeros(60))
    rows, begin = spec.book.rows(spec.rows), some.delay_chips - some.delay_chips.mean()
    per_chip = 16.0
    seen = row_samples(rows, begin, np.ones(60), 0, 16 * order, per_chip)
    ideal = row_samples(rows, np.zeros(60), np.ones(60), 0, 16 * order, per_chip)
    shifted = seen @ ideal.T / (16 * order) - np.diag(1 - np.abs(begin))
    power = np.square(shifted).sum(axis=0).mean()  # bits, ±1, add independently
    assert crosstalk(spec, some) == pytest.approx(np.sqrt(power), rel=0.2)


def test_decorrelation_is_for_clocks_that_are_apart() -> None:
    spec = FrameSpec()
    together = clocks([0.3] * 16, [0.01] * 16)  # which timing recovery follows
    assert not needs_decorrelation(spec, together)
    assert needs_decorrelation(spec, clocks([0.0, 0.5] * 8, [0.0] * 16))
    assert needs_decorrelation(spec, clocks([0.0] * 16, [0.0, 2e-3] * 8))
