# SPDX-License-Identifier: Apache-2.0

"""Speaks for a source as a digitizer does, through a port of pyserial: all else is the same.

A packet of samples is a frame: a count is a code, or NO_READING.
"""

import math
import time
import zlib
from collections import deque

import numpy as np

from ..base.arrays import Counts
from ..base.errors import SpecError
from ..code.frame import FrameSpec
from ..config.skin_config import chips_that_fit
from ..wire._protocol import MAX_SAMPLES, Result, SyncMode
from ..wire.identity import NO_READING, SOURCE_ID, UNSCALED
from ..wire.messages import (
    Command,
    Configure,
    FrameLayout,
    GetInfo,
    Info,
    Packet,
    Samples,
    Start,
    Status,
    Stop,
)
from ..wire.packets import Outbox, PacketParser, PacketWriter
from ..wire.virtual_port import VirtualPort
from .taxel_source import TaxelFrame, TaxelSource, open_source

MOST_BITS = 15
"""Bits of a code that fit a count beside NO_READING."""
USUAL_BITS = 10
"""Bits of a code where nobody says: those of an Arduino's analogRead."""
REPORT_S = 1.0
"""s between descriptions and reports, as the protocol asks of digitizers."""
MEASURED_S = 0.5
"""s of frames by which their period is known. Chosen: a USB adapter hands on bytes every 16 ms."""
OTHER_PACE = 0.1
"""Share by which the period has to differ to be told anew. Chosen: others rest on it roughly."""


class SourceDigitizer(Outbox):
    """Makes packets of a source's frames, and obeys commands.

    problem: why no frames come, in one sentence; None where nothing is known to be wrong.
    """

    def __init__(self, source: TaxelSource, url: str) -> None:
        super().__init__(b"\0")  # a delimiter ends whatever was on the line before
        self.source = source
        self._id = SOURCE_ID + zlib.crc32(url.encode()).to_bytes(4, "little")
        self._parser, self._writer = PacketParser(), PacketWriter()
        self._asked: FrameLayout | None = None
        self._nodes: int | None = None
        self._info: Info | None = None
        self._streaming = False
        self._refused: str | None = None
        self._seen = deque[tuple[float, int]]()  # times and numbers of frames
        self._period_s: float | None = None
        self._number, self._told_number = -1, -1
        self._told_us, self._sent_us, self._report_s = -1, -1, 0.0

    @property
    def problem(self) -> str | None:
        return self._refused or self.source.problem

    def advance(self, wanted: int) -> float:
        """Wait for frames of the source, as long as it does, unless some are pending; returns 0."""
        if self._output:
            return 0.0
        for frame in self.source.read(self._nodes):
            self._hear(frame)
        if (now_s := time.monotonic()) >= self._report_s:
            self._report_s = now_s + REPORT_S
            if (info := self._described()) is not None:
                status = Status(uptime_us=max(self._sent_us, 0), streaming=self._streaming)
                self._send(info, status)
        return 0.0

    def receive(self, data: bytes) -> None:
        """Obey the commands that these bytes complete, and answer them."""
        for packet in self._parser.feed(data):
            if not isinstance(packet, Command):
                continue
            is_known = isinstance(packet, Start | Stop | Configure | GetInfo)
            if isinstance(packet, Start | Stop):
                self._streaming = isinstance(packet, Start)
            elif isinstance(packet, Configure):
                self._asked, self._nodes = packet.frame, packet.frame.nodes
            self._send(packet.ack(Result.OK if is_known else Result.UNKNOWN_COMMAND))
            if isinstance(packet, GetInfo | Configure) and (info := self._described()) is not None:
                self._send(info)

    def _hear(self, frame: TaxelFrame) -> None:
        """Make a packet of a frame, or note why it cannot be one."""
        count = len(frame.values)
        # By the sensor's own count of frames, if it has one.
        told = self._told_number + 1 if frame.number is None else frame.number
        passed = told - self._told_number if self._number >= 0 else 1
        self._number, self._told_number = self._number + max(1, passed), told
        if self._nodes is None:
            self._nodes = count
        if count != self._nodes:
            self._refused = f"frames of {count} taxels come, but nodes is {self._nodes}"
            return
        if (counts := self._counts(frame)) is None:
            return
        self._refused = None
        time_s = frame.t_host if frame.t_device is None else frame.t_device
        self._note_pace(time_s)
        if self._info is None and (info := self._described()) is not None:
            self._send(info)
        told_us = round(time_s * 1e6)
        # Several may be read at once, or within one unit of the sensor's time; less is a reset.
        goes_on = told_us >= self._told_us
        self._sent_us = max(told_us, self._sent_us + 1) if goes_on else told_us
        self._told_us = told_us
        if self._streaming and self._info is not None:
            self._send(Samples(self._sent_us, self._number * count, counts, sync=True))

    def _counts(self, frame: TaxelFrame) -> Counts | None:
        """Return a frame's codes as counts; None, with the reason noted, where one is beyond."""
        values = np.asarray(frame.values, np.float64)
        valid = np.isfinite(values) if frame.valid is None else frame.valid & np.isfinite(values)
        if self.source.full_scale_v is not None:
            values = values / self.source.full_scale_v * (1 << self._bits)
        codes = np.floor(np.where(valid, values, 0.0) + 0.5)
        low, high = codes.min(initial=0), codes.max(initial=0)
        if low >= 0 and high < 1 << self._bits <= 1 << MOST_BITS:
            return np.where(valid, codes, NO_READING).astype(np.int16)
        if self._bits > MOST_BITS:
            self._refused = f"bits is {self._bits}; a source has {MOST_BITS} at most"
        else:
            worst = low if low < 0 else high
            self._refused = (
                f"a code of {worst:g} comes, beyond 0…{(1 << self._bits) - 1} of bits "
                f"{self._bits}: set bits to what the sensor's converter has"
            )
        return None

    @property
    def _bits(self) -> int:
        return self.source.bits or (self._asked.bits if self._asked else USUAL_BITS)

    def _described(self) -> Info | None:
        """Describe the source as it is now; None where its taxels or its period are not known."""
        if self._nodes is None or self._period_s is None:
            return None
        known, bits = self._info, self._bits
        if known is not None and (known.frame.nodes, known.frame.bits) == (self._nodes, bits):
            before_s = known.frame.frame_period_us * 1e-6
            if abs(self._period_s - before_s) <= OTHER_PACE * before_s:
                return known
        try:
            if self._nodes > MAX_SAMPLES:
                raise SpecError(f"nodes is {self._nodes}; a source has {MAX_SAMPLES} at most")
            spec = FrameSpec(nodes=self._nodes, bits=bits, frame_period_s=math.inf)
            frame = FrameLayout.of(chips_that_fit(spec, self._period_s), 1)
        except SpecError as error:
            self._refused = str(error)
            return None
        full_scale_v = self.source.full_scale_v
        self._info = Info(
            frame=frame,
            sample_rate_uhz=round(1e15 / frame.chip_ns),
            volts_per_count=full_scale_v / (1 << bits) if full_scale_v else UNSCALED,
            min_count=NO_READING,
            max_count=(1 << bits) - 1,
            sync_mode=SyncMode.DRIVE,
            integrated=True,
            digitizer_id=self._id,
        )
        return self._info

    def _note_pace(self, time_s: float) -> None:
        """Measure the period of frames over the last second; time_s: of one, by its own clock."""
        seen = self._seen
        if seen and time_s < seen[-1][0]:  # the sensor's clock began anew
            seen.clear()
        seen.append((time_s, self._number))
        while len(seen) > 2 and time_s - seen[1][0] > 2 * MEASURED_S:
            seen.popleft()
        passed_s = time_s - seen[0][0]
        if passed_s >= MEASURED_S:
            self._period_s = passed_s / (self._number - seen[0][1])

    def _send(self, *packets: Packet) -> None:
        self._output += b"".join(map(self._writer.encode, packets))


class Serial(VirtualPort[SourceDigitizer]):
    """A source behind a digitizer's packets; open() and read() raise what the source raises."""

    @property
    def problem(self) -> str | None:
        return self._opened().problem

    def close(self) -> None:
        """Close the source, too; closing twice is harmless."""
        device = self._device
        super().close()
        if device is not None:
            device.source.close()

    def _made(self, url: str) -> SourceDigitizer:
        return SourceDigitizer(open_source(url), url)
