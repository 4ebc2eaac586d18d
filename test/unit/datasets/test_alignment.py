# SPDX-License-Identifier: Apache-2.0

"""Streams on one clock: a row holds what was known at its tick, whatever order messages came in."""

import weakref
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import CaptureError, ParameterError
from tactile_cdma.datasets.alignment import (
    DROP,
    HOLD,
    LAST,
    MODES,
    STALE_S,
    WAIT_S,
    WINDOW,
    ZERO,
    Aligner,
    Row,
    Touch,
    TouchStream,
)
from tactile_cdma.datasets.episodes import FOREVER_NS, Episode, find_episodes, parse_interval
from tactile_cdma.datasets.samples import NANO, Kind, RawImage, Sample, SampleStream, SkinFrame

MS = 1_000_000
ALWAYS = [Episode(0, FOREVER_NS, "all")]


def skin_frame(*pressure_pa: float, masked: Sequence[int] = ()) -> SkinFrame:
    status = np.zeros(len(pressure_pa), dtype=np.uint8)
    status[list(masked)] = 32
    values = np.array(pressure_pa, dtype=np.float32)
    return SkinFrame(0, 0.0, 0.0, 0.0, 0.0, values, values, status)


def state(stamp_ms: float, seen_ms: float, value: float, key: str = "state") -> Sample:
    number = np.array([value], dtype=np.float32)
    return Sample(key, round(stamp_ms * MS), round(seen_ms * MS), number)


def stream(key: str) -> SampleStream:
    return SampleStream(key, Kind.STATE, key, (1,))


def rows_of(aligner: Aligner, samples: Sequence[Sample]) -> list[Row]:
    rows = [row for sample in samples for row in aligner.feed(sample)]
    return rows + list(aligner.finish())


def in_order(*streams: Sequence[Sample]) -> list[Sample]:
    return sorted((sample for one in streams for sample in one), key=lambda sample: sample.seen_ns)


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
    late_ms = zip(stamps_ms, delays_ms, strict=False)
    samples = [state(stamp, stamp + delay, stamp) for stamp, delay in late_ms]
    # Another stream passes each tick only when all of these have been recorded.
    beat = [state(t, t + 301, 0.0, "beat") for t in range(0, 3400, 100)]
    merged = in_order(samples, beat)
    streams = {key: stream(key) for key in ("state", "beat")}
    aligner = Aligner(streams, {}, [Episode(0, 3000 * MS, "")], fps)
    rows = rows_of(aligner, merged)
    assert not any(aligner.late.values())
    ticks = (merged[0].stamp_ns + round(i * NANO / fps) for i in count(1))
    expected_ticks = list(takewhile(lambda tick: tick <= 3000 * MS, ticks))
    assert [row.tick.time_ns for row in rows] == expected_ticks
    for row in rows:
        before = bisect_right(stamps_ms, row.tick.time_ns / MS)
        assert ("state" in row.values or "state" in row.stopped) == (before > 0)
        if "state" in row.values:
            assert number(row) == stamps_ms[before - 1]
        elif before:
            assert row.tick.time_ns / MS - stamps_ms[before - 1] > STALE_S * 1e3


def test_a_stream_that_stops_is_not_waited_for_and_what_comes_late_is_counted() -> None:
    aligner = Aligner({key: stream(key) for key in ("state", "beat")}, {}, ALWAYS, 10)
    list(aligner.feed(state(0, 0, 1.0)))
    waited = WAIT_S * 1e3
    held = [row for t in range(10, int(waited), 10) for row in aligner.feed(state(t, t, 0, "beat"))]
    assert held == []  # it may go on
    rows = list(aligner.feed(state(waited + 100, waited + 100, 0, "beat")))
    assert len(rows) == (waited + 100) // 100
    assert [number(row) for row in rows if "state" in row.values] == [1.0] * 5  # of STALE_S
    list(aligner.feed(state(500, waited + 110, 2.0)))
    assert aligner.late == {"state": 1, "beat": 0}


def test_what_comes_later_than_something_newer_does_not_replace_it() -> None:
    aligner = Aligner({"state": stream("state")}, {}, ALWAYS, 10)
    samples = [state(0, 0, 0.0), state(250, 250, 1.0), state(330, 330, 2.0), state(240, 340, 3.0)]
    rows = rows_of(aligner, [*samples, state(520, 520, 4.0)])
    assert [number(row) for row in rows] == [0.0, 0.0, 1.0, 2.0, 2.0]
    assert aligner.late == {"state": 1}


PERIOD_MS = 12.8
SKIN = SampleStream("skin", Kind.TACTILE, "skin", (2,))


def felt(ms: float) -> float:
    """The pressure of the tests' skin at a time, Pa."""
    return 500 + 0.1 * ms


def skin_samples(begin_ms: float, end_ms: float, period_ms: float = PERIOD_MS) -> list[Sample]:
    stamps = np.arange(begin_ms, end_ms, period_ms)
    return [
        Sample("skin", round(t * MS), round((t + 6) * MS), skin_frame(felt(t), 1.0)) for t in stamps
    ]


def skin_taken(mode: str, slots: int = 1, policy: str = DROP) -> dict[str, TouchStream]:
    return {"skin": TouchStream(2, slots if mode == WINDOW else 1, mode, policy)}


def touch_of(row: Row) -> Touch:
    touch = row.values["skin"]
    assert isinstance(touch, Touch)
    return touch


@pytest.mark.parametrize("fps", [1, 2, 30])
@pytest.mark.parametrize("mode", MODES)
def test_all_frames_of_an_interval_are_valid_however_long_it_is(mode: str, fps: int) -> None:
    samples, episode = skin_samples(0, 6000), Episode(5 * MS, FOREVER_NS, "")  # no frame at a tick
    slots = int(np.ceil(1000 / fps / PERIOD_MS))
    aligner = Aligner({"skin": SKIN}, skin_taken(mode, slots), [episode], fps)
    rows = rows_of(aligner, samples)[1:]  # the first one's window begins before the first frame
    assert len(rows) >= 4
    for row in rows:
        touch = touch_of(row)
        assert touch.complete and touch.valid.all() and not row.stopped


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("period_ms", "held_ms"), [(PERIOD_MS, STALE_S * 1e3), (1000, 3000)])
def test_a_patch_that_stopped_is_not_felt_any_more(
    mode: str, period_ms: float, held_ms: float
) -> None:
    """A slow one is believed for some of its own steps: its frames are good until the next one."""
    samples = [*skin_samples(0, 8000, period_ms), *skin_samples(16_000, 16_001)]
    aligner = Aligner({"skin": SKIN}, skin_taken(mode), ALWAYS, 10)
    ages = {True: [0.0], False: [np.inf]}
    for row in rows_of(aligner, samples):
        if row.tick.time_ns > period_ms * MS:  # before that its steps are not known
            last_ms = max(s.stamp_ns for s in samples if s.stamp_ns <= row.tick.time_ns) / MS
            is_valid = bool(touch_of(row).valid.all())
            assert is_valid == touch_of(row).valid.any() == ("skin" not in row.stopped)
            ages[is_valid].append(row.tick.time_ns / MS - last_ms)
    assert held_ms - 101 < max(ages[True]) <= held_ms < min(ages[False])


@pytest.mark.parametrize("pause_ms", [400, 2000])
def test_a_window_begins_anew_after_a_stop(pause_ms: int) -> None:
    """What was felt before it is not of the present; a short pause loses frames, and no more."""
    begin_ms = 2000 + pause_ms
    samples = [*skin_samples(0, 2000), *skin_samples(begin_ms, begin_ms + 1000)]
    aligner = Aligner({"skin": SKIN}, skin_taken(WINDOW, 8), ALWAYS, 10)
    rows = {row.tick.time_ns // MS: touch_of(row) for row in rows_of(aligner, samples)}
    first, second = rows[begin_ms], rows[begin_ms + 100]
    assert first.valid[:, 0].tolist() == [pause_ms == 400] * 7 + [True]
    assert (first.age_s[:7] > 0.4).all() == (pause_ms == 400)
    assert second.valid.all() and (second.age_s <= 0.1).all()


def test_an_episode_includes_what_is_measured_at_its_beginning() -> None:
    skin = skin_samples(0, 1000)
    episodes = [Episode(128 * MS, FOREVER_NS, "")]
    first, *_ = rows_of(Aligner({"skin": SKIN}, skin_taken(WINDOW, 8), episodes, 10), skin)
    assert first.tick.time_ns == 228 * MS
    ages_ms = [228 - sample.stamp_ns / MS for sample in skin if sample.stamp_ns >= 128 * MS]
    assert touch_of(first).age_s == pytest.approx(np.array(ages_ms[:8]) / 1e3)


@pytest.mark.parametrize("mode", MODES)
def test_after_a_pause_of_the_clock_a_row_is_of_the_present(mode: str) -> None:
    """After a lost image, and after three seconds without any."""
    skin = skin_samples(0, 7000)
    stamps = [t for t in range(0, 7000, 100) if t != 1500 and not 3000 < t < 6000]
    camera = [state(t, t + 2, 0.0, "camera") for t in stamps]
    streams = {"skin": SKIN, "camera": stream("camera")}
    aligner = Aligner(streams, skin_taken(mode, 8), ALWAYS, 10, "camera")
    rows = {row.tick.time_ns // MS: row for row in rows_of(aligner, in_order(skin, camera))}
    assert list(rows) == stamps
    for tick_ms in (1600, 6000):
        touch = touch_of(rows[tick_ms])
        assert touch.complete and (touch.age_s >= 0).all() and (touch.age_s < STALE_S).all()


def test_a_clock_that_comes_too_late_makes_no_row_of_what_is_newer() -> None:
    clock = [state(t, t + 10, t, "clock") for t in range(0, 1000, 100)]
    late = [state(t, t + 5000, t, "clock") for t in (1000, 1100)]
    again = [state(t, t + 10, t, "clock") for t in range(7000, 7400, 100)]
    beat = [state(t, t, t) for t in range(0, 8000, 10)]
    streams = {"clock": stream("clock"), "state": stream("state")}
    aligner = Aligner(streams, {}, ALWAYS, 10, "clock")
    rows = rows_of(aligner, in_order(clock, late, again, beat))
    ticks_ms = [row.tick.time_ns // MS for row in rows]
    assert ticks_ms == [*range(0, 1000, 100), *range(7000, 7400, 100)]
    assert all(number(row) == row.tick.time_ns / MS for row in rows)
    assert aligner.late == {"clock": 2, "state": 0}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("clock", [None, "clock"])
def test_memory_does_not_grow_with_the_bag(clock: str | None, mode: str) -> None:
    """Nor before, between and after episodes, nor where the clock pauses."""
    episodes = [Episode(a * NANO, b * NANO, "") for a, b in ((30, 33), (60, 120))]
    camera = SampleStream("camera", Kind.IMAGE, "camera", (6, 8, 3))
    streams = {"skin": SKIN, "camera": camera, "clock": stream("clock")}
    aligner = Aligner(streams, skin_taken(mode, 8), episodes, 10, clock)
    held: deque[weakref.ref[Any]] = deque()
    most = rows = 0
    for ms in range(0, 150_000, 100):
        message = _Message()
        frame = skin_frame(float(ms), 1.0)
        held += (weakref.ref(message), weakref.ref(frame.pressure_pa))
        now = [
            Sample("camera", ms * MS, ms * MS, RawImage(message)),
            Sample("skin", ms * MS, ms * MS, frame),
        ]
        if not 80_000 < ms < 110_000:
            now.append(state(ms, ms, 0.0, "clock"))
        del message, frame
        rows += sum(1 for sample in now for _ in aligner.feed(sample))
        del now[:]
        most = max(most, sum(one() is not None for one in held))
        if ms % 10_000 == 0:
            held = deque(one for one in held if one() is not None)
    assert rows == (630 if clock is None else 333)
    assert most <= 2 * 10 * (WAIT_S + 1)  # while a clock that paused may still go on


def touch_at(taken: TouchStream, ms: float, has_stopped: bool = False) -> Touch:
    touch = taken.at(round(ms * MS), has_stopped)
    assert not np.isnan(touch.pressure_pa).any()
    return touch


@pytest.mark.parametrize("policy", [HOLD, ZERO])
def test_a_window_holds_all_samples_of_an_interval_the_newest_last(policy: str) -> None:
    taken = TouchStream(taxels=2, slots=3, mode=WINDOW, policy=policy)
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
def test_a_frame_that_may_be_of_another_time_has_no_valid_reading(mode: str) -> None:
    taken = TouchStream(taxels=1, slots=1, mode=mode, policy=HOLD)
    for ms, uncertainty_s in ((0, 0.04), (10, 0.06), (20, np.inf)):
        frame = replace(skin_frame(3.0 + ms), stamp_uncertainty_s=uncertainty_s)
        taken.take(ms * MS, frame)
        found = touch_at(taken, ms + 1)
        assert found.valid.all() == (ms == 0)
        assert found.pressure_pa.ravel().tolist() == [3.0]


def test_masked_taxels_do_not_count() -> None:
    taken = TouchStream(taxels=3, slots=1, mode=LAST, policy=DROP)
    taken.take(0, skin_frame(1, np.nan, 3, masked=[1]))
    assert touch_at(taken, 1).complete
    taken.take(2, skin_frame(1, np.nan, np.nan, masked=[1]))
    assert not touch_at(taken, 3).complete


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
    two = found(_Marked(), intervals=[(20.0, 30.0), (1.5, 3.0)])
    assert two == [(101.5, 103.0, "press"), (120.0, 130.0, "press")]
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
