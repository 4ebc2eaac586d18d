# SPDX-License-Identifier: Apache-2.0

"""When a driver that is too slow discards buffered input."""

import pytest

from tactile_cdma.driver.clock import SLOW_S
from tactile_cdma.driver.driver import CATCH_UP_S, LATE_PERIODS, LATE_S, Backlog

PERIOD_S = 12.8e-3
LATE = LATE_S + LATE_PERIODS * PERIOD_S + 0.01
STEP_S = 0.05


def looks(waiting: list[int], ages_s: list[float]) -> list[bool]:
    """The verdicts at looks every STEP_S."""
    backlog = Backlog(PERIOD_S)
    pairs = enumerate(zip(waiting, ages_s, strict=True))
    return [backlog.observe(count, age_s, i * STEP_S) for i, (count, age_s) in pairs]


def test_who_stays_behind_skips_again_and_again() -> None:
    count = round(3 * CATCH_UP_S / STEP_S) + 3
    said = looks(count * [1], count * [LATE])
    assert sum(said) == 3
    assert said.index(True) == pytest.approx(CATCH_UP_S / STEP_S, abs=1)


@pytest.mark.parametrize(("waiting", "age_s"), [(4095, LATE_S), (0, 10.0)])
def test_bytes_that_wait_and_frames_that_are_late_are_each_harmless(
    waiting: int, age_s: float
) -> None:
    """A fast link always has more; a slow device is always late."""
    assert not any(looks(200 * [waiting], 200 * [age_s]))


def test_who_was_held_up_and_makes_up_for_it_skips_nothing() -> None:
    once = round(0.8 * CATCH_UP_S / STEP_S)
    assert not any(looks((once * [1] + [0]) * 5, (once * [5.0] + [5.0]) * 5))


def test_it_comes_before_old_frames_would_be_taken_for_new_ones() -> None:
    assert LATE_S < SLOW_S
