# SPDX-License-Identifier: Apache-2.0

"""The image that sends chips by a shift register: its pin, to the cycle, against the encoder."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import FIRMWARE
from emulated_node import (
    CALL,
    CLOCK_KNOWN,
    FRAME,
    LEAD_NS,
    POWER_UP_NS,
    RESTART,
    UNIT_NS,
    Bench,
    EmulatedNodes,
    Node,
    image,
    slots,
    volts,
)
from numpy.typing import NDArray

from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.hardware.node_memory import FAST, MCUS, node_memory

CYCLE_NS = 125
EDGE_NS = 2 * CYCLE_NS
"""Largest error of an edge: the pulse is captured at a cycle, and the first chip begins at one."""
PRELUDE_NS = 4_000
"""Longest time before a sub-slot, beside half a chip, for which the transmitter drives the line."""
PPM = 1e-6
REST = 225
SCRAMBLED_S = MCUS[FAST].scrambled_chip_ns * 1e-9
SPEECH = {"threshold": 0, "rest": REST}
CODES = (0, 1023, 0b0101101110)


def fast(nodes: int, order: int, chip_s: float = 2e-6, bits: int = 10, **more: bool) -> FrameSpec:
    """A skin whose nodes start anew at every bit, with the least guards."""
    guard_chips = int(np.ceil(80e-6 / chip_s))
    spec = FrameSpec(nodes=nodes, order=order, chip_s=chip_s, bits=bits, resync_chips=order,
                     guard_chips=guard_chips, frame_period_s=1.0, **more)  # fmt: skip
    return replace(spec, frame_period_s=round(spec.frame_s + 1.1e-3, 6))


SHAPES = {
    "a thousand nodes": fast(900, 912),
    "a row that ends within an octet": fast(19, 20),
    "a row shorter than an octet": fast(3, 4),
    "the shortest row": fast(1, 2, first_row=0),
    "shortest chips": fast(1000, 1024, 0.5e-6),
    "shortest chips, half an octet": fast(11, 12, 0.5e-6),
    "chips of 5 cycles and a half": fast(11, 12, 2.75e-6),
    "slow chips": fast(15, 16, 16e-6),
    "slow chips that outlast the timer": fast(60, 1024, 16e-6),
    "longest row": fast(4000, 4096),
    "parity, 8 bits": fast(31, 32, bits=8, parity=True),
    "scrambled": fast(900, 912, scramble=True),
    "scrambled, shortest chips": fast(1000, 1024, SCRAMBLED_S, scramble=True),
    "scrambled, half an octet": fast(19, 20, SCRAMBLED_S, scramble=True, parity=True),
    "scrambled, shortest row": fast(3, 4, SCRAMBLED_S, scramble=True),
    "scrambled, slow": fast(3, 4, 16e-6, scramble=True),
}  # fmt: skip


@pytest.fixture(scope="module")
def build(built: Callable[[str], Path]) -> Path:
    """Where images and emulation are."""
    built("node")
    return built("sim")


@contextmanager
def bench(
    build: Path,
    spec: FrameSpec,
    nodes: tuple[int, ...] = (1,),
    clock_hz: float = 8e6,
    start_ns: int = 0,
    **options: int | bool | None,
) -> Iterator[Bench]:
    """Nodes of these numbers, from 1; no emulation that they were not made for."""
    made = [
        Node(image(build, FAST), FAST, node_memory(spec, node, mcu=FAST, **(SPEECH | options)),
             clock_hz=clock_hz, start_ns=start_ns)
        for node in nodes
    ]  # fmt: skip
    with EmulatedNodes(made) as skin:
        skin.press(volts(REST >> (10 - spec.bits), spec.bits))
        yield Bench(skin, spec)
        for node in range(len(nodes)):
            counters = skin.counters(node)
            assert not (counters.faults or counters.deep_sleeps or counters.pull_ups)


def said(bench: Bench, start_ns: int, node: int = 0, chip_ns: float | None = None) -> NDArray:
    """Levels of all places of a frame at its pin, (span,), 0 where released; sampled at mid-chip.

    Checks that edges lie where a chip of the node's clock ends, to a cycle, and that the line is
    released but for sub-slots and what precedes them. Restarts count from their own pulse.
    """
    spec, own_ns = bench.spec, chip_ns or bench.spec.chip_s * 1e9
    edges = bench.heard(node, start_ns)
    nominal_ns, levels = spec.chip_s * 1e9, np.zeros(spec.span_chips, np.int8)
    pitch_chips, left = spec.resync_chips + spec.guard_chips, np.ones(len(edges), bool)
    for slot in range(slots(spec)):
        begin_ns = start_ns + slot * pitch_chips * nominal_ns
        times_ns = edges["t_ns"] - begin_ns
        inside = (times_ns > -PRELUDE_NS - own_ns / 2) & (times_ns < (spec.order + 0.5) * own_ns)
        left &= ~inside
        if not inside.any():
            continue
        counted = times_ns[inside & (times_ns > -EDGE_NS)]
        assert np.abs(counted - np.round(counted / own_ns) * own_ns).max() <= EDGE_NS
        middles_ns = begin_ns + (np.arange(spec.order) + 0.5) * own_ns
        before = np.searchsorted(edges["t_ns"], middles_ns, side="right") - 1
        levels[slot * pitch_chips :][: spec.order] = edges["level"][before]
        assert edges["level"][inside][-1] == 0
        assert abs(counted[-1] - spec.order * own_ns) <= EDGE_NS
    assert not left.any()
    return levels


def wanted(spec: FrameSpec, node: int, code: int) -> NDArray[np.int8]:
    """The same by the host's encoder; node counts from 1."""
    active = np.arange(spec.nodes) == node - 1
    chips = line_chips(spec, np.full(spec.nodes, code), active, amplitude_v=1.0)
    return (frame_levels(chips, spec) * spec.polarity).astype(np.int8)


@pytest.mark.parametrize("error", [-100 * PPM, 0.0, 100 * PPM])
@pytest.mark.parametrize("shape", SHAPES)
def test_words_of_every_shape(build: Path, shape: str, error: float) -> None:
    """First and last node; all chips of a bit by the node's own crystal, a bit by the sync line."""
    spec = SHAPES[shape]
    which = (1, spec.nodes) if spec.nodes > 1 else (1,)
    with bench(build, spec, which, 8e6 * (1 + error)) as skin:
        for number in range(CLOCK_KNOWN + 1):  # one more: a long row takes 40 ms to read
            skin.frame(number)
        for number, code in enumerate(CODES, CLOCK_KNOWN + 1):
            code >>= 10 - spec.bits
            skin.skin.press(volts(code, spec.bits))
            start = skin.frame(number)
            for place, node in enumerate(which):
                levels = said(skin, start, place, spec.chip_s * 1e9 / (1 + error))
                np.testing.assert_array_equal(levels, wanted(spec, node, code))


def test_every_code_at_any_time_of_the_timer(build: Path) -> None:
    """Also where the timer overflows in the middle of a bit."""
    spec = replace(fast(1, 16, 1e-6), frame_period_s=2.049e-3)
    with bench(build, spec) as skin:
        for number in range(CLOCK_KNOWN):
            skin.frame(number)
        for code in range(1024):
            skin.skin.press(volts(code, 10))
            start = skin.frame(number + 1 + code)
            np.testing.assert_array_equal(said(skin, start), wanted(spec, 1, code))
            skin.skin.forget(start)


def test_clock_survives_bits_that_outlast_the_timer(build: Path) -> None:
    """A bit of 65 ms holds all interrupts off; the timer's overflows are counted meanwhile."""
    spec = fast(4000, 4096, 16e-6)
    with bench(build, spec) as skin:
        for number in range(CLOCK_KNOWN + 2):
            start = skin.frame(number)
        np.testing.assert_array_equal(said(skin, start), wanted(spec, 1, REST))
        assert skin.skin.counters(0).watchdog_resets == 0


def test_before_a_bit_nodes_send_no_common_level(build: Path) -> None:
    """A transmitter that idles drives high; all at once would saturate the amplifier."""
    spec = fast(60, 64)
    nodes = tuple(range(1, 61))
    with bench(build, spec, nodes) as skin:
        for number in range(CLOCK_KNOWN):
            skin.frame(number)
        start = skin.frame(CLOCK_KNOWN)
        skin.skin.run(start + 1_000_000)
        # from the first level of the guard on, every 2 cycles
        instants = start - 2_875 + 250 * np.arange(8) + 100
        high = np.zeros(8)
        for node in range(60):
            edges = skin.skin.edges(node)
            high += edges["level"][np.searchsorted(edges["t_ns"], instants, side="right") - 1]
        assert np.abs(high).max() < 5 * np.sqrt(60)


def test_silent_nodes_leave_the_line_released(build: Path) -> None:
    with bench(build, fast(15, 16), threshold=1, heartbeat=0) as skin:
        for number in range(6):
            assert not len(skin.heard(0, skin.frame(number)))
        skin.skin.press(volts(400, 10))
        start = skin.frame(6)
        np.testing.assert_array_equal(said(skin, start), wanted(skin.spec, 1, 400))


@pytest.mark.parametrize("order", [2, 4, 16])
def test_roll_call(build: Path, order: int) -> None:
    """Right after its long pulse a node is in time, whenever that falls; the others are silent."""
    spec = fast(order - 1, order, bits=8)
    memories = [node_memory(spec, node, mcu=FAST, **SPEECH) for node in range(1, spec.nodes + 1)]
    nodes = [
        Node(image(build, FAST), FAST, memory, start_ns=37 * phase)
        for memory in memories[:3]
        for phase in range(40)
    ]
    with EmulatedNodes(nodes) as emulated:
        emulated.press(volts(REST >> 2, 8))
        skin = Bench(emulated, spec)
        for number in range(CLOCK_KNOWN):
            skin.frame(number)
        for turn in range(spec.nodes):
            start = skin.frame(CLOCK_KNOWN + turn, CALL if turn == 0 else FRAME)
            for place in range(len(nodes)):
                levels = wanted(spec, turn + 1, REST >> 2) * (place // 40 == turn)
                np.testing.assert_array_equal(said(skin, start, place), levels)


def test_missing_restart_ends_the_frame(build: Path) -> None:
    spec = fast(15, 16)
    with bench(build, spec) as skin:
        for number in range(CLOCK_KNOWN):
            skin.frame(number)
        start = skin.frame(CLOCK_KNOWN, skip=[4])
        levels, pitch = wanted(spec, 1, REST), spec.resync_chips + spec.guard_chips
        levels[4 * pitch :] = 0
        np.testing.assert_array_equal(said(skin, start), levels)
        start = skin.frame(CLOCK_KNOWN + 1)
        np.testing.assert_array_equal(said(skin, start), wanted(spec, 1, REST))


@pytest.mark.parametrize("mcu", ["atmega328p", FAST])
@pytest.mark.parametrize("width_ns", [60, 120, 370])
def test_spikes_in_pulses_cost_nothing(build: Path, mcu: str, width_ns: int) -> None:
    """The noise canceller drops what is shorter than 4 cycles, high or low."""
    spec = fast(15, 16) if mcu == FAST else FrameSpec(nodes=4, order=16)
    node = Node(image(build, mcu), mcu, node_memory(spec, 1, mcu=mcu, **SPEECH))
    with EmulatedNodes([node]) as emulated:
        emulated.press(volts(REST, 10))
        skin = Bench(emulated, spec)
        for number in range(CLOCK_KNOWN + 4):
            start = POWER_UP_NS + number * skin.period_ns
            for slot in range(slots(spec)):
                at = slot * (spec.resync_chips + spec.guard_chips) * spec.chip_s * 1e9
                rise = start + round(at) - LEAD_NS
                length = (RESTART if slot else FRAME) * UNIT_NS
                dip = rise + 3_000 + 1_000 * number
                skin.pulse(rise - 5_000, width_ns)
                skin.pulse(rise, dip - rise)
                skin.pulse(dip + width_ns, length - (dip + width_ns - rise))
            skin.skin.run(start + skin.period_ns - 950_000)
            assert bool(len(skin.heard(0, start))) == (number >= CLOCK_KNOWN)
        if mcu == FAST:
            np.testing.assert_array_equal(said(skin, start), wanted(spec, 1, REST))


def test_pulses_at_any_time_of_the_timer(build: Path) -> None:
    """Each frame is 3 µs further in the timer's turn than the one before."""
    spec = replace(fast(31, 32), frame_period_s=2.563e-3)
    with bench(build, spec, start_ns=12_345) as skin:
        for number in range(CLOCK_KNOWN):
            skin.frame(number)
        for number in range(CLOCK_KNOWN, 900):
            start = skin.frame(number)
            np.testing.assert_array_equal(said(skin, start), wanted(spec, 1, REST))
            skin.skin.forget(start)


def test_glitches_and_wrong_pulses_bend_no_chip(build: Path) -> None:
    spec = fast(31, 32)
    with bench(build, spec) as skin:
        for number in range(CLOCK_KNOWN):
            skin.frame(number)
        for number in range(CLOCK_KNOWN, CLOCK_KNOWN + 8):
            start = POWER_UP_NS + number * skin.period_ns
            skin.pulse(start - LEAD_NS)
            skin.pulse(start - LEAD_NS + 40_000, 10_000)  # while it waits for its first chip
            skin.pulse(start + 20_000 + 500 * number, UNIT_NS)  # while it talks
            for slot in range(1, slots(spec)):
                at = slot * (spec.resync_chips + spec.guard_chips) * spec.chip_s
                skin.pulse(start + round(at * 1e9) - LEAD_NS, RESTART * UNIT_NS)
            skin.skin.run(start + skin.period_ns - 950_000)
            np.testing.assert_array_equal(said(skin, start), wanted(spec, 1, REST))


def test_constants_agree_with_the_header(build: Path) -> None:
    """The shortest chip that was tried is the one that the board promises."""
    text = (FIRMWARE / "node" / "atmega328p.h").read_text()
    assert "#define BOARD_CHIP_NS 500u" in text
    assert min(spec.chip_s for spec in SHAPES.values()) == 500e-9
