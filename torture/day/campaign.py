# SPDX-License-Identifier: Apache-2.0

"""A robot's day in minutes: every counter of the driver runs for 24 hours, and wraps.

    laps ──bytes, host time──▶ Pipeline ──frames──▶ DayJudge

A few seconds of a skin are repeated as if a digitizer ran all day. They arrive with the delays of
USB, by a host clock that drifts against the digitizer's. A part of the day is also recorded, and
replayed through the driver's thread from replay://.
"""

from __future__ import annotations

import gc
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.driver import Driver
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.driver.vitals import Counts
from tactile_cdma.recording.recording_file import Recorder
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.messages import Status

from ..outcome import Outcome, Plan
from ..process_watch import Slope, Watch, slope
from . import saves
from .host_clock import STALL_S, HostClock, UsbLine
from .judge import DayJudge, Lap
from .laps import LapWriter, Stretch, record

LAP_FRAMES = 195
SKIN = {"frame_period_ms": 102.4, "stale_after_s": 24.0}
"""Frames at an eighth of the paper's rate, and nodes that at rest speak once per lap, 20 s, so that
a day takes minutes."""
QUIET_SCENE, BUSY_SCENES = "idle", ("presses", "moving", "hand")
BUSY = 0.05
"""Share of laps in which something touches the skin."""
DAY_S, QUICK_S = 86_400.0, 400.0
REPLAYED_S, QUICK_REPLAYED_S = 3600.0, 30.0
BEFORE_S = 20.0
"""Device time and index begin this long before 32 bits overflow; the sequence, as many packets."""
MOST_ERROR_S = 1e-3
"""Largest error of a stamp against the true host time of its frame's middle."""
LOOKS, COUNTS = 120, 12
"""Samples of memory in a day, and counts of Python's objects, which take longer."""
WARM_UP = 0.25
"""Share of the day after which neither may grow; pools fill up before."""
MOST_GROWTH_KB, MOST_NEW_OBJECTS = 2048, 200
REPORT_US = 1_000_000
PATIENCE_S = 60.0
EDGE = 1 << 32


def run(plan: Plan) -> Iterator[Outcome]:
    """A day through the pipeline, part of one through the driver, and kills during saves."""
    config = SkinConfig.of(SKIN)
    stretches = [
        record(config, SimOptions(scene=scene, heartbeat=LAP_FRAMES, seed=plan.seed), LAP_FRAMES)
        for scene in (QUIET_SCENE, *BUSY_SCENES)
    ]
    seconds = QUICK_S if plan.quick else DAY_S
    yield from day(config, Telling(stretches, plan.seed), seconds, plan.seed)
    seconds = QUICK_REPLAYED_S if plan.quick else REPLAYED_S
    yield replayed(config, Telling(stretches, plan.seed + 1), seconds)
    yield saves.run(plan)


class Telling:
    """The digitizer of a day: an endless sequence of laps in random order.

    writer: counts packets and bytes. begin_us: of the first frame.
    """

    begin_us = EDGE - round(BEFORE_S * 1e6)

    def __init__(self, stretches: list[Stretch], seed: int) -> None:
        self._stretches = stretches
        self._rng = np.random.default_rng([seed, 0])
        self.writer = LapWriter(sequence=round(0x10000 - BEFORE_S))

    def bursts(self, frames: int, on_lap: Callable[[Lap], None]) -> Iterator[tuple[float, bytes]]:
        """Yield device time, s, and bytes sent then, for this many frames."""
        writer, info = self.writer, self._stretches[0].info
        begin_us = due_us = report_us = self.begin_us
        begin_index = EDGE - round(BEFORE_S * info.sample_rate_hz)
        number, data = 0, b"\0"
        while number < frames:
            stretch = self._next()
            on_lap(Lap(stretch, number, begin_us))
            for packets in stretch.frames[: frames - number]:
                if begin_us >= report_us:
                    data += writer.encode(info) + writer.encode(Status(begin_us, streaming=True))
                    report_us += REPORT_US
                for told in packets:
                    if begin_us + told.due_us != due_us:
                        yield due_us * 1e-6, data
                        due_us, data = begin_us + told.due_us, b""
                    data += writer.tell(told, begin_us, begin_index)
                begin_us += stretch.period_us
                begin_index += stretch.period_samples
                number += 1
        yield due_us * 1e-6, data

    def _next(self) -> Stretch:
        busy = self._rng.random() < BUSY
        return self._stretches[self._rng.integers(1, len(self._stretches)) if busy else 0]


class Holdings:
    """Memory, threads, descriptors and objects of this process during a day."""

    def __init__(self) -> None:
        self._watch = Watch(os.getpid())
        self._t_s: list[float] = []
        self._objects: list[int] = []  # of Python's, after a collection

    def look(self, share: float, t_s: float) -> None:
        """Sample them if due. share: of the day that has passed; t_s: device time, s."""
        if share * LOOKS >= len(self._t_s):
            self._t_s.append(t_s)
            self._watch.look()
        if share * COUNTS >= len(self._objects):
            gc.collect()
            self._objects.append(len(gc.get_objects()))

    def slope(self) -> Slope:
        """Growth of memory per device time."""
        first = round(WARM_UP * LOOKS)
        return slope(np.array(self._t_s[first:]), np.array(self._watch.rss_kb[first:], float))

    @property
    def grown(self) -> bool:
        """Whether there is more at the end than after the warm-up."""
        kb, alone = self._watch.rss_kb, self._watch.alone
        objects = self._objects[round(WARM_UP * COUNTS) :]
        first = round(WARM_UP * LOOKS)
        return (
            kb[-1] - kb[first] > MOST_GROWTH_KB
            or objects[-1] - objects[0] > MOST_NEW_OBJECTS
            or alone[-1] != alone[first]
        )


def day(config: SkinConfig, telling: Telling, seconds: float, seed: int) -> Iterator[Outcome]:
    """Through the pipeline, as fast as it goes."""
    rng = np.random.default_rng([seed, 1])
    host, line = HostClock(rng), UsbLine(rng)
    pipeline, began_s = Pipeline(config), time.monotonic()

    def host_at(t_s: float) -> float:
        return host.at(t_s - telling.begin_us * 1e-6)

    judge, holdings = DayJudge(config, host_at), Holdings()
    frames = round(seconds / config.spec.frame_period_s)
    for t_s, data in telling.bursts(frames, judge.told):
        for frame in pipeline.feed(data, line.read_at(host_at(t_s))):
            judge.judge(frame)
        holdings.look(judge.frames / frames, t_s)
    minutes, slope = (time.monotonic() - began_s) / 60, holdings.slope()
    wraps = (telling.writer.packets + 0x10000 - round(BEFORE_S)) // 0x10000
    yield Outcome(
        f"{seconds / 3600:.3g} h in a row: 16 bits of sequence, 32 of time and index run over",
        times=wraps + 2,
        wrong_values=judge.wrong,
        uncounted_losses=judge.uncounted + _miscounted(pipeline, telling.writer, judge, frames),
        crashes=int(holdings.grown),
        said=f"{judge.frames:,} frames in {minutes:.1f} min; memory {slope} of the skin's time",
        rss_slope_kb_per_h=slope.kb_per_h,
    )
    median_s, p99_s = (judge.stamp_error_s(share) for share in (0.5, 0.99))
    yield Outcome(
        f"USB late by tens of ms, or held up for up to {STALL_S[1]:.0f} s",
        times=line.late + line.stalls,
        wrong_values=judge.stamps_beyond(MOST_ERROR_S),
        said=f"stamps off by {median_s * 1e3:.2f} ms, p99 {p99_s * 1e3:.2f}, "
        f"max {judge.worst_s * 1e3:.2f}; crystals {host.crystal * 1e6:.0f} ppm apart, and drifting",
    )


def replayed(config: SkinConfig, telling: Telling, seconds: float) -> Outcome:
    """Record part of a day, and replay it through the driver's thread."""
    judge = DayJudge(config, None)
    frames = round(seconds / config.spec.frame_period_s)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "day.skin"
        with Recorder(path, "day", 0, {}) as recorder:
            for t_s, data in telling.bursts(frames, judge.told):
                recorder.write(data, t_s)
        threads = threading.active_count()
        problems: list[str | None] = []
        driver = Driver(config, f"replay://{path}?speed=0", 0, judge.judge, problems.append)
        with driver:
            goes_on = _wait(judge, frames)
    return Outcome(
        f"{seconds / 3600:.3g} h of it recorded, and replayed through the driver",
        times=1,
        wrong_values=judge.wrong,
        uncounted_losses=judge.uncounted
        + _miscounted(driver.pipeline, telling.writer, judge, frames),
        crashes=sum("internal error" in (problem or "") for problem in problems)
        + (threading.active_count() > threads),
        hangs=int(not goes_on),
        said=f"{judge.frames:,} frames",
    )


def _wait(judge: DayJudge, frames: int) -> bool:
    """Wait for all frames; whether they came."""
    came, since_s = 0, time.monotonic()
    while judge.frames < frames and time.monotonic() < since_s + PATIENCE_S:
        if judge.frames > came:
            came, since_s = judge.frames, time.monotonic()
        time.sleep(0.05)
    return judge.frames >= frames


def _miscounted(pipeline: Pipeline, writer: LapWriter, judge: DayJudge, frames: int) -> int:
    """Sum of missing frames and of the errors of all counts."""
    counters, packets = pipeline.counters, pipeline.packet_counts
    grows = counters.frames + counters.samples + packets.bytes + packets.packets
    counts = replace(Counts.of(pipeline), digitizer=None).named().values()
    losses = sum(counts) - grows
    return (
        abs(frames - judge.frames)
        + abs(frames - counters.frames)
        + abs(writer.packets - packets.packets)
        + abs(writer.bytes + 1 - packets.bytes)
        + losses
    )
