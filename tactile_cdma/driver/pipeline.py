# SPDX-License-Identifier: Apache-2.0

"""Decodes one skin: bytes in, TactileFrames out. No I/O, no ROS."""

from __future__ import annotations

import logging
from collections.abc import Callable

from ..base.errors import SpecError
from ..base.stage import stage
from ..code.separate import NodeLevels
from ..config.skin_config import SkinConfig
from ..framing.sparse_timing import Load, SparseTiming, capacity
from ..framing.timing import FrameLevels, Rejections
from ..readings.baseline import Baseline
from ..readings.drift import DriftTracker, nodes_beside
from ..readings.pressure import PressureChain
from ..readings.taxels import Readings, Taxels
from ..wire.messages import Ack, Info, OtherVersion, Quiet, Received, Samples, Status
from ..wire.packets import MAX_REPEATED, Counters, PacketParser
from ..words.decode import Words, decode, silent
from ..words.groups import Groups, out_of_turn
from ..words.health import NodeHealth
from .clock import DeviceClock, StreamCounters
from .compiled_stream import CompiledStream
from .description import Description
from .digitizer import DigitizerState, contradiction
from .stream import Decisions, Event
from .timeline import Answer, Arrival, Placement, Step, Timeline, sample_count

_log = logging.getLogger(__name__)


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


class Pipeline:
    """Decodes the digitizer's bytes: bytes → packets → levels → words → readings.

    problem: why nothing can be decoded at present, in one sentence; None while all is well.
    digitizer: what the digitizer has said about itself. on_info: called with that where it fits and
    is new, before what follows is decoded. decisions: where frames were decided, and why.
    groups: in how many the nodes should transmit. stream: of the present connection; a live port is
    read by it, and its events go to `take`.
    """

    def __init__(
        self,
        config: SkinConfig,
        most_repeated: int = MAX_REPEATED,
        clocks: Callable[[], DeviceClock] = DeviceClock,
        frames: bool = True,
    ) -> None:
        """most_repeated: see PacketParser. clocks: see Timeline.

        frames: False to follow the stream and its clock only.
        """
        self.config = config
        self.counters, self.decisions = StreamCounters(), Decisions()
        self.digitizer = DigitizerState()
        self.problem: str | None = None
        self.on_info: Callable[[Info], None] = lambda info: None
        self.timeline = Timeline(self.counters, clocks)
        self.health = NodeHealth(config.spec)
        nodes = config.spec.nodes
        tracker = DriftTracker(config.adc, nodes_beside(config.layout, nodes), config.rest)
        chain = PressureChain(config.calibration, Baseline(nodes), tracker)
        self.taxels = Taxels(nodes, config.adc, chain, config.layout, config.stale_after_s)
        self._most_repeated = most_repeated
        self._frames_wanted = frames
        self._earlier_packets = Counters()
        self._description: Description | None = None  # while the digitizer can be decoded
        self.groups = Groups(config.spec.nodes, capacity(config.spec), config.spec.frame_period_s)
        self._follows = 0  # sequence of the frame that follows the last one
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
        if event.frame is not None:
            return self._frame(event.frame)
        if isinstance(packet, (Samples, Quiet)):
            self._place(Arrival(packet, event.t_host, event.backlog))
        elif packet is not None:
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
        self._description = None
        stream = self._new_stream()
        # At once, for those who read the counts meanwhile.
        self._earlier_packets, self.stream = self.packet_counts, stream
        self.digitizer, self.problem = DigitizerState(), None
        self._exchanged()

    def adjust(self, config: SkinConfig) -> None:
        """Adopt what may change while the stream goes on from another configuration."""
        before, self.config = self.config, config
        self.taxels.stale_after_s = config.stale_after_s
        self.taxels.chain.tracker.rules = config.rest
        self.taxels.refresh()
        if config.calibration is not before.calibration:
            self.taxels.calibrate(config.calibration)

    @property
    def parser(self) -> PacketParser:
        """Return the parser of the present connection."""
        return self.stream.parser

    @property
    def packet_counts(self) -> Counters:
        """Return the parser's counters, over all connections."""
        return self._earlier_packets + self.parser.counters

    @property
    def rejections(self) -> Rejections:
        """Count the bursts that were no frame since the digitizer described itself."""
        return self._description.timing.rejections if self._description else Rejections()

    @property
    def load(self) -> Load | None:
        """Tell how many nodes speak at once; None where all may."""
        timing = self._description.timing if self._description else None
        return timing.load if isinstance(timing, SparseTiming) else None

    def _new_stream(self) -> CompiledStream:
        return CompiledStream(PacketParser(self._most_repeated), self.decisions)

    def _place(self, arrival: Arrival) -> None:
        """Tell the stream where a packet of samples belongs."""
        if self._description is None:
            self.counters.unannounced_samples += sample_count(arrival.packet)
            placement = Placement(Answer.IGNORE)
        else:
            placement = self.timeline.place(arrival, self._description.pace)
        if placement.step is Step.RESET:
            self.taxels.forget()
        elif placement.step is Step.RESTART:  # how many frames were lost meanwhile is a guess
            self.taxels.miss(self.config.nodes_repeat, self.groups.spoke)
        self.stream.place(placement)

    def _frame(self, heard: FrameLevels) -> TactileFrame:
        assert self._description is not None
        rate_hz, spec = self._description.pace.rate_hz, self.config.spec
        stamp = self.timeline.times.stamp(heard, rate_hz, spec)
        if stamp.sequence != self._follows:
            self.taxels.miss(self.config.nodes_repeat, self.groups.spoke)
        self._follows = stamp.sequence + 1
        words, readings = self._read(heard, stamp.t_middle)
        if (load := self.load) is not None:
            self.groups.take(heard.turn, load.now, words.active, load.crowded)
        elif heard.turn:
            self.groups.hear(heard.turn, words.active)
        else:  # what hear would do, without a call in every frame
            self.groups.spoke = words.active
        if heard.turn:
            readings = self.taxels.waiting(readings, out_of_turn(heard.turn, spec.nodes))
        return TactileFrame(*stamp, heard.clipped, words, readings)

    def _read(self, heard: FrameLevels, t_device: float) -> tuple[Words, Readings]:
        """Read a frame's words and readings: in one call of the kernel, if nothing is odd."""
        levels, config, taxels = heard.levels, self.config, self.taxels
        if levels is None:
            words = silent(config.spec.nodes, heard.noise_rms_v)
            if heard.doubtful is not None:
                words = words.doubted(heard.doubtful)
            held = taxels.try_hold(t_device) if heard.doubtful is None else None
            return words, held or taxels.update(words, t_device, self.health)
        is_odd = (
            levels.late or levels.level_unknown or heard.doubtful is not None or not heard.placed
        )
        if not is_odd:
            read = taxels.read(levels, config.spec, config.active_share, t_device, self.health)
            if read is not None:
                return read
        self.decisions.words_in_python += 1
        words = self._words(heard, levels)
        return words, taxels.update(words, t_device, self.health)

    def _words(self, heard: FrameLevels, levels: NodeLevels) -> Words:
        """Decode the words; updates the nodes' health by those that are not a guess."""
        words = decode(levels, self.config.spec, self.config.active_share, self.health.swing_v)
        if heard.doubtful is None or levels.understood:
            self.health.update(words)
        if heard.doubtful is not None:
            words = words.doubted(heard.doubtful)
        if self.health.any_suspect:
            suspect = self.health.suspect & words.active
            words = words.doubted(suspect | (~words.active & suspect.any()))
        # A frame is where its words are: if none of them is certain, it may be elsewhere.
        lost = not heard.placed and not (words.active & ~words.doubtful).any()
        if lost or (words.doubtful.any() and words.disturbed(self.health.invalid)):
            words = words.doubted(~words.active)
        return words

    def _hear(self, packet: Received | None) -> None:
        """Take in what the digitizer says about itself."""
        match packet:
            case Info():
                self._describe(packet)
            case OtherVersion():
                self._forget()
                self.digitizer.info, self.problem = None, str(packet)
            case Status():
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
        if self.problem is None:
            try:
                self._description = Description(info, self.config)
            except SpecError as error:
                self.problem = f"the digitizer's sampling does not fit: {error}"
        if self._description is not None:
            _log.debug("digitizer %s is decoded", info.digitizer_id)
            self.stream.describe(self._description, self._frames_wanted)
            self.on_info(info)

    def _exchanged(self) -> None:
        """Forget what was heard of another digitizer, or at another time."""
        self.timeline.reconnected()
        self.taxels.forget()

    def _forget(self) -> None:
        """Decode nothing until the digitizer describes itself again."""
        self._description = None
        self.stream.forget()
