# SPDX-License-Identifier: Apache-2.0

"""Streams of samples, in the order in which they were recorded ──▶ rows at the ticks of one clock.

A row holds what was measured up to its tick and nothing later: what a policy could have known.
Memory is bounded: a tick is done as soon as every stream that goes on has passed it.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count

from .episodes import Episode
from .samples import CONTACTS, NANO, WRENCH, Sample, SkinFrame, Stream, Value
from .touch import STALE_S, Touch, TouchStream

WAIT_S = 2.0
"""A stream from which nothing was recorded for so long is not waited for, s; chosen: far above the
time that messages need to the recorder, and little to hold."""


@dataclass(frozen=True, slots=True)
class Tick:
    """A moment of the clock, Unix time in ns, of the episode of that number."""

    time_ns: int
    episode: int


@dataclass(frozen=True, slots=True)
class Row:
    """What is known at a tick: by stream, the patches' touch and the other streams' last value.

    A stream that has not begun is absent, and so are contacts and wrench older than STALE_S.
    """

    tick: Tick
    values: Mapping[str, Touch | Value]


class Aligner:
    """Samples in, rows out; feed() each sample, then finish().

    streams: by key. touch: of the patches, by key. clock: key of the stream whose stamps are the
    ticks; None: fps ticks per s from the beginning of each episode or of the data. late: samples
    per stream that came after a tick that they belong to.
    """

    def __init__(
        self,
        streams: Mapping[str, Stream],
        touch: Mapping[str, TouchStream],
        episodes: Sequence[Episode],
        fps: float,
        clock: str | None = None,
    ) -> None:
        self._streams, self._touch, self._episodes = streams, touch, episodes
        self._clock, self._fps = clock, fps
        self._grid: Iterator[Tick] = iter(())
        self._ticks: deque[Tick] = deque()
        self._waiting: dict[str, list[tuple[int, int, Value]]] = {key: [] for key in streams}
        self._order = count()
        self._last: dict[str, Value] = {}
        self._newest: dict[str, tuple[int, int]] = {}  # stamp, and when it was recorded
        self._taken_ns = dict.fromkeys(streams, -1)
        self._done_ns = -1
        self._begun_ns: int | None = None
        self.late = dict.fromkeys(streams, 0)

    def feed(self, sample: Sample) -> Iterator[Row]:
        """Rows that this sample completes."""
        key, stamp_ns = sample.stream, sample.stamp_ns
        if self._begun_ns is None:
            self._begun_ns = sample.seen_ns
            if self._clock is None:
                self._grid = _grid(self._episodes, self._fps, stamp_ns)
        if stamp_ns <= self._done_ns:
            self.late[key] += 1
        if stamp_ns > self._taken_ns[key]:  # else there is something newer already
            heapq.heappush(self._waiting[key], (stamp_ns, next(self._order), sample.value))
        newest_ns = max(stamp_ns, self._newest.get(key, (0, 0))[0])
        self._newest[key] = newest_ns, sample.seen_ns
        if key == self._clock:
            self._tick(stamp_ns)
        yield from self._rows(self._passed_ns(sample.seen_ns))

    def finish(self) -> Iterator[Row]:
        """Rows that waited for more samples; none after the last one was recorded."""
        newest_ns = max((stamp for stamp, _ in self._newest.values()), default=0)
        seen_ns = max((seen for _, seen in self._newest.values()), default=0)
        yield from self._rows(min(newest_ns, seen_ns))

    def _passed_ns(self, now_ns: int) -> int:
        """The time that all streams have passed from which samples are still to be expected."""
        wait_ns = round(WAIT_S * NANO)
        assert self._begun_ns is not None
        if len(self._newest) < len(self._streams) and now_ns - self._begun_ns <= wait_ns:
            return 0
        going = (stamp for stamp, seen in self._newest.values() if now_ns - seen <= wait_ns)
        return min(now_ns, *going)

    def _tick(self, time_ns: int) -> None:
        """A tick at a stamp of the clock's stream, where that lies in an episode and is new."""
        last_ns = self._ticks[-1].time_ns if self._ticks else self._done_ns
        within = (n for n, e in enumerate(self._episodes) if e.begin_ns <= time_ns <= e.end_ns)
        if time_ns > last_ns and (number := next(within, None)) is not None:
            self._ticks.append(Tick(time_ns, number))

    def _rows(self, passed_ns: int) -> Iterator[Row]:
        """Rows of all ticks before a time that every stream has passed."""
        while (tick := self._next(passed_ns)) is not None:
            yield self._row(tick)

    def _next(self, passed_ns: int) -> Tick | None:
        if not self._ticks and (tick := next(self._grid, None)) is not None:
            self._ticks.append(tick)
        if self._ticks and self._ticks[0].time_ns <= passed_ns:
            return self._ticks.popleft()
        return None

    def _row(self, tick: Tick) -> Row:
        values: dict[str, Touch | Value] = {}
        for key, waiting in self._waiting.items():
            while waiting and waiting[0][0] <= tick.time_ns:
                stamp_ns, _, value = heapq.heappop(waiting)
                self._last[key], self._taken_ns[key] = value, stamp_ns
                if isinstance(value, SkinFrame):
                    self._touch[key].take(stamp_ns, value)
            if key in self._touch:
                if (touch := self._touch[key].at(tick.time_ns)) is not None:
                    values[key] = touch
            elif key in self._last and not self._expired(key, tick.time_ns):
                values[key] = self._last[key]
        self._done_ns = tick.time_ns
        return Row(tick, values)

    def _expired(self, key: str, time_ns: int) -> bool:
        """Whether the last contacts or wrench are too old to be taken for present ones."""
        is_of_skin = self._streams[key].kind in (CONTACTS, WRENCH)
        return is_of_skin and time_ns - self._taken_ns[key] > STALE_S * NANO


def _grid(episodes: Iterable[Episode], fps: float, first_ns: int) -> Iterator[Tick]:
    """Ticks of all episodes from a time on, each computed from its first: rounding must not add up.

    An episode's first tick is an interval after its beginning.
    """
    for number, episode in enumerate(episodes):
        begin_ns = max(episode.begin_ns, first_ns)
        for i in count(1):
            time_ns = begin_ns + round(i * NANO / fps)
            if time_ns > episode.end_ns:
                break
            yield Tick(time_ns, number)
