# SPDX-License-Identifier: Apache-2.0

"""Tells losses, restarts and resets: where packets belong that do not continue the stream."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, IntEnum, auto
from typing import NamedTuple, TypeAlias

from ..code.frame import FrameSpec
from ..wire._protocol import MAX_GAP
from ..wire.messages import Info, Quiet, Samples, Status
from ..wire.packets import SEQUENCES
from .clock import MAX_RATE_ERROR, AcceptedPacket, DeviceClock, FrameTimes, StreamCounters

_log = logging.getLogger(__name__)


AnySamples: TypeAlias = Samples | Quiet | AcceptedPacket

CLOCK_SLACK_S = 1e-3
"""s; device time and sample count that part by more from packet to packet are not those of one
stream. One crystal makes both: the firmware here computes the time from the count, to a µs. Chosen:
for digitizers that read the time when they begin a packet."""
CLOCK_TOLERANCE = MAX_RATE_ERROR
"""Share by which they may part, too: the count may be a crystal's of its own."""
LEAST_GAP = 0.5
"""Share of the gap between two frames that lies between them at least. Chosen."""
EARLY_S = 0.05
"""s; a packet that is read earlier than expected by more is one of another clock. Chosen: the first
packets of a stream, by which the others are expected, may be so late on a busy host."""
MAX_DEVICE_TIME_US = 1 << 53
"""µs; 285 years, and the largest range in which a float holds every microsecond."""
MAX_LEAP_S = 10.0
"""s; a longer loss counts only if a second packet confirms it. Chosen: a cable that is out for as
long usually closes the port, and impossible indices are mostly farther off."""
MAX_LATE_S = 2.0
"""s; a packet that seems to be read later than this counts as one of another clock. Chosen: a busy
host is seldom held up for longer."""


class Step(Enum):
    """Says how a packet of samples relates to the one before."""

    CONTINUES = auto()
    """Nothing is missing in between."""
    LOSS = auto()
    """Samples are missing in between."""
    RESTART = auto()
    """The digitizer counts samples anew, as after another START; its clock goes on."""
    RESET = auto()
    """The digitizer's clock began anew, too, or stepped."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A packet, when it was read, s, host's monotonic clock, and whether it waited (backlog)."""

    packet: Samples | Quiet
    t_host: float
    backlog: bool = False


class Answer(IntEnum):
    """Says what becomes of a packet that does not continue the stream: stream_answer in C.

    HOLD and TAKE forget the packet that was held back; TAKE_HELD takes that one first, and asks
    again.
    """

    IGNORE = 0
    HOLD = 1
    TAKE = 2
    TAKE_HELD = 3


class Placement(NamedTuple):
    """Tells where a packet belongs that does not continue the stream.

    origin: the digitizer's index of the stream's index 0, which is that of the first sample after a
    restart: the digitizer's come near 2⁶⁴ and are no exact floats.
    """

    answer: Answer
    origin: int = 0
    step: Step = Step.CONTINUES


class Pace:
    """Limits what packets of samples may claim, by the digitizer's description of itself.

    gap_s, gaps: s, and share of the time counted, by which device time may run ahead of the count
        where a gap may lie in between: of integrated samples, there are none in gaps. least_gap_s:
        by which it does so from a frame to the next mark, or a packet was repeated.
    most_quiet: samples that a Quiet may stand for. most_quiet_v2: their variance, V².
    rate_hz: of samples, as described.

    Every public attribute becomes a field of the kernel's struct stream_rules, see limits: what is
    none of its fields has to begin with an underscore.
    """

    def __init__(self, info: Info, spec: FrameSpec) -> None:
        self.rate_hz = info.sample_rate_hz
        self.gap_s = spec.frame_period_s if info.integrated else 0.0
        self.gaps = self.gap_s / spec.frame_s - 1 if info.integrated else 0.0
        self.least_gap_s = LEAST_GAP * max(self.gap_s - spec.frame_s, 0.0)
        range_v = (info.max_count - info.min_count) * info.volts_per_count
        deviation_v = 0.5 * (info.quiet_uv * 1e-6 or range_v) + info.volts_per_count
        self.most_quiet_v2, self._v2_per_count = deviation_v**2, info.volts_per_count**2
        self.most_quiet = 2 * self.rate_hz * spec.frame_period_s

    @property
    def limits(self) -> dict[str, float]:
        """Return all of them, as the kernel's struct stream_rules names them."""
        common = {"slack_s": CLOCK_SLACK_S, "slack": CLOCK_TOLERANCE}
        own = {name: value for name, value in vars(self).items() if not name.startswith("_")}
        return {**common, **own, "most_device_us": MAX_DEVICE_TIME_US}

    def is_plausible(self, packet: Samples | Quiet) -> bool:
        """Tell whether a clock can show this time, and silence last so long and vary so much."""
        if packet.device_time_us > MAX_DEVICE_TIME_US:
            return False
        return isinstance(packet, Samples) or (
            packet.count <= self.most_quiet
            and packet.variance * self._v2_per_count <= self.most_quiet_v2
        )

    def fits(self, before: AnySamples, packet: Samples | Quiet) -> bool:
        """Tell whether device time advanced between two packets as the count of samples says."""
        counted_s = (packet.first_index - before.first_index) / self.rate_hz
        ahead_s = (packet.device_time_us - before.device_time_us) * 1e-6 - counted_s
        slack_s, least_s, gap_s = CLOCK_SLACK_S + CLOCK_TOLERANCE * counted_s, 0.0, 0.0
        if packet.sync or packet.first_index != end_index(before):
            gap_s = self.gap_s + self.gaps * counted_s
        if packet.sync and packet.first_index == end_index(before):
            least_s = self.least_gap_s
        return least_s - slack_s <= ahead_s <= slack_s + gap_s

    def follows(self, before: AnySamples, packet: Samples | Quiet) -> bool:
        """Tell whether a packet continues the stream after another, with a short loss at most."""
        missing = packet.first_index - end_index(before)
        return 0 <= missing <= MAX_LEAP_S * self.rate_hz and self.fits(before, packet)


class Timeline:
    """Decides where a packet belongs that does not simply continue the stream.

    Whether samples were lost, and whether the digitizer was restarted or reset, is decided here and
    nowhere else, when the stream asks where a packet belongs. That packet is held back. If the next
    one continues it, the digitizer was restarted or much was lost; otherwise its contents were
    impossible.

    times: of the packets that the stream has accepted, and of frames.
    """

    def __init__(
        self, counters: StreamCounters, clocks: Callable[[], DeviceClock] = DeviceClock
    ) -> None:
        """counters: where packets, samples and frames are counted. clocks: see FrameTimes."""
        self.times = FrameTimes(counters, clocks)
        self._counters = counters
        self._held: Arrival | None = None
        # The last packet before a STATUS of a younger clock, until another one is accepted.
        self._told_reset_after: AcceptedPacket | None = None

    def reconnected(self) -> None:
        """Start anew on another connection; the frames' sequence goes on."""
        self.times.last = self._held = None
        self.times.begin_clock()

    def hear_status(self, status: Status) -> None:
        """Compare a STATUS with the samples before: a digitizer that was reset is younger."""
        last = self.times.last
        if last is not None and status.uptime_us < last.device_time_us:
            self._told_reset_after = last

    @property
    def _told_reset(self) -> bool:
        """Tell whether a STATUS since showed the device's clock younger than the last samples."""
        return self._told_reset_after is not None and self._told_reset_after is self.times.last

    def place(self, arrival: Arrival, pace: Pace) -> Placement:
        """Tell where a packet belongs that does not simply continue the stream; see Answer."""
        packet, held, last = arrival.packet, self._held, self.times.last
        if not pace.is_plausible(packet):
            self._counters.implausible_packets += 1
            return Placement(Answer.IGNORE)
        if last is not None and pace.follows(last, packet):
            self._drop_held()
            missing = packet.first_index - end_index(last)
            self._counters.lost_samples += missing
            return self._begin(Answer.TAKE, packet, Step.LOSS if missing else Step.CONTINUES)
        if last is not None and not self._told_reset:
            if held is not None and pace.follows(held.packet, packet):
                self._held = None
                return self._begin(Answer.TAKE_HELD, held.packet, self._step(held, pace))
            self._drop_held()
            self._held = arrival
            return Placement(Answer.HOLD)
        self._drop_held()
        return self._begin(Answer.TAKE, packet, self._step(arrival, pace))

    def _drop_held(self) -> None:
        """Forget the packet that is held back: nothing has continued it."""
        self._counters.implausible_packets += self._held is not None
        self._held = None

    def _begin(self, answer: Answer, packet: Samples | Quiet, step: Step) -> Placement:
        """Let a packet be accepted, as the first of another stream after a restart or reset."""
        if step is Step.RESET:
            self.times.begin_clock()
        elif step is Step.RESTART:
            self.times.begin_count()
        self.times.count_from(packet.first_index)
        if step is not Step.CONTINUES:
            self.times.tear(packet.first_index)
            _log.debug("%s before sample %d", step.name.lower(), packet.first_index)
        return Placement(answer, self.times.origin, step)

    def _step(self, arrival: Arrival, pace: Pace) -> Step:
        """Tell how an accepted packet relates to the one before; counts what was lost."""
        packet, last = arrival.packet, self.times.last
        if last is None:
            return Step.CONTINUES
        missing = packet.first_index - end_index(last)
        if missing >= 0 and pace.fits(last, packet):
            self._counters.lost_samples += missing
            return Step.LOSS if missing else Step.CONTINUES
        # A digitizer that was reset restarts packet numbering, though all that says so may be lost.
        renumbered = (packet.sequence - last.sequence) % SEQUENCES > MAX_GAP
        if missing >= 0 and not (renumbered or self._told_reset):
            self._counters.clock_steps += 1  # the count goes on, device time does not
            return Step.RESET
        self._counters.restarts += 1
        if self._told_reset or renumbered or packet.device_time_us <= last.device_time_us:
            return Step.RESET
        late_s = arrival.t_host - self.times.clock.to_host(packet.device_time_us * 1e-6)
        return Step.RESTART if -EARLY_S < late_s < MAX_LATE_S else Step.RESET


def sample_count(packet: AnySamples) -> int:
    """Number of samples that a packet stands for."""
    if isinstance(packet, Samples):
        return len(packet.counts)
    return packet.count if isinstance(packet, Quiet) else packet.samples


def end_index(packet: AnySamples) -> int:
    """Return the index of the sample that follows a packet."""
    return packet.first_index + sample_count(packet)
