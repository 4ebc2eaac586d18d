# SPDX-License-Identifier: Apache-2.0

"""Decodes one skin: bytes in, TactileFrames out. No I/O, no ROS."""

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..base.errors import SpecError
from ..base.stage import stage
from ..code.frame import FrameSpec
from ..config.skin_config import SkinConfig
from ..framing.frames import Certificate, LineFrame, Rejections
from ..framing.load import Load, capacity, groups_for_all
from ..readings.baseline import Baseline
from ..readings.drift import DriftTracker, nodes_beside
from ..readings.pressure import PressureChain
from ..readings.taxels import Readings, Taxels
from ..wire.identity import NO_READING, is_source_id
from ..wire.messages import Ack, Info, OtherVersion, Quiet, Received, Samples, Status
from ..wire.packets import MAX_REPEATED, Counters, PacketParser
from ..words.groups import Groups, out_of_turn
from ..words.health import JUDGE_FRAMES, NodeHealth
from ..words.words import Words, nobody, silent
from .asking import Asking
from .clock import DeviceClock, StreamCounters
from .digitizer import DigitizerState, contradiction
from .stream import Decisions, Description, Event, Stream
from .timeline import Answer, Arrival, Placement, Step, Timeline, sample_count

_log = logging.getLogger(__name__)

UNKNOWN_V = 1.0
"""Amplitude of a source's words where none is stated, V; any will do, as all have the same."""


@stage
class TactileFrame:
    """One decoded frame.

    sequence: counts frame periods on the wire; a gap is the number of frames lost.
    t_start: device time of the first chip, s.
    t_middle: device time of the middle of the frame's chips, s.
    t_host: the same moment on the host's monotonic clock, s.
    stamp_uncertainty_s: t_host may be off by up to this; infinite while it is a guess.
    chip_s: measured chip duration, s.
    clipped: share of the frame's samples at a rail of the digitizer, 0…1.
    certificate: how near the frame is to what makes its words doubtful; None where the line held
        too little power for any word.
    """

    sequence: int
    t_start: float
    t_middle: float
    t_host: float
    stamp_uncertainty_s: float
    chip_s: float
    clipped: float
    words: Words
    readings: Readings
    certificate: Certificate | None = None


class Pipeline:
    """Decodes the digitizer's bytes: bytes → packets → levels → words → readings.

    problem: why nothing can be decoded at present, in one sentence; None while all is well.
    digitizer: what the digitizer has said about itself. on_info: called with that where it fits and
    is new, before what follows is decoded. decisions: how frames were read.
    groups: in how many the nodes should transmit. asking: when all should.
    stream: of the present connection; a live port is read by it, and its events go to `take`.
    """

    def __init__(
        self,
        config: SkinConfig,
        most_repeated: int = MAX_REPEATED,
        clocks: Callable[[], DeviceClock] = DeviceClock,
        frames: bool = True,
    ) -> None:
        """Set up decoding; most_repeated: see PacketParser. clocks: see Timeline.

        frames: False to follow the stream and its clock only.
        """
        self.config = config
        self.counters, self.decisions = StreamCounters(), Decisions()
        self.digitizer = DigitizerState()
        self.problem: str | None = None
        self.on_info: Callable[[Info], None] = lambda info: None
        self.timeline = Timeline(self.counters, clocks)
        self.health, self._to_verdict = NodeHealth(config.spec), JUDGE_FRAMES
        nodes = config.spec.nodes
        tracker = DriftTracker(config.adc, nodes_beside(config.layout, nodes), config.rest)
        chain = PressureChain(config.calibration, Baseline(nodes), tracker)
        self.taxels = Taxels(nodes, config.adc, chain, config.layout, config.stale_after_s)
        self._adopt_service()
        self._most_repeated = most_repeated
        self._frames_wanted = frames
        self._earlier_packets = Counters()
        self._old_info: Info | None = None  # one that came again, unless a jump follows
        self._description: Description | None = None  # while the digitizer can be decoded
        self._source_s: float | None = None  # device time of a source's last frame
        self.groups = Groups(nodes, capacity(config.spec), config.spec.frame_period_s)
        self.load = Load(capacity(config.spec)) if config.spec.sparse else None
        turns = groups_for_all(config.spec) if config.spec.sparse else 1
        self.asking = Asking(turns, config.spec.frame_period_s)
        self.stream = self._new_stream()

    def feed(self, data: bytes, t_host: float, backlog: bool = False) -> list[TactileFrame]:
        """Decode bytes read at t_host (monotonic, s), in any split; backlog: they had waited."""
        self.stream.give(data, t_host, backlog)
        return self.drain()

    def drain(self) -> list[TactileFrame]:
        """Return the frames in the bytes that were read so far."""
        frames: list[TactileFrame] = []
        needs_bytes = False
        while not needs_bytes:
            event = self.stream.next()
            if (frame := self.take(event)) is not None:
                frames.append(frame)
            needs_bytes = event.needs_bytes
        return frames

    def take(self, event: Event) -> TactileFrame | None:
        """Take in what the stream has come to; returns the frame, if it is one."""
        description, packet = self._description, event.packet
        if event.passed and description is not None:
            self.timeline.times.passed(event.passed, description.pace.rate_hz)
            self._old_info = None
        if event.frame is not None:
            return self._frame(event.frame)
        if event.needs_bytes:
            return None
        if event.jumped:
            self._hear(self._old_info)  # reset, the digitizer begins as it did before
        if isinstance(packet, Samples) and self.has_source:
            return self._read_source(packet, event)
        if isinstance(packet, Info) and event.again:
            self._old_info = packet
        elif isinstance(packet, (Samples, Quiet)):
            self._place(Arrival(packet, event.t_host, event.backlog))
        else:
            self._hear(packet)
        return None

    def flush(self) -> list[TactileFrame]:
        """Return a last frame that nothing followed, at the end of a recording."""
        self.stream.end()
        return self.drain()

    def skipped(self, count: int) -> None:
        """Note that this many bytes were left out, to catch up; `drain` comes first."""
        self.counters.skipped_bytes += count
        self.parser.skip()

    def reconnected(self) -> None:
        """Start anew on a port that was opened again; sequence and counts go on."""
        self._description = self._old_info = None
        stream = self._new_stream()
        # At once, for those who read the counts meanwhile.
        self._earlier_packets, self.stream = self.packet_counts, stream
        self.digitizer, self.problem = DigitizerState(), None
        self._exchanged()

    def adjust(self, config: SkinConfig) -> None:
        """Adopt what may change while the stream goes on from another configuration."""
        before = self.config  # whose spec may have a source's own period
        self.config = config = replace(config, spec=before.spec)
        if self._description is not None:
            self._description.reader.count_above(config.active_share)
        self.taxels.stale_after_s = config.stale_after_s
        self.taxels.chain.tracker.rules = config.rest
        self._adopt_service()
        if config.calibration is not before.calibration:
            self.taxels.calibrate(config.calibration)

    def _adopt_service(self) -> None:
        """Adopt which taxels serve, and whether to tell how sure they are."""
        taxels, config = self.taxels, self.config
        taxels.dead_share, taxels.with_sigma = config.dead_share, config.publish_sigma
        taxels.mask(parameter=config.masked)

    @property
    def has_source(self) -> bool:
        """Whether what comes are a source's codes, not chips."""
        info = self.digitizer.info
        return info is not None and is_source_id(info.digitizer_id)

    @property
    def parser(self) -> PacketParser:
        return self.stream.parser

    @property
    def packet_counts(self) -> Counters:
        """Return the parser's counters, over all connections."""
        return self._earlier_packets + self.parser.counters

    @property
    def rejections(self) -> Rejections:
        """Bursts on the line that were no frame, since the digitizer described itself."""
        return self.stream.rejections if self._description else Rejections()

    def _new_stream(self) -> Stream:
        return Stream(PacketParser(self._most_repeated), self.decisions)

    def _place(self, arrival: Arrival) -> None:
        if self._description is None:
            self.counters.unannounced_samples += sample_count(arrival.packet)
            placement = Placement(Answer.IGNORE)
        else:
            placement = self.timeline.place(arrival, self._description.pace)
        if placement.step is Step.RESET:
            self._forget_values()
        elif placement.step is Step.RESTART:  # how many frames were lost meanwhile is a guess
            self.taxels.miss(self.config.nodes_repeat, self.groups.spoke)
        self.stream.place(placement)

    def _frame(self, frame: LineFrame) -> TactileFrame:
        assert self._description is not None
        rate_hz, spec = self._description.pace.rate_hz, self.config.spec
        stamp = self.timeline.times.stamp(frame, rate_hz, spec)
        if self.timeline.times.missed:
            self.taxels.miss(self.config.nodes_repeat, self.groups.spoke)
        words, readings = self._read(frame, stamp.t_middle)
        is_certain = frame.certificate is None or frame.certificate.holds
        if frame.asked and is_certain and self.asking.hear(frame.turn):
            self.asking.settle(self.taxels.may_answer)
        if self.taxels.doubts_rise():
            self.asking.doubt()
        if self.load is not None and not frame.asked:
            self.load = self.load.after(frame.speakers, frame.crowded)
            self.groups.take(frame.turn, self.load.now, words.active, self.load.crowded)
        elif frame.turn:
            self.groups.hear(frame.turn, words.active)
        else:  # what hear would do, without a call in every frame
            self.groups.spoke = words.active
        if frame.turn:
            readings = self.taxels.waiting(readings, out_of_turn(frame.turn, spec.nodes))
        return TactileFrame(*stamp, frame.clipped, words, readings, frame.certificate)

    def _read_source(self, packet: Samples, event: Event) -> TactileFrame | None:
        """Return the frame of a source's packet; none while its INFO does not fit."""
        self.stream.place(Placement(Answer.IGNORE))
        self._old_info = None
        spec, times, counters = self.config.spec, self.timeline.times, self.counters
        if self.problem is not None or len(packet.counts) != spec.nodes:
            counters.unannounced_samples += len(packet.counts)
            return None
        number, t_device = packet.first_index // spec.nodes, packet.device_time_us * 1e-6
        if self._source_s is not None and t_device <= self._source_s:
            counters.restarts += 1
            times.begin_clock()
            self.taxels.forget()
        self._source_s, counters.samples = t_device, counters.samples + spec.nodes
        arrived = event.t_host, event.backlog
        if not self._frames_wanted:
            times.clock.observe(t_device, *arrived)
            return None
        words = source_words(packet, spec)
        stamp = times.stamp_reading(number, t_device, arrived, spec.frame_period_s)
        readings = self.taxels.update(words, t_device, self.health, counts=True)
        self._note_counted()
        self.decisions.frames += 1
        self.groups.spoke = words.active
        return TactileFrame(*stamp, 0.0, words, readings)

    def _read(self, frame: LineFrame, t_device: float) -> tuple[Words, Readings]:
        words, certificate = frame.words, frame.certificate
        if words is None or certificate is None:
            words = silent(self.config.spec.nodes, frame.noise_rms_v)
            return words, self.taxels.update_silent(words, t_device, self.health)
        if frame.speakers or self.config.spec.sparse:
            counts = frame.speakers > 0 and (frame.understood or certificate.holds)
        else:
            counts = frame.understood  # too weak, all of them
        readings = self.taxels.update(frame.memory, t_device, self.health, counts)
        if counts:
            self._note_counted()
        return words, readings

    def _note_counted(self) -> None:
        """Note that what a frame's words say of their nodes was counted."""
        self._to_verdict -= 1
        if not self._to_verdict:
            self._to_verdict = JUDGE_FRAMES
            if self.health.judge():
                self._adopt_health()

    def _adopt_health(self) -> None:
        """Have the next frames read by the present verdicts on the nodes."""
        if self._description is not None:
            reader, health = self._description.reader, self.health
            reader.broken[:] = health.invalid
            if health.swing_v is not None:
                reader.expected_v[:] = health.swing_v

    def _hear(self, packet: Received | None) -> None:
        match packet:
            case Info():
                self._old_info = None
                self._describe(packet)
            case OtherVersion():
                self._forget()
                self.digitizer.info, self.problem = None, str(packet)
            case Status():
                if self.digitizer.blinds(packet):  # who did not hear a pulse was silent, too
                    self.taxels.miss(nodes_repeat=False, spoke=self.groups.spoke)
                self.digitizer.status, self.digitizer.streaming = packet, packet.streaming
                self.timeline.hear_status(packet)
            case Ack():
                self.digitizer.hear_ack(packet)

    def _describe(self, info: Info) -> None:
        """Set up decoding for the digitizer's new description of itself."""
        if info == self.digitizer.info:
            return
        before, self.digitizer.info = self.digitizer.info, info
        self._forget()
        if before is None or before.digitizer_id != info.digitizer_id:
            self.counters.restarts += before is not None
            self._exchanged()
        self.problem = contradiction(info, self.config)
        if self.problem is None and self.has_source:
            spec = replace(info.frame.spec(), amplitude_v=self.config.spec.amplitude_v)
            self.config = replace(self.config, spec=spec)
            self.on_info(info)
        elif self.problem is None:
            try:
                self._description = Description(info, self.config, self.health.nominal_v)
            except SpecError as error:
                self.problem = f"the digitizer's sampling does not fit: {error}"
        if self._description is not None:
            _log.debug("digitizer %s is decoded", info.digitizer_id)
            self._adopt_health()
            self.stream.describe(self._description, self._frames_wanted)
            self.on_info(info)

    def _exchanged(self) -> None:
        """Forget what was heard of another digitizer, or at another time."""
        self._source_s = None
        self.timeline.reconnected()
        self._forget_values()

    def _forget_values(self) -> None:
        self.taxels.forget()
        self.asking.doubt()

    def _forget(self) -> None:
        """Decode nothing until the digitizer describes itself again."""
        self._description = None
        self.stream.forget()


def source_words(packet: Samples, spec: FrameSpec) -> Words:
    """Make words of a source's codes: without noise, or in doubt where a taxel has no reading."""
    active, no = packet.counts != NO_READING, nobody(spec.nodes)
    ones = np.ones(spec.nodes, np.float32)
    return Words(
        active=active,
        codes=np.where(active, packet.counts, 0).astype(np.int32),
        amplitude_v=ones * np.float32(spec.node_swing_v or UNKNOWN_V),
        rho=np.full(spec.nodes, np.inf, np.float32),
        margin=ones,
        doubtful=~active,
        doubled=no,
        odd=no,
        faint=no,
        noise_rms_v=float("nan"),
    )
