# SPDX-License-Identifier: Apache-2.0

"""Samples simulated voltages as the RP2040 does, and has the driver's pipeline decode them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.wire._protocol import SyncMode, SyncWire
from tactile_cdma.wire.messages import FrameLayout, Info, Packet, Samples
from tactile_cdma.wire.packets import PacketWriter

PERIODS = 3
"""Periods that the decoder sees, all of them the same frame."""


class Sampled(Protocol):
    """Knows one count of the converter, V, and when a chip's first sample is taken, s."""

    @property
    def count_v(self) -> float: ...
    @property
    def sample_s(self) -> float: ...


def wrong_words(
    config: SkinConfig,
    front: Sampled,
    times: NDArray[np.float64],
    volts: NDArray[np.float64],
    sent: NDArray[np.int64],
    held_s: float = 0.0,
) -> int:
    """Count words of PERIODS frames that are not as sent (−1: by nobody), or are missing."""
    decoded = [*_decoded(config, front, times, volts, held_s)]
    wrong = sum(int(np.sum(np.where(active, said, -1) != sent)) for active, said in decoded)
    return wrong + (PERIODS - len(decoded)) * config.spec.nodes


def _decoded(
    config: SkinConfig,
    front: Sampled,
    times: NDArray[np.float64],
    volts: NDArray[np.float64],
    held_s: float = 0.0,
) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.int32]]]:
    """Yield who spoke, and the codes, of the frames found in PERIODS of these volts."""
    pipeline, writer = Pipeline(config), PacketWriter()
    packets = packets_of(config, front, times, volts, held_s)
    frames = [f for p in packets for f in pipeline.feed(writer.encode(p), 0.0)]
    yield from ((frame.words.active, frame.words.codes) for frame in frames[:PERIODS])


def packets_of(
    config: SkinConfig,
    front: Sampled,
    times: NDArray[np.float64],
    volts: NDArray[np.float64],
    held_s: float = 0.0,
    periods: int = PERIODS,
) -> list[Packet]:
    """Sample a period's volts, again and again: what a digitizer would send, and one period more.

    held_s: end of the period in which it holds its last sample, s.
    """
    spec, per_chip = config.spec, config.samples_per_chip
    integrated = per_chip == 1
    if integrated:
        instants = spec.places * spec.chip_s + front.sample_s
        period = spec.chips
    else:
        period = round(spec.frame_period_s / spec.chip_s * per_chip)
        instants = (np.arange(period) + 0.5) * spec.chip_s / per_chip
    counts = np.clip(np.interp(instants, times, volts) / front.count_v, 0, 4095).astype(np.int16)
    held = instants >= spec.frame_period_s - held_s
    counts[held] = counts[~held][-1]
    step_s = spec.chip_s / per_chip
    info = Info(
        frame=FrameLayout.of(spec, per_chip),
        sample_rate_uhz=round(1e6 / step_s),
        volts_per_count=front.count_v,
        zero_count=2048,
        min_count=0,
        max_count=4095,
        sync_mode=SyncMode.DRIVE,
        integrated=integrated,
        sync_wire=SyncWire[config.sync_wire.upper()],
    )
    packets: list[Packet] = [info]
    for number in range(periods + 1):  # the last one ends the frame before it
        begin_us = round((1 + number * spec.frame_period_s) * 1e6)
        for first in range(0, period, 4096):
            part = counts[first : first + 4096]
            late_us = (spec.places[first] * spec.chip_s if integrated else first * step_s) * 1e6
            index = number * period + first
            packets.append(Samples(begin_us + round(late_us), index, part, sync=first == 0))
    return packets
