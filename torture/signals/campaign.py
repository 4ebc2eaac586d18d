# SPDX-License-Identifier: Apache-2.0

"""Faults of nodes and of the analog line: sound nodes must read right, others must be flagged.

Faults beyond the limits of docs/signal-model.md have rows of their own, which report the effect.
"""

from __future__ import annotations

import traceback
from collections import defaultdict
from collections.abc import Iterator
from functools import partial

from tactile_cdma.config.parameters import Value

from ..line.campaign import FEW_SPEAK
from ..outcome import Outcome, Plan
from . import faulty_line as line
from . import faulty_nodes as nodes
from .trial import CHIPS, GAP, LINE, Kind, Skin, Trial, WordTally

ALWAYS: dict[str, Value] = {"threshold": 0}
NODES_256: dict[str, Value] = {"nodes": 256, "chip_us": 4.0, "frame_period_ms": 16.0}
NODES_1024: dict[str, Value] = {"nodes": 1024, "chip_us": 1.0, "frame_period_ms": 20.0}
SMALL = [
    Skin(LINE, {}, ALWAYS),
    Skin(CHIPS, {"parity": True}, ALWAYS),
    Skin(GAP, {}, ALWAYS | {"stretch": 0.1}),
    Skin(LINE, {"parity": True}),
]
"""The nodes of most speak in every frame, those of the last when something changes. A quick run
uses one of these skins for each kind of fault, in turn."""
LARGE = [
    Skin(CHIPS, NODES_256, ALWAYS),
    Skin(LINE, NODES_256 | {"parity": True}, ALWAYS),
    Skin(LINE, NODES_256, {"scene": "presses"}),
    Skin(GAP, NODES_256 | {"parity": True}, ALWAYS),
    Skin(LINE, NODES_1024, ALWAYS),
]
SPARSE = Skin(CHIPS, FEW_SPEAK, {"scene": "moving"})
"""A full run tries it where no node has to be found out: they speak too seldom here."""
QUICK_KINDS = 3
"""A quick run tries one in three kinds, by the seed."""
LARGE_IN_TURN = 2
"""A full run tries all small skins and this many large ones for each kind, by the seed."""
FRAMES = 100
"""Frames with the fault for each kind on each skin; at least one episode."""

flash = partial(Kind, length=1, pause=8)
short = partial(Kind, length=3, pause=9)
spell = partial(Kind, length=20, pause=9)
marked = (LINE, CHIPS)

KINDS = (
    Kind("dead nodes", nodes.dead, count=3),
    Kind("node stuck", nodes.stuck, flagged=False),  # found within minutes
    # With quiet nodes it takes four heartbeats of 20 frames each, and a verdict or two.
    Kind("two nodes on a row", nodes.doubled(1), length=160),
    Kind("three nodes on a row", nodes.doubled(2), length=160),
    Kind("node with garbage in half of its frames", nodes.chattering, flagged=False),
    Kind("node that switches on within frames", nodes.switching_on),
    Kind("node cut off within frames", nodes.cut_off),
    Kind("node late by ≤ 0.1 frame", nodes.late(0.1), flagged=False),
    Kind("node late by ≤ 0.5 frame", nodes.late(0.5), flagged=False),
    Kind("node late by whole chips", nodes.chips_late, flagged=False),
    Kind("node that says half of its word twice", nodes.half_twice, flagged=False),
    Kind("node on an unused row", nodes.unused_row),
    Kind("node on another's row", nodes.other_row, victims=True, flagged=False),
    Kind("node with inverted sign", nodes.inverted, flagged=False, parity_tells=True),
    Kind("node of another order", nodes.other_order),
    Kind("node of two bits more", nodes.other_bits, flagged=False, parity_tells=True),
    Kind("node 40 dB too loud, in range", nodes.louder(100.0), range_v=90.0, timings=marked),
    Kind(
        "node 40 dB too loud, in range, timing gap",
        nodes.louder(100.0),
        range_v=90.0,
        timings=(GAP,),
    ),
    Kind("node 40 dB too loud, clipping", nodes.louder(100.0), flagged=False),
    Kind("node 40 dB too weak", nodes.louder(0.01)),
    Kind("half of the nodes 40 dB too weak", nodes.louder(0.01), count=32),
    spell("hum of 3 nodes, 50 Hz", line=line.hum(50, 3.0), timings=marked),
    spell("hum of 3 nodes, 60 Hz", line=line.hum(60, 3.0), timings=marked),
    spell("hum of 0.1 nodes, timing gap", line=line.hum(50, 0.1), timings=(GAP,)),
    spell("hum of 3 nodes, timing gap", line=line.hum(50, 3.0), timings=(GAP,)),
    short("bursts of a motor's PWM, 2 nodes", line=line.motor(2.0)),
    flash("ESD spikes of 5 to 500 nodes", line=line.discharge),
    Kind("baseline wanders by 10 nodes", line=line.wander, length=80),
    short("baseline jumps by ≤ 1.5 nodes", line=line.jump(1.5)),
    short("baseline jumps by ≤ 5 nodes", line=line.jump(5.0)),
    spell("rails at 3·√n nodes", line=line.hard_clipping(0.75)),
    spell("rails at √n nodes", line=line.hard_clipping(0.25)),
    spell("amplifier soft from 3·√n nodes on", line=line.soft_clipping(0.75)),
    spell("amplifier soft from √n nodes on", line=line.soft_clipping(0.25)),
    short("gain steps to 0.7 … 1.5", line=line.gain_step),
    short("supply dips of 1 to 6 ms", line=line.dip),
    short(
        "brown-outs: 5 nodes restart within frames",
        nodes.one_of(nodes.cut_off, nodes.switching_on, nodes.late(0.3)),
        count=5,
        flagged=False,
    ),
    spell("wire at a rail", line=line.at_rail),
    Kind("wire pulled low for good", line=line.pulled_low),
    spell("wire that a second digitizer pulls low, too", line=line.second_digitizer),
    spell("sync pulses on the wire, not held", line=line.pulse_seen, timings=(LINE,)),
    Kind("node that sees no sync pulse and runs freely", nodes.late(1.0), flagged=False),
    # Longer than stale_after_s: what is held until then has to be flagged afterwards.
    Kind("wire torn off", line=line.torn_off),
    Kind("wire shorted", line=line.shorted),
    spell("wire with a loose contact", line=line.loose),
    spell("amplifier oscillates", line=line.oscillating),
    Kind("gain and offset drift by 20 %", line=line.warming, length=200),
    short(
        "a dead node, a doubled row, hum of 1 node and a motor",
        nodes.one_of(nodes.dead, nodes.doubled(1)),
        line.in_turn(line.hum(50, 1.0), line.motor(1.0)),
        count=2,
        flagged=False,
        timings=marked,
    ),
)


def run(plan: Plan) -> Iterator[Outcome]:
    """Yield an outcome per kind of fault."""
    kinds = KINDS[plan.seed % QUICK_KINDS :: QUICK_KINDS] if plan.quick else KINDS
    for place, kind in enumerate(kinds):
        small, large = (
            [skin for skin in some if skin.timing in kind.timings] for some in (SMALL, LARGE)
        )
        turn = (plan.seed + place) % len(large)
        skins = small + (large[turn:] + large[:turn])[:LARGE_IN_TURN]
        if CHIPS in kind.timings and not (kind.nodes and kind.flagged):
            skins.append(SPARSE)
        if plan.quick:
            skins = [small[place % len(small)]]
        yield trials(kind, skins, FRAMES, plan.seed)


def trials(kind: Kind, skins: list[Skin], frames: int, seed: int) -> Outcome:
    """Try about this many frames with the fault on each of these skins."""
    total = WordTally()
    of_timing: defaultdict[str, WordTally] = defaultdict(WordTally)
    for skin in skins:
        try:
            tally = Trial(kind, skin, seed).run(max(1, frames // kind.length))
        except Exception:  # any at all is a defect
            traceback.print_exc()
            total.crashes += 1
            continue
        if kind.flagged or (kind.parity_tells and skin.config.spec.parity):
            tally.wrong_values += tally.unnoticed
        total += tally
        of_timing[skin.timing] += tally
    total.wrong_values += total.wrong + total.invented + total.missed
    return total.outcome(kind.name, "; ".join(_said(total, of_timing)))


def _said(total: WordTally, of_timing: dict[str, WordTally]) -> Iterator[str]:
    shares = [f"{timing} {t.published / t.faulty:.0%}" for timing, t in of_timing.items()]
    yield f"{total.words:,} words, frames published: {', '.join(shares)}"
    broken = len(total.noticed) + total.unnoticed
    if broken:
        within = f" in ≤ {max(total.noticed)} frames" if total.noticed else ""
        yield f"{len(total.noticed)} of {broken} found{within}"
    for count, text in (
        (total.wrong, "wrong, not flagged"),
        (total.invented, "invented, not flagged"),
        (total.missed, "missed, not flagged"),
        (total.doubted, "wrong and flagged"),
        (total.unheard, "of which too little reached the converter"),
        (total.broken, "wrong of the broken nodes, not flagged"),
        (total.cautious if total.cautious > 0.01 * total.words else 0, "right and flagged"),
    ):
        if count:
            yield f"{count:,} {text}"
    if (cost := max(total.cost, default=0.0)) > 2:
        yield f"time × {cost:.0f}"
