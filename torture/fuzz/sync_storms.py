# SPDX-License-Identifier: Apache-2.0

"""The real images of the nodes, emulated, on a sync line with storms of pulses."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.hardware.node_memory import FAST, MCUS, node_memory
from tactile_cdma.wire._protocol import SYNC_FRAME, SYNC_LEAD, SYNC_RESTART, SYNC_UNIT_US

from ..outcome import Outcome, Plan
from .harnesses import BUILD, FIRMWARE, SIMAVR, build

sys.path.append(str(FIRMWARE / "sim"))
from emulated import EmulatedNodes, Node

SPEC = FrameSpec(nodes=4, order=16)
FAST_SPEC = FrameSpec(
    nodes=4, order=16, chip_s=2e-6, resync_chips=16, guard_chips=40, frame_period_s=3e-3
)
"""For the image that makes no longer chips, and starts anew at every bit."""
NODE = 2
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
        spec = FAST_SPEC if mcu == FAST else SPEC
        memory = node_memory(spec, NODE, mcu=mcu, threshold=0, rest=225)
        yield storms_at(node_of(mcu, memory), plan, spec)


def node_of(mcu: str, memory: bytes) -> Node:
    """A node with the image that was built for it."""
    return Node(BUILD / "node" / f"node-{mcu}.elf", mcu, memory)


def storms_at(node: Node, plan: Plan, spec: FrameSpec = SPEC) -> Outcome:
    """Storms of up to 60 ms at one node, which must send the right word after each.

    None is as long as the watchdog, 250 ms: if that has to help, the node hung.
    """
    rng, period_ns = np.random.default_rng(plan.seed), round(spec.frame_period_s * 1e9)
    count, wrong, hangs, now_ns = (10 if plan.quick else 400), 0, 0, 100_000_000
    with EmulatedNodes([node]) as skin:
        for _ in range(count):
            code = int(rng.integers(1, 2**spec.bits - 1))
            skin.press(
                code / 2**spec.bits * VREF_V
            )  # the middle of a code, as the converter rounds
            now_ns = storm(skin, rng, now_ns, period_ns)
            for frame in range(RECOVERY):
                start_ns = now_ns + LEAD_NS + frame * period_ns
                for place in spec.places[:: spec.resync_chips or spec.chips]:
                    units = SYNC_RESTART if place else SYNC_FRAME
                    due_ns = start_ns + round(place * spec.chip_s * 1e9)
                    pulse(skin, due_ns - LEAD_NS, units * UNIT_NS)
                skin.run(start_ns + period_ns - 2 * LEAD_NS)
                if frame >= RECOVERY - JUDGED:
                    said = levels(skin.edges(0), start_ns, spec)
                    hangs += not said.any()
                    wrong += bool(said.any()) and not np.array_equal(said, expected(code, spec))
                skin.forget(start_ns)
            now_ns += (RECOVERY + 1) * period_ns
        hangs += skin.counters(0).watchdog_resets
    return Outcome(
        f"storms on the sync line of an emulated {node.mcu}",
        count,
        wrong_values=wrong,
        hangs=hangs,
        said="right again each time, without its watchdog" if not wrong + hangs else "",
    )


def storm(skin: EmulatedNodes, rng: np.random.Generator, now_ns: int, period_ns: int) -> int:
    """Send pulses of any length and distance, some dense, some like frames; returns the end."""
    end_ns = now_ns + int(rng.integers(1_000_000, 60_000_000))
    apart_ns = int(rng.choice([10_000, 100_000, 1_000_000, period_ns]))
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


def levels(edges: NDArray[np.void], start_ns: int, spec: FrameSpec) -> NDArray[np.int8]:
    """Levels of the pin in the middle of every coded chip of a frame, (k·N,)."""
    middles_ns = start_ns + (spec.places + 0.5) * spec.chip_s * 1e9
    since_start = np.append(np.int8(0), edges["level"])
    return np.asarray(since_start[np.searchsorted(edges["t_ns"], middles_ns)], np.int8)


def expected(code: int, spec: FrameSpec) -> NDArray[np.int8]:
    """The levels of a node that sends this code, (k·N,)."""
    active = np.arange(spec.nodes) == NODE - 1
    chips = line_chips(spec, np.full(spec.nodes, code), active, amplitude_v=1.0)
    return np.asarray(chips.ravel() * spec.polarity, np.int8)
