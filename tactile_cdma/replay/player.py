# SPDX-License-Identifier: Apache-2.0

"""Hands out the bytes of a recording when they are due. Knows no ports."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from ..base.errors import CaptureError, SpecError
from ..config.parameters import REPLAY, Parameter, parse_options
from ..config.skin_config import user_path
from ..recording.recording_file import (
    Chunk,
    RecordingParser,
    describe,
    is_recording,
    read_chunks,
    seek,
)
from ..wire.device import Device
from ..wire.messages import Info
from ..wire.packets import PacketParser, PacketWriter

_log = logging.getLogger(__name__)

_LONGEST_S = 1e9
"""Longer than any recording."""
OPTIONS: tuple[Parameter, ...] = (
    Parameter(
        "speed", 1.0, "pace; 1: as it was recorded, 0: as fast as it is read", "", (0.0, 1000.0)
    ),
    Parameter("loop", False, "begin again at the end"),
    Parameter("start", 0.0, "skip what was recorded before", "s", (0.0, _LONGEST_S)),
    Parameter("end", _LONGEST_S, "skip what was recorded after", "s", (0.0, _LONGEST_S)),
)
SLOWEST = 0.1
"""Least speed above 0: a driver takes a slower port for dead."""


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """Says what to replay and how. start_s, end_s: times since the recording began, s."""

    path: Path
    speed: float
    loop: bool
    start_s: float
    end_s: float

    @classmethod
    def from_url(cls, url: str) -> ReplayOptions:
        """Parse replay://FILE?option=value&…; raises SpecError."""
        file, _, query = url[len(REPLAY) :].partition("?")
        if not file:
            raise SpecError("name the recording: replay://FILE, for example replay://touch.skin")
        defaults: dict[str, Any] = {option.name: option.default for option in OPTIONS}
        values = defaults | parse_options(query, OPTIONS, "replay://")
        speed, start_s, end_s = values["speed"], values["start"], values["end"]
        if 0 < speed < SLOWEST:
            raise SpecError(f"option speed is {speed:g}; it must be 0 or at least {SLOWEST:g}")
        if start_s >= end_s:
            raise SpecError(f"option start is {start_s:g} s, which is not before end, {end_s:g} s")
        path = user_path("the recording", unquote(file))
        return cls(path, speed, values["loop"], start_s, end_s)


class Player(Device):
    """Hands out the bytes of a recording at their times, counted from the first call of advance.

    ended: all of them are due or taken; no more will come.
    """

    def __init__(self, options: ReplayOptions, clock: Callable[[], float] = time.monotonic) -> None:
        """Raises CaptureError where there is no recording, SpecError for a span without bytes."""
        super().__init__()
        self._options, self._clock = options, clock
        self.ended = False
        self._notes: tuple[str, ...] = ()
        self._origin_s = math.nan  # host's time of the chunk that begins a round
        path = options.path
        if not is_recording(path):
            raise CaptureError(
                f"{path} is not a recording; tactile-cdma record makes one (bytes alone have no "
                "times: tactile-cdma decode reads these)"
            )
        describe(path)
        self._round = self._chunks()
        first = next(self._round, None)
        if first is None:
            raise SpecError(f"{path} holds no bytes between start and end")
        self._next: Chunk | None = first
        self._first_ns = first.time_ns

    @property
    def farewell(self) -> str:
        """Return the message for the end of the replay, with what the recording lacks."""
        return "the recording has ended" + (f" ({'; '.join(self._notes)})" if self._notes else "")

    def advance(self, wanted: int) -> float:
        """Make due bytes pending, until so many are.

        Returns the seconds until more is due: 0 if there may be more now, infinity at the end.
        Raises CaptureError where the file was removed or changed meanwhile.
        """
        if math.isnan(self._origin_s):
            self._origin_s = self._clock()
        while len(self._output) < wanted and not self.ended:
            if self._next is None:
                _log.debug("%s begins again", self._options.path)
                self._origin_s, self._round = self._clock(), self._chunks()
                if (first := next(self._round, None)) is None:
                    path = self._options.path
                    raise CaptureError(f"{path} was changed: it no longer holds bytes")
                self._next = first
            speed, passed_s = self._options.speed, (self._next.time_ns - self._first_ns) * 1e-9
            wait_s = self._origin_s + passed_s / speed - self._clock() if speed else 0.0
            if wait_s > 0:
                return wait_s
            self._output += self._next.data
            self._next = next(self._round, None)
            self.ended = self._next is None and not self._options.loop
        return math.inf if self.ended else 0.0

    def receive(self, data: bytes) -> None:
        """Ignore what was written: it was answered when it was recorded."""

    def _chunks(self) -> Iterator[Chunk]:
        """Yield chunks of the span that is asked for, first the digitizer's earlier description."""
        options = self._options
        start_ns, end_ns = round(options.start_s * 1e9), round(options.end_s * 1e9)
        parser, position = seek(options.path, start_ns)
        told = not start_ns
        for chunk in read_chunks(options.path, parser, position):
            if chunk.time_ns > end_ns:
                return
            if chunk.time_ns >= start_ns:
                if not told:
                    told = True
                    yield Chunk(chunk.time_ns, self._described())
                yield chunk
        self._notes = parser.losses

    def _described(self) -> bytes:
        """Find the digitizer's description of itself, which comes at a stream's beginning."""
        parser = PacketParser()
        for chunk in read_chunks(self._options.path, RecordingParser()):
            for packet in parser.feed(chunk.data):
                if isinstance(packet, Info):
                    return PacketWriter().encode(packet)
        return b""
