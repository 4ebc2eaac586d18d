# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Faults of nodes and of the analog line: right values of the sound nodes, flags for the others."""

from __future__ import annotations

from collections.abc import Iterator

from . import faulty_line as line
from . import faulty_nodes as nodes
from .outcome import Outcome, Plan
from .signal_trial import Kind, Skin, Tally, Trial

NODES_256 = {"nodes": 256, "chip_us": 4.0, "frame_period_ms": 16.0}
SKINS = (
    Skin("line 16", {}, {"threshold": 0}),
    Skin("integrated 256", NODES_256 | {"samples_per_chip": 1}, {"threshold": 0}),
    Skin("gap 16", {"timing": "gap"}, {"threshold": 0, "stretch": 0.1}),
    Skin("line 16, parity, changes", {"parity": True}),
    Skin("line 256", NODES_256, {"scene": "presses"}),
    Skin("gap 256, parity", NODES_256 | {"timing": "gap", "parity": True}, {"threshold": 0}),
    Skin("integrated 16, parity", {"samples_per_chip": 1, "parity": True}, {"threshold": 0}),
    Skin("line 1024", {"nodes": 1024, "chip_us": 1.0, "frame_period_ms": 20.0}, {"threshold": 0}),
)

SHORT = {"length": 3, "pause": 9}
KINDS = (
    Kind("dead nodes", nodes.dead, count=3),
    Kind("stuck nodes", nodes.stuck, flagged=False),
    Kind("two nodes on a row", nodes.doubled(1)),
    Kind("three nodes on a row", nodes.doubled(2)),
    Kind("garbage in half of the frames", nodes.chattering),
    Kind("node switches on within a frame", nodes.switching_on),
    Kind("node cut off within a frame", nodes.cut_off),
    Kind("node late by up to 0.1 of a frame", nodes.late(0.1)),
    Kind("node late by up to half a frame", nodes.late(0.5)),
    Kind("node late by whole chips", nodes.chips_late),
    Kind("half a word twice", nodes.half_twice),
    Kind("node on an unused row", nodes.unused_row),
    Kind("node on another's row", nodes.other_row, victims=True, flagged=False),
    Kind("inverted node", nodes.inverted, flagged=False),
    Kind("node of another order", nodes.other_order),
    Kind("node of another word length", nodes.other_bits),
    Kind("one node 100 times as loud, clipping", nodes.louder(100.0)),
    Kind("one node 100 times as loud, in range", nodes.louder(100.0), range_v=40.0),
    Kind("one node 100 times as weak", nodes.louder(0.01)),
    Kind("all but some 100 times as weak", nodes.louder(0.01), count=40),
    Kind("hum of 50 Hz", line=line.hum(50, 3), length=20),
    Kind("hum of 60 Hz", line=line.hum(60, 3), length=20),
    Kind("motor bursts", line=line.motor(2), **SHORT),
    Kind("ESD spikes", line=line.discharge, length=1, pause=6),
    Kind("baseline wanders", line=line.wander, length=40),
    Kind("baseline jumps", line=line.jump, length=6, pause=9),
    Kind("hard clipping at 3·√n", line=line.hard_clipping(0.75), length=20, pause=9),
    Kind("hard clipping at √n", line=line.hard_clipping(0.25), length=20, pause=9),
    Kind("soft clipping", line=line.soft_clipping(0.75), length=20, pause=9),
    Kind("soft clipping, hard", line=line.soft_clipping(0.25), length=20, pause=9),
    Kind("gain steps", line=line.gain_step, length=6, pause=9),
    Kind("supply dips", line=line.dip, **SHORT),
    Kind("wire at rail", line=line.at_rail, length=20),
    Kind("torn wire", line=line.torn_off, length=20),
    Kind("shorted wire", line=line.shorted, length=20),
    Kind("loose wire", line=line.loose, length=20),
    Kind("oscillating", line=line.oscillating, length=20),
    Kind("warming", line=line.warming, length=100),
)


def run(plan: Plan) -> Iterator[Outcome]:
    """An outcome per kind of fault."""
    for place, kind in enumerate(KINDS):
        tally = Tally()
        for skin in SKINS[place % 4 : place % 4 + 1] if plan.quick else SKINS:
            episodes = max(1, (110 if plan.quick else 660) // (kind.length + kind.pause))
            tally += Trial(kind, skin, plan.seed).run(episodes)
        yield _outcome(kind, tally)


def _outcome(kind: Kind, tally: Tally) -> Outcome:
    return Outcome(kind.name, tally.episodes, tally.wrong, tally.uncounted, 0, tally.late, str(tally))
