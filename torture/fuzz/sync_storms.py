# SPDX-License-Identifier: Apache-2.0

"""The real images of the nodes, emulated, on a sync line with storms of pulses."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.frame_rate import FAST, MCUS

from ..outcome import Outcome, Plan
from .harnesses import FIRMWARE, SIMAVR, build

sys.path.append(str(FIRMWARE / "sim"))
from emulated import Node
from test.support.emulated_node import (
    FRAME,
    LEAD_NS,
    RESTART,
    UNIT_NS,
    Bench,
    expected,
    node_for,
    volts,
)

SPEC = FrameSpec(nodes=4, order=16)
FAST_SPEC = FrameSpec(
    nodes=4, order=16, chip_s=2e-6, resync_chips=16, guard_chips=40, frame_period_s=3e-3
)
"""For the image that makes no longer chips, and starts anew at every bit."""
NODE = 1
"""The first of those whose words a node of several sensors sends."""
RECOVERY = 12
"""Frames after a storm: a node may have to relearn the period. Chosen."""
JUDGED = 2
"""Number of these, the last ones, that must be right."""


def storms(plan: Plan) -> Iterator[Outcome]:
    """Storms at a node of each kind; nothing if images or emulator cannot be built."""
    if shutil.which("avr-gcc") is None or not SIMAVR.exists():
        return
    build("node")
    build("sim")
    for mcu in MCUS:
        spec = FAST_SPEC if mcu == FAST else SPEC
        yield storms_at(node_for(spec, NODE, mcu), plan, spec)


def storms_at(node: Node, plan: Plan, spec: FrameSpec = SPEC) -> Outcome:
    """Storms of up to 60 ms at one node, which must send the right word after each.

    None is as long as the watchdog, 250 ms: if that has to help, the node hung.
    """
    rng, count = np.random.default_rng(plan.seed), 10 if plan.quick else 400
    wrong, hangs, now_ns = 0, 0, 100_000_000
    with Bench([node], spec) as skin:
        for _ in range(count):
            code = int(rng.integers(1, 2**spec.bits - 1))
            skin.press(volts(code, spec.bits))
            now_ns = storm(skin, rng, now_ns)
            for frame in range(RECOVERY):
                start_ns = now_ns + LEAD_NS + frame * skin.period_ns
                for slot, rise_ns in enumerate(skin.rises(start_ns)):
                    skin.pulse(rise_ns, (RESTART if slot else FRAME) * UNIT_NS)
                skin.run(start_ns + skin.period_ns - 2 * LEAD_NS)
                if frame >= RECOVERY - JUDGED:
                    said = levels(skin.edges(0), start_ns, spec)
                    right = levels(expected(spec, NODE - 1, code, start_ns), start_ns, spec)
                    hangs += not said.any()
                    wrong += bool(said.any()) and not np.array_equal(said, right)
                skin.forget(start_ns)
            now_ns += (RECOVERY + 1) * skin.period_ns
        hangs += skin.counters(0).watchdog_resets
    return Outcome(
        f"storms on the sync line of an emulated {node.mcu}",
        count,
        wrong_values=wrong,
        hangs=hangs,
        said="right again each time, without its watchdog" if not wrong + hangs else "",
    )


def storm(skin: Bench, rng: np.random.Generator, now_ns: int) -> int:
    """Send pulses of any length and distance, some dense, some like frames; returns the end."""
    end_ns = now_ns + int(rng.integers(1_000_000, 60_000_000))
    apart_ns = int(rng.choice([10_000, 100_000, 1_000_000, skin.period_ns]))
    longest_ns = int(rng.choice([500, 20_000, 60_000, 1_000_000]))
    while now_ns < end_ns:
        length_ns = int(rng.integers(100, longest_ns))
        skin.pulse(now_ns, length_ns)
        now_ns += length_ns + int(rng.integers(1_000, apart_ns))
    return now_ns


def levels(edges: NDArray[np.void], start_ns: int, spec: FrameSpec) -> NDArray[np.int8]:
    """Levels of the pin in the middle of every coded chip of a frame, (k·N,)."""
    middles_ns = start_ns + (spec.places + 0.5) * spec.chip_s * 1e9
    since_start = np.append(np.int8(0), edges["level"])
    return np.asarray(since_start[np.searchsorted(edges["t_ns"], middles_ns)], np.int8)
