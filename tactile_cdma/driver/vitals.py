# SPDX-License-Identifier: Apache-2.0

"""Measures a running driver: notes frame by frame, evaluates for every report."""

import math
import time
from collections import Counter, deque
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self, TypeAlias

import numpy as np

from ..framing.frames import Clause, Rejections
from ..wire.messages import Status
from ..wire.packets import Counters
from .clock import StreamCounters
from .pipeline import Pipeline

MOST_HANDED_ON = 1 << 14
"""Frames that are kept for a report. Chosen: three minutes at 78 Hz, for whoever never asks."""
_NO_COUNTS = ("text_bytes", "sequence", "streaming")
"""Fields that count nothing that happens."""


HandedOn: TypeAlias = tuple[float, float, float, float, float, float]
"""A frame that was handed on: host's monotonic clock, s, of its middle, when its last byte was
read, when it was decoded, and handed on; clipped, noise_rms_v: see TactileFrame and Words."""


@dataclass(frozen=True, slots=True)
class Counts:
    """Everything that is counted, up to one moment or between two.

    digitizer: by its own STATUS; None while that is unknown. doubts: frames in doubt, by the clause
    that fails; see Decisions. overloads: see Load.
    """

    stream: StreamCounters
    packets: Counters
    digitizer: Status | None
    rejections: Rejections
    doubts: Counter[Clause] = field(default_factory=Counter)
    overloads: int = 0

    @classmethod
    def of(cls, pipeline: Pipeline) -> Self:
        return cls(
            replace(pipeline.counters),
            pipeline.packet_counts,
            pipeline.digitizer.status,
            pipeline.rejections,
            pipeline.decisions.doubts.copy(),
            pipeline.load.overloads if pipeline.load else 0,
        )

    def since(self, before: Self) -> Self:
        """Tell by how much the counts rose; one that fell began anew, from 0."""
        rises: Self = _rise(before, self)
        return rises

    def named(self) -> dict[str, int]:
        """Name the counts for people; those of the digitizer begin with "digitizer"."""
        counts = _named(self.stream) | _named(self.packets)
        if self.digitizer:
            counts |= {f"digitizer {name}": n for name, n in _named(self.digitizer).items()}
        reasons = {f"rejected {name}": n for name, n in _named(self.rejections).items()}
        return counts | {"rejected bursts": self.rejections.total} | reasons


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
        """Return the mean time from the middle of a code frame until it was handed on, s."""
        return self.line_s + self.decode_s + self.publish_s


class Vitals:
    """Filled by the driver's thread, taken by another one, which waits for nobody.

    handed_on: the driver adds every frame.
    """

    def __init__(self) -> None:
        self.handed_on: deque[HandedOn] = deque(maxlen=MOST_HANDED_ON)
        self._backlog_bytes = 0
        self._thread_s = 0.0  # CPU time of the driver's thread so far
        self._clocks = self._read_clocks()
        self._totals: Counts | None = None  # at the end of the last window

    def note_read(self, waiting_bytes: int) -> None:
        """Note that what was read has been handed on; this much more waits in the port."""
        self._backlog_bytes = max(self._backlog_bytes, waiting_bytes)
        self._thread_s = time.thread_time()

    def take(self, pipeline: Pipeline) -> Window:
        """Tell what happened since the last call."""
        backlog_bytes, self._backlog_bytes = self._backlog_bytes, 0
        frames = [self.handed_on.popleft() for _ in range(len(self.handed_on))]
        before, self._clocks = self._clocks, self._read_clocks()
        passed_s, process_s, thread_s = np.subtract(self._clocks, before).tolist()
        totals, seconds = Counts.of(pipeline), max(passed_s, 1e-3)
        rises, self._totals = totals.since(self._totals or totals), totals
        line_s = decode_s = publish_s = slowest_s = noise_rms_v = math.nan
        clipped = 0.0
        if frames:
            table = np.array(frames)
            line_s, decode_s, publish_s = np.diff(table[:, :4]).mean(axis=0).tolist()
            slowest_s = float((table[:, 3] - table[:, 0]).max())
            clipped = float(table[:, 4].mean())
            noise_v = table[~np.isnan(table[:, 5]), 5]
            noise_rms_v = math.sqrt(np.square(noise_v).mean()) if noise_v.size else math.nan
        return Window(
            seconds=seconds,
            frames=len(frames),
            line_s=line_s,
            decode_s=decode_s,
            publish_s=publish_s,
            slowest_s=slowest_s,
            noise_rms_v=noise_rms_v,
            clipped=clipped,
            backlog_bytes=backlog_bytes,
            process_share=process_s / seconds,
            thread_share=thread_s / seconds,
            totals=totals,
            rises=rises,
        )

    def _read_clocks(self) -> tuple[float, float, float]:
        """Read the host's time, and CPU time of the process and of the driver's thread, s."""
        return time.monotonic(), time.process_time(), self._thread_s


def _named(part: StreamCounters | Counters | Status | Rejections) -> dict[str, int]:
    names = [item.name for item in fields(part) if item.name not in _NO_COUNTS]
    return {name.replace("_", " "): getattr(part, name) for name in names}


def _rise(before: Any, now: Any) -> Any:
    """Subtract counts, or those of two dataclasses; None where one of both is unknown."""
    if before is None or now is None:
        return None
    if isinstance(now, int):
        return now - before if now >= before else now
    if isinstance(now, Counter):
        return now - before
    names = [item.name for item in fields(now)]
    return replace(now, **{n: _rise(getattr(before, n), getattr(now, n)) for n in names})
