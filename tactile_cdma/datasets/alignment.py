# SPDX-License-Identifier: Apache-2.0

"""Streams of samples, in the order in which they were recorded ──▶ rows at the ticks of one clock.

A row holds what was measured up to its tick and nothing later: what a policy could have known.
Memory is bounded: a tick is done as soon as every stream that goes on has passed it, and what comes
before the interval of the next one is reduced to what is still known then.
"""

import heapq
import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count, islice
from statistics import median

import numpy as np

from ..base.arrays import Bools, Floats32
from ..base.errors import ParameterError
from ..readings.status import is_in_service
from .episodes import Episode, number_at
from .samples import NANO, Completeness, Kind, PatchInfo, Sample, SampleStream, SkinFrame, Value

WINDOW, LAST = "window", "last"
MODES = (WINDOW, LAST)
HOLD, ZERO, DROP, KEEP = "hold", "zero", "drop", "keep"
POLICIES = (HOLD, ZERO, DROP)
"""What may stand in place of NaN; KEEP: nothing does, where a format and its readers allow it."""
MOST_UNCERTAIN_S = 0.05
"""s; a frame whose stamp may be off by more has no valid readings, because it may be of another
tick. Chosen: as long as a tick at 20 per second, and above what an idle computer delays."""
MOST_SLOTS = 1000
"""Samples of a patch per tick; chosen: 12 s of frames that come every 12.8 ms."""


def slots(patch: PatchInfo, fps: float, mode: str) -> int:
    """Tell how many samples of a patch one tick holds: with WINDOW, the most that an interval can.

    Raises ParameterError for more than MOST_SLOTS.
    """
    if mode != WINDOW or math.isnan(patch.frame_period_s):
        return 1
    count = max(1, math.ceil(1 / (fps * patch.frame_period_s) - 1e-9))
    if count > MOST_SLOTS:
        raise ParameterError(
            f"{count} frames of {patch.name} per row, {patch.frame_period_s:g} s apart; at most "
            f"{MOST_SLOTS} are kept: ask for more rows per s, or for --samples last"
        )
    return count


@dataclass(frozen=True, slots=True, eq=False)
class Touch:
    """A patch at one tick.

    pressure_pa: (slots, t) float32 for WINDOW, the newest last, else (t,); NaN only with KEEP.
    valid: of the same shape, bool: there was a certain reading; none of a patch that stopped.
    age_s: (slots,) or (1,) float32, how long before the tick each was measured.
    complete: every taxel in service is valid.
    """

    pressure_pa: Floats32
    valid: Bools
    age_s: Floats32
    complete: bool


class TouchStream:
    """Takes a patch's frames in the order of their stamps; gives what is known of it at a tick.

    completeness: of all frames that were taken.
    """

    def __init__(self, taxels: int, slots: int, mode: str, policy: str) -> None:
        self._slots, self._mode, self._policy = slots, mode, policy
        self.completeness = Completeness()
        self._held_pa = np.zeros(taxels, dtype=np.float32)  # last valid readings, or 0
        self._wanted = np.ones(taxels, dtype=bool)
        # By frame: stamp, ns; which readings are valid; the last valid ones then, Pa.
        self._window: deque[tuple[int, Bools, Floats32]] = deque(maxlen=slots)

    def take(self, stamp_ns: int, frame: SkinFrame) -> None:
        valid = frame.valid & (not frame.stamp_uncertainty_s > MOST_UNCERTAIN_S)  # NaN: unknown
        self._held_pa = np.where(valid, frame.pressure_pa, self._held_pa)
        self._wanted = is_in_service(frame.status)
        self.completeness.take(frame)
        if not self._window:  # the first frame, also after a stop: before it nothing was read
            self._window.extend([(stamp_ns, np.zeros_like(valid), self._held_pa)] * self._slots)
        self._window.append((stamp_ns, valid, self._held_pa))

    def restart(self) -> None:
        """Begin the window anew after a stop: what was before that is not of the present."""
        self._window.clear()

    def at(self, tick_ns: int, has_stopped: bool = False) -> Touch:
        """Return the patch at a tick that is later than all frames taken; at least one must be.

        has_stopped: the newest frame is too old for the present, so that nothing is valid.
        """
        stamps_ns, valids, filled = zip(*self._window, strict=True)
        ages_s = np.array([(tick_ns - stamp_ns) / NANO for stamp_ns in stamps_ns], np.float32)
        valid, pressure_pa = np.array(valids) & (not has_stopped), np.array(filled)
        if self._mode == LAST:
            valid, pressure_pa = valid[-1], pressure_pa[-1]
        if self._policy == ZERO:
            pressure_pa = np.where(valid, pressure_pa, np.float32(0))
        elif self._policy == KEEP:
            pressure_pa = np.where(valid, pressure_pa, np.float32(np.nan))
        return Touch(pressure_pa, valid, ages_s, bool(valid[..., self._wanted].all()))


WAIT_S = 2.0
"""Rows wait for a stream until it has been silent for so long, s; chosen: far longer than messages
take to the recorder, and little to hold."""
STALE_S = 0.5
"""Least age of a stream's last sample, s, at which the stream counts as stopped. Chosen: five
frames of a driver that thins frames without words to 10 Hz (idle_rate_hz), and little to repeat an
image."""
STEPS, LAST_STEPS = 3, 15
"""That age is also at least STEPS of the stream's own intervals (median of the LAST_STEPS newest):
a slow stream may lose one sample and send the next one late. Chosen."""
REACH = 2
"""Where the clock is a stream, which may lose a tick, an interval is at most as long as this many
usual ones, or as STALE_S if that is longer. Chosen."""


def stale_s(fps: float) -> float:
    """Return the age that a stream's last sample may have at least, at so many ticks per s, s."""
    return max(STALE_S, 1 / fps)


@dataclass(frozen=True, slots=True)
class Tick:
    """A moment of the clock, Unix time in ns, of the episode of that number.

    since_ns: the tick before, after which its interval begins.
    """

    time_ns: int
    episode: int
    since_ns: int


@dataclass(frozen=True, slots=True)
class Row:
    """What is known at a tick: by stream, the patches' touch and the other streams' last value.

    stopped: streams whose newest sample is too old at this tick, each with the stamp of its last
    sample in time, ns. Their values are left out, except touch (with nothing valid) and actions (a
    command holds until the next one). A stream that has not begun is in neither mapping.
    """

    tick: Tick
    values: Mapping[str, Touch | Value]
    stopped: Mapping[str, int]


class Present:
    """What is known of streams at a moment: add() samples, then ask for the row of a tick.

    streams: by key. touch: of the patches, by key. fps: ticks per s. newest: stamp of each stream's
    newest sample, and when it was recorded; passed by none that has not begun. done_ns, drained_ns:
    the last tick; the time up to which samples were taken in, which may be later than that.
    """

    def __init__(
        self, streams: Mapping[str, SampleStream], touch: Mapping[str, TouchStream], fps: float
    ) -> None:
        self._touch = touch
        self._commands = {key for key, stream in streams.items() if stream.kind == Kind.ACTION}
        self._waiting: dict[str, list[tuple[int, int, Value]]] = {key: [] for key in streams}
        self._order = count()
        self._last: dict[str, Value] = {}
        self._taken_ns = dict.fromkeys(streams, -1)
        self._steps_ns: dict[str, deque[int]] = {key: deque(maxlen=LAST_STEPS) for key in streams}
        self._stopped_ns: dict[str, int] = {}
        self._stale_ns = round(stale_s(fps) * NANO)
        self.newest: dict[str, tuple[int, int]] = {}
        self.done_ns = self.drained_ns = -1

    def add(self, sample: Sample) -> None:
        """Take a sample; one that is older than others of its stream that are in use is ignored."""
        key, stamp_ns = sample.stream, sample.stamp_ns
        if stamp_ns > self._taken_ns[key]:
            heapq.heappush(self._waiting[key], (stamp_ns, next(self._order), sample.value))
        newest_ns = max(stamp_ns, self.newest.get(key, (0, 0))[0])
        self.newest[key] = newest_ns, sample.seen_ns

    def row(self, tick: Tick) -> Row:
        """Return the row of a tick that is later than the one before."""
        self.drain(tick.time_ns)
        self.done_ns = tick.time_ns
        values: dict[str, Touch | Value] = {}
        stopped: dict[str, int] = {}
        for key, value in self._last.items():
            if has_stopped := self._has_stopped(key, tick.time_ns):
                stopped[key] = self._stopped_ns.setdefault(key, self._taken_ns[key])
            if key in self._touch:
                values[key] = self._touch[key].at(tick.time_ns, has_stopped)
            elif not has_stopped or key in self._commands:
                values[key] = value
        return Row(tick, values, stopped)

    def drain(self, until_ns: int) -> None:
        if until_ns <= self.drained_ns:
            return
        self.drained_ns = until_ns
        for key, waiting in self._waiting.items():
            while waiting and waiting[0][0] <= until_ns:
                stamp_ns, _, value = heapq.heappop(waiting)
                if key in self._last:
                    if key in self._touch and self._has_stopped(key, stamp_ns):
                        self._touch[key].restart()
                    self._steps_ns[key].append(stamp_ns - self._taken_ns[key])
                self._last[key], self._taken_ns[key] = value, stamp_ns
                if isinstance(value, SkinFrame):
                    self._touch[key].take(stamp_ns, value)

    def _has_stopped(self, key: str, time_ns: int) -> bool:
        age_ns, steps_ns = time_ns - self._taken_ns[key], self._steps_ns[key]
        if age_ns <= self._stale_ns:
            return False
        return not steps_ns or age_ns > STEPS * median(steps_ns)


class Aligner:
    """Samples in, rows out; feed() each sample, then finish().

    clock: key of the stream whose stamps are the ticks, about fps per s; None: exactly fps from the
    beginning of each episode or of the data. streams, touch: see Present.
    late: samples per stream that came after a tick that they belong to.
    """

    def __init__(
        self,
        streams: Mapping[str, SampleStream],
        touch: Mapping[str, TouchStream],
        episodes: Sequence[Episode],
        fps: float,
        clock: str | None = None,
    ) -> None:
        self._present = Present(streams, touch, fps)
        self._episodes, self._clock, self._fps = episodes, clock, fps
        self._grid: Iterator[Tick] = iter(())
        self._ticks: deque[Tick] = deque()
        self._begun_ns: int | None = None
        self._last_tick: Tick | None = None
        self._interval_ns = round(NANO / fps)
        self._reach_ns = max(round(STALE_S * NANO), REACH * self._interval_ns)
        self.late = dict.fromkeys(streams, 0)

    def feed(self, sample: Sample) -> Iterator[Row]:
        """Yield rows that this sample completes."""
        key, stamp_ns, present = sample.stream, sample.stamp_ns, self._present
        if self._begun_ns is None:
            self._begun_ns = sample.seen_ns
            if self._clock is None:
                self._grid = _grid(self._episodes, self._fps, stamp_ns)
        if stamp_ns <= (present.drained_ns if key == self._clock else present.done_ns):
            self.late[key] += 1
        present.add(sample)
        if key == self._clock:
            self._tick(stamp_ns)
        now_ns, wait_ns, newest = sample.seen_ns, round(WAIT_S * NANO), present.newest
        passed_ns = min(now_ns, *(ns for ns, seen in newest.values() if now_ns - seen <= wait_ns))
        if len(newest) < len(self.late) and now_ns - self._begun_ns <= wait_ns:
            passed_ns = 0  # a stream has not begun
        yield from self._rows(passed_ns)

    def finish(self) -> Iterator[Row]:
        """Yield rows that waited for more samples; none after the last one was recorded."""
        newest = self._present.newest.values()
        newest_ns = max((stamp for stamp, _ in newest), default=0)
        seen_ns = max((seen for _, seen in newest), default=0)
        yield from self._rows(min(newest_ns, seen_ns))

    def _tick(self, time_ns: int) -> None:
        """Add a tick at a stamp of the clock's stream, where that lies in an episode and is new."""
        last_ns = self._ticks[-1].time_ns if self._ticks else self._present.drained_ns
        if time_ns > last_ns and (number := number_at(self._episodes, time_ns)) is not None:
            since_ns, before = time_ns - self._interval_ns, self._last_tick
            if before is not None and before.episode == number:
                since_ns = max(before.time_ns, time_ns - self._reach_ns)
            self._last_tick = Tick(time_ns, number, since_ns)
            self._ticks.append(self._last_tick)

    def _rows(self, passed_ns: int) -> Iterator[Row]:
        """Yield rows of all ticks before a time that every stream has passed."""
        while True:
            if not self._ticks:
                self._ticks.extend(islice(self._grid, 1))
            if not self._ticks or self._ticks[0].time_ns > passed_ns:
                break
            yield self._present.row(self._ticks.popleft())
        # The grid's next tick is known; of a clock that is a stream only that it is not before.
        since_ns = self._ticks[0].since_ns if self._ticks else passed_ns - self._reach_ns
        self._present.drain(min(passed_ns, since_ns))


def _grid(episodes: Iterable[Episode], fps: float, first_ns: int) -> Iterator[Tick]:
    """Yield all episodes' ticks from a time on, each from the first: rounding must not add up.

    An episode's first tick is an interval after its beginning.
    """
    for number, episode in enumerate(episodes):
        begin_ns = max(episode.begin_ns, first_ns)
        since_ns = begin_ns - 1
        for i in count(1):
            time_ns = begin_ns + round(i * NANO / fps)
            if time_ns > episode.end_ns:
                break
            yield Tick(time_ns, number, since_ns)
            since_ns = time_ns
