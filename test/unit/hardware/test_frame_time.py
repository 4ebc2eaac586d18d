# SPDX-License-Identifier: Apache-2.0

"""How many nodes each pair of boards reads in 20 ms, beside the table of docs/results.md.

Computed from the limits that `tactile-cdma node` and the digitizer's firmware check. A chip is as
long as the slowest takes: the node, the converter (one sample of each chip), or the link. Nodes
with crystals of their own start anew at every bit.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from tactile_cdma.code.codes import smallest_order
from tactile_cdma.hardware.node_memory import FAST, MCUS, MEASURING_S, Mcu

ROOT = Path(__file__).resolve().parents[3]
BITS = 10
SAMPLE_BYTES = 1.5
"""Of PACKED; its head, and that of USB, are in the links' rates."""
USB, UART, HIGH_SPEED = 1e6, 180e3, 30e6
"""Bytes of samples per second; `make firmware-figures`: 0.99 MB/s by USB without loss."""
SIXTEEN = Mcu("", 4096, 250, 16_000, 125, bits_restart=True, restart_s=80e-6)
"""Nodes as the fast ones, but at 16 MHz, which takes a supply of 4.5 V; not built or emulated."""
DRIFT = 0.1
"""Largest error of a chip's place at the end of a bit, chips: `make bench-timing` loses nothing."""

Pair = tuple[Mcu, float, float]
"""A node, samples per second of the converter, bytes per second of the link."""
PAIRS: dict[str, Pair] = {
    "ATtiny85; RP2040": (MCUS["attiny85"], 500e3, USB),
    "ATmega328P; RP2040": (MCUS["atmega328p"], 500e3, USB),
    "fast ATmega328P; RP2040 on a UART of 2 Mbaud": (MCUS[FAST], 500e3, UART),
    "fast ATmega328P; RP2040": (MCUS[FAST], 500e3, USB),
    "fast ATmega328P; a converter of 2 MS/s on full-speed USB": (MCUS[FAST], 2e6, USB),
    "fast ATmega328P; the same on high-speed USB": (MCUS[FAST], 2e6, HIGH_SPEED),
    "16 MHz nodes; 4 MS/s on high-speed USB": (SIXTEEN, 4e6, HIGH_SPEED),
}


def period_s(order: int, pair: Pair) -> float:
    """Duration of the shortest frame and the pause in which nodes measure, s."""
    mcu, samples_hz, bytes_per_s = pair
    least_s = max(mcu.chip_ns * 1e-9, 1 / samples_hz, SAMPLE_BYTES / bytes_per_s)
    step_s = mcu.chip_step_ns * 1e-9
    chip_s = math.ceil(least_s / step_s - 1e-9) * step_s
    guard_chips = math.ceil(mcu.restart_s / chip_s - 1e-9) if mcu.bits_restart else 0
    return (BITS * order + (BITS - 1) * guard_chips) * chip_s + MEASURING_S


def most_nodes(pair: Pair) -> int:
    """The most nodes whose rows fit their memory and whose frame takes less than 20 ms."""
    nodes = 0
    while (order := smallest_order(nodes + 2)) <= pair[0].order and period_s(order, pair) < 0.02:
        nodes += 1
    return nodes


@pytest.mark.parametrize("boards", PAIRS)
def test_boards_read_as_many_nodes_as_the_document_says(boards: str) -> None:
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    [told] = re.findall(rf"^\| {re.escape(boards)} \| ([\d,]+) \|", page, re.MULTILINE)
    assert most_nodes(PAIRS[boards]) == int(told.replace(",", ""))


@pytest.mark.parametrize(("order", "ppm"), [(1024, 49), (4096, 12)])
def test_crystals_are_as_accurate_as_the_document_says(order: int, ppm: int) -> None:
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    assert f"{ppm} ppm at {order:,}" in " ".join(page.split())
    assert round(1e6 * DRIFT / 2 / order) == ppm  # digitizer and node may be off either way
