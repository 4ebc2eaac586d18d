# SPDX-License-Identifier: Apache-2.0

"""Findings stay long enough to be read, and one odd second does not change a level."""

from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.driver.findings import (
    CLEAR_REPORTS,
    RAISE_REPORTS,
    Finding,
    Level,
    Settling,
    worst,
)

STATE = Finding("slow", key="slow")
EVENT = Finding("broken", Level.ERROR, event=True)


def test_a_state_stands_when_it_was_found_in_a_row() -> None:
    settling = Settling()
    for _ in range(RAISE_REPORTS - 1):
        assert settling.settle([STATE]) == []
    assert settling.settle([STATE]) == [STATE]
    for _ in range(CLEAR_REPORTS - 1):
        assert settling.settle([]) == [STATE]
    assert settling.settle([]) == []
    assert settling.settle([STATE]) == []  # and must prove itself again


def test_an_event_stands_at_once_and_for_some_reports() -> None:
    settling = Settling()
    standing = [settling.settle([EVENT])] + [settling.settle([]) for _ in range(CLEAR_REPORTS)]
    assert standing == [[EVENT]] * CLEAR_REPORTS + [[]]


def test_the_newest_text_is_told_and_the_worst_finding_first() -> None:
    settling = Settling()
    settling.settle([STATE])
    newer = Finding("slower", key="slow")
    assert settling.settle([newer, EVENT]) == [EVENT, newer]


@given(st.lists(st.booleans(), min_size=1, max_size=200))
def test_a_level_changes_no_faster_than_it_may(course: list[bool]) -> None:
    settling = Settling()
    levels = [worst(settling.settle([STATE] if there else []))[0] for there in course]
    ups = [i for i in range(1, len(levels)) if levels[i] > levels[i - 1]]
    downs = [i for i in range(1, len(levels)) if levels[i] < levels[i - 1]]
    for down in downs:
        assert not any(course[down - CLEAR_REPORTS + 1 : down + 1])
        since = [up for up in ups if up < down]
        assert down - max(since, default=0) >= CLEAR_REPORTS
    for up in ups:
        assert all(course[up - RAISE_REPORTS + 1 : up + 1])


def test_texts_of_the_worst_level_are_told_together() -> None:
    assert worst([]) == (Level.OK, "")
    other = Finding("other")
    assert worst([STATE, other]) == (Level.WARN, "slow; other")
    assert worst([STATE, EVENT, other]) == (Level.ERROR, "broken")
