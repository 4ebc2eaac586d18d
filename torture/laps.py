# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A recorded stretch of a skin's day, told again and again while time goes on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.driver import Session
from tactile_cdma.messages import Info, Quiet, Samples
from tactile_cdma.protocol import PacketParser
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.skin_config import SkinConfig


@dataclass(frozen=True)
class Stretch:
    """Whole frame periods of a digitizer's packets, and what the nodes said in them.

    frames: the packets of each period, their times and indices counted from its start.
    period_us, period_samples: of one period. active: (l, n) bool, who spoke. codes: (l, n) int64.
    pressure_pa: (l, n) float32, what a driver reads that has heard every node before: the last
        word of each, by the skin's curves.
    """

    info: Info
    frames: tuple[tuple[Samples | Quiet, ...], ...]
    period_us: int
    period_samples: int
    active: NDArray[np.bool_]
    codes: NDArray[np.int64]
    pressure_pa: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.frames)

    def period(self, number: int, first: int = 0) -> Iterator[Samples | Quiet]:
        """The packets of a frame period, counted from power-up; the stream began with `first`."""
        begin_us, begin = number * self.period_us, (number - first) * self.period_samples
        for packet in self.frames[number % len(self)]:
            yield replace(
                packet,
                device_time_us=begin_us + packet.device_time_us,
                first_index=begin + packet.first_index,
            )


def record(config: SkinConfig, options: SimOptions, count: int) -> Stretch:
    """The first frame periods of a simulated skin.

    Every node must speak in them, so that one lap tells where the next begins.
    """
    digitizer = VirtualDigitizer(replace(options, speed=0.0))
    digitizer.receive(Session(config).open())
    parser, frames = PacketParser(), list[list[Samples | Quiet]]()
    while len(frames) <= count:
        digitizer.advance(65_536)
        for packet in parser.feed(digitizer.take(digitizer.pending)):
            if isinstance(packet, Samples | Quiet):
                if packet.sync:
                    frames.append([])
                frames[-1].append(packet)
    period_us = round(config.spec.frame_period_s * 1e6)
    period_samples = frames[1][0].first_index - frames[0][0].first_index
    told = [digitizer.truth(number) for number in range(count)]
    active = np.array([frame.active for frame in told])
    codes = np.array([frame.codes for frame in told])
    if not active.any(axis=0).all():
        raise ValueError(f"not every node speaks in {count} frames")
    return Stretch(
        digitizer.info(),
        tuple(tuple(_from_start(period)) for period in frames[:count]),
        period_us,
        period_samples,
        active,
        codes,
        _held_pa(config, active, codes),
    )


def _from_start(period: list[Samples | Quiet]) -> Iterator[Samples | Quiet]:
    begin = period[0]
    for packet in period:
        yield replace(
            packet,
            device_time_us=packet.device_time_us - begin.device_time_us,
            first_index=packet.first_index - begin.first_index,
        )


def _held_pa(
    config: SkinConfig, active: NDArray[np.bool_], codes: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Pressure of every node's last word in a stretch that comes again and again, (l, n) Pa."""
    adc, curves = config.adc, config.calibration.curves
    held = np.zeros_like(codes)
    last = np.zeros_like(codes[0])
    for _ in range(2):  # what is held at the beginning is known after the first time
        for number, spoke in enumerate(active):
            last = np.where(spoke, codes[number], last)
            held[number] = last
    rest_v = curves.voltage_v[0]
    volts = np.where(held == (1 << adc.bits) - 1, np.maximum(adc.voltage(held), rest_v), adc.voltage(held))
    return np.array([curves.pressure(row.astype(np.float32)) for row in volts])
