# SPDX-License-Identifier: Apache-2.0

"""The real images of the nodes, emulated, on a sync line with storms of pulses."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.hardware.node_memory import MCUS, node_memory
from tactile_cdma.wire._protocol import SYNC_FRAME, SYNC_LEAD, SYNC_UNIT_US

from ..outcome import Outcome, Plan
from .c_fuzzing import BUILD, FIRMWARE, SIMAVR, build

sys.path.append(str(FIRMWARE / "sim"))
from emulated import EmulatedNodes, Node

SPEC = FrameSpec(nodes=4, order=16)
NODE = 2
PERIOD_NS = round(SPEC.frame_period_s * 1e9)
CHIP_NS = round(SPEC.chip_s * 1e9)
UNIT_NS, LEAD_NS = SYNC_UNIT_US * 1000, SYNC_LEAD * SYNC_UNIT_US * 1000
RECOVERY = 12
"""Frames after a storm: a node may have to wait for a roll call's end and relearn the period."""
JUDGED = 2
"""Number of these, the last ones, that must be right."""
VREF_V = 3.3


def storms(plan: Plan) -> Iterator[Outcome]:
    """Storms at a node of each kind; nothing if images or emulator cannot be built."""
    if shutil.which("avr-gcc") is None or not SIMAVR.exists():
        return
    build("node")
    build("sim")
    for mcu in MCUS:
        yield storms_at(node_of(mcu, node_memory(SPEC, NODE, mcu=mcu, threshold=0, rest=225)), plan)


def node_of(mcu: str, memory: bytes) -> Node:
    """A node with the image that was built for it."""
    return Node(BUILD / "node" / f"node-{mcu}.elf", mcu, memory)


def storms_at(node: Node, plan: Plan) -> Outcome:
    """Storms of up to 60 ms at one node, which must send the right word after each.

    None is as long as the watchdog, 250 ms: if that has to help, the node hung.
    """
    rng = np.random.default_rng(plan.seed)
    count, wrong, hangs, now_ns = (10 if plan.quick else 400), 0, 0, 100_000_000
    with EmulatedNodes([node]) as skin:
        for _ in range(count):
            code = int(rng.integers(1, 2**SPEC.bits - 1))
            skin.press(
                code / 2**SPEC.bits * VREF_V
            )  # the middle of a code, as the converter rounds
            now_ns = storm(skin, rng, now_ns)
            for frame in range(RECOVERY):
                start_ns = now_ns + LEAD_NS + frame * PERIOD_NS
                pulse(skin, start_ns - LEAD_NS, SYNC_FRAME * UNIT_NS)
                skin.run(start_ns + PERIOD_NS - 2 * LEAD_NS)
                if frame >= RECOVERY - JUDGED:
                    said = levels(skin.edges(0), start_ns)
                    hangs += not said.any()
                    wrong += bool(said.any()) and not np.array_equal(said, expected(code))
                skin.forget(start_ns)
            now_ns += (RECOVERY + 1) * PERIOD_NS
        hangs += skin.counters(0).watchdog_resets
    return Outcome(
        f"storms on the sync line of an emulated {node.mcu}",
        count,
        wrong_values=wrong,
        hangs=hangs,
        said="right again each time, without its watchdog" if not wrong + hangs else "",
    )


def storm(skin: EmulatedNodes, rng: np.random.Generator, now_ns: int) -> int:
    """Send pulses of any length and distance, some dense, some like frames; returns the end."""
    end_ns = now_ns + int(rng.integers(1_000_000, 60_000_000))
    apart_ns = int(rng.choice([10_000, 100_000, 1_000_000, PERIOD_NS]))
    longest_ns = int(rng.choice([500, 20_000, 60_000, 1_000_000]))
    while now_ns < end_ns:
        length_ns = int(rng.integers(100, longest_ns))
        pulse(skin, now_ns, length_ns)
        now_ns += length_ns + int(rng.integers(1_000, apart_ns))
    return now_ns


def pulse(skin: EmulatedNodes, rise_ns: int, length_ns: int) -> None:
    """Send one pulse."""
    skin.sync(rise_ns, True)
    skin.sync(rise_ns + length_ns, False)


def levels(edges: NDArray[np.void], start_ns: int) -> NDArray[np.int8]:
    """Levels of the pin in the middle of every chip of a frame, (k·N,)."""
    middles_ns = start_ns + (np.arange(SPEC.chips) + 0.5) * CHIP_NS
    since_start = np.append(np.int8(0), edges["level"])
    return np.asarray(since_start[np.searchsorted(edges["t_ns"], middles_ns)], np.int8)


def expected(code: int) -> NDArray[np.int8]:
    """The levels of a node that sends this code, (k·N,)."""
    active = np.arange(SPEC.nodes) == NODE - 1
    chips = line_chips(SPEC, np.full(SPEC.nodes, code), active, amplitude_v=1.0)
    return np.asarray(frame_levels(chips * SPEC.polarity, SPEC), np.int8)
