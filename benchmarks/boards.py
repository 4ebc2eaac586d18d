# SPDX-License-Identifier: Apache-2.0

"""How long a frame takes by the number of nodes, for every pair of boards, and what limits it.

Computed from the limits that `tactile-cdma node` and the digitizer's firmware check, which the
emulated boards were run at (`make firmware-test`, `make firmware-thousand`); nothing is timed here.
A chip is as long as the slowest takes: the node, the converter (one sample of each chip), or the
link, which carries 1.5 bytes of each. Nodes with their own crystals start anew at every bit, and so
need one that drifts by less than DRIFT chips in it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from matplotlib.figure import Figure

from tactile_cdma.code.codes import smallest_order
from tactile_cdma.hardware.node_memory import FAST, MCUS, MEASURING_S, Mcu

from .report import Report

NODES = (16, 64, 128, 256, 512, 900, 1023, 2047, 4095)
BITS = 10
SAMPLE_BYTES = 1.5
"""Of PACKED; its head, and that of USB, are in the links' rates."""
DRIFT = 0.1
"""Largest error of a chip's place at the end of a bit, chips: `make bench-timing` loses nothing."""
GOAL_S = 0.02


@dataclass(frozen=True, slots=True)
class Digitizer:
    """samples_hz: of its converter. bytes_per_s: of samples that its link carries."""

    name: str
    samples_hz: float
    bytes_per_s: float


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame of so many nodes. limit: what makes its chips as long as they are, or prevents it.

    crystal_ppm: accuracy that nodes' crystals need; infinite where they follow the sync line.
    """

    order: int
    chip_s: float
    period_s: float
    limit: str
    crystal_ppm: float


RP2040 = Digitizer("RP2040, USB", 500e3, 1e6)
"""`make firmware-figures`: 0.99 MB/s of samples without loss."""
UART = Digitizer("RP2040, UART", 500e3, 180e3)
EXTERNAL = Digitizer("2 MS/s converter, full-speed USB", 2e6, 1e6)
HIGH_SPEED = Digitizer("2 MS/s converter, high-speed USB", 2e6, 30e6)
SIXTEEN = Mcu("", 4096, 250, 16_000, 125, bits_restart=True, restart_s=80e-6)
"""Nodes as the fast ones, but at 16 MHz, which takes a supply of 4.5 V; not built or emulated."""
PAIRS = [
    ("attiny85", MCUS["attiny85"], RP2040),
    ("atmega328p", MCUS["atmega328p"], RP2040),
    (FAST, MCUS[FAST], UART),
    (FAST, MCUS[FAST], RP2040),
    (FAST, MCUS[FAST], EXTERNAL),
    (FAST, MCUS[FAST], HIGH_SPEED),
    ("16 MHz", SIXTEEN, Digitizer("4 MS/s converter, high-speed USB", 4e6, 30e6)),
]


def frame(nodes: int, mcu: Mcu, digitizer: Digitizer) -> Frame | None:
    """The shortest frame, or None where the node's memory has no room for its row."""
    order = smallest_order(nodes + 1)
    if order > mcu.order:
        return None
    least_s = {
        "chip": mcu.chip_ns * 1e-9,
        "converter": 1 / digitizer.samples_hz,
        "link": SAMPLE_BYTES / digitizer.bytes_per_s,
    }
    limit = max(least_s, key=lambda name: least_s[name])
    step_s = mcu.chip_step_ns * 1e-9
    chip_s = math.ceil(least_s[limit] / step_s - 1e-9) * step_s
    guards_s, crystal_ppm = 0.0, math.inf
    if mcu.bits_restart:
        guards_s = (BITS - 1) * math.ceil(mcu.restart_s / chip_s - 1e-9) * chip_s
        crystal_ppm = 1e6 * DRIFT / 2 / order  # digitizer and node may be off either way
    period_s = BITS * order * chip_s + guards_s + MEASURING_S
    return Frame(order, chip_s, period_s, limit, crystal_ppm)


def main() -> None:
    report = Report("boards", "Frame time by nodes and boards, and what limits it")
    figure = Figure(figsize=(8, 5))
    axes = figure.add_subplot(xlabel="nodes", ylabel="frame period, ms", xscale="log", yscale="log")
    rows, most = [], {}
    for name, mcu, digitizer in PAIRS:
        frames = {nodes: frame(nodes, mcu, digitizer) for nodes in NODES}
        label = f"{name}; {digitizer.name}"
        found = {nodes: one for nodes, one in frames.items() if one is not None}
        axes.plot([*found], [one.period_s * 1e3 for one in found.values()], "o-", label=label)
        for nodes, one in frames.items():
            if one is None:
                rows.append([name, digitizer.name, nodes, "", "", "", "", "RAM, EEPROM"])
                continue
            ppm = "" if math.isinf(one.crystal_ppm) else round(one.crystal_ppm)
            rows.append(
                [name, digitizer.name, nodes, one.order, one.chip_s * 1e6, one.period_s * 1e3, ppm,
                 one.limit]
            )  # fmt: skip
        most[label] = in_time(mcu, digitizer)
    axes.axhline(GOAL_S * 1e3, color="gray", linestyle=":")
    axes.legend(fontsize="small")
    axes.grid(which="both", alpha=0.3)
    headers = [
        "node",
        "digitizer",
        "nodes",
        "order",
        "chip, µs",
        "frame, ms",
        "crystal, ppm",
        "limit",
    ]
    report.table(headers, rows)
    report.table(["boards", f"nodes in {GOAL_S * 1e3:g} ms"], [*most.items()])
    report.finish(
        figure,
        nodes_in_20_ms=most[f"{FAST}; {RP2040.name}"],
        nodes_in_20_ms_slow=most[f"atmega328p; {RP2040.name}"],
        nodes_in_20_ms_most=max(most.values()),
    )


def in_time(mcu: Mcu, digitizer: Digitizer) -> int:
    """The most nodes in less than GOAL_S."""
    nodes = 1
    for more in range(1, mcu.order):
        one = frame(more, mcu, digitizer)
        if one is None or one.period_s >= GOAL_S:
            break
        nodes = more
    return nodes


if __name__ == "__main__":
    main()
