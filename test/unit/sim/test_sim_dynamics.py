# SPDX-License-Identifier: Apache-2.0

"""Lag and hysteresis of simulated sensors."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tactile_cdma.sim.sensor import PAPER_DYNAMICS, SCALE_PA, Dynamics, delayed, followed

RANGE_PA = 140e3

paths_pa = arrays(np.float64, (40, 3), elements=st.floats(0.0, RANGE_PA))


@st.composite
def any_dynamics(draw: st.DrawFn) -> Dynamics:
    plays = draw(st.integers(0, 10))
    steps = draw(st.lists(st.floats(0.01, 0.5), min_size=plays, max_size=plays))
    parts = draw(st.lists(st.floats(0.0, 1.0), min_size=plays, max_size=plays))
    total = draw(st.floats(0.0, 0.9))
    return Dynamics(
        rise_s=draw(st.floats(1e-3, 10.0)),
        fall_s=draw(st.floats(1e-3, 1.0)),
        widths=tuple(np.cumsum(steps).tolist()),
        weights=tuple(total * part / max(sum(parts), 1e-9) for part in parts),
    )


def run(dynamics: Dynamics, path_pa: np.ndarray) -> np.ndarray:
    """Apparent pressures along a path of pressures of sensors, both (steps, n), Pa."""
    plays, apparent_pa = (np.zeros(path_pa.shape[1]),) * len(dynamics.widths), []
    for pressure_pa in path_pa:
        plays, felt_pa = followed(plays, pressure_pa, dynamics, np)
        apparent_pa.append(felt_pa)
    return np.array(apparent_pa)


@given(any_dynamics(), paths_pa)
def test_rising_loads_read_what_the_curve_says_and_falling_ones_no_less(
    dynamics: Dynamics, path_pa: np.ndarray
) -> None:
    apparent_pa = run(dynamics, path_pa)
    assert np.all(apparent_pa >= path_pa * (1 - 1e-9) - 1e-6)
    highest = path_pa >= np.maximum.accumulate(path_pa, axis=0)
    np.testing.assert_allclose(apparent_pa[highest], path_pa[highest], rtol=1e-9, atol=1e-6)


@given(any_dynamics(), paths_pa)
def test_hysteresis_depends_on_turns_but_not_on_time(
    dynamics: Dynamics, path_pa: np.ndarray
) -> None:
    """Frames that repeat a pressure, or split a move in two, change nothing."""
    middles_pa = path_pa.copy()
    middles_pa[1:] = (path_pa[1:] + path_pa[:-1]) / 2
    finer = np.stack((middles_pa, path_pa, path_pa), axis=1).reshape(-1, 3)
    whole, split = run(dynamics, path_pa), run(dynamics, finer)
    np.testing.assert_allclose(split[1::3], whole, rtol=1e-9, atol=1e-6)
    assert np.array_equal(split[2::3], split[1::3])


def test_loops_open_with_the_load() -> None:
    """The gap after a full turn is (P + scale)·(e^Σw·width − 1), proportional to the load."""
    loads_pa = np.array([20e3, 40e3, 60e3])
    _, back_pa, released_pa = run(PAPER_DYNAMICS, np.array([3 * loads_pa, loads_pa, 0 * loads_pa]))
    opened = math.exp(np.dot(PAPER_DYNAMICS.widths, PAPER_DYNAMICS.weights)) - 1
    np.testing.assert_allclose(back_pa - loads_pa, (loads_pa + SCALE_PA) * opened, rtol=1e-9)
    # The remainder at zero is at most about two counts of a 10-bit ADC, 98 Pa each.
    assert np.all(released_pa < 200)


@given(
    st.floats(1e-3, 1.0),
    st.floats(1e-3, 1.0),
    paths_pa,
    arrays(np.float64, 40, elements=st.floats(0.0, 2.0)),
)
def test_the_lag_is_the_same_in_steps_of_any_size(
    rise_s: float, fall_s: float, path_pa: np.ndarray, passed_s: np.ndarray
) -> None:
    dynamics = Dynamics(rise_s, fall_s)
    whole_pa = split_pa = path_pa[0]
    for pressure_pa, step_s in zip(path_pa, passed_s, strict=True):
        whole_pa = delayed(whole_pa, pressure_pa, step_s, dynamics, np)
        for share in (0.3, 0.7):
            split_pa = delayed(split_pa, pressure_pa, share * step_s, dynamics, np)
        np.testing.assert_allclose(split_pa, whole_pa, atol=1e-4)


def test_the_lag_is_an_exponential_of_either_kind() -> None:
    rise_s, fall_s = PAPER_DYNAMICS.rise_s, PAPER_DYNAMICS.fall_s
    left = math.exp(-1)
    assert delayed(0.0, 1e3, rise_s, PAPER_DYNAMICS, np) == pytest.approx(1e3 * (1 - left))
    assert delayed(1e3, 0.0, fall_s, PAPER_DYNAMICS, np) == pytest.approx(1e3 * left)
