# SPDX-License-Identifier: Apache-2.0

"""How a running driver does: what its thread notes with every frame, summed up for each report."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, field, fields

from ..wire.messages import Status
from ..wire.packets import Counters
from .pipeline import Pipeline, TactileFrame

_NO_COUNTS = {"text_bytes", "sequence", "streaming"}
"""Fields of Counters and Status that do not count what happens."""


@dataclass(frozen=True, slots=True)
class Window:
    """What happened between two reports.

    seconds: how long that was. frames: decoded in it.
    line_s: from the middle of a code frame until its last byte was read, mean. decode_s: from there
        until its chunk of bytes was decoded, mean. publish_s: until it was handed on, mean.
    slowest_s: the longest of their sums. All four NaN without frames.
    noise_rms_v: noise of one chip sample, V; NaN if unknown.
    clipped: share of the samples at a rail of the digitizer, 0…1.
    backlog_bytes: most that was seen to wait in the port after a read was dealt with.
    process_share, thread_share: CPU time of the process and of the driver's thread, in cores.
    totals, rises: counts by name, and by how much they rose; those of the digitizer's STATUS begin
        with `digitizer_`.
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
    totals: dict[str, int]
    rises: dict[str, int]

    @property
    def latency_s(self) -> float:
        """From the middle of a code frame until it was handed on, mean, s."""
        return self.line_s + self.decode_s + self.publish_s

    def per_s(self, name: str) -> float:
        """How fast a count rose, 1/s; 0 for one that is not there."""
        return self.rises.get(name, 0) / self.seconds


class Vitals:
    """Noted by the driver's thread, taken by another one.

    Taking waits for nobody: a frame that is noted at that very moment may be left out.
    """

    def __init__(self) -> None:
        self._sums = _Sums()
        self._thread_s = 0.0  # CPU time of the driver's thread so far
        self._taken = _Taken()

    def handed_on(self, frame: TactileFrame, t_read: float, t_decoded: float) -> None:
        """A frame, read and decoded at these times (host's monotonic, s), was just handed on."""
        sums, now = self._sums, time.monotonic()
        sums.frames += 1
        sums.line_s += t_read - frame.t_host
        sums.decode_s += t_decoded - t_read
        sums.publish_s += now - t_decoded
        sums.slowest_s = max(sums.slowest_s, now - frame.t_host)
        sums.clipped += frame.clipped
        noise_v = frame.words.noise_rms_v
        if noise_v == noise_v:  # not NaN
            sums.noise_v2 += noise_v * noise_v
            sums.noisy += 1

    def dealt_with(self, waiting_bytes: int) -> None:
        """What was read is dealt with, and so much more waits in the port."""
        self._sums.backlog_bytes = max(self._sums.backlog_bytes, waiting_bytes)
        self._thread_s = time.thread_time()

    def take(self, pipeline: Pipeline) -> Window:
        """What happened since the last call."""
        sums, self._sums = self._sums, _Sums()
        before = self._taken
        self._taken = now = _Taken(thread_s=self._thread_s, totals=totals(pipeline))
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
            totals=now.totals,
            rises=_rises(before.totals, now.totals),
        )


def totals(pipeline: Pipeline) -> dict[str, int]:
    """Every count of a pipeline by name; those of the digitizer as its last STATUS has them."""
    packets, status = pipeline.packet_counts, pipeline.status
    counts: dict[str, int] = asdict(pipeline.counters)
    counts |= {item.name: packets[item.name] for item in fields(Counters)}
    if status is not None:
        counts |= {f"digitizer_{item.name}": getattr(status, item.name) for item in fields(Status)}
    counts["rejected_bursts"] = pipeline.rejected
    return {
        name: count
        for name, count in counts.items()
        if name.removeprefix("digitizer_") not in _NO_COUNTS
    }


def _rises(before: dict[str, int], now: dict[str, int]) -> dict[str, int]:
    """By how much counts rose; one that is lower than before began anew, from 0."""
    return {
        name: count - before[name] if count >= before[name] else count
        for name, count in now.items()
        if name in before
    }


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
class _Taken:
    """How far clocks and counts were when a window ended."""

    t_host: float = field(default_factory=time.monotonic)
    process_s: float = field(default_factory=time.process_time)
    thread_s: float = 0.0
    totals: dict[str, int] = field(default_factory=dict)
