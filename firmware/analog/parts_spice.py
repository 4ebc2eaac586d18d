# SPDX-License-Identifier: Apache-2.0

"""Skins of inexact parts in SPICE: how many leave the converter's range when all pins agree.

Every skin has an amplifier, its own resistors from the bag, and pins that are released, high and
low, one after the other. tolerance.py computes the same by sums; this is what it is held against.
"""

from __future__ import annotations

import numpy as np

from amplifier import RAIL_V, FrontEnd
from circuit import PIN_OHM
from ngspice import transients
from tactile_cdma.base.arrays import Floats

GAIN = 1e6
"""Gain of an amplifier, which is ideal here: what leaves the range is to be seen, not cut off."""
HOLD_S, EDGE_S = 1e-3, 1e-4
"""Time of each state of the pins, and from one to the next."""
AT_ONCE = 100
"""Skins of one analysis; chosen."""


def share_outside(front: FrontEnd, tolerance: float, skins: int, seed: int = 1) -> float:
    """Return the share of skins, all of whose parts have this tolerance, that leave the range.

    front: one amplifier, of nodes without followers that may all agree. Raises SpiceError.
    """
    rng, top_v = np.random.default_rng(seed), min(front.supply_v - RAIL_V, front.adc_volts)
    outside = 0
    for first in range(0, skins, AT_ONCE):
        outputs_v = _outputs(front, tolerance, min(AT_ONCE, skins - first), rng)
        outside += int(np.sum((outputs_v.min(axis=0) < RAIL_V) | (outputs_v.max(axis=0) > top_v)))
    return outside / skins


def _outputs(front: FrontEnd, tolerance: float, skins: int, rng: np.random.Generator) -> Floats:
    """Simulate some skins: volts at their outputs, (3, skins): pins released, high, low."""
    found = transients(netlist(front, tolerance, skins, rng))
    middles = HOLD_S * (np.arange(3) + 0.5)
    return np.array(
        [np.interp(middles, found["time"], found[f"v(out{skin})"]) for skin in range(skins)]
    ).T


def netlist(front: FrontEnd, tolerance: float, skins: int, rng: np.random.Generator) -> str:
    """Write an analysis of skins beside each other. v(on): pins drive; v(high): they are high."""

    def part(ohm: float) -> float:
        return float(ohm * (1 + rng.uniform(-tolerance, tolerance)))

    stage, supply_v = front.nodes_stage, front.supply_v
    high_s, low_s, end_s = HOLD_S, 2 * HOLD_S, 3 * HOLD_S
    lines = [
        f"* {skins} skins of {stage.inputs} nodes, parts of {tolerance:.0%}",
        f"vsupply supply 0 {supply_v:g}",
        f"von on 0 pwl(0 0 {high_s - EDGE_S:g} 0 {high_s:g} 1)",
        f"vpin high 0 pwl(0 {supply_v:g} {low_s - EDGE_S:g} {supply_v:g} {low_s:g} 0)",
    ]
    for skin in range(skins):
        lines += [
            f"rup{skin} supply half{skin} {part(10e3):.9g}",
            f"rdown{skin} half{skin} 0 {part(10e3):.9g}",
            f"eamp{skin} out{skin} 0 half{skin} line{skin} {GAIN:g}",
            f"rf{skin} out{skin} line{skin} {part(stage.feedback_ohm):.9g}",
        ]
        siemens = sum(1 / (part(stage.input_ohm) + PIN_OHM) for _ in range(stage.inputs))
        lines.append(f"bpins{skin} line{skin} 0 i=v(on)*(v(line{skin})-v(high))*{siemens:.9g}")
    saved = " ".join(f"v(out{skin})" for skin in range(skins))
    return "\n".join([*lines, f".tran {EDGE_S:g} {end_s:g}", f".save {saved}", ".end", ""])
