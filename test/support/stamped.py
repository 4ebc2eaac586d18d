# SPDX-License-Identifier: Apache-2.0

"""Stamps that the driver gives the frames of a clock model."""

import math
from collections.abc import Iterable
from typing import NamedTuple

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
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
    frame, gap = SAMPLES, SAMPLES_PER_PERIOD - SAMPLES
    found: list[Stamped] = []
    true_s: list[float] = []
    for read in sent:
        true_s.append(read.true_s)
        before_us, before = read.device_us - round(1e6 * gap / RATE_HZ), read.first_index - gap
        rest = [Quiet(before_us, before, gap, 0, gap)] if before > 0 else []
        own = Quiet(read.device_us, read.first_index, frame, 0, frame, sync=True)
        data = b"".join(writer.encode(packet) for packet in [*rest, own])
        frames = pipeline.feed(data, read.t_host, read.had_waited)
        for its_s, one in zip(true_s[len(true_s) - len(frames) :], frames, strict=True):
            found.append(Stamped(its_s, one.t_host - its_s, one.stamp_uncertainty_s))
    return found
