# SPDX-License-Identifier: Apache-2.0

"""A recorded stretch of packets, repeated with continued numbers, times and CRCs."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.session import Session
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.messages import Info, Packet, Quiet, Samples
from tactile_cdma.wire.packets import PacketParser, PacketWriter, wrap

_HEAD = struct.Struct("<BHQQ")
"""Type, sequence, device_time_us and first_index: how Samples and Quiet begin."""
_WHERE_BYTES = 16
"""Size of device_time_us and first_index."""
_SEQUENCES = 2**16


class Told(NamedTuple):
    """A packet of Samples or Quiet, counted from the start of its frame period.

    time_us, place: time and index of its first sample. due_us: when it is sent. body: the bytes
    after type, sequence, time and index.
    """

    kind: int
    time_us: int
    place: int
    due_us: int
    body: bytes


@dataclass(frozen=True)
class Stretch:
    """Whole frame periods of a digitizer's packets, and the truth about them.

    info: of the digitizer. frames: packets by period. period_us, period_samples: its length.
    active: (l, n) bool, nodes that spoke. codes: (l, n) int64.
    """

    info: Info
    frames: tuple[tuple[Told, ...], ...]
    period_us: int
    period_samples: int
    active: NDArray[np.bool_]
    codes: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.frames)


class LapWriter:
    """Writes packets of a stretch for another time, with new CRC and COBS.

    sequence: of the next packet. packets, bytes: written so far.
    """

    def __init__(self, sequence: int = 0) -> None:
        self._others = PacketWriter()
        self.sequence = sequence
        self.packets = self.bytes = 0

    def tell(self, told: Told, begin_us: int, begin_index: int) -> bytes:
        """Bytes of a packet whose frame period begins at this time and index."""
        head = _HEAD.pack(
            told.kind, self.sequence, begin_us + told.time_us, begin_index + told.place
        )
        return self._count(wrap(head + told.body))

    def encode(self, packet: Packet) -> bytes:
        """Bytes of any other packet."""
        self._others.sequence = self.sequence
        return self._count(self._others.encode(packet))

    def _count(self, data: bytes) -> bytes:
        self.sequence = (self.sequence + 1) % _SEQUENCES
        self.packets += 1
        self.bytes += len(data)
        return data


def record(config: SkinConfig, options: SimOptions, count: int) -> Stretch:
    """Record the first frame periods of a simulated skin."""
    digitizer = VirtualDigitizer(replace(options, speed=0.0))
    digitizer.receive(Session(config).open())
    parser, periods = PacketParser(), list[list[Samples | Quiet]]()
    while len(periods) <= count:
        digitizer.advance(65_536)
        for packet in parser.feed(digitizer.take(digitizer.pending)):
            if isinstance(packet, Samples | Quiet):
                if packet.sync:
                    periods.append([])
                periods[-1].append(packet)
    info = digitizer.info()
    period_us = round(config.spec.frame_period_s * 1e6)
    started_us = round(digitizer.started_s * 1e6)
    said = list(islice(truth(digitizer.options, digitizer.setup), count))
    return Stretch(
        info=info,
        frames=tuple(
            tuple(_told(period, info, period_us, started_us + number * period_us))
            for number, period in enumerate(periods[:count])
        ),
        period_us=period_us,
        period_samples=periods[1][0].first_index - periods[0][0].first_index,
        active=np.array([frame.active for frame in said]),
        codes=np.array([frame.codes for frame in said]),
    )


def _told(
    period: list[Samples | Quiet], info: Info, period_us: int, begin_us: int
) -> Iterator[Told]:
    begin, frame_us = period[0], _length_us(period[0], info)
    for packet in period:
        time_us = packet.device_time_us - begin_us
        due_us = time_us + _length_us(packet, info)
        if isinstance(begin, Quiet) and isinstance(packet, Quiet) and packet is not begin:
            # QUIET of a gap after a silent frame is sent with the next frame.
            due_us = period_us + begin.device_time_us - begin_us + frame_us
        place = packet.first_index - begin.first_index
        yield Told(packet.TYPE, time_us, place, due_us, packet.pack()[_WHERE_BYTES:])


def _length_us(packet: Samples | Quiet, info: Info) -> int:
    count = packet.count if isinstance(packet, Quiet) else packet.counts.size
    return round(count / info.sample_rate_hz * 1e6)
