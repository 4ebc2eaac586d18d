# SPDX-License-Identifier: Apache-2.0

"""Follows a stream in the compiled kernel while it goes on as it was: one call per frame.

As a rule every packet continues the stream, and every frame is explained by the timing of the one
before. Then the kernel waits for bytes, parses them, cuts frames, separates nodes and learns the
line at rest; anything else ends that, and goes the stages' way from there. Either way gives the
same frames, to the bit.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from ..base import kernel
from ..code.amplitude import ACTIVE_SHARE, LOUDEST_FLOOR
from ..code.frame import UNIPOLAR
from ..code.separate import SPOKEN_OVER, NodeLevels
from ..code.transform import compiled_transform, is_compiled
from ..framing.fit import lowest_power
from ..framing.frame_end import tail_of
from ..framing.limits import LIMITS
from ..framing.marked_timing import (
    GAP_WEIGHT,
    LEAST_REST,
    MarkedLine,
    MarkedTiming,
    Place,
    SteadyTiming,
)
from ..framing.timing import ABSURD_V, FrameLevels, blinding_noise_v, within_rails
from ..wire.messages import Info
from ..wire.packets import Found, PacketParser
from .timeline import CLOCK_SLACK_S, MAX_DEVICE_TIME_US, Pace, PassedPacket, Timeline, sample_count

NO_FILE = -1
"""In place of a file descriptor: only bytes that were given are followed."""
SOUND_FRAMES, MOST_PAUSE = 4, 64
"""Frames without an exception that make it worth while to follow a stream here; most frames that go
the stages' way before it is tried again, after attempts that were not. Chosen: to begin and to end
costs as much as one or two frames."""


class Event(IntEnum):
    """What ended a wait, as enum steady_event in the kernel's steady.h."""

    MORE = 0
    HEARD = 1
    SILENT = 2
    FULL = 3
    PACKET = 4
    UNDECIDED = 5


class Waited(NamedTuple):
    """What a wait has brought.

    passed: packets of samples that continued the stream. frame: one that was decoded. packet: one
    to be interpreted, which is none of those. t_host: when the last bytes were read, s, host's
    monotonic clock. backlog: they had been waiting.
    """

    event: Event
    passed: list[PassedPacket]
    frame: FrameLevels | None
    packet: Found | None
    t_host: float
    backlog: bool


class Left(NamedTuple):
    """What remains when a stream is not followed any more.

    frames: decided now. data: bytes that were not parsed. t_host, backlog: as in Waited.
    """

    frames: list[FrameLevels]
    data: bytes
    t_host: float
    backlog: bool


class SteadyStream:
    """The kernel's Steady for one digitizer. entered: whether it follows the stream now."""

    def __init__(self, info: Info, timing: MarkedTiming, pace: Pace, parser: PacketParser) -> None:
        """timing, parser: of the stages, which it takes turns with. See `can_follow`."""
        assert kernel.compiled is not None
        line = timing.line
        spec = line.spec
        self.entered = False
        self._marked, self._line, self._spec = timing, line, spec
        self._rows = np.empty((spec.line_bits, spec.order), np.float32)
        self._values = self._rows[:, spec.node_slice]
        self._root = math.sqrt(spec.order)
        setting = np.array(_setting(line, info, pace, timing.gap_size))
        transform = compiled_transform(spec.book.plan, spreading=False)
        self._kernel = kernel.compiled.Steady(parser.scanner, transform, setting, self._rows)
        self._timing = SteadyTiming(None, None, 0, 0)
        self._frames = self._pause = self._wait = 0
        self._read = 0.0, False  # t_host and backlog of the last wait

    def try_enter(self, timeline: Timeline) -> None:
        """Follow the stream from here on, if there is nothing to be decided first."""
        if self._wait:
            self._wait -= 1
            return
        now, place = self._marked.steady(), timeline.place
        if now is None or place is None:
            return
        at, self._timing = now
        origin, last = place
        if origin + at.end != last.first_index + sample_count(last):
            return
        fit, gap_begin = self._timing.fit, -1 if at.gap_begin is None else at.gap_begin
        over = 0 if fit is None else self._line.over(fit)
        self._kernel.enter(
            origin, at.end, gap_begin, at.mark, last.device_time_us, sample_count(last), at.level_v,
            at.noise, at.gap, np.ascontiguousarray(at.volts), self._timing.due, over,
            self._timing.uses, self._fit(),
        )  # fmt: skip
        self._frames, self.entered = 0, True

    def give(self, data: bytes, t_host: float, backlog: bool) -> None:
        """Bytes that were read elsewhere; the waits that follow use them up."""
        self._kernel.give(data, t_host, backlog)

    def wait(self, file: int, timeout_ms: int) -> Waited:
        """Go on to the next event: with the bytes at hand, then with those read from a file.

        Event.MORE where there is none within timeout_ms. Raises OSError where nothing can be read.
        """
        number, found, passed, t_host, backlog = self._kernel.wait(file, timeout_ms)
        self._read = t_host, backlog
        event = Event(number)
        frame = packet = None
        if event is Event.HEARD or event is Event.SILENT:
            self._frames += 1
            frame = self._frame(event, *found)
        elif event is Event.PACKET:
            packet = found
        return Waited(event, passed, frame, packet, t_host, backlog)

    def leave(self) -> Left:
        """Hand the stream over to the stages."""
        (
            end, start, gap_begin, mark, level_v, noise, gap, uses, marks, data, volts,
        ) = self._kernel.leave()  # fmt: skip
        self.entered = False
        self._pause = 0 if self._frames >= SOUND_FRAMES else min(2 * self._pause + 1, MOST_PAUSE)
        self._wait = self._pause
        place = Place(
            end,
            None if start < 0 else start,
            None if gap_begin < 0 or start >= 0 else gap_begin,
            mark,
            np.frombuffer(volts),
            level_v,
            noise,
            gap,
        )
        frames = self._marked.go_on(place, self._timing, marks, uses)
        return Left(frames, data, *self._read)

    @property
    def counts(self) -> dict[str, int]:
        """The scanner's counts as of the last event; may be asked for by any thread."""
        counts: dict[str, int] = self._kernel.counts()
        return counts

    def _frame(
        self, event: Event, start: int, noise_v: float, level_v: float, clipped: float
    ) -> FrameLevels:
        fit, levels = self._line.nominal, None
        if event is Event.HEARD:
            fit, levels = (
                self._timing.fit or fit,
                NodeLevels(self._values, noise_v, rows=self._rows),
            )
            noise_v *= self._root
        begin = float(start) if self._line.integrated else start + fit.start
        return FrameLevels(begin, fit.chip, levels, noise_v, level_v, clipped)

    def _fit(self) -> tuple[object, ...] | None:
        """The timing of the next frames, as the kernel takes it; None where it cannot be used."""
        fit, edges, due, _ = self._timing
        if fit is None or edges is None:
            return None
        size, (begin, stop) = round(fit.end(self._spec) + 0.5), tail_of(fit, self._spec)
        if stop > due or stop - begin < 0.5 * fit.chip or size > due:
            return None
        return (fit.chip, size, begin, stop - begin, *edges.within(due))


def can_follow(timing: MarkedTiming) -> bool:
    """Whether the kernel can follow a stream of such frames."""
    spec = timing.line.spec
    return is_compiled(spec.book) and not spec.scramble


def _setting(line: MarkedLine, info: Info, pace: Pace, gap_size: int) -> list[float]:
    """The numbers of setting_of in the kernel's module_steady.c, in its order."""
    spec, nominal, spare = line.spec, line.nominal, line.spec.spare_rows
    return [
        spec.line_bits,
        spec.order,
        spec.first_row,
        spec.nodes,
        spec.drive == UNIPOLAR,
        math.nan if spec.node_swing_v is None else spec.node_swing_v,
        LOUDEST_FLOOR,
        ACTIVE_SHARE,
        spare.start,
        spare.stop - spare.start,
        line.size,
        line.chip,
        line.least_power,
        blinding_noise_v(spec),
        *within_rails(line.rails_v),
        LIMITS.deafened,
        LIMITS.carried_noise,
        LIMITS.carried_misfit,
        LIMITS.loud,
        info.zero_count,
        info.volts_per_count,
        ABSURD_V,
        gap_size,
        LEAST_REST,
        GAP_WEIGHT,
        LIMITS.rise,
        lowest_power(1e-3),
        line.over(nominal),
        pace.rate_hz,
        CLOCK_SLACK_S,
        pace.ahead_s,
        pace.ahead,
        MAX_DEVICE_TIME_US,
        pace.longest_quiet,
        pace.most_quiet_v2,
        line.integrated,
        line.integrated and line.mean_is_offset,
        round(nominal.end(spec) + 0.5),
        LIMITS.spread,
        LIMITS.misfit,
        LIMITS.left,
        SPOKEN_OVER,
    ]
