# SPDX-License-Identifier: Apache-2.0

"""Times of samples and frames: index ──▶ the digitizer's clock ──▶ the host's."""

import logging
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from ..base.arrays import Floats, Indices
from ..code.frame import FrameSpec
from ..framing.frames import LineFrame

_log = logging.getLogger(__name__)

MAX_RATE_ERROR = 1e-3
"""Largest rate difference of two clocks; a steeper fit is jitter of the bus. Chosen: ten times what
two crystals of 50 ppm can differ by."""
INTERVAL_S, KEPT_INTERVALS = 0.25, 120
"""Device time per kept observation, s; observations kept: 30 s of them. Chosen."""
SURE_INTERVALS = 40
"""Kept observations from which the rate is shown to people: 1 ms of jitter is 55 ppm then."""
RECENT = 8
"""Newest observations that tell the pace of a slow device; also the fewest from which the rate of a
clock is fitted. Chosen: 2 s of them."""
SLOW_S, FALLS_BEHIND_S = 0.5, 0.005
"""s; a device is not a clock but a slow replay or emulation if the RECENT newest observations are
later than earlier ones by SLOW_S, though nothing had been waiting to be read (crystals come to
0.03 s in 30 s), and each pair of them is later than the one before by FALLS_BEHIND_S. What a
stalled bus or a busy host held back is late, too, but ever less so, or by what buffers hold."""
SURE = 4
"""Newest observations that tell a step of the clock; also the fewest by which a map is more than a
guess. Chosen: 1 s of them."""
STEP_S, STEADY_S = 0.005, 0.002
"""s; the clock stood still, or is slow, if the SURE newest observations are later than the line by
STEP_S though nothing had been waiting to be read, and on a line of their own that is no faster than
a clock may be: within STEADY_S of it, or what is usual on this link. Chosen: USB polls every ms;
what a busy host or a congested network holds up arrives by fits and starts."""
LEAST_ERROR_S = 1e-3
"""s; what no arrival tells: the shortest delay of the link, and by how much more the earliest of a
second's arrivals was delayed. Chosen: a frame of full-speed USB."""
FASTER = 0.95
"""Share of the told period; frames that usually come sooner are counted by their own. Chosen:
starts of frames scatter by less, and a period that is off by so much, by one frame in twenty."""
MISSED = 1.5
"""Times the shortest of the RECENT newest ways from frame to frame, from which on one may have been
lost between two. Chosen: the middle, as frames that are heard need not be on a raster."""
MAX_ANCHORS = 4096
"""Packets whose device times are kept, for frames that began in them. Chosen: a frame spans fewer,
as a packet holds hundreds of samples."""
TICK_S = 1e-6
"""s; stamps rise by at least one unit of device time."""
_TOUCH_S = 1e-9
"""s; a point that is less below a line is on it, but for rounding."""


class AcceptedPacket(NamedTuple):
    """What is kept of a packet of samples that was accepted; samples: their number."""

    first_index: int
    device_time_us: int
    samples: int
    sequence: int


PassedPacket: TypeAlias = tuple[int, int, int, int, float, bool]
"""An accepted packet: index in the stream, device time (µs), number of samples, sequence; and as of
an Arrival t_host (s) and backlog."""


class Stamp(NamedTuple):
    """Number and times of one frame; see TactileFrame."""

    sequence: int
    t_start: float
    t_middle: float
    t_host: float
    stamp_uncertainty_s: float
    chip_s: float


@dataclass(slots=True)
class StreamCounters:
    """What happened to the stream so far; every number only grows."""

    frames: int = 0
    lost_frames: int = 0
    samples: int = 0
    lost_samples: int = 0
    unannounced_samples: int = 0
    restarts: int = 0
    clock_steps: int = 0
    implausible_packets: int = 0
    skipped_bytes: int = 0


class FrameTimes:
    """Follows the count of samples and the digitizer's clock, and gives frames number and time.

    clock: maps device time to host time. last: the packet of samples that was accepted last.
    origin: the digitizer's index of the stream's index 0. missed: before the last frame there may
    have been another, since the one that was heard before it.
    """

    def __init__(self, counters: StreamCounters, clocks: Callable[[], "DeviceClock"]) -> None:
        """counters: of samples and frames. clocks: makes one for each that the device has."""
        self.clock, self.origin = clocks(), 0
        self.last: AcceptedPacket | None = None
        self._clocks, self._counters = clocks, counters
        self._anchors: deque[PassedPacket] = deque(maxlen=MAX_ANCHORS)
        self._sequence, self._number, self.missed = -1, -1, False
        self._last_start_s: float | None = None  # of the last frame, if on the present clock
        self._ways_s = deque[float](maxlen=RECENT)  # from frame to frame; no samples were missing
        self._tears = deque[int](maxlen=MAX_ANCHORS)  # before these samples are missing
        self._last_t_host = -math.inf
        self._arrival = 0.0, 0.0  # of the last packet: device time of its end, host time

    def begin_clock(self) -> None:
        """Forget the device's clock: the next packet is of another one."""
        self.clock, self._last_start_s = self._clocks(), None
        self._ways_s.clear()
        self.begin_count()

    def begin_count(self) -> None:
        """Forget the count of samples: the next packet's begins anew."""
        self._anchors.clear()
        self._tears.clear()

    def tear(self, first_index: int) -> None:
        """Note that samples are missing before this one, by the digitizer's index."""
        self._tears.append(first_index - self.origin)

    def count_from(self, first_index: int) -> None:
        """Begin the count anew at this index of the digitizer's."""
        if not self._anchors:
            self.origin = first_index

    def passed(self, packets: list[PassedPacket], rate_hz: float) -> None:
        """Enter packets that the stream has accepted, one at least."""
        clock, samples = self.clock, 0
        for _, device_time_us, count, _, t_host, backlog in packets:
            samples += count
            t_device = device_time_us * 1e-6 + count / rate_hz
            if not (clock.from_s <= t_device < clock.to_s and t_host - t_device >= clock.lead_s):
                clock.observe(t_device, t_host, backlog)
        self._counters.samples += samples
        self._anchors.extend(packets)
        self._arrival = t_device, t_host
        index, device_time_us, count, sequence, *_ = packets[-1]
        self.last = AcceptedPacket(self.origin + index, device_time_us, count, sequence)

    def stamp(self, heard: LineFrame, rate_hz: float, spec: FrameSpec) -> Stamp:
        """Number and times of the next frame."""
        clock, chip_s = self.clock, heard.chip_samples / rate_hz
        start = heard.start
        for packet in reversed(self._anchors):  # the last one that begins before the frame
            if packet[0] <= start:
                break
        t_start = packet[1] * 1e-6 + (start - packet[0]) / rate_hz
        t_middle = t_start + chip_s * spec.span_chips / 2
        t_host = clock.to_host(t_middle)
        left_s, arrived_s = self._arrival
        late_s = arrived_s - clock.to_host(left_s)
        passed_s = 0.0
        if self._last_start_s is not None:
            passed_s = t_start - self._last_start_s
        elif self._sequence >= 0:  # after a reset only the host knows how long that took
            passed_s = t_host - self._last_t_host
        usual_s = sorted(self._ways_s)[len(self._ways_s) // 2] if self._ways_s else math.inf
        is_faster = usual_s < FASTER * spec.frame_period_s
        periods = max(1, round(passed_s / (usual_s if is_faster else spec.frame_period_s)))
        # The period is what a user says: if frames come faster, some can be lost within one.
        torn = self._passes_tear(start + heard.chip_samples * spec.span_chips / 2)
        least_s = min(self._ways_s, default=0.0)
        self.missed = periods > 1 or (bool(torn or least_s) and passed_s >= MISSED * least_s)
        if self._last_start_s is not None and not torn:
            self._ways_s.append(passed_s)
        self._last_start_s = t_start
        error_s = self._rise(periods, t_host, max(late_s, clock.error_s(t_middle)))
        return Stamp(self._sequence, t_start, t_middle, self._last_t_host, error_s, chip_s)

    def stamp_reading(
        self, number: int, t_device: float, arrived: tuple[float, bool], period_s: float
    ) -> Stamp:
        """Number and times of a frame that a source measured at t_device, s, and counts itself.

        arrived: when it was read, s, and whether it had waited.
        """
        clock = self.clock
        clock.observe(t_device, *arrived)
        t_host = clock.to_host(t_device)
        passed = number - self._number
        if self._last_start_s is None:  # after a reset only the host knows how long that took
            passed = round((t_host - self._last_t_host) / period_s) if self._sequence >= 0 else 1
        self._number, self._last_start_s = number, t_device
        error_s = max(arrived[0] - t_host, clock.error_s(t_device))
        error_s = self._rise(max(1, passed), t_host, error_s)
        return Stamp(self._sequence, t_device, t_device, self._last_t_host, error_s, math.nan)

    def _rise(self, periods: int, t_host: float, error_s: float) -> float:
        """Go on to a frame so many periods later; returns by what its t_host may be off, s.

        error_s: of the clock, and how late the packet came: the frame was over then.
        """
        # A better estimate of the clock may move time back: stamps still rise.
        self._last_t_host = max(t_host, self._last_t_host + TICK_S)
        self._sequence += periods
        self._counters.frames += 1
        self._counters.lost_frames += periods - 1
        if self.clock.steps:
            self._counters.clock_steps += self.clock.take_steps()
        return LEAST_ERROR_S + max(error_s, self._last_t_host - t_host)

    def _passes_tear(self, index: float) -> bool:
        """Forget the tears up to this index of the stream; returns whether there was one."""
        waiting = len(self._tears)
        while self._tears and self._tears[0] <= index:
            self._tears.popleft()
        return len(self._tears) < waiting


class DeviceClock:
    """Maps device time to host time, both in s, from the arrival times of packets.

    A packet arrives late by a varying amount, and never early. So the map is a line that no arrival
    lies below, the one closest to the earliest arrivals of all intervals (Moon, Skelly and Towsley
    1999, "Estimation and removal of clock skew from network delay measurements"). Arrivals later
    than clocks can explain are left out.

    A clock that stood still, with its device, makes all arrivals later from then on, and by the
    same amount; that is a step, after which the line is that of the arrivals since. A device slower
    than real time, such as a replay at half speed, or one whose clock is no crystal, is followed at
    its own pace. Otherwise its frames would be stamped ever farther in the past.

    from_s, to_s, lead_s: an arrival of a packet that left the device between these, s, says nothing
    new if host time is ahead of device time by lead_s, s, or more: it need not be observed.
    steps: how often the clock was found to have stepped since the last `take_steps`.
    """

    def __init__(self) -> None:
        self.from_s = self.to_s = 0.0
        self.lead_s = 0.0  # of the newest observation
        # A ring: the newest observation takes the place of the oldest.
        self._device, self._host = np.zeros((2, KEPT_INTERVALS))
        self._is_backlog = np.zeros(KEPT_INTERVALS, dtype=bool)
        self._count = 0
        self._rate = 1.0
        self._origin = (0.0, 0.0)
        self._fitted = True
        self._is_slow = False
        self.steps = 0
        self._scatter_s = 0.0  # of the newest observations about the line

    def observe(self, t_device: float, t_host: float, backlog: bool = False) -> None:
        """Note when a packet left and was read, s; backlog: it may have come long before."""
        is_first = not self.from_s <= t_device < self.to_s
        if is_first:
            self.from_s = t_device // INTERVAL_S * INTERVAL_S
            self.to_s = self.from_s + INTERVAL_S
            self._count += 1
        elif t_host - t_device >= self.lead_s:
            return
        newest = (self._count - 1) % self._device.size
        self._device[newest], self._host[newest] = t_device, t_host
        self._is_backlog[newest] = backlog
        self.lead_s = t_host - t_device
        # Others move the line little, and at the next interval's fit.
        self._fitted = self._fitted and not is_first and t_host >= self.to_host(t_device)

    def error_s(self, t_device: float) -> float:
        """Tell how far the map may be off though packets are in time, s; infinite for a guess."""
        if self._count < SURE:
            return math.inf
        return max(self._scatter_s, STEP_S if self._is_slow or self._count < RECENT else 0.0)

    @property
    def drift_ppm(self) -> float:
        """Return the rate of the device's clock less the host's, ppm; NaN until it is known."""
        known = self._is_slow or self._count >= SURE_INTERVALS
        return (1 / self._rate - 1) * 1e6 if known else np.nan

    def take_steps(self) -> int:
        """Count the steps of the clock that were found since the last call."""
        steps, self.steps = self.steps, 0
        return steps

    def to_host(self, t_device: float) -> float:
        """Map a device time to host time by the packets observed so far, s."""
        if not self._fitted:
            self._fit()
        t_s, host_s = self._origin
        return host_s + (t_device - t_s) * self._rate

    def _fit(self) -> None:
        self._fitted = True
        if self._is_slow:
            self._keep(RECENT)
        self._lay()
        if self._is_behind():
            _log.debug("the device's clock stood still, or is slow")
            self._keep(SURE)
            self.steps += 1
            self._is_slow = True  # unless its pace is that of a clock
            self._lay()

    def _lay(self) -> None:
        """Lay the line below the observations that are kept."""
        kept = min(self._count, self._device.size)
        device, host = float(self._device[0]), float(self._host[0])
        # Differences to one observation keep the precision over weeks of device time.
        x, y = self._device[:kept] - device, self._host[:kept] - host
        if self._is_slow:
            self._rate, offset_s = _own_line(x, y)
            self._is_slow = self._rate > 1 + MAX_RATE_ERROR
        else:
            self._rate, offset_s = line_below(x, y, RECENT)
        self._origin = device, host + offset_s

    def _is_behind(self) -> bool:
        """Tell whether the newest arrivals are late as no bus or host makes them."""
        sure = self._newest(SURE)
        sure_s = sorted(self._late_s(sure).tolist())
        self._scatter_s = self._scatter(sure_s)
        if self._count <= SURE or sure_s[0] <= STEP_S or self._is_backlog[sure].any():
            return False
        late_s = self._late_s(self._newest(KEPT_INTERVALS))
        had_waited = self._is_backlog[self._newest(RECENT)]
        x, y = self._device[sure], self._host[sure]
        x, y = x - x[-1], y - y[-1]
        rate, offset_s = _own_line(x, y)
        usual_s = min(4 * float(np.quantile(late_s[:-SURE], 0.25)), 0.1 * sure_s[0])
        if (y - rate * x).max() - offset_s <= max(STEADY_S, usual_s):
            return True
        if had_waited.any() or len(late_s) < RECENT or late_s[-RECENT:].min() <= SLOW_S:
            return False
        earliest_s = late_s[-RECENT:].reshape(-1, 2).min(axis=1)
        return bool((earliest_s[1:] > earliest_s[:-1] + FALLS_BEHIND_S).all())

    def _scatter(self, sure_s: list[float]) -> float:
        """Tell how far off the map may be as arrivals scatter, s. sure_s: how late the newest are.

        Measured, by seven of eight about a line of their own: under 30 ms of jitter no stamp is off
        by more.
        """
        if self._count < RECENT:
            return 3 * sure_s[-1]
        recent = self._newest(RECENT)
        x, y = self._device[recent], self._host[recent]
        x, y = x - x[-1], y - y[-1]
        own_s = np.sort(y - _rate_below(x, y) * x)
        return max(sure_s[2], float(own_s[-2] - own_s[0]))

    def _late_s(self, places: Indices) -> Floats:
        """Tell how much later than by the last fit the observations at these places were, s."""
        device, host = self._origin
        return self._host[places] - host - (self._device[places] - device) * self._rate

    def _newest(self, count: int) -> Indices:
        """Return the places of so many observations, or all, the newest last."""
        kept = min(self._count, self._device.size, count)
        return np.arange(self._count - kept, self._count) % self._device.size

    def _keep(self, count: int) -> None:
        """Forget all but so many of the newest observations."""
        newest = self._newest(count)
        for kept in (self._device, self._host, self._is_backlog):
            kept[: newest.size] = kept[newest]
        self._count = newest.size


def line_below(x: Floats, y: Floats, fewest: int) -> tuple[float, float]:
    """Find rate and offset, s, of the line that no arrival lies below: y ≥ rate·x + offset.

    x, y: (m,), s, device and host times of arrivals. fewest: timely ones from which a rate is
    fitted; with fewer it is 1.
    """
    late_s = y - x
    timely = late_s - late_s.min() <= MAX_RATE_ERROR * np.ptp(x)
    rate = 1.0
    if not timely.all():
        x, y = x[timely], y[timely]
    if x.size >= fewest:
        rate = min(max(_rate_below(x, y), 1 - MAX_RATE_ERROR), 1 + MAX_RATE_ERROR)
    return rate, float((y - rate * x).min())


def _own_line(x: Floats, y: Floats) -> tuple[float, float]:
    """Find the line below the arrivals of a device that may be slow, but not fast."""
    rate = max(_rate_below(x, y), 1 - MAX_RATE_ERROR)
    return rate, float((y - rate * x).min())


def _rate_below(x: Floats, y: Floats) -> float:
    """Find the slope of the line below all points with the least sum of distances to them.

    It is the edge of their lower convex hull that spans the mean x: starting with one point on
    either side, replace one by the lowest point until no point lies below the line through both.
    """
    beyond, late_s = x > x.mean(), y - x
    left, right = (int(np.where(away, np.inf, late_s).argmin()) for away in (beyond, ~beyond))
    while True:
        rate = float((y[right] - y[left]) / (x[right] - x[left]))
        above = y - y[left] - rate * (x - x[left])
        lowest = int(above.argmin())
        if above[lowest] > -_TOUCH_S:
            return rate
        if beyond[lowest]:
            right = lowest
        else:
            left = lowest
