# SPDX-License-Identifier: Apache-2.0

"""A driver's measurements of itself, the findings drawn from them, when it discards what waits."""

import math
import time
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver import checkup
from tactile_cdma.driver.checkup import (
    CLEAR_REPORTS,
    RAISE_REPORTS,
    Finding,
    Level,
    Settling,
    worst,
)
from tactile_cdma.driver.clock import SLOW_S, StreamCounters
from tactile_cdma.driver.driver import CATCH_UP_S, LATE_PERIODS, LATE_S, Backlog, Driver
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.vitals import Counts, Vitals, Window
from tactile_cdma.wire.messages import Status
from tactile_cdma.wire.packets import Counters, PacketWriter
from tactile_cdma.words.health import NodeState
from test.support.waiting import wait_for

CONFIG = SkinConfig.of({})


class Slow:
    """Takes frames, each for a while."""

    def __init__(self, seconds: float) -> None:
        self.frames: list[TactileFrame] = []
        self._seconds = seconds

    def take(self, frame: TactileFrame) -> None:
        self.frames.append(frame)
        time.sleep(self._seconds)


def driven(slow: Slow, url: str, frames: int) -> Window:
    """What was measured while this many frames arrived."""
    with Driver(CONFIG, url, 2_000_000, slow.take, lambda problem: None) as driver:
        wait_for(lambda: len(slow.frames) >= frames)
    return driver.vitals.take(driver.pipeline)


def test_frames_are_counted_and_their_way_is_timed() -> None:
    slow = Slow(0.004)
    window = driven(slow, "sim://?scene=all&threshold=0&rail=1.0", 60)
    assert window.frames == window.totals.stream.frames == len(slow.frames)
    assert window.publish_s >= 0.004
    assert window.line_s >= CONFIG.spec.frame_s / 2 - 1e-3
    assert window.slowest_s >= window.latency_s > 0
    assert window.latency_s == window.line_s + window.decode_s + window.publish_s
    clipped = sum(frame.clipped for frame in slow.frames) / len(slow.frames)
    assert window.clipped == pytest.approx(clipped)
    power = sum(frame.words.noise_rms_v**2 for frame in slow.frames) / len(slow.frames)
    assert window.noise_rms_v == pytest.approx(math.sqrt(power))


def test_a_driver_that_is_never_idle_takes_cpu_time() -> None:
    window = driven(Slow(0), "sim://?scene=all&threshold=0&speed=0", 500)
    assert 0.05 < window.thread_share <= 1.05  # other programs may take most of the core
    assert window.process_share >= 0.9 * window.thread_share


def test_cpu_shares_are_cpu_time_by_time_that_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    passed_s = {"monotonic": 100.0, "process_time": 7.0, "thread_time": 3.0}
    for name in passed_s:
        monkeypatch.setattr(time, name, lambda name=name: passed_s[name])
    vitals, pipeline = Vitals(), Pipeline(CONFIG)
    vitals.note_read(0)
    vitals.take(pipeline)
    passed_s |= {"monotonic": 102.0, "process_time": 7.5, "thread_time": 3.1}
    vitals.note_read(0)
    window = vitals.take(pipeline)
    assert window.seconds == pytest.approx(2.0)
    assert window.process_share == pytest.approx(0.25)
    assert window.thread_share == pytest.approx(0.05)


def test_rises_are_since_the_last_report_and_nothing_is_made_up() -> None:
    pipeline, vitals = Pipeline(CONFIG), Vitals()
    pipeline.counters.lost_frames = 5
    first = vitals.take(pipeline)
    assert set(first.rises.named().values()) == {0} and first.totals.stream.lost_frames == 5
    pipeline.counters.lost_frames = 12
    second = vitals.take(pipeline)
    assert second.rises.stream.lost_frames == 7
    assert first.totals.stream.lost_frames == 5, "a snapshot, whatever comes later"
    pipeline.counters.lost_frames = 2  # began anew
    assert vitals.take(pipeline).rises.stream.lost_frames == 2
    assert second.frames == 0 and math.isnan(second.latency_s) and math.isnan(second.noise_rms_v)
    assert second.thread_share == 0


def test_the_digitizers_counts_rise_once_two_statuses_came() -> None:
    pipeline, vitals, writer = Pipeline(CONFIG), Vitals(), PacketWriter()
    windows = [vitals.take(pipeline)]
    for lost in (4, 9):
        pipeline.feed(writer.encode(Status(uptime_us=lost, samples_lost=lost)), 0.0)
        windows.append(vitals.take(pipeline))
    assert windows[0].totals.digitizer is None
    assert "digitizer samples lost" not in windows[0].totals.named()
    assert windows[1].rises.digitizer is None
    assert windows[2].totals.named()["digitizer samples lost"] == 9
    assert windows[2].rises.digitizer == Status(uptime_us=5, samples_lost=5)


def window_with(**values: object) -> Window:
    return replace(Vitals().take(Pipeline(CONFIG)), seconds=1.0, **values)  # type: ignore[arg-type]


def levels(findings: list[Finding]) -> dict[str, Level]:
    return {finding.key: finding.level for finding in findings}


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        (78, {}),
        (72, {}),
        (69, {"slow": Level.WARN}),
        (38, {"very slow": Level.ERROR}),
        (87, {"fast": Level.WARN}),
    ],
)
def test_the_rate_has_limits(frames: int, expected: dict[str, Level]) -> None:
    window = window_with(frames=frames)
    assert levels(list(checkup.stream(Pipeline(CONFIG), window, None))) == expected


NO_RISE = Counts(StreamCounters(), Counters(), None, 0)


@pytest.mark.parametrize(
    ("risen", "text"),
    [
        (StreamCounters(skipped_bytes=1), "does not keep up"),
        (StreamCounters(restarts=1), "the digitizer restarted"),
        (StreamCounters(clock_steps=1), "clock stood still, stepped"),
        (StreamCounters(implausible_packets=1), "impossible contents"),
        (Counters(lost_packets=1), "packets are missing"),
        (Counters(jumps=1), "restarts packet numbering"),
        (Counters(repeated_packets=1), "packets come twice"),
        (Counters(resyncs=1), "bytes arrive that are no packets"),
        (Counters(malformed=1), "do not fit the protocol"),
        (Status(0, sync_faults=1), "sync edges came late"),
        (Status(0, samples_lost=1), "the digitizer loses samples"),
        (Status(0, packets_dropped=1), "too slow for the digitizer's packets"),
        (Status(0, command_errors=1), "commands reach the digitizer broken"),
    ],
    ids=str,
)
def test_every_loss_is_told_while_it_rises(
    risen: StreamCounters | Counters | Status, text: str
) -> None:
    part = {StreamCounters: "stream", Counters: "packets", Status: "digitizer"}[type(risen)]
    rises = replace(NO_RISE, **{part: risen})  # type: ignore[arg-type]
    [finding] = checkup.link(Pipeline(CONFIG), window_with(rises=rises))
    assert text in finding.text and (finding.level, finding.event) == (Level.WARN, True)


def test_counts_that_may_rise_are_no_losses() -> None:
    rises = Counts(
        StreamCounters(frames=78, samples=10**5, lost_samples=1, unannounced_samples=1),
        Counters(bytes=10**5, packets=500, unknown=1, text_bytes=1),
        Status(10**6, commands_refused=1, streaming=True),
        0,
    )
    for quiet in (rises, NO_RISE):
        assert list(checkup.link(Pipeline(CONFIG), window_with(rises=quiet))) == []


@pytest.mark.parametrize(("errors", "level"), [(1, Level.WARN), (12, Level.ERROR)])
def test_broken_packets_are_told_by_their_share(errors: int, level: Level) -> None:
    rises = replace(NO_RISE, packets=Counters(packets=98, crc_errors=errors, framing_errors=1))
    [finding] = checkup.link(Pipeline(CONFIG), window_with(rises=rises))
    share = (errors + 1) / (errors + 99)
    assert (finding.level, finding.event) == (level, True)
    assert f"{share:.1%} of the packets arrive broken" in finding.text


def test_a_thread_without_reserve_is_told() -> None:
    assert list(checkup.host(window_with(thread_share=0.79), 1)) == []
    [finding] = checkup.host(window_with(thread_share=0.85), 1)
    assert finding.level == Level.WARN and "85% of a core" in finding.text
    [finding] = checkup.host(window_with(thread_share=0.3, process_share=0.95), 1)
    assert "its process takes 95% of a core" in finding.text and "fewer patches" in finding.text
    assert list(checkup.host(window_with(thread_share=0.3, process_share=0.85), 1)) == []


@pytest.mark.parametrize(
    ("stated_mv", "options", "key", "said"),
    [
        (97.5, "", "amplitude", "which is 97.5: set it"),  # not twenty pairs of nodes on one row
        (300.0, "&amplitude_mv=97.5", "weak", "instead of 300. Are these the parameters"),
    ],
)
def test_an_amplitude_that_is_far_off_is_told_as_such(
    stated_mv: float, options: str, key: str, said: str
) -> None:
    config, frames = SkinConfig.of({"amplitude_mv": stated_mv}), []
    url = f"sim://?scene=all&threshold=0&speed=0{options}"
    with Driver(config, url, 2_000_000, frames.append, lambda problem: None) as driver:
        wait_for(lambda: len(frames) >= 100)
        with driver.between_frames() as pipeline:
            found = [*checkup.nodes(pipeline, [], driver.vitals.take(pipeline))]
    assert [finding.key for finding in found] == [key]
    assert said in found[0].text


@pytest.mark.parametrize(("weak", "level"), [(0, None), (1, Level.WARN), (16, Level.ERROR)])
def test_only_where_nearly_all_nodes_are_weak_the_amplitude_is_suspected(
    weak: int, level: Level | None
) -> None:
    frames: list[TactileFrame] = []
    url = "sim://?scene=all&threshold=0&speed=0"
    with Driver(CONFIG, url, 2_000_000, frames.append, lambda problem: None) as driver:
        wait_for(lambda: len(frames) >= 100)
        with driver.between_frames() as pipeline:
            pipeline.health.state[:weak] = NodeState.WEAK
            found = [*checkup.nodes(pipeline, [], driver.vitals.take(pipeline))]
    assert [finding.level for finding in found] == ([] if level is None else [level])
    assert all(("amplitude_mv" in f.text) == (level == Level.ERROR) for f in found)


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
