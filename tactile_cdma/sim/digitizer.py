# SPDX-License-Identifier: Apache-2.0

"""VirtualDigitizer: commands in, packets out, in its own time. No I/O.

What is sent is decided frame by frame from the options and the set-up alone (`stream`); the clock
only decides when. So the same samples come at any pace, through any transport.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.errors import SpecError
from ..wire._protocol import MAX_SAMPLES, Result, SyncMode
from ..wire.messages import (
    Command,
    Configure,
    FrameLayout,
    GetInfo,
    Info,
    Packet,
    Quiet,
    Rejected,
    RollCall,
    Samples,
    Start,
    Status,
    Stop,
)
from ..wire.packets import PacketParser, PacketWriter
from .channel import chip_means, first_sample, point_samples, waveforms
from .disturbance import Disturbance
from .loads import LOADS
from .nodes import NodeFrame, RollCalls, frame_start_s, node_frames
from .options import Setup, SimOptions
from .packets import Cutter
from .scene import SCENES

REPORT_S = 1.0
"""INFO and STATUS are repeated at this interval."""
BUFFER_S = 0.5
"""Output that waits for a slow host, in seconds of host time; older packets are kept."""
MIN_BUFFER = 65_536
MAKE_S = 0.05
"""Host time that making what is due takes at most at once: whoever reads is not held up."""
_PREPARE_S = 1e-3
"""So long after a packet the next one is made up, which takes time, so that the first gets away."""
_REPORT_RESERVE = 4096
"""Bytes of the output buffer that only other packets than SAMPLES may use."""


@dataclass(frozen=True, slots=True)
class Block:
    """The samples of one packet.

    first_index: of the first sample, counted from START. counts: (m,) int16.
    sync: the first sample is the first of a frame. called: of one of a roll call.
    quiet: sent as Quiet.
    begin_s: when the first sample is taken; if integrated, when its chip begins. due_s: when it is
        sent: as the last sample's period ends, or where it waits, with the block after it. Both in
        s since START. waits: a gap at rest.
    """

    first_index: int
    counts: NDArray[np.int16]
    sync: bool
    called: bool
    quiet: bool
    begin_s: float
    due_s: float
    waits: bool


def truth(
    options: SimOptions, setup: Setup, roll_calls: RollCalls | None = None
) -> Iterator[NodeFrame]:
    """What the nodes measure and say in every frame since START, endlessly."""
    spec = setup.spec
    return node_frames(
        spec,
        (SCENES | LOADS)[options.scene],
        options.skin(spec.nodes, spec.first_row),
        options.rules,
        options.sensors,
        start_phase=options.start_phase,
        roll_calls=roll_calls,
    )


def stream(
    options: SimOptions,
    setup: Setup,
    roll_calls: RollCalls | None = None,
    disturbance: Disturbance | None = None,
) -> Iterator[Block]:
    """The digitized line since START, endlessly; a pure function of its arguments.

    Where frames are marked, each begins a new block and ends one; else blocks are of equal size.
    roll_calls: may be asked for meanwhile.
    """
    rate_hz = setup.rate_hz
    volts_per_count = options.channel.volts_per_count(setup.spec)
    cutter = Cutter(setup, int(setup.quiet_uv * 1e-6 / volts_per_count))
    instant = 0.0 if setup.integrated else 0.5  # at which a sample is taken, within its period
    waiting = np.empty(0, dtype=np.int16)
    index = 0
    for frame in truth(options, setup, roll_calls):
        whole = frame.start_s >= 0
        if setup.integrated:
            if not whole:
                continue  # it takes a frame mark to know where a chip begins
            counts = _chips(options, setup, frame, disturbance)
            epoch_s = frame.start_s - index / rate_hz
        else:
            counts, epoch_s = _samples(options, setup, frame, disturbance), 0.0
        marked = whole and setup.sync != SyncMode.NONE
        if setup.sync == SyncMode.NONE:
            counts = np.concatenate((waiting, counts))
            waiting = counts[len(counts) // cutter.gap_size * cutter.gap_size :]
            counts = counts[: len(counts) - len(waiting)]
        for cut in cutter.cuts(counts, marked):
            stop = index + cut.stop - cut.start
            due = stop + min(cutter.frame_size, MAX_SAMPLES) if cut.waits else stop
            yield Block(
                first_index=index,
                counts=counts[cut.start : cut.stop],
                sync=marked and cut.start == 0,
                called=cut.start == 0 and frame.called,
                quiet=cut.quiet,
                begin_s=epoch_s + (index + instant) / rate_hz,
                due_s=epoch_s + due / rate_hz,
                waits=cut.waits,
            )
            index = stop


class VirtualDigitizer:
    """A digitizer with a skin on its line, from power-up on.

    Call `advance` for what is due to enter the output buffer and `take` to get it out; hand
    commands to `receive`. Where the output is not taken in time, whole packets are dropped: they
    are missing from the sequence and counted in STATUS. A machine that cannot make the samples at
    this speed loses frames as a digitizer does in an overrun; the skin stands still meanwhile. At
    speed 0 packets are made as they are asked for, so there is never one to drop; without a stream
    time then passes as usual.

    started_s: its own time at START, s; later by what overruns have cost since.

    clock: host time, s. disturbance: of its line. Not thread-safe.
    """

    def __init__(
        self,
        options: SimOptions | None = None,
        clock: Callable[[], float] = time.monotonic,
        disturbance: Disturbance | None = None,
    ) -> None:
        self.options = options or SimOptions()
        self.setup = self.options.setup()
        self.packets_dropped = self.samples_lost = 0
        self._roll_calls = RollCalls()
        self.commands_refused = self._commands = 0
        self._disturbance = disturbance
        self._clock, self._host_s = clock, clock()
        self._now_s = self._due_s = self._report_s = 0.0
        self._parser, self._writer = PacketParser(), PacketWriter()
        self._output = bytearray(1)  # a delimiter ends whatever was on the line before
        self._stream: Iterator[Block] | None = None
        self._blocks: deque[Block] = deque()  # made and not yet sent
        self.started_s = self._prepare_s = 0.0
        self._frames_lost = 0  # since START
        self._overrun = False  # before the next block
        self._truth: Iterator[NodeFrame] | None = None
        self._true_frame: NodeFrame | None = None

    @property
    def pending(self) -> int:
        """Bytes in the output buffer."""
        return len(self._output)

    @property
    def streaming(self) -> bool:
        """Between START and STOP."""
        return self._stream is not None

    def receive(self, data: bytes) -> None:
        """Obey the commands that these bytes complete, and answer them."""
        self.advance(0)  # what was due before comes first
        for packet in self._parser.feed(data):
            self._commands += isinstance(packet, Command | Rejected)
            if isinstance(packet, Command):
                self._obey(packet)
            elif isinstance(packet, Rejected):
                self.commands_refused += 1
                self._send(packet.ack())

    def advance(self, wanted: int = 1) -> float:
        """Put what is due by now in the output buffer; at speed 0, at least `wanted` bytes.

        Returns the seconds of host time until something else is due; at speed 0 while streaming,
        infinity: nothing comes by waiting.
        """
        self._pass_time()
        enough_s = self._host_s + MAKE_S
        while self._due_s <= self._now_s or (self._hurried and self.pending < wanted):
            self._now_s = max(self._now_s, self._due_s)
            self._emit()
            if not self._hurried and self._clock() > enough_s:
                self._pass_time()
                self._lose_frames()
                return 0.0
        if self._hurried:
            return math.inf
        self._pass_time()  # making packets has taken some
        return max(0.0, self._due_s - self._now_s) / (self.options.speed or 1.0)

    def take(self, size: int) -> bytes:
        """Remove at most `size` bytes from the output buffer."""
        data = bytes(self._output[:size])
        del self._output[:size]
        return data

    def truth(self, frame_number: int) -> NodeFrame:
        """What the nodes measured and said in a frame, in the present set-up; 0 is START's.

        Recomputed, so that any frame may be asked for; in rising order that costs least.
        """
        if self._truth is None or (self._true_frame and self._true_frame.number > frame_number):
            self._truth, self._true_frame = self._new_truth(), None
        while self._true_frame is None or self._true_frame.number < frame_number:
            self._true_frame = next(self._truth)
        return self._true_frame

    def _new_truth(self) -> Iterator[NodeFrame]:
        called = RollCalls(self._roll_calls.starts)  # what is asked for is the stream's to begin
        return truth(self.options, self.setup, called)

    def info(self) -> Info:
        """The description that it gives of itself."""
        setup, channel = self.setup, self.options.channel
        return Info(
            frame=FrameLayout.of(setup.spec, setup.samples_per_chip),
            sample_rate_uhz=round(setup.rate_hz * 1e6),
            volts_per_count=channel.volts_per_count(setup.spec),
            zero_count=channel.zero_count(setup.spec),
            min_count=channel.min_count,
            max_count=channel.max_count,
            sync_mode=setup.sync,
            integrated=setup.integrated,
            quiet_uv=setup.quiet_uv,
            digitizer_id=b"sim\0" + self.options.seed.to_bytes(4, "little"),
        )

    @property
    def _command_errors(self) -> int:
        seen = self._parser.counters
        broken = seen.framing_errors + seen.crc_errors + seen.resyncs
        return broken + seen.packets - self._commands  # an echo of its own, for one

    @property
    def _hurried(self) -> bool:
        return self.options.speed == 0 and self.streaming

    def _pass_time(self) -> None:
        host_s = self._clock()
        if not self._hurried:
            self._now_s += (host_s - self._host_s) * (self.options.speed or 1.0)
        self._host_s = host_s

    def _lose_frames(self) -> None:
        """Skip as many whole frames as are due for longer than the output would be kept."""
        setup = self.setup
        period_s = setup.spec.frame_period_s
        behind_s = self._now_s - self._due_s
        if not self.streaming or behind_s < max(period_s, BUFFER_S * self.options.speed):
            return
        lost = int(behind_s / period_s)
        before = self._index_lost
        self._frames_lost += lost
        self.samples_lost += self._index_lost - before
        self.started_s += lost * period_s
        self._prepare_s += lost * period_s
        self._report_s = max(self._report_s, self._now_s)
        self._overrun = True
        self._schedule()

    @property
    def _index_lost(self) -> int:
        """Samples of the frames that were lost since START."""
        setup = self.setup
        size = setup.spec.frame_period_s * setup.rate_hz
        return round(self._frames_lost * (setup.spec.chips if setup.integrated else size))

    def _emit(self) -> None:
        """Send what is due next."""
        if self._due_s == self._report_s:
            self._report()
        elif not self._blocks:
            assert self._stream is not None, "something is due: it must be a block"
            while not self._blocks or self._blocks[-1].waits:
                self._blocks.append(next(self._stream))
        else:
            block = self._blocks.popleft()
            self._prepare_s = self._due_s + (0.0 if self._hurried else _PREPARE_S)
            make = Quiet.of if block.quiet else Samples
            device_time_us = round((self.started_s + block.begin_s) * 1e6)
            self._send(
                make(
                    device_time_us,
                    block.first_index + self._index_lost,
                    block.counts,
                    block.sync,
                    overrun=self._overrun,
                    called=block.called,
                )
            )
            self._overrun = False
        self._schedule()

    def _schedule(self) -> None:
        """Find out when something is due next."""
        self._due_s = self._report_s
        if self._blocks:
            self._due_s = min(self._due_s, self.started_s + self._blocks[0].due_s)
        elif self._stream is not None:
            self._due_s = min(self._due_s, self._prepare_s)

    def _report(self) -> None:
        self._send(self.info())
        self._send(
            Status(
                uptime_us=round(self._report_s * 1e6),
                samples_lost=self.samples_lost,
                packets_dropped=self.packets_dropped,
                commands_refused=self.commands_refused,
                command_errors=self._command_errors,
                streaming=self.streaming,
            )
        )
        self._report_s += REPORT_S

    def _send(self, packet: Packet) -> None:
        data = self._writer.encode(packet)
        bytes_per_s = 2 * self.setup.rate_hz * max(1.0, self.options.speed)
        room = max(MIN_BUFFER, int(BUFFER_S * bytes_per_s)) - self.pending
        if not isinstance(packet, Samples | Quiet):
            room += _REPORT_RESERVE
        if len(data) <= room or self._hurried:
            self._output += data
        else:
            self.packets_dropped += 1

    def _obey(self, command: Command) -> None:
        result = Result.OK
        match command:
            case Start():
                self._stop()
                self._roll_calls = RollCalls()
                self._stream = stream(self.options, self.setup, self._roll_calls, self._disturbance)
                self.started_s = self._prepare_s = self._now_s
                self._frames_lost, self._overrun = 0, False
                self._truth = None
            case Stop():
                self._stop()
            case RollCall():
                marked = self.setup.sync != SyncMode.NONE and not self.setup.integrated
                if self.streaming and marked:
                    self._roll_calls.asked = True
                else:
                    result = Result.UNSUPPORTED
            case Configure():
                result = self._configure(command)
        self._schedule()
        self.commands_refused += result != Result.OK
        self._send(command.ack(result))
        if isinstance(command, GetInfo | Configure):
            self._send(self.info())

    def _configure(self, command: Configure) -> Result:
        """Take over a set-up as far as the options leave it open; this ends a stream."""
        layout = command.frame
        try:
            self.setup = self.options.setup(
                Setup(
                    layout.spec(),
                    layout.samples_per_chip,
                    command.sync_mode,
                    command.integrated,
                    command.quiet_uv,
                )
            )
        except SpecError:
            return Result.UNSUPPORTED
        self._stop()
        self._truth = None
        return Result.OK

    def _stop(self) -> None:
        self._stream = None
        self._blocks.clear()


def _samples(
    options: SimOptions, setup: Setup, frame: NodeFrame, disturbance: Disturbance | None
) -> NDArray[np.int16]:
    """Raw samples from the start of a frame to the start of the next."""
    spec, channel = setup.spec, options.channel
    rng = np.random.default_rng([options.seed, frame.number])
    next_s = frame_start_s(spec, frame.number + 1, options.start_phase)
    first, stop = np.maximum(first_sample([frame.start_s, next_s], setup.rate_hz), 0).tolist()
    edges_s = frame.start_s + channel.edges(spec, rng)
    clocks = options.clocks.at(spec.nodes, frame.start_s)
    line_v = np.zeros(stop - first, np.float32)
    for levels, own_s in waveforms(spec, frame.codes, frame.active, edges_s, clocks):
        line_v += point_samples(levels, own_s, setup.rate_hz, first, stop)
    if disturbance:
        for levels, own_s in disturbance.added(frame, edges_s):
            line_v += point_samples(levels, own_s, setup.rate_hz, first, stop)
        t_s = (np.arange(first, stop) + 0.5) / setup.rate_hz
        line_v = disturbance.disturbed(frame, line_v, t_s)
    return channel.digitize(line_v, spec, rng)


def _chips(
    options: SimOptions, setup: Setup, frame: NodeFrame, disturbance: Disturbance | None
) -> NDArray[np.int16]:
    """Mean values of the coded chips of a frame."""
    spec, channel = setup.spec, options.channel
    rng = np.random.default_rng([options.seed, frame.number])
    edges_s = channel.edges(spec, rng)
    clocks = options.clocks.at(spec.nodes, frame.start_s)
    nominal = clocks is None and not (channel.stretch or channel.jitter)
    means = np.zeros(spec.chips, np.float32)
    for levels, own_s in waveforms(spec, frame.codes, frame.active, edges_s, clocks):
        seen = levels if nominal else chip_means(levels, own_s, spec.chip_s)
        means += seen[spec.places]
    if disturbance:
        for levels, own_s in disturbance.added(frame, edges_s):
            means += chip_means(levels, own_s, spec.chip_s)[spec.places]
        t_s = np.asarray(frame.start_s + (spec.places + 0.5) * spec.chip_s, dtype=np.float64)
        means = disturbance.disturbed(frame, means, t_s)
    return channel.digitize(means, spec, rng, averaged=setup.samples_per_chip)
