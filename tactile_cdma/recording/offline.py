# SPDX-License-Identifier: Apache-2.0

"""Decodes files: feeds the stages of a live skin from a recording or a scope's capture."""

import math
from array import array
from bisect import bisect
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..base.arrays import Floats, Indices
from ..base.errors import CaptureError
from ..code.frame import SPARSE
from ..config.parameters import GAP, LINE, NATURAL_SIGNS, Value
from ..config.skin_config import FRAME_PARAMETERS, SkinConfig
from ..driver.clock import RECENT, STEP_S, SURE_INTERVALS, DeviceClock, line_below
from ..driver.digitizer import Source
from ..driver.pipeline import Pipeline, TactileFrame
from ..driver.stream import ABSURD_V
from ..framing.frame_reader import FrameReader
from ..framing.gaps.gap_timing import SIDE_CHIPS, GapTiming
from ..wire._protocol import SyncMode
from ..wire.messages import Info
from ..wire.packets import PacketParser, diagnose
from ..words.words import Words
from .recording_file import describe, is_recording, read_bytes
from .scope_csv import ScopeCapture

_MIN_SAMPLES_PER_CHIP = 3
"""Chosen: with fewer, one of them at an edge, a chip may have no clean sample."""


def decode_scope(capture: ScopeCapture, config: SkinConfig) -> Iterator[tuple[float, Words]]:
    """Yield frames of a scope's capture: start of the first chip on the file's time axis, s; words.

    Raises CaptureError where the capture is too coarse to show single chips.
    """
    spec, samples_per_chip = config.spec, capture.rate_hz * config.spec.chip_s
    if samples_per_chip < _MIN_SAMPLES_PER_CHIP:
        raise CaptureError(
            f"{capture.rate_hz:g} samples/s are {samples_per_chip:.2g} per chip of "
            f"{spec.chip_s * 1e6:g} µs; {_MIN_SAMPLES_PER_CHIP} or more are needed: "
            "record faster, or correct the chip duration (is the first column in s?)"
        )
    for start_s, volts in capture.pieces:
        reader = FrameReader(
            spec, capture.rate_hz, active_share=config.active_share, side_chips=SIDE_CHIPS
        )
        timing = GapTiming(reader, capture.rate_hz)
        checked = np.where(np.abs(volts) < ABSURD_V, volts, np.float32(np.nan))
        for frame in timing.feed(0, checked) + timing.flush():
            if frame.words is not None and frame.speakers:
                yield start_s + frame.start / capture.rate_hz, frame.words


def described_parameters(path: Path) -> dict[str, Value]:
    """Read the frame layout that the digitizer described in a raw capture, as parameters.

    That is the first that it said twice: one said as the port opens may be of before it was
    configured. Raises CaptureError where there is none.
    """
    parser, told = PacketParser(), None
    for packet in (packet for data, _ in read_bytes(path) for packet in parser.feed(data)):
        if isinstance(packet, Info):
            if packet == told:
                break
            told = packet
    if told is None:
        raise CaptureError(f"{path}: {diagnose(parser.counters)}")
    return parameters_of(told)


def parameters_of(info: Info) -> dict[str, Value]:
    """Return the frame layout that a digitizer describes, as parameters."""
    spec = info.frame.spec()
    return {
        **{name: getattr(spec, name) for name in FRAME_PARAMETERS},
        "rate_hz": 0.0,
        "chip_us": spec.chip_s * 1e6,
        "frame_period_ms": spec.frame_period_s * 1e3,
        "sign_seed": NATURAL_SIGNS if spec.sign_seed is None else spec.sign_seed,
        "sync_wire": info.sync_wire.name.lower(),
        "timing": GAP if info.sync_mode == SyncMode.NONE else LINE,
        "samples_per_chip": info.frame.samples_per_chip,
    }


def raw_frames(path: Path, pipeline: Pipeline) -> Iterator[TactileFrame]:
    """Yield frames of a raw capture, with readings."""
    for data, t_host in read_bytes(path):
        yield from pipeline.feed(data, t_host)
    yield from pipeline.flush()


class RawCapture:
    """A recording, or a port's raw bytes, opened to be decoded.

    values: the parameters it is decoded with; config: made of them. Raises CaptureError where it
    cannot be read or describes no digitizer, SpecError for impossible values.
    """

    def __init__(self, path: Path, asked: dict[str, Value]) -> None:
        """asked: parameters that override what the digitizer described.

        That overrides what the recording says was asked of it. The amplitude is learnt unless it is
        given; that of sparse codes cannot be, and is the one that the driver had.
        """
        recorded = describe(path).parameters if is_recording(path) else {}
        described = described_parameters(path)
        self.path = path
        learnt: dict[str, Value] = {} if recorded.get("codes") == SPARSE else {"amplitude_mv": 0.0}
        self.values: dict[str, Value] = {**learnt, **recorded, **described, **asked}
        self.config = SkinConfig.of(self.values)
        self.pipeline = Pipeline(self.config)

    @property
    def source(self) -> Source:
        """Tell which digitizer was recorded, as far as it has been decoded."""
        info = self.pipeline.digitizer.info
        return Source(self.path.name, True, info.digitizer_id if info else None)

    def frames(self) -> Iterator[TactileFrame]:
        return raw_frames(self.path, self.pipeline)

    def timed_frames(self) -> Iterator[tuple[TactileFrame, float]]:
        """Yield all frames, once, each with the Unix time of its middle, s; NaN for raw bytes.

        The file is read twice: the clocks are fitted to all of it before the first frame is
        stamped.
        """
        description = describe(self.path) if is_recording(self.path) else None
        if description is not None:
            clocks = fitted_clocks(self.config, read_bytes(self.path))
            self.pipeline = Pipeline(self.config, clocks=clocks)
        for frame in self.frames():
            yield frame, description.wall_s(frame.t_host) if description else math.nan


SPACING_S = 0.25
"""Device time per kept arrival, s; as of DeviceClock. A day takes 5.5 MB."""
REACH = 60
"""Arrivals before and after a knot that place it. Chosen, 15 s either way: long enough for a prompt
packet among late ones, short enough for a crystal that warms up (tested at 2 ppm in 10 min)."""
REAL_TIME = 0.05
"""Largest rate difference of a device that keeps real time. Chosen: 500 × that of two crystals,
as arrivals are late by varying amounts, and below that of any replay worth its option speed."""


def fitted_clocks(
    config: SkinConfig, reads: Iterable[tuple[bytes, float]]
) -> Callable[[], DeviceClock]:
    """Fit the clocks of a stream, one for each reset of the digitizer, as Timeline asks.

    reads: bytes of the stream, and when they were read, s on the host's monotonic clock.
    A live driver's first stamps rest on its first packets, which may have waited for long. Here a
    first pass notes when packets arrived, and stamps are by a map fitted to all arrivals.
    """
    observed: list[_ObservedClock] = []

    def observing() -> DeviceClock:
        observed.append(_ObservedClock())
        return observed[-1]

    pipeline = Pipeline(config, clocks=observing, frames=False)
    for data, t_host in reads:
        pipeline.feed(data, t_host)
    clocks = iter([_FittedClock(*clock.knots()) if clock.arrivals else clock for clock in observed])
    # A recording may have grown between the passes, and hold another reset.
    return lambda: next(clocks, None) or DeviceClock()


class _ObservedClock(DeviceClock):
    """Notes the earliest arrivals of the whole stream.

    arrivals: how many are kept.
    """

    def __init__(self) -> None:
        super().__init__()
        self._x_s, self._y_s = array("d"), array("d")  # device and host times
        self._place = -1

    @property
    def arrivals(self) -> int:
        return len(self._x_s)

    def observe(self, t_device: float, t_host: float, backlog: bool = False) -> None:
        super().observe(t_device, t_host, backlog)
        place = int(t_device // SPACING_S)
        if place != self._place or not self._x_s:
            self._place = place
            self._x_s.append(t_device)
            self._y_s.append(t_host)
        elif t_host - t_device < self._y_s[-1] - self._x_s[-1]:
            self._x_s[-1], self._y_s[-1] = t_device, t_host

    def knots(self) -> tuple[list[float], list[float], list[float], list[float]]:
        """Return device times, rising, and their host times, s; between them the map is linear.

        Also the device times of all arrivals, and how far the map may be off until the next, s:
        where the clock stood still, or arrivals about there are not on it.
        """
        x, y = np.array(self._x_s), np.array(self._y_s)
        x, first = np.unique(x, return_index=True)
        y = y[first]
        halts = _halts(x, y)
        parts = zip(np.split(x, halts), np.split(y, halts), strict=True)
        x_s, y_s, envelope_s = map(
            np.hstack, zip(*(_knots_of(*part) for part in parts), strict=True)
        )
        late_s = y - envelope_s
        # Later than the map though nothing was prompt since; or the map is later than was possible.
        off_s = np.maximum(np.abs(_earliest(late_s)), np.abs(np.interp(x, x_s, y_s) - envelope_s))
        off_s = np.maximum(off_s, np.append(off_s[1:], 0.0))
        around = np.pad(np.abs(late_s), (RECENT // 2, RECENT // 2 - 1), mode="edge")
        off_s += sliding_window_view(around, RECENT).max(axis=1)
        if len(x_s) > 1:
            paces = np.diff(y_s) / np.diff(x_s)
            unlike_s = np.abs(paces - np.median(paces)) * np.diff(x_s)
            off_s += np.append(unlike_s, 0)[np.searchsorted(x_s, x, "right") - 1]
        return x_s.tolist(), y_s.tolist(), x.tolist(), off_s.tolist()


class _FittedClock(DeviceClock):
    """Learns as any clock, by which the timeline tells restarts, and stamps by knots."""

    def __init__(
        self, x_s: list[float], y_s: list[float], arrivals_s: list[float], errors_s: list[float]
    ) -> None:
        """See _ObservedClock.knots."""
        super().__init__()
        self._x_s, self._y_s = x_s, y_s
        self._arrivals_s, self._errors_s = arrivals_s, errors_s

    def error_s(self, t_device: float) -> float:
        return self._errors_s[max(bisect(self._arrivals_s, t_device) - 1, 0)]

    def to_host(self, t_device: float) -> float:
        x_s, y_s = self._x_s, self._y_s
        if len(x_s) < 2:
            return y_s[0] + (t_device - x_s[0])
        i = min(max(bisect(x_s, t_device), 1), len(x_s) - 1)  # the knot after it
        rate = (y_s[i] - y_s[i - 1]) / (x_s[i] - x_s[i - 1])
        return y_s[i] + (t_device - x_s[i]) * rate


def _halts(x: Floats, y: Floats) -> Indices:
    """Find where all arrivals within REACH are later than those before by STEP_S, from there on.

    There the device's clock has stood still, with the device; a bus soon delivers promptly again.
    Not looked for within RECENT arrivals of either end, nor where the device has a pace of its own.
    """
    if len(x) < 2 * RECENT:
        return np.empty(0, np.intp)
    pace = float(np.median(np.diff(y) / np.diff(x)))
    if abs(pace - 1) > REAL_TIME:
        return np.empty(0, np.intp)
    halts: Indices = np.flatnonzero(np.diff(_earliest(y - y[0] - pace * (x - x[0]))) > STEP_S) + 1
    return halts[(halts >= RECENT) & (halts <= len(x) - RECENT)]


def _earliest(late_s: Floats) -> Floats:
    """Tell by how much arrivals were late at least, from each one on, within REACH."""
    ahead = np.pad(late_s, (0, REACH - 1), constant_values=np.inf)
    return np.asarray(sliding_window_view(ahead, REACH).min(axis=1))


def _knots_of(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the knots, as _ObservedClock.knots, of a clock that never stands still; (m,) s.

    Also the host times of all arrivals, had they been as prompt as the promptest of those around.
    """
    pace = float(np.median(np.diff(y) / np.diff(x))) if len(x) >= RECENT else 1.0
    if abs(pace - 1) > REAL_TIME:  # a simulation or a replay
        late_s = np.pad(y - pace * x, RECENT, constant_values=np.inf)
        around = sliding_window_view(late_s, 2 * RECENT + 1)
        return x, np.maximum.accumulate(y), pace * x + around.min(axis=1)
    last = len(x) - 1
    places = np.linspace(0, last, 1 + -(-last // REACH)).round().astype(int)
    hosts = []
    for place in places:
        near = slice(max(0, place - REACH), place + REACH + 1)
        # Differences to the knot keep the precision over weeks of device time.
        _, offset_s = line_below(x[near] - x[place], y[near] - y[place], SURE_INTERVALS)
        hosts.append(float(y[place]) + offset_s)
    return x[places], np.array(hosts), np.interp(x, x[places], hosts)
