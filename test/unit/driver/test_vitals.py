# SPDX-License-Identifier: Apache-2.0

"""What a driver measures of itself, and what is made of it."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import pytest

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver import checkup
from tactile_cdma.driver.driver import Driver
from tactile_cdma.driver.findings import Finding, Level
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.vitals import Vitals, Window

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
    """What was measured while so many frames came."""
    with Driver(CONFIG, url, 2_000_000, slow.take, lambda problem: None) as driver:
        deadline = time.monotonic() + 20
        while len(slow.frames) < frames:
            assert time.monotonic() < deadline, "no frames"
            time.sleep(0.01)
    return driver.vitals.take(driver.pipeline)


def test_frames_are_counted_and_their_way_is_timed() -> None:
    slow = Slow(0.004)
    window = driven(slow, "sim://?scene=all&threshold=0&rail=1.0", 60)
    assert window.frames == window.totals["frames"] == len(slow.frames)
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


def test_rises_are_since_the_last_report_and_nothing_is_made_up() -> None:
    pipeline, vitals = Pipeline(CONFIG), Vitals()
    pipeline.counters.lost_frames = 5
    first = vitals.take(pipeline)
    assert first.rises == {} and first.totals["lost_frames"] == 5
    pipeline.counters.lost_frames = 12
    second = vitals.take(pipeline)
    assert second.rises["lost_frames"] == 7
    assert second.per_s("lost_frames") == pytest.approx(7 / second.seconds)
    pipeline.counters.lost_frames = 2  # began anew
    assert vitals.take(pipeline).rises["lost_frames"] == 2
    assert second.per_s("nobody counts this") == 0
    assert second.frames == 0 and math.isnan(second.latency_s) and math.isnan(second.noise_rms_v)
    assert second.thread_share == 0


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


@pytest.mark.parametrize("name", sorted(checkup.LOSSES))
def test_every_loss_is_told_while_it_rises(name: str) -> None:
    pipeline = Pipeline(CONFIG)
    [finding] = checkup.link(pipeline, window_with(rises={name: 1, "packets": 100}))
    assert finding == Finding(name, Level.WARN, checkup.LOSSES[name], event=True)
    assert list(checkup.link(pipeline, window_with(rises={name: 0, "packets": 100}))) == []


def test_every_loss_is_one_of_the_counts() -> None:
    names = set(Vitals().take(Pipeline(CONFIG)).totals)
    assert {name for name in checkup.LOSSES if not name.startswith("digitizer_")} <= names


def test_a_thread_without_reserve_is_told() -> None:
    assert list(checkup.host(window_with(thread_share=0.79), 1)) == []
    [finding] = checkup.host(window_with(thread_share=0.85), 1)
    assert finding.level == Level.WARN and "85% of a core" in finding.text
