# SPDX-License-Identifier: Apache-2.0

"""Lag, hysteresis and their compensation: exact where possible, bounded elsewhere."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tactile_cdma.base.errors import SpecError
from tactile_cdma.readings.dynamics import LEAST_SHARE, Compensator, Dynamics, Hysteresis, Lag
from tactile_cdma.sim.sensor import PAPER_DYNAMICS

RANGE_PA = 140e3
EVERYWHERE = np.full(3, RANGE_PA)
ALL = np.ones(3, dtype=bool)

paths_pa = arrays(np.float64, (40, 3), elements=st.floats(0.0, RANGE_PA))


@st.composite
def any_dynamics(draw: st.DrawFn) -> Dynamics:
    plays = draw(st.integers(0, 10))
    steps = draw(st.lists(st.floats(0.01, 0.5), min_size=plays, max_size=plays))
    parts = draw(st.lists(st.floats(0.0, 1.0), min_size=plays, max_size=plays))
    total = draw(st.floats(0.0, 0.999 - LEAST_SHARE))
    return Dynamics(
        rise_s=draw(st.floats(1e-3, 10.0)),
        fall_s=draw(st.floats(1e-3, 1.0)),
        widths=tuple(np.cumsum(steps).tolist()),
        weights=tuple(total * part / max(sum(parts), 1e-9) for part in parts),
        scale_pa=draw(st.floats(100.0, 1e5)),
        most_gain=draw(st.floats(1.0, 20.0)),
    )


def run(operator: Hysteresis, path_pa: np.ndarray) -> np.ndarray:
    return np.array([operator.update(pressure_pa) for pressure_pa in path_pa])


@given(any_dynamics(), paths_pa)
def test_the_inverse_undoes_hysteresis_exactly(dynamics: Dynamics, path_pa: np.ndarray) -> None:
    apparent_pa = run(Hysteresis(dynamics, 3), path_pa)
    np.testing.assert_allclose(
        run(Hysteresis(dynamics, 3, inverse=True), apparent_pa), path_pa, rtol=1e-8, atol=1e-5
    )


@given(any_dynamics(), paths_pa)
def test_rising_loads_read_what_the_curve_says_and_falling_ones_no_less(
    dynamics: Dynamics, path_pa: np.ndarray
) -> None:
    apparent_pa = run(Hysteresis(dynamics, 3), path_pa)
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
    whole = run(Hysteresis(dynamics, 3), path_pa)
    split = run(Hysteresis(dynamics, 3), finer)
    np.testing.assert_allclose(split[1::3], whole, rtol=1e-9, atol=1e-6)
    assert np.array_equal(split[2::3], split[1::3])


def test_loops_open_with_the_load() -> None:
    """The gap after a full turn is (P + scale)·(e^Σw·width − 1), proportional to the load."""
    hysteresis = Hysteresis(PAPER_DYNAMICS, 3)
    loads_pa = np.array([20e3, 40e3, 60e3])
    hysteresis.update(3 * loads_pa)
    opened = math.exp(np.dot(PAPER_DYNAMICS.widths, PAPER_DYNAMICS.weights)) - 1
    gap_pa = hysteresis.update(loads_pa) - loads_pa
    np.testing.assert_allclose(gap_pa, (loads_pa + PAPER_DYNAMICS.scale_pa) * opened, rtol=1e-9)
    # The remainder at zero is at most about two counts of a 10-bit ADC, 98 Pa each.
    assert np.all(hysteresis.update(np.zeros(3)) < 200)


@given(
    st.floats(1e-3, 1.0),
    st.floats(1e-3, 1.0),
    paths_pa,
    arrays(np.float64, 40, elements=st.floats(0.0, 2.0)),
)
def test_the_lag_is_the_same_in_steps_of_any_size(
    rise_s: float, fall_s: float, path_pa: np.ndarray, passed_s: np.ndarray
) -> None:
    whole, split = (Lag(np.array([rise_s]), np.array([fall_s])) for _ in range(2))
    for pressure_pa, step_s in zip(path_pa, passed_s, strict=True):
        expected = whole.update(pressure_pa, step_s)
        split.update(pressure_pa, 0.3 * step_s)
        np.testing.assert_allclose(split.update(pressure_pa, 0.7 * step_s), expected, atol=1e-4)


def test_the_lag_is_an_exponential_of_either_kind() -> None:
    lag = Lag(PAPER_DYNAMICS.rise_s, PAPER_DYNAMICS.fall_s)
    assert np.all(lag.update(np.zeros(3), 0.0) == 0)
    assert lag.update(np.full(3, 1e3), PAPER_DYNAMICS.rise_s) == pytest.approx(
        1e3 * (1 - math.exp(-1))
    )
    lag.update(np.full(3, 1e3), 100.0)
    assert lag.update(np.zeros(3), PAPER_DYNAMICS.fall_s) == pytest.approx(1e3 * math.exp(-1))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rise_s": 0.0}, "rise_s is 0"),
        ({"fall_s": math.nan}, "fall_s is nan"),
        ({"scale_pa": -1.0}, "scale_pa is -1"),
        ({"most_gain": 0.5}, "most_gain is 0.5.*1…20"),
        ({"weights": (0.1,)}, "8 widths but 1 weights"),
        ({"widths": (0.2, 0.1), "weights": (0.1, 0.1)}, "widths must rise"),
        ({"widths": (0.2, math.nan), "weights": (0.1, 0.1)}, "widths must rise"),
        ({"widths": (0.1, 0.2), "weights": (0.1, -0.1)}, "negative"),
        ({"widths": (0.1, 0.2), "weights": (0.9, 0.1)}, "add up to 1;.*0.9"),
    ],
)
def test_impossible_dynamics_are_refused(change: dict, words: str) -> None:
    with pytest.raises(SpecError, match=words):
        replace(PAPER_DYNAMICS, **change)


def compensated(
    dynamics: Dynamics, measured_pa: np.ndarray, t_s: np.ndarray, nodes: int = 3
) -> np.ndarray:
    compensator = Compensator(dynamics, np.full(nodes, RANGE_PA))
    valid = np.ones(nodes, dtype=bool)
    return np.array(
        [
            compensator.update(pressure_pa.astype(np.float32), valid, time)
            for pressure_pa, time in zip(measured_pa, t_s, strict=True)
        ]
    )


def distorted(dynamics: Dynamics, path_pa: np.ndarray, step_s: float) -> np.ndarray:
    lag, hysteresis = Lag(dynamics.rise_s, dynamics.fall_s), Hysteresis(dynamics, path_pa.shape[1])
    return np.array([hysteresis.update(lag.update(row, step_s)) for row in path_pa])


@pytest.mark.parametrize("step_s", [0.0128, 0.02, 0.05])
def test_a_rising_pressure_comes_back_through_the_filter_alone(step_s: float) -> None:
    """Lag and lead together are a filter with rise_s/most_gain, to the precision of float32."""
    t_s = np.arange(0, 2, step_s)
    path_pa = 100e3 * (1 - np.exp(-t_s / 0.3))[:, None] + [5e3, 10e3, 20e3]
    path_pa[0] = 0
    found = compensated(PAPER_DYNAMICS, distorted(PAPER_DYNAMICS, path_pa, step_s), t_s)
    quick_s = PAPER_DYNAMICS.rise_s / PAPER_DYNAMICS.most_gain
    alone = Lag(np.array([quick_s]), np.array([quick_s]))
    expected = np.array([alone.update(row, step_s) for row in path_pa])
    rising = t_s < 0.8  # later the rest of the way is less than what sets the lead in
    np.testing.assert_allclose(found[rising], expected[rising], rtol=1e-3, atol=10)


def test_steps_are_known_sooner_each_time() -> None:
    t_s = np.arange(0, 2, 0.01)
    pressed = (np.abs(t_s - 0.55) < 0.449) | (t_s > 1.2)
    path_pa = pressed[:, None] * np.array([10e3, 40e3, 100e3])
    measured = distorted(PAPER_DYNAMICS, path_pa, 0.01)
    found = compensated(PAPER_DYNAMICS, measured, t_s)

    def arrival_s(course_pa: np.ndarray, begin_s: float) -> np.ndarray:
        there = (course_pa >= 0.9 * path_pa[-1]) & (t_s > begin_s)[:, None]
        return t_s[np.argmax(there, axis=0)] - begin_s

    for begin_s in (0.1, 1.2):
        assert np.all(arrival_s(found, begin_s) < arrival_s(measured, begin_s) / 2.5)
    assert np.all(found <= path_pa.max(axis=0) * 1.001), "without overshoot"
    np.testing.assert_allclose(found[-1], path_pa[-1], rtol=1e-3)


@settings(deadline=None)
@given(
    any_dynamics(),
    arrays(np.float32, (30, 3), elements=st.floats(width=32)),
    arrays(np.bool_, (30, 3)),
    st.lists(st.floats(-1e3, 1e6), min_size=30, max_size=30),
)
def test_whatever_comes_in_the_result_stays_in_the_range(
    dynamics: Dynamics, measured_pa: np.ndarray, valid: np.ndarray, t_s: list[float]
) -> None:
    """For any pressures, NaN and infinite ones included, lost readings, and any times."""
    compensator = Compensator(dynamics, EVERYWHERE)
    for row, known, time in zip(measured_pa, valid, t_s, strict=True):
        found = compensator.update(row, known, time)
        known = known & np.isfinite(row)
        assert np.array_equal(np.isfinite(found), known)
        assert np.all((found[known] >= 0) & (found[known] <= np.float32(RANGE_PA)))


@pytest.mark.slow
@pytest.mark.parametrize("step_s", [1e-4, 0.0128, 0.1])
@pytest.mark.parametrize("most_gain", [1.0, 4.0, 20.0])
def test_noise_grows_no_more_than_promised(most_gain: float, step_s: float) -> None:
    """Noise of a third of a count on rising pressures, with the lead on, and on resting ones."""
    dynamics = replace(PAPER_DYNAMICS, most_gain=most_gain)
    rng = np.random.default_rng(1)
    t_s = step_s * np.arange(min(2000, round(1.6 / step_s)))
    noise_pa = rng.normal(0, 30.0, (len(t_s), 256))
    for slope_pa_per_s, bound in ((60e3, dynamics.noise_gain), (0.0, 1 / dynamics.share)):
        true_pa = 20e3 + slope_pa_per_s * t_s[:, None] * np.ones(256)
        found = compensated(dynamics, true_pa + noise_pa, t_s, 256)
        found -= compensated(dynamics, true_pa, t_s, 256)
        late = found[len(t_s) // 4 :]
        grown = np.sqrt(np.mean(np.var(late, axis=0))) / 30.0
        assert grown <= 1.01 * bound
    assert grown > 0.8, "noise is not swallowed either"


def test_no_disturbance_grows_beyond_its_bound() -> None:
    """Not white noise but the worst of many courses between two values: peaks, small ones.

    Plays, and what the lead follows, move by no more than what moves them: what is taken from
    what adds up to (2·G − 1)·(2/share − 1), without the lead to the second factor.
    """
    rng = np.random.default_rng(5)
    t_s = 1e-3 * np.arange(800)
    flips = rng.random((800, 300)) < rng.uniform(0.003, 0.3, 300)
    disturbance_pa = 50.0 * np.cumprod(np.where(flips, -1, 1), axis=0)
    at_rest = 2 / PAPER_DYNAMICS.share - 1
    rising = (2 * PAPER_DYNAMICS.most_gain - 1) * at_rest
    for slope_pa_per_s, bound in ((60e3, rising), (0.0, at_rest)):
        true_pa = 20e3 + slope_pa_per_s * t_s[:, None] * np.ones(300)
        found = compensated(PAPER_DYNAMICS, true_pa + disturbance_pa, t_s, 300)
        found -= compensated(PAPER_DYNAMICS, true_pa, t_s, 300)
        peak = np.abs(found[200:]).max() / 50.0
        assert 0.6 * bound < peak < 1.01 * bound


@pytest.mark.slow
@pytest.mark.parametrize(
    ("period_s", "lost", "removed"),
    [(0.0128, 0.5, 0.65), (0.02, 0.1, 0.7), (0.3, 0.1, 0.1)],
)
def test_slow_and_lost_frames_leave_more_of_the_error(
    period_s: float, lost: float, removed: float
) -> None:
    """Pressures change between frames, which no compensation can see."""
    rng = np.random.default_rng(6)
    turns_s = np.append(0.0, np.cumsum(rng.uniform(0.3, 3.0, 60)))
    turns_pa = rng.uniform(0, 120e3, (61, 3)) * np.where(np.arange(61) % 2, 1.0, 0.2)[:, None]
    fine_s = np.arange(0, turns_s[-1], 1e-3)
    path_pa = np.stack([np.interp(fine_s, turns_s, turn) for turn in turns_pa.T], axis=1)
    frames = np.arange(0, len(fine_s), round(period_s * 1e4) / 10).astype(int)
    frames = frames[rng.random(len(frames)) >= lost]
    measured = distorted(PAPER_DYNAMICS, path_pa, 1e-3)[frames]
    found = compensated(PAPER_DYNAMICS, measured, fine_s[frames])
    before, after = (np.sqrt(np.mean((x - path_pa[frames]) ** 2)) for x in (measured, found))
    assert 1 - after / before > removed


def test_a_resting_reading_does_not_flicker_more_than_its_last_digit() -> None:
    """The ADC code alternates between two values, in both stages of the curve."""
    rng = np.random.default_rng(2)
    at_pa, digit_pa = np.array([5e3, 40e3, 100e3]), np.array([98.0, 98.0, 546.0])
    measured = at_pa + digit_pa * rng.integers(0, 2, (2000, 3))
    measured[:50] *= np.linspace(0, 1, 50)[:, None]  # the load comes, and stays
    found = compensated(PAPER_DYNAMICS, measured, 0.0128 * np.arange(2000))
    assert np.all(np.ptp(found[100:], axis=0) <= 1.01 * digit_pa / PAPER_DYNAMICS.share)


@pytest.mark.parametrize("drift", [0.7, 1.4])
def test_a_wrong_model_does_no_harm(drift: float) -> None:
    """With every value off by a third, the remaining error is still below the uncompensated one."""
    rng = np.random.default_rng(3)
    t_s = 0.0128 * np.arange(4000)
    swings = rng.uniform(0.3, 3.0, 3)
    path_pa = 60e3 * (1 - np.cos(t_s[:, None] * swings)) * (0.6 + 0.4 * np.sin(0.21 * t_s))[:, None]
    measured = distorted(PAPER_DYNAMICS, path_pa, 0.0128)
    wrong = replace(
        PAPER_DYNAMICS,
        rise_s=PAPER_DYNAMICS.rise_s * drift,
        weights=tuple(weight * drift for weight in PAPER_DYNAMICS.weights),
    )
    found = compensated(wrong, measured, t_s)
    assert np.all((found >= 0) & (found <= np.float32(RANGE_PA)))
    rms_before, rms_after = (np.sqrt(np.mean((x - path_pa) ** 2)) for x in (measured, found))
    assert rms_after < 0.7 * rms_before


def test_a_node_that_comes_back_starts_over() -> None:
    """Its load while unheard is unknown: no jump, no memory of before."""
    compensator = Compensator(PAPER_DYNAMICS, EVERYWHERE)
    for step in range(20):
        compensator.update(np.full(3, 5e3 * step, np.float32), ALL, 0.01 * step)
    lost = np.array([True, False, True])
    gone = compensator.update(np.full(3, 60e3, np.float32), lost, 0.2)
    assert np.isnan(gone[1]) and np.isfinite(gone[[0, 2]]).all()
    back = compensator.update(np.full(3, 60e3, np.float32), ALL, 0.21)
    assert back[1] == pytest.approx(60e3, rel=1e-5)
    assert back[0] < 59e3, "the others remember that they were pressed harder"
    again = compensator.update(np.full(3, 60e3, np.float32), ALL, -5.0)
    assert again == pytest.approx(60e3, rel=1e-5), "after a restart nobody does"


def test_frames_that_are_held_change_nothing() -> None:
    rng = np.random.default_rng(4)
    heights = np.repeat(rng.uniform(0, RANGE_PA, (30, 3)), 60, axis=0).astype(np.float32)
    every, some = Compensator(PAPER_DYNAMICS, EVERYWHERE), Compensator(PAPER_DYNAMICS, EVERYWHERE)
    skipped, held = 0, np.zeros(3, dtype=np.float32)
    for frame, row in enumerate(heights):
        expected = every.update(row, ALL, 0.0128 * frame)
        same = frame > 0 and np.array_equal(row, heights[frame - 1])
        if same and some.try_hold(0.0128 * frame):
            skipped += 1
        else:
            held = some.update(row, ALL, 0.0128 * frame)
        assert np.array_equal(held, expected)
    assert skipped > len(heights) / 3
    assert not some.try_hold(0.0), "time that goes back is news"
