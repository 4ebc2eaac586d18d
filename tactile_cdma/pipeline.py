# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""One skin's decoding chain: bytes in, TactileFrames out. No I/O, no ROS."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import asdict, dataclass, fields

import numpy as np

from ._protocol import PacketType, Result, SyncMode
from .baseline import Baseline
from .clock import DeviceClock
from .clock_keeper import ClockReport
from .decode import Words, decode, silent
from .drift import DriftTracker, nodes_beside
from .errors import SpecError
from .gap_timing import GapTiming
from .health import NodeHealth
from .line_timing import LineTiming
from .messages import (
    Ack,
    FrameLayout,
    Info,
    OtherVersion,
    Quiet,
    Samples,
    Status,
)
from .node_timing import NodeTiming
from .parameters import GAP
from .pressure import PressureChain
from .protocol import PacketParser
from .silence import quiet_uv
from .skin_config import SkinConfig
from .taxels import Readings, Taxels
from .timing import FrameLevels, QuietBlock, SampleBlock

_TICK_S = 1e-6
_CLOCK_SLACK_S = 0.05
"""Difference of device time and sample count beyond which one of them was restarted."""
_MAX_DEVICE_TIME_US = 1 << 53
"""285 years, and what a float holds without rounding."""
_MAX_SAMPLES_PER_CHIP = 1000


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
    """

    def __init__(self, config: SkinConfig, background: bool = True) -> None:
        """background: long work is done beside the stream, else at once.

        Beside the stream, the frames depend on when it is done.
        """
        self.config = config
        self._background = background
        self.counters = PipelineCounters()
        self.parser = PacketParser()
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
        self.problem: str | None = None
        self._earlier_packets: Counter[str] = Counter()
        self._clock = DeviceClock()
        self._timing: LineTiming | GapTiming | None = None
        self._anchors: deque[tuple[int, float]] = deque(maxlen=4096)
        self._next_index: int | None = None
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

    def feed(self, data: bytes, t_host: float) -> list[TactileFrame]:
        """Decode what was read at t_host (monotonic, s). Any split gives the same frames."""
        frames: list[TactileFrame] = []
        for packet in self.parser.feed(data):
            match packet:
                case Samples():
                    frames += self._samples(packet, t_host)
                case Quiet():
                    frames += self._quiet(packet, t_host)
                case Info():
                    self._describe(packet)
                case OtherVersion():
                    self.info = self._timing = None
                    self.problem = str(packet)
                case Status():
                    self.status = packet
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
        self._earlier_packets, self.parser = self.packet_counts, PacketParser()
        self.status = None
        self.close()
        self.info = self.refusal = self._timing = self._next_index = None
        self.problem = None
        self._forget()

    def _acknowledged(self, ack: Ack) -> None:
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
        self.close()
        self._timing = None
        self.problem = _contradiction(info, self.config)
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

    def _samples(self, packet: Samples, t_host: float) -> list[TactileFrame]:
        if not self._arrived(packet, len(packet.counts), t_host):
            return []
        assert self.info is not None and self._timing is not None
        volts = self.info.volts(packet.counts)
        block = SampleBlock(packet.first_index, volts, packet.sync, packet.called)
        return [self._frame(chips) for chips in self._timing.feed(block)]

    def _quiet(self, packet: Quiet, t_host: float) -> list[TactileFrame]:
        """Samples that nobody spoke in."""
        info, timing = self.info, self._timing
        if info and not _is_plausible(packet, info, self.config.spec.frame_period_s):
            self.counters.implausible_packets += 1
            return []
        if not self._arrived(packet, packet.count, t_host):
            return []
        assert info is not None and timing is not None
        block = QuietBlock(
            packet.first_index,
            packet.count,
            (packet.mean - info.zero_count) * info.volts_per_count,
            packet.variance * info.volts_per_count**2,
            packet.sync,
            packet.called,
        )
        if isinstance(timing, LineTiming):
            levels = timing.quiet(block)
        else:
            levels = timing.feed(block.samples())
        return [self._frame(frame) for frame in levels]

    def _arrived(self, packet: Samples | Quiet, count: int, t_host: float) -> bool:
        """Keep account of samples in index and time; whether they are of use."""
        if self.info is None or self._timing is None:
            self.counters.unannounced_samples += count
            return False
        if packet.device_time_us > _MAX_DEVICE_TIME_US:
            self.counters.implausible_packets += 1
            return False
        self.counters.samples += count
        t_device = packet.device_time_us * 1e-6
        if self._next_index is not None:
            missing = packet.first_index - self._next_index
            if missing < 0 or not self._continues(packet.first_index, t_device):
                self._restart()
            elif missing:
                self.counters.lost_samples += missing
                self._timing.reset()
        self._next_index = packet.first_index + count
        self._anchors.append((packet.first_index, t_device))
        self._clock.observe(t_device + count / self.info.sample_rate_hz, t_host)
        return True

    def _continues(self, index: int, t_device: float) -> bool:
        """Whether the device's time has advanced as its count of samples says.

        Where chips are integrated the gaps between frames are not counted, so time may run ahead
        by one gap for every frame.
        """
        assert self.info is not None
        spec, (last_index, last_s) = self.config.spec, self._anchors[-1]
        counted_s = (index - last_index) / self.info.sample_rate_hz
        slack_s = _CLOCK_SLACK_S
        if self.info.integrated:
            slack_s += spec.frame_period_s + counted_s * (spec.frame_period_s / spec.frame_s - 1)
        return -_CLOCK_SLACK_S <= t_device - last_s - counted_s <= slack_s + 0.01 * counted_s

    def _restart(self) -> None:
        """The digitizer began anew: its count went back, or its clock and count part ways."""
        assert self._timing is not None
        self.counters.restarts += 1
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


def _is_plausible(packet: Quiet, info: Info, period_s: float) -> bool:
    """Whether samples within quiet_uv of each other may have these sums, and last so long."""
    range_v = (info.max_count - info.min_count) * info.volts_per_count
    half_v = 0.5 * (info.quiet_uv * 1e-6 or range_v) + info.volts_per_count
    variance_v2 = packet.variance * info.volts_per_count**2
    return packet.count <= 2 * info.sample_rate_hz * period_s and variance_v2 <= half_v**2


def _contradiction(info: Info, config: SkinConfig) -> str | None:
    """Why this digitizer's stream cannot be decoded with these parameters, or None."""
    if wrong := config.refusal(info.digitizer_id):
        return wrong
    if not (info.volts_per_count > 0 and info.min_count < info.max_count):
        return (
            f"the digitizer describes no voltages: {info.volts_per_count:g} V per count, counts "
            f"{info.min_count} to {info.max_count}"
        )
    samples_per_chip = info.sample_rate_hz * config.spec.chip_s
    if samples_per_chip > _MAX_SAMPLES_PER_CHIP:
        return (
            f"the digitizer sends {samples_per_chip:.3g} samples per chip; "
            f"{_MAX_SAMPLES_PER_CHIP} at most are taken"
        )
    if info.integrated != (abs(samples_per_chip - 1) < 0.01):
        return (
            f"the digitizer says it sends {'chip means' if info.integrated else 'raw samples'}, "
            f"but {samples_per_chip:.3g} per chip"
        )
    if config.timing != GAP and info.sync_mode == SyncMode.NONE:
        return (
            "the digitizer marks no frame starts but timing is 'line': set timing to 'gap', "
            "or connect the sync wire"
        )
    if config.timing == GAP and info.integrated:
        return "the digitizer sends one mean per chip, timing 'gap' needs raw samples"
    if config.spec.amplitude_v is not None and info.quiet_uv > (most_uv := quiet_uv(config.spec)):
        return (
            f"the digitizer leaves out frames whose samples differ by up to {info.quiet_uv} µV, in "
            f"which nodes may have spoken: {most_uv} µV at most"
        )
    theirs, ours = info.frame, FrameLayout.of(config.spec, config.samples_per_chip)
    # A digitizer may sample faster or slower than asked: its rate is in INFO and is what counts.
    aside = {"samples_per_chip"} | ({"sign_seed"} if ours.natural_signs else set())
    different = [
        f"{field.name} {getattr(theirs, field.name)} (parameters: {getattr(ours, field.name)})"
        for field in fields(FrameLayout)
        if field.name not in aside and getattr(theirs, field.name) != getattr(ours, field.name)
    ]
    if different:
        return f"the digitizer is set to {', '.join(different)}; make the two agree"
    return None
