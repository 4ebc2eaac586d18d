# SPDX-License-Identifier: Apache-2.0

"""Stamps that the driver gives the frames of a clock model."""

import math
from collections.abc import Iterable
from typing import NamedTuple

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.recording.offline import fitted_clocks
from tactile_cdma.wire.messages import Quiet
from tactile_cdma.wire.packets import PacketWriter

from .clock_model import FRAME_S, PERIOD_S, RATE_HZ, SAMPLES, SAMPLES_PER_PERIOD, Read
from .simulated import introduction


class Stamped(NamedTuple):
    """A frame: when it was, by how much its stamp is off, and may be by its own words, s."""

    true_s: float
    off_s: float
    claimed_s: float


def silent_pipeline() -> tuple[Pipeline, PacketWriter]:
    """Of a skin of 16 nodes whose digitizer has introduced itself."""
    config = SkinConfig.of({"nodes": 16, "order": 20, "frame_period_ms": 1e3 * PERIOD_S})
    writer = PacketWriter()
    assert math.isclose(config.spec.frame_s, FRAME_S)
    pipeline = Pipeline(config)
    pipeline.feed(writer.encode(introduction(config, quiet_uv=2000)), 0.0)
    assert pipeline.problem is None
    return pipeline, writer


def stamped(pipeline: Pipeline, writer: PacketWriter, sent: Iterable[Read]) -> list[Stamped]:
    """What becomes of packets; a frame is found with its packet, or with the next one."""
    found: list[Stamped] = []
    true_s: list[float] = []
    for read in sent:
        true_s.append(read.true_s)
        frames = pipeline.feed(_told(writer, read), read.t_host, read.had_waited)
        for its_s, one in zip(true_s[len(true_s) - len(frames) :], frames, strict=True):
            found.append(Stamped(its_s, one.t_host - its_s, one.stamp_uncertainty_s))
    return found


def recorded(sent: Iterable[Read]) -> list[Stamped]:
    """The same of packets that were recorded, and are read when all have come."""
    pipeline, writer = silent_pipeline()
    reads = list(sent)
    begin = PacketWriter().encode(introduction(pipeline.config, quiet_uv=2000))
    said = [(begin, 0.0), *((_told(writer, read), read.t_host) for read in reads)]
    pipeline = Pipeline(pipeline.config, clocks=fitted_clocks(pipeline.config, said))
    frames = [frame for data, t_host in said for frame in pipeline.feed(data, t_host)]
    return [
        Stamped(read.true_s, frame.t_host - read.true_s, frame.stamp_uncertainty_s)
        for read, frame in zip(reads, frames, strict=False)
    ]


def _told(writer: PacketWriter, read: Read) -> bytes:
    """The packets of a frame, and of the gap before it."""
    frame, gap = SAMPLES, SAMPLES_PER_PERIOD - SAMPLES
    before_us, before = read.device_us - round(1e6 * gap / RATE_HZ), read.first_index - gap
    rest = [Quiet(before_us, before, gap, 0, gap)] if before > 0 else []
    own = Quiet(read.device_us, read.first_index, frame, 0, frame, sync=True)
    return b"".join(writer.encode(packet) for packet in [*rest, own])
