# SPDX-License-Identifier: Apache-2.0

"""Node images under test: a scripted sync line, and the expected pin levels."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from emulated import Amplifier, DataWire, EmulatedNodes, Node
from skin import IMAGES
from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.frame_rate import FAST, MCUS, TINY_ON_DATA
from tactile_cdma.hardware.node_memory import hearing_data, node_memory
from trial import expected_edges

UNIT_NS, LEAD_NS, DIGIT_NS = 16_000, 64_000, 128_000
RESTART, FRAME = 1, 2
VREF = 3.3
REST = 225
"""Code at rest."""
POWER_UP_NS = 20_000_000
"""Time from power-up to the first frame pulse."""
MEASURED_NS = 950_000
"""Time before a frame at which a node has ended the last one and not yet measured."""
MEASURED_FOUR_NS = 1_250_000
"""… of four sensors."""
ON_DATA = "atmega328p-data"
"""An ATmega328P that hears sync pulses on the data wire."""
TINY = ("attiny85", TINY_ON_DATA)
SLOW = ("atmega328p", ON_DATA, *TINY)
"""Boards that time every chip by an interrupt."""
PULL = DataWire(pulled_v=3.24, recovery_s=2e-6, back_s=1e-6)
"""The data wire, back as late as a node's firmware expects."""
COMPARATOR_NS = 140
"""By which edges are later on the data wire: its output is synchronised, a cycle at 7.2 MHz."""
EDGE_NS = 280
"""Largest error of an edge that a timer makes: two cycles at 7.2 MHz, or an ATtiny85's tick."""
BUSY_NS = 7_500
"""… of an ATtiny85 whose alarm rings just before a restart pulse."""
CLOCK_KNOWN = 2
"""Frames in which a node measures its clock before it transmits."""
ASK = 32
"""The turn whose digit asks everybody to speak."""
CYCLE_NS = 125
ROUNDING_NS = 10
"""Of the emulation's times of edges and cycles."""
PRELUDE_NS = 4_000
"""Longest time before a sub-slot, beside half a chip, for which a transmitter drives the line."""


class Bench(EmulatedNodes):
    """Nodes at rest, and a sync line that is driven pulse by pulse; all times in ns."""

    def __init__(self, nodes: Sequence[Node], spec: FrameSpec) -> None:
        on_data = any(node.bandgap_v for node in nodes)
        super().__init__(nodes, Amplifier(pull=PULL) if on_data else None)
        self.spec = spec
        self.press(volts(REST, spec.bits))

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        counted = [self.counters(node) for node in range(len(self.nodes))]
        self.close()
        assert kind or not any(c.faults or c.deep_sleeps or c.pull_ups for c in counted)

    @property
    def period_ns(self) -> int:
        """Frame period."""
        return round(self.spec.frame_period_s * 1e9)

    def pulse(self, rise_ns: int, length_ns: int = FRAME * UNIT_NS) -> None:
        """Send a pulse of any length at any time."""
        self.sync(rise_ns, True)
        self.sync(rise_ns + length_ns, False)

    def frame(
        self,
        number: int,
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
        start = self.start(number) + late_ns
        for digit in range(turn.bit_length() - 1, -1, -1):
            if turn >> digit & 1:
                self.pulse(start - LEAD_NS - (digit + 1) * DIGIT_NS, RESTART * UNIT_NS)
        for slot, rise in enumerate(self.rises(start)):
            if before and slot in before:
                early_ns, length_ns = before[slot]
                self.pulse(rise - early_ns, length_ns)
            if slot not in skip:
                self.pulse(rise, (RESTART if slot else FRAME) * UNIT_NS)
        self.end(start)
        return start

    def start(self, number: int) -> int:
        """When the first chip of a frame is due."""
        return POWER_UP_NS + number * self.period_ns

    def rises(self, start_ns: int) -> list[int]:
        """When the pulses of the frame's sub-slots begin."""
        pitch_s = (self.spec.resync_chips + self.spec.guard_chips) * self.spec.chip_s
        return [start_ns + round(s * pitch_s * 1e9) - LEAD_NS for s in range(slots(self.spec))]

    def end(self, start_ns: int) -> None:
        """Run to the end of the frame that begins at a time."""
        early_ns = MEASURED_NS if self.nodes[0].sensors == 1 else MEASURED_FOUR_NS
        self.run(start_ns + self.period_ns - early_ns)

    def listen(self, frames: int = CLOCK_KNOWN) -> int:
        """Run the first frames, in which all are silent; return the number of the next one.

        In as many as CLOCK_KNOWN nodes learn their clocks; in more they are silent if at rest.
        """
        for number in range(frames):
            assert self.spoke(self.frame(number)) == []
        return frames

    def heard(self, sensor: int, start_ns: int) -> NDArray[np.void]:
        """Edges of a sensor's pin in the frame that began at a time."""
        edges = self.edges(sensor)
        begin_ns = start_ns - LEAD_NS
        return edges[(edges["t_ns"] >= begin_ns) & (edges["t_ns"] < begin_ns + self.period_ns)]

    def spoke(self, start_ns: int) -> list[int]:
        """Which sensors, from 0, drove their pins in a frame; most nodes have one."""
        return [sensor for sensor in range(len(self.sensors)) if len(self.heard(sensor, start_ns))]

    def node_of(self, sensor: int) -> Node:
        """The node that has a sensor."""
        return self.nodes[self.sensors[sensor][0]]


def node_for(
    spec: FrameSpec,
    number: int = 1,
    mcu: str = "atmega328p",
    *,
    clock_hz: float = 8e6,
    start_ns: int = 0,
    **options: int | bool | str | None,
) -> Node:
    """A node whose first taxel has this number, with the host's memories. mcu: or ON_DATA.

    It transmits in every frame unless the options, those of node_memory, say otherwise.
    """
    on_data = mcu in (ON_DATA, TINY_ON_DATA)
    if mcu == ON_DATA:
        mcu = "atmega328p"
    how = {"threshold": 0, "rest": REST} | options
    taxels = range(number, number + MCUS[mcu].sensors)
    memory = b"".join(node_memory(spec, taxel, mcu=mcu, **how) for taxel in taxels)
    image = IMAGES / f"node-{mcu}.elf"
    node = Node(image, mcu, memory, clock_hz=clock_hz, start_ns=start_ns)
    return hearing(node) if on_data else node


def hearing(node: Node) -> Node:
    """This node as it hears sync pulses on the data wire, as late as its firmware expects."""
    memory = hearing_data(node.memory, node.mcu) if node.memory else b""
    return replace(node, memory=memory, bandgap_v=1.1, delay_ns=1000)


def bench(
    spec: FrameSpec,
    mcu: str = "atmega328p",
    numbers: Iterable[int] = (1,),
    **more: float | str | None,
) -> Bench:
    """Nodes of these numbers, from 1. more: what node_for takes."""
    return Bench([node_for(spec, number, mcu, **more) for number in numbers], spec)  # type: ignore[arg-type]


def slots(spec: FrameSpec) -> int:
    """Sub-slots of a frame."""
    return 1 + (spec.chips - 1) // spec.resync_chips if spec.resync_chips else 1


def expected(
    spec: FrameSpec, node: int, code: int, start_ns: int, chip_ns: float | None = None
) -> NDArray[np.void]:
    """Expected edges of a node's pin (EDGE) by the host's encoder; node counts from 0.

    chip_ns: duration of a chip by the node's clock, within each sub-slot.
    """
    edges = expected_edges(spec, node, code)
    chips, nominal_ns = edges["t_ns"].copy(), spec.chip_s * 1e9
    # the end of a sub-slot, and all that is in it, is counted from its beginning
    pitch = spec.resync_chips + spec.guard_chips
    slot_start = chips // pitch * pitch if spec.resync_chips else 0
    since = chips - slot_start
    edges["t_ns"] = np.round(start_ns + slot_start * nominal_ns + since * (chip_ns or nominal_ns))
    return edges


def assert_says(
    bench: Bench,
    start_ns: int,
    code: int = REST,
    number: int = 1,
    node: int = 0,
    *,
    most_ns: int = EDGE_NS,
    until_slot: int | None = None,
) -> None:
    """Check that a node, numbered from 1, transmitted a code in the frame begun at a time.

    node: its place among the bench's sensors. most_ns: largest error of an edge by a timer.
    until_slot: the sub-slot before which it ended.
    """
    spec = bench.spec
    pitch = spec.resync_chips + spec.guard_chips
    if bench.node_of(node).mcu == FAST:
        levels = shifted_levels(bench, start_ns, node)
        wanted_levels = host_levels(spec, number, code)
        if until_slot is not None:
            wanted_levels[until_slot * pitch :] = 0
        np.testing.assert_array_equal(levels, wanted_levels)
        return
    heard = bench.heard(node, start_ns)
    wanted = expected(spec, number - 1, code, start_ns)
    if until_slot is not None:
        cut_ns = start_ns + until_slot * pitch * spec.chip_s * 1e9 - EDGE_NS
        wanted = wanted[wanted["t_ns"] < cut_ns]
    np.testing.assert_array_equal(heard["level"], wanted["level"])
    worst_ns = np.abs(heard["t_ns"] - wanted["t_ns"]).max()
    busy = spec.resync_chips and bench.node_of(node).mcu in TINY
    late_ns = COMPARATOR_NS if bench.node_of(node).bandgap_v else 0
    assert worst_ns <= (BUSY_NS if busy else most_ns + late_ns)


def host_levels(spec: FrameSpec, number: int, code: int) -> NDArray[np.int8]:
    """Levels of all places of a frame by the host's encoder, (span,), 0 where released."""
    active = np.arange(spec.nodes) == number - 1
    chips = line_chips(spec, np.full(spec.nodes, code), active, amplitude_v=1.0)
    return (frame_levels(chips, spec) * spec.polarity).astype(np.int8)


def shifted_levels(bench: Bench, start_ns: int, node: int) -> NDArray[np.int8]:
    """The same at the pin of a node that sends chips by a shift register; sampled at mid-chip.

    Checks that edges lie where a chip of the node's clock ends or less than a cycle later, as the
    pulse is captured at a cycle, and that the line is released but for sub-slots and what precedes
    them. Restarts count from their own pulse.
    """
    spec, edges = bench.spec, bench.heard(node, start_ns)
    own_ns = spec.chip_s * 1e9 * 8e6 / bench.node_of(node).clock_hz
    nominal_ns, levels = spec.chip_s * 1e9, np.zeros(spec.span_chips, np.int8)
    pitch_chips, left = spec.resync_chips + spec.guard_chips, np.ones(len(edges), bool)
    for slot in range(slots(spec)):
        begin_ns = start_ns + slot * pitch_chips * nominal_ns
        times_ns = edges["t_ns"] - begin_ns
        inside = (times_ns > -PRELUDE_NS - own_ns / 2) & (times_ns < (spec.order + 0.5) * own_ns)
        left &= ~inside
        if not inside.any():
            continue
        counted = times_ns[inside & (times_ns > -ROUNDING_NS)] + ROUNDING_NS
        assert counted.size, "it came early"
        late_ns = counted - np.append(np.floor(counted[:-1] / own_ns), spec.order) * own_ns
        assert late_ns.min() >= 0 and late_ns.max() <= CYCLE_NS + 2 * ROUNDING_NS
        middles_ns = begin_ns + (np.arange(spec.order) + 0.5) * own_ns
        before = np.searchsorted(edges["t_ns"], middles_ns, side="right") - 1
        levels[slot * pitch_chips :][: spec.order] = edges["level"][before]
        assert edges["level"][inside][-1] == 0
    assert not left.any()
    return levels


def in_turn(numbers: Iterable[int], turn: int) -> list[int]:
    """Places of those of some nodes whose number modulo G is g, as a turn of G + g says."""
    groups = 1 << (turn & 31).bit_length() - 1 if turn & 31 else 1
    return [place for place, number in enumerate(numbers) if number % groups == turn % groups]


def fast_spec(
    nodes: int, order: int, chip_s: float = 2e-6, bits: int = 10, **more: bool | str
) -> FrameSpec:
    """A skin of fast nodes, which start anew at every bit, with the least guards."""
    guard_chips = int(np.ceil(MCUS[FAST].restart_s / chip_s - 1e-9))
    spec = FrameSpec(nodes=nodes, order=order, chip_s=chip_s, bits=bits, resync_chips=order,
                     guard_chips=guard_chips, frame_period_s=1.0, **more)  # fmt: skip
    return replace(spec, frame_period_s=round(spec.frame_s + 1.1e-3, 6))


def volts(code: int, bits: int) -> float:
    """A sensor's voltage in the middle of a code, the first bits of the converter's 10."""
    return ((code + 0.5) / (1 << bits) - 0.5 / 1024) * VREF
