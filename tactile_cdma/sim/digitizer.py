# SPDX-License-Identifier: Apache-2.0

"""VirtualDigitizer: commands in, packets out, by its own clock. No I/O.

`packets.stream` decides what is sent, frame by frame, from the options and the set-up alone;
`Schedule` decides when. So the same samples come at any pace, through any transport.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from ..base.errors import SpecError
from ..wire import messages
from ..wire._protocol import (
    PACKED_BITS,
    SIMULATED_ID,
    SYNC_DIGIT,
    SYNC_LEAD,
    SYNC_UNIT_US,
    TURN_MOST_LOG2,
    Result,
    SyncMode,
)
from ..wire.device import Device
from ..wire.packets import PacketParser, PacketWriter
from .indenters import Indenter
from .line import Disturbance
from .nodes import Turns
from .options import Setup, SimOptions
from .packets import Block, stream
from .scene import EXTERNAL, External

BUFFER_S = 0.5
"""Host time for which output is kept for a slow host, s; what comes later is dropped."""
MIN_BUFFER = 65_536
"""Bytes that the output buffer has at least: one read of the pty or the port."""
MAKE_S = 0.05
"""Host time that `advance` computes at most, s, so that its caller can go on reading."""
TURN_S, ASK_S = (
    ((TURN_MOST_LOG2 + digits) * SYNC_DIGIT + 3 * SYNC_LEAD) * SYNC_UNIT_US * 1e-6
    for digits in (1, 2)
)
"""Least time from the end of a frame to the next one for the pulses of its turn, and of a turn in
which all are asked to speak, s."""
REPORT_S = 1.0
"""INFO and STATUS are repeated at this interval (docs/protocol.md)."""
_PREPARE_S = 1e-3
"""Pause after a packet before the samples of the next one are computed, which takes time, so that
the transport hands on the first one meanwhile; chosen, well below a frame period."""
_REPORT_RESERVE = 4096
"""Bytes of the output buffer that only other packets than SAMPLES may use."""


class VirtualDigitizer(Device):
    """A digitizer with a skin on its line, from power-up on.

    Call `advance` for what is due to enter the output buffer and `take` to get it out; hand
    commands to `receive`. Where the output is not taken in time, whole packets are dropped: they
    are missing from the sequence and counted in STATUS. A machine that cannot make the samples at
    this speed loses frames as a digitizer does in an overrun; the skin stands still meanwhile. At
    speed 0 packets are made as they are asked for; without a stream time then passes as usual. In
    the scene "external" a program presses, and at speed 0 it also says how many frames pass.

    packets_dropped, samples_lost, commands_refused: as in STATUS. frames_lost, turns: since
    START. born_s: host time of power-up, s.

    clock: host time, s. disturbance: of its line. Not thread-safe.
    """

    def __init__(
        self,
        options: SimOptions | None = None,
        clock: Callable[[], float] = time.monotonic,
        disturbance: Disturbance | None = None,
    ) -> None:
        super().__init__(b"\0")  # a delimiter ends whatever was on the line before
        self.options = options or SimOptions()
        self.setup = self.options.setup()
        self.packets_dropped = self.samples_lost = self.commands_refused = self.frames_lost = 0
        self._schedule = Schedule(clock, self.options.speed)
        self.born_s = self._schedule.born_s
        self._disturbance = disturbance
        self.turns = Turns()
        self._parser, self._writer = PacketParser(), PacketWriter()
        self._external = External() if self.options.scene == EXTERNAL else None
        # What touches the skin in the frames that may begin, where the program says so.
        self._steps: deque[Sequence[Indenter]] = deque()
        self._commands = 0
        self._packs = False
        self._overrun = False  # before the next block

    @property
    def streaming(self) -> bool:
        """Between START and STOP."""
        return self._schedule.streaming

    @property
    def started_s(self) -> float:
        """Its own time at START, s; later by what overruns have cost since."""
        return self._schedule.started_s

    def receive(self, data: bytes) -> None:
        """Obey the commands that these bytes complete, and answer them."""
        self.advance(0)  # what was due before comes first
        for packet in self._parser.feed(data):
            self._commands += isinstance(packet, messages.Command | messages.Rejected)
            if isinstance(packet, messages.Command):
                self._obey(packet)
            elif isinstance(packet, messages.Rejected):
                self.commands_refused += 1
                self._send(packet.ack())

    def press(self, objects: Sequence[Indenter], frames: int = 0) -> None:
        """Let these objects, and no others, touch the skin from the next frame on.

        frames: at speed 0, number of frames that may pass with these, after those with the objects
        of earlier calls.
        Raises SpecError where another scene is played, frames pass by themselves or, without a
        number, one by one, or something is no object.
        """
        if not all(isinstance(each, Indenter) for each in objects):
            raise SpecError(
                "objects are given one by one, as press(*objects), and each is a Sphere, Cylinder "
                f"or Box, not {', '.join(type(each).__name__ for each in objects)}"
            )
        if self._external is None:
            raise SpecError(
                f"the scene is {self.options.scene!r}; a program presses on sim://?scene={EXTERNAL}"
            )
        if frames and not self.options.stepped:
            raise SpecError(
                f"speed is {self.options.speed:g}, so frames come by themselves; one by one they "
                f"come with sim://?scene={EXTERNAL}&speed=0"
            )
        if self.options.stepped and not frames:
            raise SpecError("speed is 0, so frames come one by one: step(*objects) makes one")
        if frames:
            self._steps.extend([objects] * frames)
        else:
            self._external.press(objects)

    def advance(self, wanted: int = 1) -> float:
        """Put what is due by now in the output buffer; at speed 0, at least `wanted` bytes.

        Returns the host time until something else is due, s; ∞ where nothing comes by waiting.
        """
        schedule = self._schedule
        enough_s = schedule.pass_time() + MAKE_S
        while (due_s := schedule.due_s) <= schedule.now_s or (
            schedule.hurried and self.pending < wanted
        ):
            begins = schedule.frame_is_due and self.options.stepped
            if begins:
                if not self._steps:
                    break
                assert self._external is not None
                self._external.press(self._steps.popleft())
            schedule.now_s = max(schedule.now_s, due_s)
            if due_s == schedule.report_s:
                self._report()
            elif (block := schedule.take()) is not None:
                self._send_block(block)
            if not schedule.hurried and schedule.host_clock() > enough_s:
                schedule.pass_time()
                self._lose_frames()
                return 0.0
        if schedule.hurried:
            return math.inf
        schedule.pass_time()  # making packets has taken some
        return max(0.0, schedule.due_s - schedule.now_s) / (self.options.speed or 1.0)

    def info(self) -> messages.Info:
        setup, channel = self.setup, self.options.channel
        return messages.Info(
            frame=messages.FrameLayout.of(setup.spec, setup.samples_per_chip),
            sample_rate_uhz=round(setup.rate_hz * 1e6),
            volts_per_count=channel.volts_per_count(setup.spec),
            zero_count=channel.zero_count(setup.spec),
            min_count=channel.min_count,
            max_count=channel.max_count,
            sync_mode=setup.sync,
            integrated=setup.integrated,
            quiet_uv=setup.quiet_uv,
            sync_wire=setup.wire,
            digitizer_id=SIMULATED_ID + self.options.seed.to_bytes(4, "little"),
        )

    def _obey(self, command: messages.Command) -> None:
        result, spec = Result.OK, self.setup.spec
        is_marked = self.streaming and self.setup.sync != SyncMode.NONE
        gap_s = spec.frame_period_s - spec.frame_s
        match command:
            case messages.Start():
                self.turns = Turns(groups_log2=0)
                of_line = self.turns, self._disturbance, self._external
                self._schedule.start(stream(self.options, self.setup, *of_line))
                self.frames_lost, self._overrun = 0, False
            case messages.Stop():
                self._schedule.stop()
            case messages.Groups() if is_marked and gap_s >= TURN_S:
                self.turns.groups_log2 = command.log2_groups
            case messages.Ask() if is_marked and gap_s >= ASK_S:
                self.turns.words_log2 = command.log2_groups
            case messages.Groups() | messages.Ask():
                result = Result.UNSUPPORTED
            case messages.Pack():
                self._packs = True
            case messages.Configure():
                result = self._configure(command)
            case messages.Touch() | messages.Bootsel() | messages.Number():
                result = Result.UNKNOWN_COMMAND
        self.commands_refused += result != Result.OK
        self._send(command.ack(result))
        if isinstance(command, messages.GetInfo | messages.Configure):
            self._send(self.info())

    def _configure(self, command: messages.Configure) -> Result:
        """Adopt a set-up as far as the options leave it open; this ends a stream."""
        layout = command.frame
        try:
            how = command.sync_mode, command.integrated, command.quiet_uv, command.sync_wire
            asked = Setup(layout.spec(), layout.samples_per_chip, *how)
            self.setup = self.options.setup(asked)
        except SpecError:
            return Result.UNSUPPORTED
        self._schedule.stop()
        self._packs = False
        return Result.OK

    def _send_block(self, block: Block) -> None:
        make: Callable[..., messages.Samples | messages.Quiet] = (
            messages.Quiet.of if block.quiet else messages.Samples
        )
        if make is messages.Samples and self._packs and self.options.adc_bits <= PACKED_BITS:
            make = partial(messages.Packed, base=self.options.channel.min_count)
        packet = make(
            round((self.started_s + block.begin_s) * 1e6),
            block.first_index + self._index_lost,
            block.counts,
            sync=block.sync,
            overrun=self._overrun,
            turn=block.turn,
            asked=block.asked,
        )
        self._overrun = False
        self._send(packet)

    def _report(self) -> None:
        seen = self._parser.counters
        broken = seen.framing_errors + seen.crc_errors + seen.resyncs
        self._send(self.info())
        self._send(
            messages.Status(
                uptime_us=round(self._schedule.report_s * 1e6),
                samples_lost=self.samples_lost,
                packets_dropped=self.packets_dropped,
                commands_refused=self.commands_refused,
                # Other packets than commands are errors as well: an echo of its own, for one.
                command_errors=broken + seen.packets - self._commands,
                streaming=self.streaming,
            )
        )
        self._schedule.report_s += REPORT_S

    def _send(self, packet: messages.Packet) -> None:
        data = self._writer.encode(packet)
        bytes_per_s = 2 * self.setup.rate_hz * max(1.0, self.options.speed)
        room = max(MIN_BUFFER, int(BUFFER_S * bytes_per_s)) - self.pending
        if not isinstance(packet, messages.Samples | messages.Quiet):
            room += _REPORT_RESERVE
        if len(data) <= room or self._schedule.hurried:
            self._output += data
        else:
            self.packets_dropped += 1

    def _lose_frames(self) -> None:
        """Skip as many whole frames as are due for longer than the output would be kept."""
        period_s, schedule = self.setup.spec.frame_period_s, self._schedule
        behind_s = schedule.now_s - schedule.due_s
        if not self.streaming or behind_s < max(period_s, BUFFER_S * self.options.speed):
            return
        lost, before = int(behind_s / period_s), self._index_lost
        self.frames_lost += lost
        self.samples_lost += self._index_lost - before
        self._overrun = True
        schedule.skip(lost * period_s)

    @property
    def _index_lost(self) -> int:
        """Count the samples of frames that were lost since START."""
        spec = self.setup.spec
        of_frame = spec.chips if self.setup.integrated else spec.frame_period_s * self.setup.rate_hz
        return round(self.frames_lost * of_frame)


class Schedule:
    """One clock for all that a digitizer does.

    now_s: s since power-up, at `speed` times the host's pace. At speed 0, while streaming, the
    clock stands until something is asked for, and then steps to when that is due.
    started_s: when the stream began, s; later by the duration of frames lost since.
    report_s: when the next report is due. born_s: host time of power-up, s.
    streaming: between start and stop. hurried: packets are then made as they are asked for.
    """

    def __init__(self, clock: Callable[[], float], speed: float) -> None:
        """clock: host time, s."""
        self.host_clock, self._speed = clock, speed
        self.born_s = self._host_s = clock()
        self.now_s = self.started_s = self.report_s = 0.0
        self.streaming = self.hurried = False
        self._blocks: Iterator[Block] = iter(())
        self._ready = deque[Block]()  # computed, and not sent yet
        self._compute_s = math.inf  # when the next ones are to be computed, s since START
        self._begins = False  # those are of a new frame, where frames are marked

    @property
    def due_s(self) -> float:
        due_s = self._ready[0].due_s if self._ready else self._compute_s
        return min(self.report_s, self.started_s + due_s)

    @property
    def frame_is_due(self) -> bool:
        """Tell whether what is due next is to compute a new frame; where frames are marked."""
        return not self._ready and self._begins and self.due_s != self.report_s

    def pass_time(self) -> float:
        """Follow the host's clock; returns its time."""
        host_s = self.host_clock()
        if not self.hurried:
            self.now_s += (host_s - self._host_s) * (self._speed or 1.0)
        self._host_s = host_s
        return host_s

    def start(self, blocks: Iterator[Block]) -> None:
        self._blocks, self._compute_s, self._begins = blocks, 0.0, True
        self._ready.clear()
        self.started_s = self.now_s
        self.streaming, self.hurried = True, self._speed == 0

    def stop(self) -> None:
        self._ready.clear()
        self._compute_s, self._begins = math.inf, False
        self.streaming = self.hurried = False

    def skip(self, seconds: float) -> None:
        """Let the stream stand still for so long; no more than one report of that time is due."""
        self.started_s += seconds
        self.report_s = max(self.report_s, self.now_s)

    def take(self) -> Block | None:
        """Take what is due next of the stream: a packet, or None after computing the next ones.

        With a block that waits comes the one that it waits for. Where packets are made as they are
        asked for nothing waits: no frame is computed before.
        """
        if self._ready:
            return self._ready.popleft()
        self._ready.append(next(self._blocks))
        while self._ready[-1].waits and self._speed:
            self._ready.append(next(self._blocks))
        last = self._ready[-1]
        self._compute_s = last.due_s + (_PREPARE_S if self._speed else 0.0)
        self._begins = last.last
        return None
