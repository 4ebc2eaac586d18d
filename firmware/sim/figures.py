# SPDX-License-Identifier: Apache-2.0

"""Measure time awake and load of the images, for docs/firmware.md: `make firmware-figures`."""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from check import FAST_SKIN, PARAMS, THOUSAND
from emulated import EmulatedSkin, EmulationError
from rp2040 import CPU_HZ, EmulatorError, Rp2040
from rp2040_skin import IMAGE
from skin import reference_amplifier, reference_nodes
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.frame_rate import FAST, MCUS
from tactile_cdma.config.parameters import DATA, OWN, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.session import Session
from tactile_cdma.wire.messages import Configure, FrameLayout, Pack, Samples, Start, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter

SETTLED_NS, SPAN_NS = 300_000_000, 1_000_000_000
READY_S, SPAN_S = 0.1, 1.2
AWAKE_MA, ASLEEP_MA = 3.0, 0.5
"""Current of an AVR at 8 MHz and 3.3 V, mA, active and idle: typical curves of the data sheets."""
LINKS = {  # name: chip, s; samples per chip; whether over USB
    "USB, 80 kS/s": (50e-6, 4, True),
    "USB, 500 kS/s": (8e-6, 4, True),
    "USB, chips of 2 µs, packed": (2e-6, 1, True),
    "UART, 80 kS/s": (50e-6, 4, False),
    "UART, 90 kS/s": (33.33e-6, 3, False),
}


def share_awake(config: SkinConfig, mcu: str, threshold: int) -> float:
    """Mean share of time that nodes at rest are awake; threshold 0: they transmit nevertheless."""
    nodes = reference_nodes(config, mcu=mcu, threshold=threshold, heartbeat=0)
    with EmulatedSkin(nodes, reference_amplifier(config)) as skin:
        skin.press([node.supply_v for node in nodes])
        skin.write(Session(config).open())
        skin.run(SETTLED_NS)
        before = [skin.counters(node) for node in range(len(nodes))]
        skin.run(SETTLED_NS + SPAN_NS)
        after = [skin.counters(node) for node in range(len(nodes))]
    awake = sum(a.cycles_awake - b.cycles_awake for a, b in zip(after, before, strict=True))
    asleep = sum(a.cycles_asleep - b.cycles_asleep for a, b in zip(after, before, strict=True))
    return awake / (awake + asleep)


def usual_skin(mcu: str) -> SkinConfig:
    """Return the skin that nodes of a kind are usual in."""
    if mcu == FAST:
        return SkinConfig.of(read_file(THOUSAND) | FAST_SKIN)
    return SkinConfig.of(read_file(PARAMS) | {"sync_wire": OWN if MCUS[mcu].hears_own else DATA})


def current_ma(awake: float) -> float:
    """Return the mean current of a node that is awake for this share of time, mA."""
    return ASLEEP_MA + (AWAKE_MA - ASLEEP_MA) * awake


def share_at_rest(mcu: str) -> float:
    """Return a node's current at rest over that when it transmits in every frame."""
    config = usual_skin(mcu)
    silent, talking = (current_ma(share_awake(config, mcu, threshold)) for threshold in (1, 0))
    return silent / talking


def digitizer(chip_s: float, samples_per_chip: int, usb: bool) -> tuple[float, int, int]:
    """Measure the RP2040's load while it streams; samples received, lost, packets dropped."""
    order = 20 if samples_per_chip > 1 else 912
    period_s = round(1.2 * 10 * order * chip_s, 6)
    spec = FrameSpec(chip_s=chip_s, frame_period_s=period_s, order=order)
    one = samples_per_chip == 1
    layout = FrameLayout.of(spec, samples_per_chip)
    commands = Configure(layout, integrated=one), *[Pack()] * one, Start()
    parser, writer = PacketParser(), PacketWriter()
    with Rp2040(IMAGE, _noise) as chip:
        if usb:
            chip.plug_usb()
        chip.run(READY_S)
        (chip.write_usb if usb else chip.write_uart)(b"".join(map(writer.encode, commands)))
        cycles = chip.cycles
        chip.run(READY_S + SPAN_S)
        load = (chip.cycles - cycles) / (SPAN_S * CPU_HZ)
        packets = parser.feed(chip.read_usb() if usb else chip.read_uart())
    samples = sum(packet.counts.size for packet in packets if isinstance(packet, Samples))
    status = [packet for packet in packets if isinstance(packet, Status)][-1]
    return load, samples, status.samples_lost + status.packets_dropped


def _noise(times_ns: NDArray[np.float64]) -> NDArray[np.uint16]:
    return np.random.default_rng(1).integers(0, 4096, times_ns.size).astype(np.uint16)


def main() -> int:
    """Print a line per figure."""
    try:
        for mcu in MCUS:
            silent, talking = (share_awake(usual_skin(mcu), mcu, threshold) for threshold in (1, 0))
            print(
                f"{mcu}: awake_silent={silent:.3f} awake_talking={talking:.3f} "
                f"silent_ma={current_ma(silent):.1f} talking_ma={current_ma(talking):.1f}",
                flush=True,
            )
        for name, how in LINKS.items():
            load, samples, lost = digitizer(*how)
            print(f"{name}: cpu_load={load:.3f} samples={samples} lost={lost}", flush=True)
    except (EmulationError, EmulatorError) as error:
        print(f"firmware-figures: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
