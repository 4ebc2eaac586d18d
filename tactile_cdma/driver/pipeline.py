# SPDX-License-Identifier: Apache-2.0

"""One skin's decoding chain: bytes in, TactileFrames out. No I/O, no ROS."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import asdict, dataclass

import numpy as np

from ..base.errors import SpecError
from ..clocks.clock_keeper import ClockReport
from ..clocks.node_timing import NodeTiming
from ..config.parameters import GAP
from ..config.skin_config import SkinConfig
from ..framing.gap_timing import GapTiming
from ..framing.line_timing import LineTiming
from ..framing.timing import FrameLevels, QuietBlock, SampleBlock
from ..readings.baseline import Baseline
from ..readings.drift import DriftTracker, nodes_beside
from ..readings.pressure import PressureChain
from ..readings.taxels import Readings, Taxels
from ..wire._protocol import MAX_GAP, PacketType, Result
from ..wire.messages import Ack, Info, OtherVersion, Quiet, Samples, Status
from ..wire.packets import MAX_REPEATED, SEQUENCES, PacketParser
from ..words.decode import Words, decode, silent
from ..words.health import NodeHealth
from .agreement import contradiction
from .clock import DeviceClock
from .continuity import (
    CLOCK_SLACK_S,
    AnySamples,
    Arrival,
    Continuity,
    Pace,
    count_of,
    is_plausible,
)

_TICK_S = 1e-6
_LATEST_S = 2.0
"""A host that is busy for longer reads what it can no longer tell from another clock's time."""


@dataclass(frozen=True, slots=True)
class TactileFrame:
    """One decoded frame.

    sequence: counts frame periods on the wire; a gap is the number of frames lost.
    t_start: device time of the first chip, s.
    t_middle: device time of the middle of the frame's chips, s.
    t_host: the same moment on the host's monotonic clock, s.
    chip_s: measured chip duration, s.
    clipped: share of the frame's samples at a rail of the digitizer, 0…1.
    """

    sequence: int
    t_start: float
    t_middle: float
    t_host: float
    chip_s: float
    clipped: float
    words: Words
    readings: Readings


@dataclass(slots=True)
class PipelineCounters:
    """What happened so far; every number only grows."""

    frames: int = 0
    lost_frames: int = 0
    samples: int = 0
    lost_samples: int = 0
    unannounced_samples: int = 0
    restarts: int = 0
    implausible_packets: int = 0
    skipped_bytes: int = 0


class Pipeline:
    """Feeds the digitizer's bytes through parser, timing, decoder and calibration.

    problem: why nothing can be decoded just now, in one sentence; None while all is well.
    info: the digitizer's last description of itself, None before the first.
    refusal: the last command that the digitizer refused and did not obey since.
    streaming: whether the digitizer says that it streams, by its last STATUS or as it obeyed a
        START since; None while it has said nothing.
    """

    def __init__(
        self, config: SkinConfig, background: bool = True, most_repeated: int = MAX_REPEATED
    ) -> None:
        """background: long work is done beside the stream, else at once.

        Beside the stream, the frames depend on when it is done. most_repeated: see PacketParser.
        """
        self.config = config
        self._background = background
        self._most_repeated = most_repeated
        self.counters = PipelineCounters()
        self.parser = PacketParser(most_repeated)
        nodes = config.spec.nodes
        beside = nodes_beside(config.layout, nodes)
        tracker = DriftTracker(config.adc.lsb_v, beside, config.rest)
        chain = PressureChain(config.calibration, Baseline(nodes), tracker, config.compensator())
        self.taxels = Taxels(nodes, config.adc, chain, config.layout, config.stale_after_s)
        self.health = NodeHealth(config.spec)
        self.threshold = config.threshold
        self.info: Info | None = None
        self.status: Status | None = None
        self.refusal: Ack | None = None
        self.streaming: bool | None = None
        self.problem: str | None = None
        self._earlier_packets: Counter[str] = Counter()
        self._clock = DeviceClock()
        self._timing: LineTiming | NodeTiming | GapTiming | None = None
        self._anchors: deque[tuple[int, float]] = deque(maxlen=4096)
        # From here on samples are counted in here: indices near 2⁶⁴ are no exact floats.
        self._base = 0
        self._continuity = Continuity()
        self._was_reset = False  # by its last STATUS: its clock is younger than its samples
        self._packet_sequence = 0  # of the last packet of samples
        self._sequence = -1
        self._last_start_s: float | None = None
        self._last_t_host = -math.inf

    @property
    def packet_counts(self) -> Counter[str]:
        """The parser's counters, over all connections."""
        return self._earlier_packets + Counter(asdict(self.parser.counters))

    @property
    def rejected(self) -> int:
        """Bursts on the line that were no frame, under the present digitizer set-up."""
        return self._timing.rejected if self._timing else 0

    @property
    def clock_drift_ppm(self) -> float:
        """By how much the digitizer's clock is faster than the host's; NaN until that is known."""
        return self._clock.drift_ppm

    @property
    def clocks(self) -> ClockReport | None:
        """What is known of the nodes' clocks; None where that is not asked."""
        return self._timing.clocks.report if isinstance(self._timing, NodeTiming) else None

    @property
    def _clocks_awaited(self) -> bool:
        """Whether nodes have clocks of their own, and these are not known yet."""
        clocks = self.clocks
        return self.config.roll_call and clocks is not None and not clocks.heard

    @property
    def can_call_roll(self) -> bool:
        """Whether a roll call makes sense: frames are marked and raw, the gap's level is known."""
        return isinstance(self._timing, NodeTiming) and self._timing.rest_known

    def close(self) -> None:
        """End what is done beside the stream."""
        if isinstance(self._timing, NodeTiming):
            self._timing.clocks.close()

    def feed(self, data: bytes, t_host: float, backlog: bool = False) -> list[TactileFrame]:
        """Decode what was read at t_host (monotonic, s). Any split gives the same frames.

        backlog: it had been waiting to be read.
        """
        frames: list[TactileFrame] = []
        for packet in self.parser.feed(data):
            match packet:
                case Samples() | Quiet():
                    frames += self._samples(Arrival(packet, t_host, backlog))
                case Info():
                    self._describe(packet)
                case OtherVersion():
                    self._drop_timing()
                    self.info, self.problem = None, str(packet)
                case Status():
                    self.status, self.streaming = packet, packet.streaming
                    if self._anchors and packet.uptime_us * 1e-6 < self._anchors[-1][1]:
                        self._was_reset = True
                case Ack():
                    self._acknowledged(packet)
        return frames

    def skipped(self, count: int) -> None:
        """So many bytes were left out here, to keep up with the digitizer."""
        self.counters.skipped_bytes += count
        self.parser.skip()

    def adjust(self, config: SkinConfig) -> bool:
        """Take over of another configuration what may change while the stream goes on.

        Returns whether tare and drift stay: they do unless the curves are others.
        """
        before, self.config = self.config, config
        self.threshold = config.threshold
        self.taxels.stale_after_s = config.stale_after_s
        if self.taxels.chain.tracker is not None:
            self.taxels.chain.tracker.rules = config.rest
        self.taxels.refresh()
        if config.calibration is before.calibration and config.compensation == before.compensation:
            return True
        return self.taxels.calibrate(config.calibration, config.compensator())

    def flush(self) -> list[TactileFrame]:
        """At the end of a recording: a last frame that nothing followed."""
        return [self._frame(chips) for chips in self._timing.flush()] if self._timing else []

    def reconnected(self) -> None:
        """The port was opened anew: whatever was under way, or held, is void."""
        # At once, for whoever reads the counts meanwhile.
        self._earlier_packets = self.packet_counts
        self.parser = PacketParser(self._most_repeated)
        self._drop_timing()
        self.info = self.status = self.streaming = self.refusal = self.problem = None
        self._continuity = Continuity()
        self._forget()

    def _drop_timing(self) -> None:
        self.close()
        self._timing = None

    def _acknowledged(self, ack: Ack) -> None:
        if ack.command == PacketType.START and ack.result == Result.OK:
            self.streaming = True
        if ack.result != Result.OK:
            self.refusal = ack
            if ack.command == PacketType.ROLL_CALL and isinstance(self._timing, NodeTiming):
                self._timing.clocks.give_up(
                    f"the digitizer refused the roll call: {ack.result.name.lower()}"
                )
        elif self.refusal and self.refusal.command == ack.command:
            self.refusal = None

    def _describe(self, info: Info) -> None:
        if info == self.info:
            return
        self.info = info
        self._drop_timing()
        self.problem = contradiction(info, self.config)
        if self.problem:
            return
        low_v, high_v = info.volts(np.array([info.min_count, info.max_count], dtype=np.int16))
        spec, rails_v = self.config.spec, (float(low_v), float(high_v))
        try:
            if self.config.timing == GAP:
                self._timing = GapTiming(spec, info.sample_rate_hz, rails_v)
            elif info.integrated or spec.resync_chips:
                self._timing = LineTiming(spec, info.sample_rate_hz, rails_v)
            else:
                self._timing = NodeTiming(spec, info.sample_rate_hz, rails_v, self._background)
        except SpecError as error:
            self.problem = f"the digitizer's sampling does not fit: {error}"

    def _samples(self, arrival: Arrival) -> list[TactileFrame]:
        """The frames that samples complete, or what stands for silent ones."""
        packet = arrival.packet
        if self.info is None or self._timing is None:
            self.counters.unannounced_samples += count_of(packet)
            return []
        spec = self.config.spec
        if not is_plausible(packet, self.info, spec.frame_period_s):
            self.counters.implausible_packets += 1
            return []
        pace = Pace.of(self.info, spec)
        believed, impossible = self._continuity.believed(arrival, pace, self._was_reset)
        self.counters.implausible_packets += impossible
        frames: list[TactileFrame] = []
        for taken in believed:
            self._account(taken, pace)
            frames += [self._frame(heard) for heard in self._heard(taken.packet)]
        return frames

    def _account(self, arrival: Arrival, pace: Pace) -> None:
        """Keep account of samples in index and time."""
        assert self._timing is not None
        packet, t_host = arrival.packet, arrival.t_host
        count, t_device = count_of(packet), packet.device_time_us * 1e-6
        self.counters.samples += count
        lost = self._continuity.lost_before(packet, pace)
        if lost is None:
            self._restart(self._goes_on(packet, t_host))
        elif lost:
            self.counters.lost_samples += lost
            self._timing.reset()
        if not self._anchors:
            self._base = packet.first_index
        self._was_reset = False
        self._packet_sequence = packet.sequence
        self._anchors.append((packet.first_index - self._base, t_device))
        self._clock.observe(t_device + count / pace.rate_hz, t_host, arrival.backlog)

    def _heard(self, packet: AnySamples) -> list[FrameLevels]:
        """What the timing makes of samples."""
        info, timing = self.info, self._timing
        assert info is not None and timing is not None
        index = packet.first_index - self._base
        if isinstance(packet, Samples):
            volts = info.volts(packet.counts)
            return timing.feed(SampleBlock(index, volts, packet.sync, packet.called))
        block = QuietBlock(
            index,
            packet.count,
            (packet.mean - info.zero_count) * info.volts_per_count,
            packet.variance * info.volts_per_count**2,
            packet.sync,
            packet.called,
        )
        return timing.quiet(block)

    def _goes_on(self, packet: AnySamples, t_host: float) -> bool:
        """Whether this is the device time that was known so far, as it is after another START.

        A digitizer that was reset numbers its packets anew, though all that told so may be lost.
        """
        ahead = (packet.sequence - self._packet_sequence) % SEQUENCES
        if self._was_reset or ahead > MAX_GAP:
            return False
        t_device = packet.device_time_us * 1e-6
        late_s = t_host - self._clock.to_host(t_device)
        return t_device > self._anchors[-1][1] and -CLOCK_SLACK_S < late_s < _LATEST_S

    def _restart(self, clock_goes_on: bool) -> None:
        """The digitizer began anew: its count went back, or its clock and count part ways."""
        assert self._timing is not None
        self.counters.restarts += 1
        if clock_goes_on:
            self._anchors.clear()
        else:
            self._forget()
        self._timing.reset()

    def _forget(self) -> None:
        """The device's clock starts anew, and who was heard on the old one was heard too long ago.

        The sequence goes on.
        """
        self._anchors.clear()
        self._clock = DeviceClock()
        self._last_start_s = None
        self.taxels.forget()

    def _frame(self, heard: FrameLevels) -> TactileFrame:
        assert self.info is not None
        spec = self.config.spec
        chip_s = heard.chip_samples / self.info.sample_rate_hz
        t_start = self._device_time(heard.start)
        t_middle = t_start + chip_s * spec.span_chips / 2
        if heard.levels is None:
            words = silent(spec.nodes, heard.noise_rms_v)
        else:
            words = decode(heard.levels, spec, self.threshold, self.health.swing_v)
            if self._clocks_awaited:
                words = words.doubted()
            if heard.tied:
                words = words.doubted()
            else:
                self.health.update(words)
        t_host = self._clock.to_host(t_middle)
        if self._last_start_s is not None:
            passed_s = t_start - self._last_start_s
        elif self._sequence >= 0:  # after a restart only the host knows how long it took
            passed_s = t_host - self._last_t_host
        else:
            passed_s = 0.0
        step = max(1, round(passed_s / spec.frame_period_s))
        self._sequence += step
        self._last_start_s = t_start
        # A better estimate of the clocks may move time back: stamps still rise.
        self._last_t_host = max(t_host, self._last_t_host + _TICK_S)
        self.counters.frames += 1
        self.counters.lost_frames += step - 1
        return TactileFrame(
            sequence=self._sequence,
            t_start=t_start,
            t_middle=t_middle,
            t_host=self._last_t_host,
            chip_s=chip_s,
            clipped=heard.clipped,
            words=words,
            readings=self.taxels.update(words, t_middle, self.health),
        )

    def _device_time(self, index: float) -> float:
        """Device time, s, of a place in the sample stream."""
        assert self.info is not None
        at_or_before = (anchor for anchor in reversed(self._anchors) if anchor[0] <= index)
        first_index, t_device = next(at_or_before, self._anchors[0])
        return t_device + (index - first_index) / self.info.sample_rate_hz
