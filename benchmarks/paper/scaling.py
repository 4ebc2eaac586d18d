# SPDX-License-Identifier: Apache-2.0

"""Frame time, wires and throughput over the number of nodes, and of other ways to read a skin.

The shortest frame of a pair of boards is computed from the limits that `tactile-cdma node` and the
digitizer's firmware check: a chip is as long as the slowest takes, the node, the converter (one
sample of each chip), or the link. Nodes with crystals of their own start anew at every bit.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

from matplotlib.axes import Axes

from tactile_cdma.code.codes import smallest_order
from tactile_cdma.code.frame import MEASURING_S
from tactile_cdma.hardware.node_memory import FAST, MCUS, Mcu

from .claims import DIFFERS, EXCEEDED, REPRODUCED, Claim

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results.json"
BITS = 10
LIMIT_S = 0.02
"""The paper's: below 20 ms into the thousands of nodes."""
SAMPLE_BYTES = 1.5
"""Bytes of a sample in PACKED; its head, and that of USB, are in the links' rates."""
USB, UART, HIGH_SPEED = 1e6, 180e3, 30e6
"""Bytes of samples per second; `make firmware-figures`: 0.99 MB/s by USB without loss."""
SIXTEEN = Mcu("", 4096, 250, 16_000, 125, bits_restart=True, restart_s=80e-6)
"""Nodes as the fast ones, but at 16 MHz, which takes a supply of 4.5 V; not built or emulated."""

Pair = tuple[Mcu, float, float]
"""A node, samples per second of the converter, bytes per second of the link."""
BEST = "fast ATmega328P; RP2040"
"""The best pair for which there is firmware."""
PAIRS: dict[str, Pair] = {
    "ATtiny85; RP2040": (MCUS["attiny85"], 500e3, USB),
    "ATmega328P; RP2040": (MCUS["atmega328p"], 500e3, USB),
    "fast ATmega328P; RP2040 on a UART of 2 Mbaud": (MCUS[FAST], 500e3, UART),
    BEST: (MCUS[FAST], 500e3, USB),
    "fast ATmega328P; a converter of 2 MS/s on full-speed USB": (MCUS[FAST], 2e6, USB),
    "fast ATmega328P; the same on high-speed USB": (MCUS[FAST], 2e6, HIGH_SPEED),
    "16 MHz nodes; 4 MS/s on high-speed USB": (SIXTEEN, 4e6, HIGH_SPEED),
}
SIZES = (16, 64, 256, 900, 4096)
MATRIX_S = 4e-6
"""Per taxel of a scanned matrix: a conversion at 500 kS/s, and as long for it to settle."""
I2C_S, I2C_MOST = 29 / 400e3, 112
"""Per node on a fast-mode bus: start, address, two data bytes with acknowledges, stop; and the most
addresses that a bus has (NXP UM10204)."""


def period_s(order: int, pair: Pair) -> float:
    """Duration of the shortest frame and the pause in which nodes measure, s."""
    mcu, samples_hz, bytes_per_s = pair
    least_s = max(mcu.chip_ns * 1e-9, 1 / samples_hz, SAMPLE_BYTES / bytes_per_s)
    step_s = mcu.chip_step_ns * 1e-9
    chip_s = math.ceil(least_s / step_s - 1e-9) * step_s
    guard_chips = math.ceil(mcu.restart_s / chip_s - 1e-9) if mcu.bits_restart else 0
    return (BITS * order + (BITS - 1) * guard_chips) * chip_s + MEASURING_S


def most_nodes(pair: Pair) -> int:
    """Return the most nodes whose rows fit their memory and whose frame takes less than 20 ms."""
    nodes = 0
    while (order := smallest_order(nodes + 2)) <= pair[0].order and period_s(order, pair) < LIMIT_S:
        nodes += 1
    return nodes


def ways(nodes: int) -> dict[str, tuple[int, float] | None]:
    """Wires, supply and ground included, and time, s, of a reading of all; None if impossible."""
    side = math.ceil(math.sqrt(nodes))
    own_s = period_s(smallest_order(nodes + 1), PAIRS[BEST])
    return {
        "scanned matrix, one converter": (2 * side, nodes * MATRIX_S),
        "time slots on a wire": (4, nodes * BITS * 2e-6 + MEASURING_S),
        "I²C, 400 kHz": (4, nodes * I2C_S) if nodes <= I2C_MOST else None,
        "this": (4, own_s),
    }


def scale_rows() -> list[tuple[int, float]]:
    """Return nodes, and ms from a frame's begin until it is published: the last bench-scale."""
    table = json.loads(RESULTS.read_text(encoding="utf-8"))["scale"]["tables"][0]
    head, *rows = table
    at = {name: head.index(name) for name in ("nodes", "scene", "latency ms")}
    return [(row[at["nodes"]], row[at["latency ms"]]) for row in rows if row[at["scene"]] == "all"]


def claims() -> list[Claim]:
    """Abstract and section II.A."""
    orders = {nodes: smallest_order(nodes) for nodes in (500, 800)}
    built, boards = most_nodes(PAIRS[BEST]), PAIRS["fast ATmega328P; the same on high-speed USB"]
    error = json.loads(RESULTS.read_text(encoding="utf-8"))["error"]["results"]
    latencies = scale_rows()
    below = max(nodes for nodes, ms in latencies if ms < 1e3 * LIMIT_S)
    return [
        Claim(
            "IV.B",
            f"wrong words in {error['paper_frames']:,} frames every 12.8 ms",
            "–",
            str(error["paper_wrong"]),
            "`make bench-error`",
            REPRODUCED,
        ),
        *(
            Claim(
                "II.A",
                f"chips per bit of {nodes} nodes",
                str(paper),
                str(orders[nodes]),
                COMMAND,
                EXCEEDED,
            )
            for nodes, paper in ((500, 512), (800, 1024))
        ),
        Claim(
            "abstract",
            "nodes below 20 ms, with boards that are emulated to the pin",
            "thousands",
            f"{built}",
            "`make firmware-thousand`",
            DIFFERS,
            "the RP2040's converter takes 500,000 samples/s; other boards, of which none is "
            f"built: {most_nodes(boards):,}",
        ),
        Claim(
            "abstract",
            "nodes below 20 ms, simulated, from a frame's begin to its message",
            "thousands",
            f"{below:,}",
            "`make bench-scale`",
            REPRODUCED if below >= 2000 else DIFFERS,
            f"4096 take {dict(latencies)[4096]:.1f} ms with chips of 0.44 µs",
        ),
    ]


COMMAND = "`make paper`"


def draw(latency: Axes, wires: Axes, time: Axes) -> None:
    """Latency over the number of nodes, and what the paper asserts of other ways."""
    latency.semilogx(*zip(*scale_rows(), strict=True), "o-", ms=3, lw=1, label="simulated")
    nodes = [16, 64, 256, most_nodes(PAIRS[BEST])]
    own_ms = [1e3 * period_s(smallest_order(n + 1), PAIRS[BEST]) for n in nodes]
    latency.semilogx(nodes, own_ms, "s-", ms=3, lw=1, label="fast nodes, RP2040: shortest frame")
    latency.axhline(1e3 * LIMIT_S, color="tab:red", ls="--", lw=0.8)
    latency.legend(fontsize=7)
    latency.set(title="latency below 20 ms", xlabel="nodes", ylabel="ms", ylim=(0, 24))
    for name in ways(16):
        known = [(n, found) for n in SIZES if (found := ways(n)[name])]
        marks = {"marker": "o", "ms": 3, "lw": 1, "label": name}
        wires.loglog([n for n, _ in known], [found[0] for _, found in known], **marks)
        time.loglog([n for n, _ in known], [1e3 * found[1] for _, found in known], **marks)
    time.axhline(1e3 * LIMIT_S, color="tab:red", ls="--", lw=0.8)
    wires.legend(fontsize=7)
    wires.set(title="wires, supply included", xlabel="nodes")
    time.set(title="time to read all nodes", xlabel="nodes", ylabel="ms")
