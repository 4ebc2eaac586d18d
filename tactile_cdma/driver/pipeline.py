# SPDX-License-Identifier: Apache-2.0

"""One skin's decoding chain: bytes in, TactileFrames out. No I/O, no ROS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ..base import kernel
from ..base.errors import SpecError
from ..clocks.clock_keeper import ClockReport
from ..code.separate import NodeLevels
from ..config.skin_config import SkinConfig
from ..framing.timing import FrameLevels, Rejections
from ..readings.baseline import Baseline
from ..readings.drift import DriftTracker, nodes_beside
from ..readings.pressure import PressureChain
from ..readings.taxels import Readings, Taxels
from ..wire._protocol import PacketType, Result
from ..wire.messages import Ack, Info, OtherVersion, Quiet, Received, Samples, Status
from ..wire.packets import MAX_REPEATED, Counters, PacketParser
from ..words.decode import Words, decode, silent
from ..words.health import NodeHealth
from .clock import DeviceClock
from .digitizer import DigitizerState, contradiction
from .levels import LevelDecoder
from .steady import NO_FILE, Event, SteadyStream, Waited
from .timeline import Arrival, Step, StreamCounters, Timeline, sample_count


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


class Pipeline:
    """Decodes the digitizer's bytes: bytes → packets → timeline → levels → words → readings.

    problem: why nothing can be decoded at present, in one sentence; None while all is well.
    digitizer: what the digitizer has said about itself. on_info: called with that where it fits and
    is new, before what follows is decoded.
    """

    def __init__(
        self,
        config: SkinConfig,
        background: bool = True,
        most_repeated: int = MAX_REPEATED,
        clocks: Callable[[], DeviceClock] = DeviceClock,
    ) -> None:
        """background: evaluate the nodes' clocks in a thread beside the stream, not at once.

        Frames then depend on when that is done. most_repeated: see PacketParser. clocks: see
        Timeline.
        """
        self.config = config
        self.counters = StreamCounters()
        self.parser = PacketParser(most_repeated)
        self.digitizer = DigitizerState()
        self.problem: str | None = None
        self.on_info: Callable[[Info], None] = lambda info: None
        self.timeline = Timeline(self.counters, clocks)
        self.health = NodeHealth(config.spec)
        nodes = config.spec.nodes
        tracker = DriftTracker(config.adc.lsb_v, nodes_beside(config.layout, nodes), config.rest)
        chain = PressureChain(config.calibration, Baseline(nodes), tracker, config.compensator())
        self.taxels = Taxels(nodes, config.adc, chain, config.layout, config.stale_after_s)
        self._background, self._most_repeated = background, most_repeated
        self._earlier_packets = Counters()
        self._levels: LevelDecoder | None = None  # while the digitizer can be decoded
        self._steady: SteadyStream | None = None

    def feed(self, data: bytes, t_host: float, backlog: bool = False) -> list[TactileFrame]:
        """Decode bytes that were read at t_host (monotonic, s). Any split gives the same frames.

        backlog: they had been waiting to be read.
        """
        steady = self._steady
        if steady is None or not steady.entered:
            return self._by_packets(data, t_host, backlog)
        frames: list[TactileFrame] = []
        steady.give(data, t_host, backlog)
        while steady.entered:
            waited = steady.wait(NO_FILE, 0)
            frames += self.take(waited)
            if waited.event is Event.MORE:
                break
        return frames

    @property
    def is_steady(self) -> bool:
        """Whether the kernel follows the stream, so that `wait` may be called."""
        return self._steady is not None and self._steady.entered

    def wait(self, file: int, timeout_ms: int) -> Waited:
        """Wait for the next frame, or whatever has to be decided, from a file descriptor.

        The only method that may run while others use the pipeline: what it brings is taken in by
        `take`. Raises OSError where nothing can be read.
        """
        assert self._steady is not None
        return self._steady.wait(file, timeout_ms)

    def take(self, waited: Waited) -> list[TactileFrame]:
        """The frames that the outcome of a wait gives."""
        levels = self._levels
        assert levels is not None
        self.timeline.passed(waited.passed, levels.pace)
        if waited.frame is not None:
            return [self._frame(waited.frame, levels)]
        if waited.event is Event.UNDECIDED:
            return self._go_on()
        if waited.packet is None:
            return []
        packet = self.parser.interpret(*waited.packet)
        if packet is None or isinstance(packet, (Status, Ack)) or packet == self.digitizer.info:
            self._hear(packet)
            return []
        return self._go_on(packet)

    def settle(self) -> list[TactileFrame]:
        """Decode what the kernel has read but not parsed, before bytes are left out."""
        return self._go_on() if self._steady and self._steady.entered else []

    def _go_on(self, packet: Received | None = None) -> list[TactileFrame]:
        """Go on in stages: with the frame in progress, this packet, and the bytes behind it."""
        assert self._steady is not None and self._levels is not None
        heard, data, t_host, backlog = self._steady.leave()
        frames = [self._frame(one, self._levels) for one in heard]
        if packet is not None:
            frames += self._take_packet(packet, t_host, backlog)
        return frames + self._by_packets(data, t_host, backlog)

    def _by_packets(self, data: bytes, t_host: float, backlog: bool) -> list[TactileFrame]:
        frames: list[TactileFrame] = []
        for packet in self.parser.feed(data):
            frames += self._take_packet(packet, t_host, backlog)
        if frames and self._steady is not None:
            self._steady.try_enter(self.timeline)
        return frames

    def _take_packet(self, packet: Received, t_host: float, backlog: bool) -> list[TactileFrame]:
        if isinstance(packet, (Samples, Quiet)):
            return self._decode(Arrival(packet, t_host, backlog))
        self._hear(packet)
        return []

    def follow(self, data: bytes, t_host: float) -> None:
        """Follow the stream and its clock as feed does, without looking for frames."""
        self.settle()
        for packet in self.parser.feed(data):
            if not isinstance(packet, (Samples, Quiet)):
                self._hear(packet)
            elif self._levels is not None:
                for _ in self.timeline.accept(Arrival(packet, t_host), self._levels.pace):
                    pass

    def flush(self) -> list[TactileFrame]:
        """At the end of a recording: a last frame that nothing followed."""
        frames, levels = self.settle(), self._levels
        if levels is not None:
            frames += [self._frame(heard, levels) for heard in levels.timing.flush()]
        return frames

    def skipped(self, count: int) -> None:
        """Note that this many bytes were left out here, to catch up with the digitizer.

        `settle` comes first.
        """
        self.counters.skipped_bytes += count
        self.parser.skip()

    def reconnected(self) -> None:
        """Start anew on a port that was opened again; sequence and counts go on."""
        # At once, for those who read the counts meanwhile.
        self._earlier_packets = self.packet_counts
        self.parser = PacketParser(self._most_repeated)
        self.digitizer, self.problem = DigitizerState(), None
        self._drop_levels()
        self.timeline.reconnected()
        self.taxels.forget()

    def adjust(self, config: SkinConfig) -> bool:
        """Adopt what may change while the stream goes on from another configuration.

        Returns whether tare and drift stay: they do unless the curves are others.
        """
        before, self.config = self.config, config
        self.taxels.stale_after_s = config.stale_after_s
        if self.taxels.chain.tracker is not None:
            self.taxels.chain.tracker.rules = config.rest
        self.taxels.refresh()
        if config.calibration is before.calibration and config.compensation == before.compensation:
            return True
        return self.taxels.calibrate(config.calibration, config.compensator())

    def close(self) -> None:
        """End the work beside the stream."""
        if self._levels and self._levels.clocks:
            self._levels.clocks.close()

    @property
    def packet_counts(self) -> Counters:
        """The parser's counters, over all connections."""
        steady = self._steady
        if steady is None or not steady.entered:
            return self._earlier_packets + self.parser.counters
        return self._earlier_packets + self.parser.counters_of(steady.counts)

    @property
    def rejections(self) -> Rejections:
        """Bursts on the line that were no frame, since the digitizer described itself."""
        return self._levels.timing.rejections if self._levels else Rejections()

    @property
    def clocks(self) -> ClockReport | None:
        """What is known of the nodes' clocks; None where they are not measured."""
        keeper = self._levels.clocks if self._levels else None
        return keeper.report if keeper else None

    @property
    def can_call_roll(self) -> bool:
        """Whether a roll call can be evaluated now."""
        return self._levels is not None and self._levels.can_call_roll

    def _decode(self, arrival: Arrival) -> list[TactileFrame]:
        """The frames that a packet of samples completes."""
        levels = self._levels
        if levels is None:
            self.counters.unannounced_samples += sample_count(arrival.packet)
            return []
        frames: list[TactileFrame] = []
        for place in self.timeline.accept(arrival, levels.pace):
            if place.step is Step.RESET:
                self.taxels.forget()
            frames += [self._frame(heard, levels) for heard in levels.feed(place)]
        return frames

    def _frame(self, heard: FrameLevels, levels: LevelDecoder) -> TactileFrame:
        stamp = self.timeline.stamp(heard, levels.pace)
        words, readings = self._read(heard, stamp.t_middle)
        return TactileFrame(*stamp, heard.clipped, words, readings)

    def _read(self, heard: FrameLevels, t_device: float) -> tuple[Words, Readings]:
        """The words and readings of a frame: in one call of the kernel, if nothing is odd."""
        levels, config, taxels = heard.levels, self.config, self.taxels
        if levels is None:
            words = silent(config.spec.nodes, heard.noise_rms_v)
            held = taxels.try_hold(t_device)
            return words, held or taxels.update(words, t_device, self.health)
        is_odd = levels.rows is None or levels.unresolved or heard.doubtful is not None
        if kernel.compiled is not None and not is_odd and not config.roll_call:
            read = taxels.read(levels, config.spec, config.threshold, t_device, self.health)
            if read is not None:
                return read
        words = self._words(heard, levels)
        return words, taxels.update(words, t_device, self.health)

    def _words(self, heard: FrameLevels, levels: NodeLevels) -> Words:
        """What the nodes said; updates their health by words that are not a guess."""
        spec, clocks = self.config.spec, self.clocks
        words = decode(levels, spec, self.config.threshold, self.health.swing_v)
        clocks_unknown = self.config.roll_call and clocks is not None and not clocks.heard
        if clocks_unknown:
            words = words.doubted(words.active)
        if heard.doubtful is None:
            self.health.update(words)
        else:
            words = words.doubted(heard.doubtful)
        if self.health.any_suspect:
            words = words.doubted(self.health.suspect & words.active)
        if words.doubtful.any() and words.disturbed(self.health.invalid):
            words = words.doubted(~words.active)
        return words

    def _hear(self, packet: Received | None) -> None:
        """Take in what the digitizer says about itself."""
        match packet:
            case Info():
                self._describe(packet)
            case OtherVersion():
                self._drop_levels()
                self.digitizer.info, self.problem = None, str(packet)
            case Status():
                self.digitizer.hear_status(packet)
                self.timeline.hear_status(packet)
            case Ack():
                self.digitizer.hear_ack(packet)
                self._give_up_roll_call(packet)

    def _give_up_roll_call(self, ack: Ack) -> None:
        """End waiting for a roll call that the digitizer refused."""
        refused = ack.command == PacketType.ROLL_CALL and ack.result != Result.OK
        if refused and self._levels and self._levels.clocks:
            reason = ack.result.name.lower()
            self._levels.clocks.give_up(f"the digitizer refused the roll call: {reason}")

    def _describe(self, info: Info) -> None:
        """Set up decoding for the digitizer's new description of itself."""
        if info == self.digitizer.info:
            return
        self.digitizer.info = info
        self._drop_levels()
        self.problem = contradiction(info, self.config)
        if self.problem is None:
            try:
                self._levels = LevelDecoder(info, self.config, self._background)
                self._steady = self._levels.steady(self.parser)
            except SpecError as error:
                self.problem = f"the digitizer's sampling does not fit: {error}"
        if self.problem is None:
            self.on_info(info)

    def _drop_levels(self) -> None:
        self.close()
        self._levels = self._steady = None
