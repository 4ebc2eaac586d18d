# SPDX-License-Identifier: Apache-2.0

"""What a running driver measures of itself: summed up frame by frame, taken with every report."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

from ..wire.messages import Status
from ..wire.packets import Counters
from .pipeline import Pipeline, TactileFrame
from .timeline import StreamCounters

C = TypeVar("C", StreamCounters, Counters, Status)

_NO_COUNTS = ("text_bytes", "sequence", "streaming")
"""Fields that count nothing that happens."""


@dataclass(frozen=True, slots=True)
class Counts:
    """Everything that is counted, up to one moment or between two.

    digitizer: by its own STATUS; None while that is unknown.
    """

    stream: StreamCounters
    packets: Counters
    digitizer: Status | None
    rejected_bursts: int

    @classmethod
    def of(cls, pipeline: Pipeline) -> Counts:
        """A snapshot of a pipeline's counts."""
        return cls(
            replace(pipeline.counters),
            pipeline.packet_counts,
            pipeline.digitizer.status,
            pipeline.rejected,
        )

    def since(self, before: Counts) -> Counts:
        """By how much the counts rose; one that fell began anew, from 0."""
        now, then = self.digitizer, before.digitizer
        return Counts(
            _rise(before.stream, self.stream),
            _rise(before.packets, self.packets),
            _rise(then, now) if now and then else None,
            _risen(before.rejected_bursts, self.rejected_bursts),
        )

    def named(self) -> dict[str, int]:
        """By name, for people; those of the digitizer begin with "digitizer"."""
        counts = _named(self.stream) | _named(self.packets)
        if self.digitizer:
            counts |= {f"digitizer {name}": n for name, n in _named(self.digitizer).items()}
        return counts | {"rejected bursts": self.rejected_bursts}


@dataclass(frozen=True, slots=True)
class Window:
    """What happened between two reports.

    seconds: its duration. frames: decoded in it.
    line_s: from the middle of a code frame until its last byte was read, mean. decode_s: from there
        until its chunk of bytes was decoded, mean. publish_s: until it was handed on, mean.
    slowest_s: the longest of their sums. All four NaN without frames.
    noise_rms_v: noise of one chip sample, V; NaN if unknown.
    clipped: share of the samples at a rail of the digitizer, 0…1.
    backlog_bytes: most that was seen waiting in the port after a read.
    process_share, thread_share: CPU time of the process and of the driver's thread, in cores.
    totals: counts up to its end. rises: by how much they rose in it.
    """

    seconds: float
    frames: int
    line_s: float
    decode_s: float
    publish_s: float
    slowest_s: float
    noise_rms_v: float
    clipped: float
    backlog_bytes: int
    process_share: float
    thread_share: float
    totals: Counts
    rises: Counts

    @property
    def latency_s(self) -> float:
        """From the middle of a code frame until it was handed on, mean, s."""
        return self.line_s + self.decode_s + self.publish_s


class Vitals:
    """Filled by the driver's thread, taken by another one.

    Taking waits for nobody: a frame that is noted at that very moment may be left out.
    """

    def __init__(self) -> None:
        self._sums = _Sums()
        self._thread_s = 0.0  # CPU time of the driver's thread so far
        self._before = _Instant(time.monotonic(), time.process_time(), 0.0, None)

    def note_frame(self, frame: TactileFrame, t_read: float, t_decoded: float) -> None:
        """A frame, read and decoded at these times (host's monotonic, s), was just handed on."""
        sums, now = self._sums, time.monotonic()
        sums.frames += 1
        sums.line_s += t_read - frame.t_host
        sums.decode_s += t_decoded - t_read
        sums.publish_s += now - t_decoded
        sums.slowest_s = max(sums.slowest_s, now - frame.t_host)
        sums.clipped += frame.clipped
        noise_v = frame.words.noise_rms_v
        if not math.isnan(noise_v):
            sums.noise_v2 += noise_v * noise_v
            sums.noisy += 1

    def note_read(self, waiting_bytes: int) -> None:
        """What was read has been handed on; this much more waits in the port."""
        self._sums.backlog_bytes = max(self._sums.backlog_bytes, waiting_bytes)
        self._thread_s = time.thread_time()

    def take(self, pipeline: Pipeline) -> Window:
        """What happened since the last call."""
        sums, self._sums = self._sums, _Sums()
        before, totals = self._before, Counts.of(pipeline)
        now = _Instant(time.monotonic(), time.process_time(), self._thread_s, totals)
        self._before = now
        seconds = max(now.t_host - before.t_host, 1e-3)
        frames = sums.frames or math.nan
        return Window(
            seconds=seconds,
            frames=sums.frames,
            line_s=sums.line_s / frames,
            decode_s=sums.decode_s / frames,
            publish_s=sums.publish_s / frames,
            slowest_s=sums.slowest_s if sums.frames else math.nan,
            noise_rms_v=math.sqrt(sums.noise_v2 / (sums.noisy or math.nan)),
            clipped=sums.clipped / frames if sums.frames else 0.0,
            backlog_bytes=sums.backlog_bytes,
            process_share=(now.process_s - before.process_s) / seconds,
            thread_share=(now.thread_s - before.thread_s) / seconds,
            totals=totals,
            rises=totals.since(before.totals or totals),
        )


@dataclass(slots=True)
class _Sums:
    frames: int = 0
    line_s: float = 0.0
    decode_s: float = 0.0
    publish_s: float = 0.0
    slowest_s: float = 0.0
    clipped: float = 0.0
    noise_v2: float = 0.0
    noisy: int = 0
    backlog_bytes: int = 0


@dataclass(frozen=True, slots=True)
class _Instant:
    """How far clocks and counts were when a window ended."""

    t_host: float
    process_s: float
    thread_s: float
    totals: Counts | None


def _named(part: StreamCounters | Counters | Status) -> dict[str, int]:
    names = [item.name for item in fields(part) if item.name not in _NO_COUNTS]
    return {name.replace("_", " "): getattr(part, name) for name in names}


def _rise(before: C, now: C) -> C:
    """The rise of every field."""
    names = [item.name for item in fields(now)]
    rises: Any = {name: _risen(getattr(before, name), getattr(now, name)) for name in names}
    return replace(now, **rises)


def _risen(before: int, now: int) -> int:
    return now - before if now >= before else now
