# SPDX-License-Identifier: Apache-2.0

"""Stamps beside the true times of a clock model: none is off by more than it says."""

import numpy as np
import pytest

from test.support.clock_model import BEGIN_S, PERIOD_S, Clock, reads
from test.support.stamped import recorded, silent_pipeline, stamped

AT_S = 4.0
"""When it happens; all is known of the clock by then."""
FRAMES = 700
SOON_S = 1.5
"""After a step, until stamps are right again: a second, and the frames until the first knot."""
STEPS = [Clock(steps=((AT_S, 1e-3 * ms),)) for ms in (-45, -20, -5, -2, 2, 5, 20, 45)]
HALTS = [Clock(halts=((AT_S, s),)) for s in (0.02, 0.5, 5.0)]
SLOW = [Clock(error=error) for error in (-0.05, -0.009, -0.003, 0.003, 0.009)]
HELD_UP = [
    Clock(stalls=((AT_S, 1.0),)),
    Clock(stalls=((AT_S, 3.0),)),
    Clock(lags=((AT_S, 3.0, 0.8),)),
    Clock(delay_s=0.01),
    Clock(latency_s=0.0159),
    Clock(error=1e-4),
]


def found(clock: Clock) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Times since the event, errors and claims of all stamps, s; how many steps were counted."""
    pipeline, writer = silent_pipeline()
    rows = np.array(stamped(pipeline, writer, reads(clock, FRAMES, seed=1)))
    true_s, off_s, claimed_s = rows.T
    assert (np.abs(off_s) <= claimed_s).all()
    return true_s - BEGIN_S - AT_S, np.abs(off_s), claimed_s, pipeline.counters.clock_steps


def test_the_first_second_is_a_guess_and_says_so() -> None:
    since_s, off_s, claimed_s, steps = found(Clock())
    assert np.isinf(claimed_s[since_s < -AT_S + 0.5]).all()
    assert np.isfinite(claimed_s[since_s > -AT_S + 1.1]).all()
    assert np.median(claimed_s[since_s > 0]) < 2e-3
    assert off_s[since_s > -AT_S + 1.1].max() < 0.5e-3
    assert steps == 0


@pytest.mark.parametrize("clock", STEPS + HALTS, ids=str)
def test_a_step_is_told_and_over_in_a_second(clock: Clock) -> None:
    since_s, off_s, claimed_s, steps = found(clock)
    stood_s = sum(s for _, s in clock.halts)
    after = since_s > stood_s + SOON_S
    assert off_s[after].max() < 0.5e-3
    assert np.median(claimed_s[after]) < 6.1e-3
    assert steps == 1


@pytest.mark.parametrize("clock", SLOW, ids=str)
def test_a_clock_that_is_no_crystal_is_followed(clock: Clock) -> None:
    since_s, off_s, claimed_s, _ = found(clock)
    assert off_s[since_s > 0].max() < 2e-3
    assert np.median(claimed_s[since_s > 0]) < 6.1e-3


@pytest.mark.parametrize("clock", HELD_UP, ids=str)
def test_what_host_and_link_hold_up_is_no_step(clock: Clock) -> None:
    """Stamps stay where they are; meanwhile they may be off, for all that a driver can know."""
    _, off_s, claimed_s, steps = found(clock)
    assert off_s[100:].max() < 2e-3
    assert np.isfinite(claimed_s[100:]).all()
    assert steps == 0


@pytest.mark.parametrize("seed", [*range(4), 104, 111, 116, 118, 131, 139, 222])
def test_jitter_of_30_ms_is_in_what_stamps_say(seed: int) -> None:
    pipeline, writer = silent_pipeline()
    rows = np.array(stamped(pipeline, writer, reads(Clock(delay_s=30e-3), 892, seed)))
    _, off_s, claimed_s = rows.T
    assert (np.abs(off_s) <= claimed_s).all()
    assert np.isfinite(claimed_s[100:]).all() and np.median(claimed_s[100:]) < 0.1


SHORT_S = 1.5, 2.0, 3.0, 4.2, 5.0, 7.5
"""Lengths of recordings."""


@pytest.mark.parametrize("halt_s", [0.02, 0.25, 0.4, 0.7, 3.0])
@pytest.mark.parametrize("at_s", [0.3, 0.5, 1.0, 2.0, 3.0, 6.8])
def test_a_clock_that_stands_still_in_a_short_recording_is_in_what_stamps_say(
    halt_s: float, at_s: float
) -> None:
    """Wherever it does, and though nothing may be known of it."""
    for length_s in SHORT_S:
        clock = Clock(error=3e-5, halts=((at_s, halt_s),))
        rows = np.array(recorded(reads(clock, round(length_s / PERIOD_S), seed=1)))
        _, off_s, claimed_s = rows.T
        assert len(rows) > 0.95 * length_s / PERIOD_S
        assert (np.abs(off_s) <= claimed_s).all(), length_s


@pytest.mark.parametrize("seed", range(6))
def test_jitter_of_30_ms_is_in_what_stamps_of_recordings_say(seed: int) -> None:
    for length_s, stalls in ((1.5, ()), (4.0, ((1.0, 1.0),)), (11.4, ()), (40.0, ())):
        clock = Clock(error=3e-5, delay_s=30e-3, stalls=stalls)
        rows = np.array(recorded(reads(clock, round(length_s / PERIOD_S), seed)))
        assert (np.abs(rows[:, 1]) <= rows[:, 2]).all(), length_s
        assert stalls or np.median(rows[:, 2]) < 0.1


@pytest.mark.parametrize("clock", [Clock(), Clock(error=1e-4), Clock(error=-1e-4)], ids=str)
@pytest.mark.parametrize("length_s", [1.5, 5.0, 40.0])
def test_a_good_link_s_recordings_are_stamped_within_2_ms(clock: Clock, length_s: float) -> None:
    """So that the tests above are not passed by stamps that say nothing."""
    rows = np.array(recorded(reads(clock, round(length_s / PERIOD_S), seed=2)))
    assert np.abs(rows[:, 1]).max() <= rows[:, 2].min() + 1.5e-3
    assert np.median(rows[:, 2]) < 2.5e-3
