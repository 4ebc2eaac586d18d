# SPDX-License-Identifier: Apache-2.0

"""Node images under test: a scripted sync line, and the expected pin levels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emulated import EDGE, EmulatedNodes, Node
from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import FrameSpec

UNIT_NS, LEAD_NS, DIGIT_NS = 16_000, 64_000, 128_000
RESTART, FRAME, CALL = 1, 2, 3
VREF = 3.3
POWER_UP_NS = 20_000_000
"""Time from power-up to the first frame pulse."""
MEASURED_NS = 950_000
"""Time before a frame at which a node has ended the last one and not yet measured."""
SLOW = ("atmega328p", "attiny85")
"""Boards that time every chip by an interrupt."""
EDGE_NS = 280
"""Largest error of an edge that a timer makes: two cycles at 7.2 MHz, or an ATtiny85's tick."""
BUSY_NS = 7_500
"""… of an ATtiny85 whose alarm rings just before a restart pulse."""
CLOCK_KNOWN = 2
"""Frames in which a node measures its clock before it transmits."""


@dataclass
class Bench:
    """Nodes and a sync line that is driven pulse by pulse; all times in ns."""

    skin: EmulatedNodes
    spec: FrameSpec
    pulses: list[tuple[int, int]] = field(default_factory=list)

    @property
    def period_ns(self) -> int:
        """Frame period."""
        return round(self.spec.frame_period_s * 1e9)

    def pulse(self, rise_ns: int, length_ns: int = FRAME * UNIT_NS) -> None:
        """Send a pulse of any length at any time."""
        self.skin.sync(rise_ns, True)
        self.skin.sync(rise_ns + length_ns, False)

    def frame(
        self,
        number: int,
        units: int = FRAME,
        late_ns: int = 0,
        skip: Sequence[int] = (),
        before: Mapping[int, tuple[int, int]] | None = None,
        turn: int = 0,
    ) -> int:
        """All pulses of a frame, in its turn; run to its end. Returns when its first chip is due.

        late_ns: it comes so much after its time. skip: restart pulses that don't come. before:
        other pulses, by the sub-slot before whose own they come: how long before, and their length.
        turn: what pulses before the frame say of whose turn it is.
        """
        start = POWER_UP_NS + number * self.period_ns + late_ns
        for digit in range(turn.bit_length() - 1, -1, -1):
            if turn >> digit & 1:
                self.pulse(start - LEAD_NS - (digit + 1) * DIGIT_NS, RESTART * UNIT_NS)
        for slot in range(slots(self.spec)):
            at = slot * (self.spec.resync_chips + self.spec.guard_chips) * self.spec.chip_s
            rise = start + round(at * 1e9) - LEAD_NS
            if before and slot in before:
                early_ns, length_ns = before[slot]
                self.pulse(rise - early_ns, length_ns)
            if slot not in skip:
                self.pulse(rise, (RESTART if slot else units) * UNIT_NS)
        self.skin.run(start + self.period_ns - MEASURED_NS)
        return start

    def heard(self, node: int, start_ns: int) -> NDArray[np.void]:
        """Edges of a node's pin in the frame that began at a time."""
        edges = self.skin.edges(node)
        inside = (edges["t_ns"] >= start_ns - LEAD_NS) & (
            edges["t_ns"] < start_ns + self.period_ns - LEAD_NS
        )
        return edges[inside]


def slots(spec: FrameSpec) -> int:
    """Sub-slots of a frame."""
    return 1 + (spec.chips - 1) // spec.resync_chips if spec.resync_chips else 1


def expected(
    spec: FrameSpec, node: int, code: int, start_ns: int, chip_ns: float | None = None
) -> NDArray[np.void]:
    """Expected edges of a node's pin (EDGE) by the host's encoder; node counts from 0.

    chip_ns: duration of a chip by the node's clock, within each sub-slot.
    """
    codes = np.full(spec.nodes, code)
    active = np.arange(spec.nodes) == node
    chips = line_chips(spec, codes, active, amplitude_v=1.0)
    levels = np.append(frame_levels(chips * spec.polarity, spec), 0).astype(np.int8)
    changed = np.flatnonzero(np.diff(levels, prepend=0))
    nominal_ns = spec.chip_s * 1e9
    since, slot_start = changed, np.zeros(len(changed))
    if spec.resync_chips:
        pitch = spec.resync_chips + spec.guard_chips
        # the end of a sub-slot, and all that is in it, is counted from its beginning
        slot_start = changed // pitch * pitch
        since = changed - slot_start
    edges = np.zeros(len(changed), EDGE)
    edges["t_ns"] = np.round(start_ns + slot_start * nominal_ns + since * (chip_ns or nominal_ns))
    edges["level"] = levels[changed]
    return edges


def assert_says(
    bench: Bench,
    start_ns: int,
    code: int,
    number: int = 1,
    node: int = 0,
    *,
    most_ns: int = EDGE_NS,
) -> None:
    """Check that a node, numbered from 1, transmitted a code in the frame begun at a time."""
    heard = bench.heard(node, start_ns)
    wanted = expected(bench.spec, number - 1, code, start_ns)
    np.testing.assert_array_equal(heard["level"], wanted["level"])
    worst_ns = np.abs(heard["t_ns"] - wanted["t_ns"]).max()
    busy = bench.spec.resync_chips and bench.skin.nodes[node].mcu == "attiny85"
    assert worst_ns <= (BUSY_NS if busy else most_ns)


def volts(code: int, bits: int) -> float:
    """A sensor's voltage in the middle of a code, the first bits of the converter's 10."""
    return ((code + 0.5) / (1 << bits) - 0.5 / 1024) * VREF


def image(build: Path, mcu: str) -> Path:
    """A node's image."""
    return build / "node" / f"node-{mcu}.elf"


__all__ = ["EDGE", "SLOW", "Bench", "EmulatedNodes", "Node", "expected", "image", "slots", "volts"]
