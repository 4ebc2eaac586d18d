# SPDX-License-Identifier: Apache-2.0

"""Streams on one clock: a row holds what was known at its tick, whatever order messages came in."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tactile_cdma.base.errors import CaptureError, ParameterError
from tactile_cdma.datasets.alignment import WAIT_S, Aligner, Row
from tactile_cdma.datasets.episodes import FOREVER_NS, Episode, find_episodes, parse_interval
from tactile_cdma.datasets.samples import IMAGE, NANO, STATE, Sample, SkinFrame, Stream
from tactile_cdma.datasets.touch import (
    DROP,
    HOLD,
    LAST,
    MEAN,
    MODES,
    STALE_S,
    WINDOW,
    ZERO,
    Touch,
    TouchStream,
)

MS = 1_000_000
ALWAYS = [Episode(0, FOREVER_NS, "all")]


def skin_frame(*pressure_pa: float, masked: Sequence[int] = ()) -> SkinFrame:
    status = np.zeros(len(pressure_pa), dtype=np.uint8)
    status[list(masked)] = 32
    values = np.array(pressure_pa, dtype=np.float32)
    return SkinFrame(0, 0.0, 0.0, 0.0, values, values, status)


def state(stamp_ms: float, seen_ms: float, value: float, key: str = "state") -> Sample:
    number = np.array([value], dtype=np.float32)
    return Sample(key, round(stamp_ms * MS), round(seen_ms * MS), number)


def stream(key: str) -> Stream:
    return Stream(key, STATE, key, (1,))


def rows_of(aligner: Aligner, samples: Sequence[Sample]) -> list[Row]:
    rows = [row for sample in samples for row in aligner.feed(sample)]
    return rows + list(aligner.finish())


def number(row: Row, key: str = "state") -> float:
    value = row.values[key]
    assert isinstance(value, np.ndarray)
    return float(value[0])


@given(
    st.lists(st.integers(0, 3000), min_size=2, max_size=60, unique=True),
    st.lists(st.integers(0, 300), min_size=60, max_size=60),
    st.sampled_from([7, 30, 100]),
)
def test_a_row_holds_the_newest_value_up_to_its_tick(
    stamps_ms: list[int], delays_ms: list[int], fps: int
) -> None:
    """Messages that are recorded late, and out of order, change nothing."""
    stamps_ms = sorted(stamps_ms)
    samples = [
        state(stamp, stamp + delay, stamp)
        for stamp, delay in zip(stamps_ms, delays_ms, strict=False)
    ]
    samples.sort(key=lambda sample: sample.seen_ns)
    # Another stream passes each tick only when all of these have been recorded.
    beat = [state(t, t + 301, 0.0, "beat") for t in range(0, 3400, 100)]
    merged = sorted(samples + beat, key=lambda sample: sample.seen_ns)
    streams = {key: stream(key) for key in ("state", "beat")}
    aligner = Aligner(streams, {}, [Episode(0, 3000 * MS, "")], fps)
    rows = rows_of(aligner, merged)
    assert not any(aligner.late.values())
    begin_ns = merged[0].stamp_ns
    expected_ticks = []
    while (tick := begin_ns + round((len(expected_ticks) + 1) * NANO / fps)) <= 3000 * MS:
        expected_ticks.append(tick)
    assert [row.tick.time_ns for row in rows] == expected_ticks
    for row in rows:
        before = bisect_right(stamps_ms, row.tick.time_ns / MS)
        assert ("state" in row.values) == (before > 0)
        if before:
            assert number(row) == stamps_ms[before - 1]


def test_ticks_are_a_topic_s_stamps_where_it_is_the_clock() -> None:
    samples = [state(t, t + 1, t) for t in range(0, 200, 10)]
    frames = [state(t, t + 40, i, "camera") for i, t in enumerate((33, 66, 101, 133))]
    streams = {"state": stream("state"), "camera": Stream("camera", IMAGE, "camera", (6, 8, 3))}
    episodes = [Episode(0, 70 * MS, ""), Episode(100 * MS, FOREVER_NS, "")]
    merged = sorted(samples + frames, key=lambda sample: sample.seen_ns)
    rows = rows_of(Aligner(streams, {}, episodes, 30, clock="camera"), merged)
    assert [(row.tick.time_ns // MS, row.tick.episode) for row in rows] == [
        *((33, 0), (66, 0), (101, 1), (133, 1)),
    ]
    assert [number(row) for row in rows] == [30, 60, 100, 130]


def test_a_stream_that_stops_is_not_waited_for_and_what_comes_late_is_counted() -> None:
    aligner = Aligner({key: stream(key) for key in ("state", "beat")}, {}, ALWAYS, 10)
    list(aligner.feed(state(0, 0, 1.0)))
    waited = WAIT_S * 1e3
    held = [row for t in range(10, int(waited), 10) for row in aligner.feed(state(t, t, 0, "beat"))]
    assert held == []  # it may go on
    rows = list(aligner.feed(state(waited + 100, waited + 100, 0, "beat")))
    assert len(rows) == (waited + 100) // 100
    assert all(number(row) == 1.0 for row in rows)
    list(aligner.feed(state(500, waited + 110, 2.0)))
    assert aligner.late == {"state": 1, "beat": 0}


def test_what_comes_later_than_something_newer_does_not_replace_it() -> None:
    aligner = Aligner({"state": stream("state")}, {}, ALWAYS, 10)
    samples = [state(0, 0, 0.0), state(250, 250, 1.0), state(330, 330, 2.0), state(240, 340, 3.0)]
    rows = rows_of(aligner, [*samples, state(520, 520, 4.0)])
    assert [number(row) for row in rows] == [0.0, 0.0, 1.0, 2.0, 2.0]
    assert aligner.late == {"state": 1}


def test_memory_does_not_grow_with_the_bag() -> None:
    aligner = Aligner({key: stream(key) for key in ("state", "beat")}, {}, ALWAYS, 30)
    most = 0
    for i in range(20_000):
        for key in ("state", "beat"):
            list(aligner.feed(state(i * 10, i * 10 + 5, 0.0, key)))
        most = max(most, *(len(waiting) for waiting in aligner._waiting.values()))
    assert most < 10


def touch_at(taken: TouchStream, ms: float) -> Touch:
    touch = taken.at(round(ms * MS))
    assert touch is not None
    assert not np.isnan(touch.pressure_pa).any()
    return touch


@pytest.mark.parametrize("policy", [HOLD, ZERO])
def test_a_window_holds_all_samples_of_an_interval_the_newest_last(policy: str) -> None:
    taken = TouchStream(taxels=2, slots=3, mode=WINDOW, policy=policy)
    assert taken.at(0) is None
    taken.take(0, skin_frame(1, np.nan))
    first = touch_at(taken, 5)
    assert first.pressure_pa.tolist() == [[1, 0]] * 3 if policy == HOLD else [[0, 0]] * 2 + [[1, 0]]
    assert first.valid.tolist() == [[False, False]] * 2 + [[True, False]]
    for ms, values in ((10, (2, 5)), (20, (3, np.nan)), (30, (4, 7))):
        taken.take(ms * MS, skin_frame(*values))
    window = touch_at(taken, 33)
    filler = 5 if policy == HOLD else 0
    assert window.pressure_pa.tolist() == [[2, 5], [3, filler], [4, 7]]
    assert window.valid.tolist() == [[True, True], [True, False], [True, True]]
    assert window.age_s == pytest.approx([0.023, 0.013, 0.003])
    assert not window.complete


@pytest.mark.parametrize("mode", MODES)
def test_old_samples_are_no_valid_readings(mode: str) -> None:
    taken = TouchStream(taxels=1, slots=1, mode=mode, policy=DROP)
    taken.take(0, skin_frame(3.0))
    assert touch_at(taken, STALE_S * 1e3 - 1).complete
    stale = touch_at(taken, STALE_S * 1e3 + 1)
    assert not stale.complete and not stale.valid.any()
    assert stale.pressure_pa.ravel().tolist() == [3.0]


def test_masked_taxels_do_not_count() -> None:
    taken = TouchStream(taxels=3, slots=1, mode=LAST, policy=DROP)
    taken.take(0, skin_frame(1, np.nan, 3, masked=[1]))
    assert touch_at(taken, 1).complete
    taken.take(2, skin_frame(1, np.nan, np.nan, masked=[1]))
    assert not touch_at(taken, 3).complete


@given(st.lists(st.lists(st.floats(0, 1e5) | st.just(np.nan), min_size=2, max_size=2), min_size=1))
def test_a_mean_is_that_of_the_valid_samples(values: list[list[float]]) -> None:
    taken = TouchStream(taxels=2, slots=1, mode=MEAN, policy=ZERO)
    for i, pressures in enumerate(values):
        taken.take(i, skin_frame(*pressures))
    found = touch_at(taken, 1)
    table: NDArray[np.float32] = np.array(values, dtype=np.float32)
    for taxel in range(2):
        known = table[:, taxel][np.isfinite(table[:, taxel])].astype(float)
        assert found.valid[taxel] == (len(known) > 0)
        assert found.pressure_pa[taxel] == pytest.approx(
            known.mean() if len(known) else 0, rel=1e-5
        )


class _Marked:
    """A source of which only its marks matter."""

    path, begin_ns, end_ns = Path("bag"), 100 * NANO, 200 * NANO

    def __init__(self, *marks: tuple[int, object]) -> None:
        self._marks = [(s * NANO, message) for s, message in marks]

    def marks(self, topic: str) -> list[tuple[int, object]]:
        return self._marks


class _Message:
    def __init__(self, data: object = None) -> None:
        kinds = {bool: "Bool", str: "String", float: "Float64"}
        self.__msgtype__ = f"std_msgs/msg/{kinds.get(type(data), 'Empty')}"
        self.data = data


def test_episodes_are_intervals_or_between_marks() -> None:
    def found(source: _Marked, **choices: object) -> list[tuple[float, float, str]]:
        episodes = find_episodes(source, "press", **choices)  # type: ignore[arg-type]
        return [(e.begin_ns / NANO, round(e.end_ns / NANO, 3), e.task) for e in episodes]

    whole = find_episodes(_Marked(), "press")  # type: ignore[arg-type]
    assert [(e.begin_ns, e.end_ns) for e in whole] == [(0, FOREVER_NS)]
    assert found(_Marked(), intervals=[(20.0, 30.0), (1.5, 3.0)]) == [
        *((101.5, 103.0, "press"), (120.0, 130.0, "press")),
    ]
    flags = _Marked(*((110, _Message(True)), (120, _Message(False)), (130, _Message(True))))
    assert found(flags, marks="/record") == [(110, 120, "press"), (130, 200, "press")]
    assert found(flags, marks="/record", end_s=15.0) == [(110, 115, "press")]
    texts = _Marked((110, _Message("grip")), (120, _Message("lift")), (130, _Message("")))
    assert found(texts, marks="/task") == [(110, 120, "grip"), (120, 130, "lift")]
    assert found(_Marked((150, _Message())), marks="/next") == [(150, 200, "press")]
    one, other = find_episodes(texts, "press", marks="/task")  # type: ignore[arg-type]
    assert one.end_ns == other.begin_ns - 1  # a tick at the mark is in one of them
    for source, choices in (
        (_Marked(), {"intervals": [(1.0, 5.0), (4.0, 6.0)]}),
        (_Marked(), {"marks": "/record"}),
        (_Marked((110, _Message(1.5))), {"marks": "/level"}),
    ):
        with pytest.raises(CaptureError):
            found(source, **choices)


@pytest.mark.parametrize("text", ["5", "a:b", "3:3", "-1:2", "1:inf", ""])
def test_an_interval_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ParameterError, match="START:END"):
        parse_interval(text)
