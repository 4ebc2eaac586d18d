# SPDX-License-Identifier: Apache-2.0

"""The image that sends chips by a shift register: its pin, to the cycle, against the encoder."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.frame_rate import FAST, MCUS
from test.support.emulated_node import (
    CLOCK_KNOWN,
    CYCLE_NS,
    FRAME,
    PRELUDE_NS,
    RESTART,
    UNIT_NS,
    assert_says,
    bench,
    fast_spec,
    slots,
    volts,
)
from test.support.node_limits import limits

pytestmark = pytest.mark.usefixtures("node_images")
PPM = 1e-6
SCRAMBLED_S = MCUS[FAST].scrambled_chip_ns * 1e-9
SPARSE_S = MCUS[FAST].sparse_chip_ns * 1e-9
SPARSE: dict[str, bool | str] = {"codes": "sparse", "scramble": True}
CODES = (0, 1023, 0b0101101110)


SHAPES = {
    "a thousand nodes": fast_spec(900, 912),
    "a row that ends within an octet": fast_spec(19, 20),
    "a row shorter than an octet": fast_spec(3, 4),
    "the shortest row": fast_spec(1, 2, first_row=0),
    "shortest chips": fast_spec(1000, 1024, 0.5e-6),
    "shortest chips, half an octet": fast_spec(11, 12, 0.5e-6),
    "chips of 5 cycles and a half": fast_spec(11, 12, 2.75e-6),
    "slow chips": fast_spec(15, 16, 16e-6),
    "slow chips that outlast the timer": fast_spec(60, 1024, 16e-6),
    "longest row": fast_spec(4000, 4096),
    "parity, 8 bits": fast_spec(31, 32, bits=8, parity=True),
    "scrambled": fast_spec(900, 912, scramble=True),
    "scrambled, shortest chips": fast_spec(1000, 1024, SCRAMBLED_S, scramble=True),
    "scrambled, half an octet": fast_spec(19, 20, SCRAMBLED_S, scramble=True, parity=True),
    "scrambled, shortest row": fast_spec(3, 4, SCRAMBLED_S, scramble=True),
    "scrambled, slow": fast_spec(3, 4, 16e-6, scramble=True),
    "sparse": fast_spec(4000, 912, SPARSE_S, **SPARSE),
    "sparse, sixteen digits": fast_spec(65_535, 1024, SPARSE_S, **SPARSE),
    "sparse, half an octet": fast_spec(300, 20, SPARSE_S, parity=True, **SPARSE),
    "sparse, shortest": fast_spec(9, 8, SPARSE_S, **SPARSE),
    "sparse, slow": fast_spec(9, 10, 16e-6, **SPARSE),
}  # fmt: skip


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
                assert_says(skin, start, code, node, place)


def test_clock_survives_bits_that_outlast_the_timer() -> None:
    """A bit of 65 ms holds all interrupts off; the timer's overflows are counted meanwhile."""
    with bench(fast_spec(4000, 4096, 16e-6), FAST) as skin:
        number = skin.listen()
        skin.frame(number)
        assert_says(skin, skin.frame(number + 1))
        assert skin.counters(0).watchdog_resets == 0


def test_before_a_bit_nodes_send_no_common_level() -> None:
    """A transmitter that idles drives high; all at once would saturate the amplifier."""
    with bench(fast_spec(60, 64), FAST, range(1, 61)) as skin:
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


@pytest.mark.parametrize("mcu", ["atmega328p", FAST])
@pytest.mark.parametrize("width_ns", [60, 120, 370])
def test_spikes_in_pulses_cost_nothing(mcu: str, width_ns: int) -> None:
    """The noise canceller drops what is shorter than 4 cycles, high or low."""
    with bench(fast_spec(15, 16) if mcu == FAST else FrameSpec(nodes=4, order=16), mcu) as skin:
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
                assert_says(skin, start)


TIMER_TURN_S = 2**16 / 8e6
LONG_PAUSES = {
    "atmega328p": FrameSpec(nodes=4, order=16, resync_chips=16, guard_chips=4,
                            frame_period_s=2 * TIMER_TURN_S),
    FAST: replace(fast_spec(31, 32), guard_chips=100, frame_period_s=TIMER_TURN_S),
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
            assert_says(skin, skin.frame(number, before=spikes))


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
            assert_says(skin, skin.frame(number, before=other))


@pytest.mark.parametrize("width_us", [26, 40])
def test_pulses_that_nobody_answers_bend_no_chip_of_a_bits_end(width_us: int) -> None:
    """In the last 64 µs of a bit: a restart's pulse could come then, so the node gets ready."""
    with bench(fast_spec(15, 16, 16e-6), FAST) as skin:
        for number, early_us in enumerate(range(60, 80, 3), skin.listen()):
            other = {1: (1000 * early_us, 1000 * width_us)}
            assert_says(skin, skin.frame(number, before=other))


def test_glitches_and_wrong_pulses_bend_no_chip() -> None:
    with bench(fast_spec(31, 32), FAST) as skin:
        for number in range(skin.listen(), CLOCK_KNOWN + 8):
            start = skin.start(number)
            first, *restarts = skin.rises(start)
            skin.pulse(first)
            skin.pulse(first + 40_000, 10_000)  # while it waits for its first chip
            skin.pulse(start + 20_000 + 500 * number, UNIT_NS)  # while it talks
            for rise in restarts:
                skin.pulse(rise, RESTART * UNIT_NS)
            skin.end(start)
            assert_says(skin, start)


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
