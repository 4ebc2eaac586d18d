# SPDX-License-Identifier: Apache-2.0

"""Frame time, wires and throughput over the number of nodes, and of other ways to read a skin.

The shortest frame of a pair of boards is computed from the limits that `tactile-cdma node` and the
digitizer's firmware check: a chip is as long as the slowest takes, the node, the converter (one
sample of each chip), or the link. Nodes with crystals of their own start anew at every bit. Wires
are those that lead to one place: nodes that are too many for one amplifier are wired in groups,
each with a cable of its own.
"""

from __future__ import annotations

import json
import math
from operator import gt, lt
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from amplifier import FrontEnd, design
from kicad_file import load
from parts_list import STRIP_NODES
from tactile_cdma.code.codes import smallest_order
from tactile_cdma.code.frame import DEFAULT_AMPLITUDE_V, MEASURING_S, FrameSpec
from tactile_cdma.config.frame_rate import FAST, HEARS_DATA_NS, MCUS, Mcu
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.wire._protocol import FIELDS

from ..error import PAPER, PAPER_NOISE_V, PAPER_SAMPLES
from .claims import (
    ASSERTED,
    DIFFERS,
    EXCEEDED,
    INPUT,
    NOT_COMPARABLE,
    OF_PAPER,
    REPRODUCED,
    THIS,
    Claim,
    at_most,
    keeps,
)

ROOT = Path(__file__).resolve().parents[2]
RESULTS, STRIP = ROOT / "docs" / "results.json", ROOT / "firmware/boards/kicad/strip.kicad_pcb"
BITS, PAPER_MOST_BITS = 10, 12
LIMIT_S = 0.02
"""The paper's: below 20 ms into the thousands of nodes."""
THOUSANDS = 2000
LEAST_RHO = math.sqrt(PAPER.order * PAPER_SAMPLES) * DEFAULT_AMPLITUDE_V / PAPER_NOISE_V[1]
"""Least ρ of the paper's streams in bench-error: of all samples of a bit, at most noise."""
CHIP_S = 2e-6
"""Chip of the fast nodes, s: one sample of the RP2040's converter."""
SAMPLE_BYTES = 1.5
"""Bytes of a sample in PACKED; its head, and that of USB, are in the links' rates."""
USB, UART, HIGH_SPEED = 1e6, 180e3, 30e6
"""Bytes of samples per second; `make firmware-figures`: 0.99 MB/s by USB without loss."""
SIXTEEN = Mcu("", 4096, 250, 16_000, 125, bits_restart=True, restart_s=80e-6)
"""Nodes as the fast ones, but at 16 MHz, which takes a supply of 4.5 V; not built or emulated."""

SCALE = ("nodes", "scene", "latency ms", "chip µs")
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
UART_S = 20 / 2e6
"""Per node that takes its turn on a UART of 2 Mbaud: two bytes of ten bit times."""
ONE_WIRE_MOST = 64
"""Most nodes that `make spice SYNC=data` simulates on one wire with the sync pulses."""


def period_s(order: int, pair: Pair) -> float:
    """Duration of the shortest frame and the pause in which nodes measure, s."""
    mcu, samples_hz, bytes_per_s = pair
    least_s = max(mcu.chip_ns * 1e-9, 1 / samples_hz, SAMPLE_BYTES / bytes_per_s)
    step_s = mcu.chip_step_ns * 1e-9
    chip_s = math.ceil(least_s / step_s - 1e-9) * step_s
    guard_chips = math.ceil(mcu.restart_s / chip_s - 1e-9) if mcu.bits_restart else 0
    return (BITS * order + (BITS - 1) * guard_chips) * chip_s + MEASURING_S


def period_s_of(nodes: int, pair: Pair) -> float:
    """Return the duration of the shortest frame of so many nodes, s."""
    return period_s(smallest_order(nodes + 1), pair)


def most_nodes(pair: Pair) -> int:
    """Return the most nodes whose rows fit their memory and whose frame takes less than 20 ms."""
    nodes = 0
    while (order := smallest_order(nodes + 2)) <= pair[0].order and period_s(order, pair) < LIMIT_S:
        nodes += 1
    return nodes


def front_end(nodes: int) -> tuple[FrameSpec, FrontEnd]:
    """Design the line of fast nodes with chips of 2 µs, each sampled once."""
    period_s = period_s_of(nodes, PAIRS[BEST])
    spec = FrameSpec(
        nodes=nodes, chip_s=CHIP_S, order=smallest_order(nodes + 1), frame_period_s=period_s
    )
    return spec, design(spec, 1)


def over_time_slots_db(nodes: int) -> tuple[float, float]:
    """Return ρ over that of a time slot, dB: at equal amplitude, and where both fill the range.

    A lone node may use the whole range for its chip; a code's bit sums up √N chips' worth of A,
    of which the range holds `room`.
    """
    spec, front = front_end(nodes)
    gain = 20 * math.log10(math.sqrt(spec.order))
    return gain, gain - 20 * math.log10(front.room)


def ways(nodes: int) -> dict[str, tuple[int, float] | None]:
    """Wires, supply and ground included, and time, s, of a reading of all; None if impossible."""
    side = math.ceil(math.sqrt(nodes))
    slow_s = period_s_of(nodes, PAIRS["ATmega328P; RP2040"])
    wires = 4 * front_end(nodes)[1].groups
    return {
        "scanned matrix, one converter": (2 * side, nodes * MATRIX_S),
        "time slots": (wires, nodes * BITS * CHIP_S + MEASURING_S),
        "UART, 2 Mbaud": (4, nodes * UART_S),
        "I²C, 400 kHz": (4, nodes * I2C_S) if nodes <= I2C_MOST else None,
        "this": (wires, period_s_of(nodes, PAIRS[BEST])),
        "this, sync on the data wire": (3, slow_s) if nodes <= ONE_WIRE_MOST else None,
    }


def strip_cm2_per_node() -> float:
    """Return the area of the strip over its nodes, cm²."""
    edges = [
        (end.number(0), end.number(1))
        for line in load(STRIP).all("gr_line")
        if line.one("layer").text() == "Edge.Cuts"
        for end in (line.one("start"), line.one("end"))
    ]
    width_mm, height_mm = np.ptp(np.array(edges), axis=0)
    return float(width_mm * height_mm) / 100 / STRIP_NODES


def scale_table() -> list[list[Any]]:
    """Return the rows of the last bench-scale in which all nodes speak; SCALE names columns."""
    head, *rows = json.loads(RESULTS.read_text(encoding="utf-8"))["scale"]["tables"][0]
    at = [head.index(name) for name in SCALE]
    return [[row[i] for i in at] for row in rows if row[at[1]] == "all"]


def scale_rows() -> list[tuple[int, float]]:
    """Nodes, and ms from a frame's begin to its values in the driver: the last bench-scale."""
    return [(row[0], row[2]) for row in scale_table()]


def _bits(kind: str) -> range:
    """Return the numbers of bits that words may have, by a message or record of the protocol."""
    [allowed] = [field.allowed for field in FIELDS[kind] if field.name == "bits"]
    assert isinstance(allowed, range)
    return allowed


def _orders() -> Claim:
    """Claim that codes are shorter than the paper's two examples of Hadamard matrices."""
    paper = {500: 512, 800: 1024}
    usual = [SkinConfig.of({"nodes": nodes}).spec.order for nodes in paper]
    least = [smallest_order(nodes + 1) for nodes in paper]
    here = "; ".join(f"{order:,}" for order in usual)
    here += f" (least {'; '.join(map(str, least))})"
    longer, shorter = (
        any(compare(ours, theirs) for ours, theirs in zip(usual, paper.values(), strict=True))
        for compare in (gt, lt)
    )
    return Claim(
        f"II.A{ASSERTED}",
        f"chips per bit of {'; '.join(map(str, paper))} nodes",
        "; ".join(f"{order:,}" for order in paper.values()),
        here,
        THIS,
        DIFFERS if longer else EXCEEDED if shorter else REPRODUCED,
        "orders other than 2^m",
    )


def claims() -> list[Claim]:
    """Abstract and section II.A."""
    built, one_wire = (most_nodes(PAIRS[pair]) for pair in (BEST, "ATmega328P; RP2040"))
    groups = front_end(built)[1].groups
    error = json.loads(RESULTS.read_text(encoding="utf-8"))["error"]["results"]
    latencies = dict(scale_rows())
    chips_us = {row[0]: row[3] for row in scale_table()}
    below = max(nodes for nodes, ms in latencies.items() if ms < 1e3 * LIMIT_S)
    sent, taken = (_bits(kind) for kind in ("NodeRecord", "FrameLayout"))
    return [
        at_most(
            "abstract",
            f"data wires, chips below {HEARS_DATA_NS / 1e3:g} µs",
            1,
            1 + (not MCUS[FAST].hears_data),
            "`make firmware-thousand`",
            "fast nodes hear sync pulses on a wire of their own",
        ),
        keeps(
            "IV.B",
            f"frames with a wrong word, of {error['paper_frames']:,} simulated ones at ρ of "
            f"{LEAST_RHO:.0f} and more; {error['paper_flagged']} have a flagged word",
            "accurately decoded",
            error["paper_wrong"],
            0,
            "`make bench-error`",
        ),
        _orders(),
        Claim(
            "II.A",
            "bits of a word that firmware sends",
            "10…12",
            f"{sent[0]}…{sent[-1]}",
            THIS,
            REPRODUCED if sent[-1] >= PAPER_MOST_BITS else DIFFERS,
            f"that of their converters; the driver takes {taken[0]}…{taken[-1]}",
        ),
        Claim(
            f"abstract{ASSERTED}",
            "nodes below 20 ms on one data wire, sync included",
            "thousands",
            f"{one_wire}",
            THIS,
            REPRODUCED if one_wire >= THOUSANDS else DIFFERS,
            f"chips of {HEARS_DATA_NS / 1e3:g} µs",
        ),
        Claim(
            f"abstract{ASSERTED}",
            f"nodes with a frame period below 20 ms, in {groups} groups ({4 * groups} wires)",
            "thousands",
            f"{built}",
            THIS,
            REPRODUCED if built >= THOUSANDS else DIFFERS,
            "the RP2040 takes 500,000 samples/s; `make firmware-thousand` emulates 900. Not "
            "latency: a touch just after measuring takes two periods",
        ),
        Claim(
            f"abstract{ASSERTED}",
            "nodes below 20 ms, simulated, until the driver has their values, median",
            "thousands",
            f"{below:,}",
            "`make bench-scale`",
            NOT_COMPARABLE if below >= THOUSANDS else DIFFERS,
            f"chips of {chips_us[below]:.2f} µs, which no node, converter or amplifier here makes",
        ),
        Claim(
            f"abstract{ASSERTED}",
            f"latency of {min(latencies)} to {max(latencies):,} nodes, simulated, median, ms",
            "almost constant",
            f"{min(latencies.values()):.1f}…{max(latencies.values()):.1f}",
            "`make bench-scale`",
            INPUT,
            "by the chip",
        ),
        at_most(
            "9",
            "area of a modular node, cm²",
            1,
            strip_cm2_per_node(),
            "`make boards`",
            f"drawn, {STRIP_NODES} nodes to a strip, not built",
        ),
    ]


def draw(latency: Axes, wires: Axes, time: Axes) -> None:
    """Latency over the number of nodes, and what the paper asserts of other ways."""
    latency.semilogx(*zip(*scale_rows(), strict=True), "o-", ms=3, lw=1, label="simulated")
    nodes = [16, 64, 256, most_nodes(PAIRS[BEST])]
    own_ms = [1e3 * period_s(smallest_order(n + 1), PAIRS[BEST]) for n in nodes]
    latency.semilogx(nodes, own_ms, "s-", ms=3, lw=1, label="fast nodes, shortest")
    latency.axhline(1e3 * LIMIT_S, label="paper: below 20 ms", **OF_PAPER)
    latency.legend(fontsize=10, loc="upper left", handlelength=1)
    latency.set(title="latency below 20 ms", xlabel="nodes", ylabel="ms", ylim=(0, 42))
    for name in ways(16):
        known = [(n, found) for n in SIZES if (found := ways(n)[name])]
        marks = {"marker": "o", "ms": 3, "lw": 1, "label": name}
        wires.loglog([n for n, _ in known], [found[0] for _, found in known], **marks)
        time.loglog([n for n, _ in known], [1e3 * found[1] for _, found in known], **marks)
    time.axhline(1e3 * LIMIT_S, **OF_PAPER)
    wires.set_ylim(top=1_000_000)
    wires.legend(fontsize=9, loc="upper left", handlelength=1)
    wires.set(title="wires to one place, with supply", xlabel="nodes")
    time.set(title="time to read all nodes", xlabel="nodes", ylabel="ms")
