# SPDX-License-Identifier: Apache-2.0

"""Which packets of samples are believed: those that go on from others, and what is lost between."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from ..code.frame import FrameSpec
from ..wire.messages import Info, Quiet, Samples

AnySamples: TypeAlias = Samples | Quiet

CLOCK_SLACK_S = 0.05
"""Difference of device time and sample count beyond which one of them was restarted."""
MAX_DEVICE_TIME_US = 1 << 53
"""285 years, and what a float holds without rounding."""
MAX_LEAP_S = 10.0
"""A loss that lasts longer is believed when a second packet confirms it."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A packet, and when it was read, by the host's monotonic clock, s.

    backlog: it had been waiting to be read.
    """

    packet: AnySamples
    t_host: float
    backlog: bool = False


@dataclass(frozen=True, slots=True)
class Pace:
    """How the digitizer's time advances with its count of samples.

    rate_hz: samples per second of what is counted. unsaid: the share by which time may run ahead
    of that, and by slack_s more.
    """

    rate_hz: float
    unsaid: float
    slack_s: float

    @classmethod
    def of(cls, info: Info, spec: FrameSpec) -> Pace:
        """Where chips are integrated, gaps are not counted: time is ahead by one for each frame."""
        if not info.integrated:
            return cls(info.sample_rate_hz, 0.01, CLOCK_SLACK_S)
        gaps = spec.frame_period_s / spec.frame_s - 1
        return cls(info.sample_rate_hz, gaps + 0.01, CLOCK_SLACK_S + spec.frame_period_s)

    def fits(self, before: AnySamples, packet: AnySamples) -> bool:
        """Whether time has advanced from one packet to the other as the count of samples says."""
        counted_s = (packet.first_index - before.first_index) / self.rate_hz
        ahead_s = (packet.device_time_us - before.device_time_us) * 1e-6 - counted_s
        return -CLOCK_SLACK_S <= ahead_s <= self.slack_s + self.unsaid * counted_s


class Continuity:
    """Follows a stream of samples: what goes on, what is lost, and when it begins anew.

    A packet that does not go on from the one before waits: where the next one goes on from it, the
    digitizer has begun anew, or has lost much; else its contents were impossible.
    """

    def __init__(self) -> None:
        self._last: AnySamples | None = None
        self._waiting: Arrival | None = None

    def believed(
        self, arrival: Arrival, pace: Pace, was_reset: bool = False
    ) -> tuple[list[Arrival], int]:
        """What is to be taken now that a packet came, and how many were impossible.

        was_reset: the digitizer said so; then a packet that does not go on needs no other.
        """
        waiting, self._waiting = self._waiting, None
        packet = arrival.packet
        if self._last is None or was_reset or _follows(self._last, packet, pace):
            return [arrival], int(waiting is not None)
        if waiting is not None and _follows(waiting.packet, packet, pace):
            return [waiting, arrival], 0
        self._waiting = arrival
        return [], int(waiting is not None)

    def lost_before(self, packet: AnySamples, pace: Pace) -> int | None:
        """Samples missing between the packet taken last and this one; None: a new beginning."""
        last, self._last = self._last, packet
        if last is None:
            return 0
        missing = packet.first_index - _end(last)
        return missing if missing >= 0 and pace.fits(last, packet) else None


def is_plausible(packet: AnySamples, info: Info, period_s: float) -> bool:
    """Whether a digitizer's clock may get so far, and silence have these sums and last so long."""
    if packet.device_time_us > MAX_DEVICE_TIME_US:
        return False
    if isinstance(packet, Samples):
        return True
    range_v = (info.max_count - info.min_count) * info.volts_per_count
    half_v = 0.5 * (info.quiet_uv * 1e-6 or range_v) + info.volts_per_count
    variance_v2 = packet.variance * info.volts_per_count**2
    return packet.count <= 2 * info.sample_rate_hz * period_s and variance_v2 <= half_v**2


def count_of(packet: AnySamples) -> int:
    """How many samples a packet stands for."""
    return packet.count if isinstance(packet, Quiet) else len(packet.counts)


def _end(packet: AnySamples) -> int:
    """Index of the sample that follows."""
    return packet.first_index + count_of(packet)


def _follows(before: AnySamples, packet: AnySamples, pace: Pace) -> bool:
    """Whether a packet comes after another one, with no more lost than is believed at once."""
    missing = packet.first_index - _end(before)
    return 0 <= missing <= MAX_LEAP_S * pace.rate_hz and pace.fits(before, packet)
