# SPDX-License-Identifier: Apache-2.0

"""The image that sends chips by a shift register: its pin, to the cycle, against the encoder."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.frame_rate import FAST, MCUS
from test.support.emulated_node import (
    CLOCK_KNOWN,
    FRAME,
    REST,
    RESTART,
    UNIT_NS,
    Bench,
    assert_says,
    bench,
    slots,
    volts,
)
from test.support.node_limits import limits

pytestmark = pytest.mark.usefixtures("node_images")
CYCLE_NS = 125
ROUNDING_NS = 10
"""Of the emulation's times of edges and cycles."""
PRELUDE_NS = 4_000
"""Longest time before a sub-slot, beside half a chip, for which the transmitter drives the line."""
PPM = 1e-6
SCRAMBLED_S = MCUS[FAST].scrambled_chip_ns * 1e-9
SPARSE_S = MCUS[FAST].sparse_chip_ns * 1e-9
SPARSE: dict[str, bool | str] = {"codes": "sparse", "scramble": True}
CODES = (0, 1023, 0b0101101110)


def fast(
    nodes: int, order: int, chip_s: float = 2e-6, bits: int = 10, **more: bool | str
) -> FrameSpec:
    """A skin whose nodes start anew at every bit, with the least guards."""
    guard_chips = int(np.ceil(MCUS[FAST].restart_s / chip_s - 1e-9))
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
    "sparse": fast(4000, 912, SPARSE_S, **SPARSE),
    "sparse, sixteen digits": fast(65_535, 1024, SPARSE_S, **SPARSE),
    "sparse, half an octet": fast(300, 20, SPARSE_S, parity=True, **SPARSE),
    "sparse, shortest": fast(9, 8, SPARSE_S, **SPARSE),
    "sparse, slow": fast(9, 10, 16e-6, **SPARSE),
}  # fmt: skip


def said(bench: Bench, start_ns: int, node: int = 0, chip_ns: float | None = None) -> NDArray:
    """Levels of all places of a frame at its pin, (span,), 0 where released; sampled at mid-chip.

    Checks that edges lie where a chip of the node's clock ends or less than a cycle later, as the
    pulse is captured at a cycle, and that the line is released but for sub-slots and what precedes
    them. Restarts count from their own pulse.
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


def wanted(spec: FrameSpec, node: int = 1, code: int = REST) -> NDArray[np.int8]:
    """The same by the host's encoder; node counts from 1."""
    active = np.arange(spec.nodes) == node - 1
    chips = line_chips(spec, np.full(spec.nodes, code), active, amplitude_v=1.0)
    return (frame_levels(chips, spec) * spec.polarity).astype(np.int8)


def assert_says_rest(bench: Bench, start_ns: int) -> None:
    """Check that a skin's first node transmitted its code at rest in a frame."""
    if bench.nodes[0].mcu == FAST:
        np.testing.assert_array_equal(said(bench, start_ns), wanted(bench.spec))
    else:
        assert_says(bench, start_ns)


@pytest.mark.parametrize("error", [-100 * PPM, 0.0, 100 * PPM])
@pytest.mark.parametrize("shape", SHAPES)
def test_words_of_every_shape(shape: str, error: float) -> None:
    """First and last node; all chips of a bit by the node's own crystal, a bit by the sync line."""
    spec = SHAPES[shape]
    which = (1, spec.nodes) if spec.nodes > 1 else (1,)
    with bench(spec, FAST, which, clock_hz=8e6 * (1 + error)) as skin:
        skin.frame(skin.listen())  # one more: a long row takes 40 ms to read
        for number, code in enumerate(CODES, CLOCK_KNOWN + 1):
            code >>= 10 - spec.bits
            skin.press(volts(code, spec.bits))
            start = skin.frame(number)
            for place, node in enumerate(which):
                levels = said(skin, start, place, spec.chip_s * 1e9 / (1 + error))
                np.testing.assert_array_equal(levels, wanted(spec, node, code))


def test_every_code_at_any_time_of_the_timer() -> None:
    """Also where the timer overflows in the middle of a bit."""
    spec = replace(fast(1, 16, 1e-6), frame_period_s=2.049e-3)
    with bench(spec, FAST) as skin:
        for number, code in enumerate(range(1024), skin.listen()):
            skin.press(volts(code, 10))
            start = skin.frame(number)
            np.testing.assert_array_equal(said(skin, start), wanted(spec, 1, code))
            skin.forget(start)


def test_clock_survives_bits_that_outlast_the_timer() -> None:
    """A bit of 65 ms holds all interrupts off; the timer's overflows are counted meanwhile."""
    with bench(fast(4000, 4096, 16e-6), FAST) as skin:
        number = skin.listen()
        skin.frame(number)
        assert_says_rest(skin, skin.frame(number + 1))
        assert skin.counters(0).watchdog_resets == 0


def test_before_a_bit_nodes_send_no_common_level() -> None:
    """A transmitter that idles drives high; all at once would saturate the amplifier."""
    with bench(fast(60, 64), FAST, range(1, 61)) as skin:
        start = skin.frame(skin.listen())
        skin.run(start + 1_000_000)
        instants = start + np.arange(-PRELUDE_NS, 0, CYCLE_NS) + CYCLE_NS // 2
        levels = np.zeros((60, instants.size))
        for node in range(60):
            edges = skin.heard(node, start)
            heard = edges["t_ns"][0] < instants
            place = np.searchsorted(edges["t_ns"], instants[heard], side="right") - 1
            levels[node, heard] = edges["level"][place]
        driven = (levels != 0).all(axis=0)
        common = np.abs(levels.sum(axis=0)) >= 5 * np.sqrt(60)
        assert np.count_nonzero(driven) == 26 and driven[-26:].all()
        # from their start to their first octet they drive high
        assert np.flatnonzero(common).tolist() == np.flatnonzero(driven)[:3].tolist()


def test_silent_nodes_leave_the_line_released() -> None:
    with bench(fast(15, 16), FAST, threshold=1, heartbeat=0) as skin:
        for number in range(6):
            assert not skin.spoke(skin.frame(number))
        skin.press(volts(400, 10))
        start = skin.frame(6)
        np.testing.assert_array_equal(said(skin, start), wanted(skin.spec, 1, 400))


def test_missing_restart_ends_the_frame() -> None:
    spec = fast(15, 16)
    with bench(spec, FAST) as skin:
        number = skin.listen()
        start = skin.frame(number, skip=[4])
        levels, pitch = wanted(spec), spec.resync_chips + spec.guard_chips
        levels[4 * pitch :] = 0
        np.testing.assert_array_equal(said(skin, start), levels)
        assert_says_rest(skin, skin.frame(number + 1))


@pytest.mark.parametrize("mcu", ["atmega328p", FAST])
@pytest.mark.parametrize("width_ns", [60, 120, 370])
def test_spikes_in_pulses_cost_nothing(mcu: str, width_ns: int) -> None:
    """The noise canceller drops what is shorter than 4 cycles, high or low."""
    with bench(fast(15, 16) if mcu == FAST else FrameSpec(nodes=4, order=16), mcu) as skin:
        for number in range(CLOCK_KNOWN + 4):
            start = skin.start(number)
            for slot, rise in enumerate(skin.rises(start)):
                length = (RESTART if slot else FRAME) * UNIT_NS
                dip = rise + 3_000 + 1_000 * number
                skin.pulse(rise - 5_000, width_ns)
                skin.pulse(rise, dip - rise)
                skin.pulse(dip + width_ns, length - (dip + width_ns - rise))
            skin.end(start)
            if number < CLOCK_KNOWN:
                assert not skin.spoke(start)
            else:
                assert_says_rest(skin, start)


TIMER_TURN_S = 2**16 / 8e6
LONG_PAUSES = {
    "atmega328p": FrameSpec(nodes=4, order=16, resync_chips=16, guard_chips=4,
                            frame_period_s=2 * TIMER_TURN_S),
    FAST: replace(fast(31, 32), guard_chips=100, frame_period_s=TIMER_TURN_S),
}  # fmt: skip
"""Of 200 µs, in none of which the timer overflows: it does 4.6 ms after frames begin."""


@pytest.mark.parametrize("mcu", LONG_PAUSES)
def test_spikes_in_pauses_begin_no_bit(mcu: str) -> None:
    """Its interrupt finds it over. Not in the first pause, in which the node has other work.

    Nor just before a pulse, which is then served late: by 15 µs with gcc-avr 14.
    """
    with bench(LONG_PAUSES[mcu], mcu) as skin:
        for number, early_us in enumerate(range(18, 200 - 64 - 14, 7), skin.listen()):
            spikes = dict.fromkeys(range(2, slots(skin.spec)), (1000 * early_us, 1000))
            assert_says_rest(skin, skin.frame(number, before=spikes))


@pytest.mark.parametrize("mcu", LONG_PAUSES)
@pytest.mark.parametrize("width_us", [1, 26, 40])
def test_what_hides_no_restart(mcu: str, width_us: int) -> None:
    """Spikes hide none from slow chips; other pulses that end and are served in time hide none."""
    early_us = np.arange(max(55, width_us + 25), 120, 7) if width_us > 1 else np.arange(1.7, 30)
    if mcu == FAST:
        early_us = early_us[(early_us < 9) | (early_us > 16)]  # 14 with gcc-avr 12, 15 with 14
    with bench(LONG_PAUSES[mcu], mcu) as skin:
        for number, early in enumerate(early_us, skin.listen()):
            other = {3: (round(1000 * early), 1000 * width_us)}
            assert_says_rest(skin, skin.frame(number, before=other))


@pytest.mark.parametrize("width_us", [26, 40])
def test_pulses_that_nobody_answers_bend_no_chip_of_a_bits_end(width_us: int) -> None:
    """In the last 64 µs of a bit: a restart's pulse could come then, so the node gets ready."""
    with bench(fast(15, 16, 16e-6), FAST) as skin:
        for number, early_us in enumerate(range(60, 80, 3), skin.listen()):
            other = {1: (1000 * early_us, 1000 * width_us)}
            assert_says_rest(skin, skin.frame(number, before=other))


def test_pulses_at_any_time_of_the_timer() -> None:
    """Each frame is 3 µs further in the timer's turn than the one before."""
    spec = replace(fast(31, 32), frame_period_s=2.563e-3)
    with bench(spec, FAST, start_ns=12_345) as skin:
        for number in range(skin.listen(), 900):
            start = skin.frame(number)
            assert_says_rest(skin, start)
            skin.forget(start)


def test_glitches_and_wrong_pulses_bend_no_chip() -> None:
    with bench(fast(31, 32), FAST) as skin:
        for number in range(skin.listen(), CLOCK_KNOWN + 8):
            start = skin.start(number)
            first, *restarts = skin.rises(start)
            skin.pulse(first)
            skin.pulse(first + 40_000, 10_000)  # while it waits for its first chip
            skin.pulse(start + 20_000 + 500 * number, UNIT_NS)  # while it talks
            for rise in restarts:
                skin.pulse(rise, RESTART * UNIT_NS)
            skin.end(start)
            assert_says_rest(skin, start)


def test_the_limits_themselves_were_tried() -> None:
    """Those of the board's header."""
    promised, shapes = limits(FAST), SHAPES.values()
    assert promised.chip_ns == round(min(spec.chip_s for spec in shapes) * 1e9)
    assert promised.longest_chip_ns == round(max(spec.chip_s for spec in shapes) * 1e9)
    scrambled = [spec.chip_s for spec in shapes if spec.scramble]
    assert promised.scrambled_chip_ns == round(min(scrambled) * 1e9)
    sparse = [spec.chip_s for spec in shapes if spec.sparse]
    assert promised.sparse_chip_ns == round(min(sparse) * 1e9)
    assert promised.order == max(spec.order for spec in shapes)
    guards = [spec.guard_chips * spec.chip_s for spec in shapes]
    assert promised.restart_us == round(min(guards) * 1e6)
