# SPDX-License-Identifier: Apache-2.0

"""The kernel sums up samples as numpy does."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base import sums
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.framing.fit import ChipEdges, Fit, Line, integrate

SIZES = st.integers(0, 300)
SEEDS = st.integers(0, 2**32 - 1)


def samples(size: int, seed: int) -> np.ndarray:
    """Some of them at a rail, absurd or no numbers."""
    rng = np.random.default_rng(seed)
    volts = rng.normal(1.6, 0.5, size).astype(np.float32)
    hit = rng.random(size) < 0.05
    volts[hit] = rng.choice([0.0, 3.3, 1e6, -2e6, np.inf, np.nan], np.count_nonzero(hit))
    return volts


def test_sums_are_those_of_c_in_every_version_of_python() -> None:
    """Since 3.12 Python's sum() of these is 1."""
    assert (
        sums.in_order([0.1] * 10) == 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 < 1
    )


@given(SIZES, SEEDS)
def test_sums_are_those_of_numpy(size: int, seed: int) -> None:
    volts = samples(size, seed)
    copy = np.empty(size)
    sums.copy_samples(1e6, volts, copy)
    assert np.isnan(copy[~(np.abs(volts) < 1e6)]).all()
    np.testing.assert_allclose(sums.sums(copy), (copy.sum(), np.square(copy).sum()), rtol=1e-12)


@pytest.mark.parametrize("resync_chips", [0, 8])
@given(st.floats(-3.0, 3.0), st.floats(1.9, 9.0), st.integers(-40, 40), SEEDS)
def test_chips_are_those_of_any_fit(
    resync_chips: int, start: float, chip: float, longer: int, seed: int
) -> None:
    """Whether the samples end before the frame or after it."""
    guard_chips = 2 if resync_chips else 0
    spec = FrameSpec(
        nodes=3, resync_chips=resync_chips, guard_chips=guard_chips, frame_period_s=1.0
    )
    size = max(1, round(spec.span_chips * chip) + longer)
    received = np.random.default_rng(seed).normal(1.6, 0.5, size)
    fit, line = Fit(start, chip), Line(received, 1.6)
    edges = ChipEdges(fit, spec)
    found = edges.chips(line)
    some, lengths = np.array([start]), np.array([chip])
    np.testing.assert_allclose(found, integrate(line, some, lengths, spec)[0], rtol=1e-5, atol=1e-6)
