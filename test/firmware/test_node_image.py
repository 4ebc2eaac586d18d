# SPDX-License-Identifier: Apache-2.0

"""The nodes' images, emulated: pin edges compared with the host's encoder."""

import zlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.frame_rate import FAST, FOUR, MCUS, TINY_ON_DATA
from test.support.emulated_node import (
    ASK,
    BUSY_NS,
    CLOCK_KNOWN,
    EDGE_NS,
    FRAME,
    LEAD_NS,
    ON_DATA,
    POWER_UP_NS,
    REST,
    SLOW,
    TINY,
    UNIT_NS,
    Bench,
    assert_says,
    bench,
    expected,
    fast_spec,
    in_turn,
    node_for,
    slots,
    volts,
)

pytestmark = pytest.mark.usefixtures("node_images")
SPEC = FrameSpec(nodes=4, order=16)
SPARSE = {"codes": "sparse", "scramble": True}


@pytest.fixture(params=SLOW)
def mcu(request: pytest.FixtureRequest) -> str:
    """A board that times every chip by an interrupt, where a test does not name others."""
    return str(request.param)


def spec_of(mcu: str, *, least_gap: bool = False) -> FrameSpec:
    """Frames of four nodes of a board, with room for the digits of any turn, or the least gap."""
    if mcu == FAST:
        period_s = 2.3e-3 if least_gap else 4.3e-3
        return replace(SPEC, chip_s=2e-6, resync_chips=16, guard_chips=40, frame_period_s=period_s)
    return replace(SPEC, frame_period_s=9e-3) if least_gap else SPEC


SHAPES = {
    "paper": FrameSpec(nodes=16, order=16, first_row=0, sign_seed=None),
    "8 bits": FrameSpec(nodes=4, order=16, bits=8),
    "9 bits, parity, Paley": FrameSpec(nodes=11, order=12, bits=9, parity=True),
    "parity": FrameSpec(nodes=4, order=16, parity=True),
    "restarts": FrameSpec(nodes=31, order=32, bits=8, resync_chips=32, guard_chips=2,
                          frame_period_s=20e-3),
    "restarts within bits": FrameSpec(nodes=4, order=16, resync_chips=25, guard_chips=3,
                                      frame_period_s=16e-3),
    "a restart for each chip": FrameSpec(nodes=1, order=2, bits=8, chip_s=80e-6, resync_chips=1,
                                         guard_chips=2),
    "least guards": FrameSpec(nodes=3, order=4, bits=8, chip_s=96e-6, resync_chips=9, guard_chips=1,
                              frame_period_s=5e-3),
    "quick chips": FrameSpec(nodes=4, order=20, chip_s=40e-6, parity=True),
    "least chips": FrameSpec(nodes=4, order=16, chip_s=35e-6),
    "scrambled": FrameSpec(nodes=19, order=20, chip_s=40e-6, parity=True, scramble=True),
    "scrambled, least chips": FrameSpec(nodes=4, order=16, chip_s=35e-6, scramble=True),
    "scrambled, restarts within bits": FrameSpec(nodes=19, order=20, resync_chips=25, guard_chips=3,
                                                 frame_period_s=16e-3, scramble=True),
    "sparse": FrameSpec(nodes=256, order=48, chip_s=35e-6, frame_period_s=17.8e-3, **SPARSE),
    "sparse, odd": FrameSpec(nodes=999, order=21, bits=8, parity=True, chip_s=35e-6, **SPARSE),
    "odd chips": FrameSpec(nodes=4, order=16, chip_s=51.237e-6),
    "chips near the timer's wrap": FrameSpec(nodes=3, order=4, chip_s=64e-6, frame_period_s=5e-3),
    "slow chips": FrameSpec(nodes=2, order=4, bits=8, chip_s=1e-3, frame_period_s=40e-3),
    "least gap": FrameSpec(nodes=4, order=16, frame_period_s=9e-3),
    "long period": FrameSpec(nodes=3, order=4, frame_period_s=0.25),
}  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
def test_words_of_every_shape(mcu: str, shape: str) -> None:
    """The first and the last node, fast and slow clocks, all kinds of codes."""
    spec = SHAPES[shape]
    limits = MCUS["atmega328p" if mcu == ON_DATA else mcu]
    if spec.chip_s < limits.chip_ns * 1e-9:
        pytest.skip(f"chips too short for the {mcu}")
    if spec.sparse and not limits.sparse_chip_ns:
        pytest.skip(f"the {mcu} has no sparse codes")
    rng = np.random.default_rng(sum(map(ord, shape)))
    top = (1 << spec.bits) - 1
    codes = [0, top, 0b0101101110 & top, *rng.integers(0, top, 2)]
    for clock_hz in (7.21e6, 8e6, 8.77e6):
        with bench(spec, mcu, (1, spec.nodes), clock_hz=clock_hz) as skin:
            for number, code in enumerate(codes, skin.listen()):
                skin.press(volts(code, spec.bits))
                start = skin.frame(number)
                for node, which in enumerate((1, spec.nodes)):
                    # An ATtiny85 is not yet asleep at the first pulses.
                    first = mcu in TINY and number < CLOCK_KNOWN + 2
                    most_ns = BUSY_NS if first else EDGE_NS
                    assert_says(skin, start, code, which, node, most_ns=most_ns)


def test_chips_of_about_a_turn_of_the_timer() -> None:
    """An ATtiny85's 256 ticks of 2 cycles, at clocks that bring its interrupts together."""
    code = 0b0101101110
    for ticks in range(236, 340, 4):
        spec = FrameSpec(
            nodes=3, order=4, chip_s=ticks * 0.25e-6, frame_period_s=5e-3, scramble=True
        )
        for clock_hz in np.linspace(7.94e6, 8.06e6, 7):
            with bench(spec, "attiny85", (1, 3), clock_hz=clock_hz) as skin:
                skin.press(volts(code, spec.bits))
                for number in range(skin.listen(), CLOCK_KNOWN + 3):
                    start = skin.frame(number)
                    for node, which in enumerate((1, 3)):
                        assert_says(skin, start, code, which, node, most_ns=BUSY_NS)


@pytest.mark.parametrize("mcu", [*SLOW, FAST])
def test_every_code(mcu: str) -> None:
    """All 1024, rails included, with pulses at any time of the node's timers."""
    shape = fast_spec(1, 16, 1e-6) if mcu == FAST else FrameSpec(nodes=1, order=2, chip_s=40e-6)
    with bench(replace(shape, frame_period_s=2.049e-3), mcu) as skin:
        for number, code in enumerate(range(1024), skin.listen()):
            skin.press(volts(code, 10))
            start = skin.frame(number)
            assert_says(skin, start, code)
            skin.forget(start)


@pytest.mark.parametrize("turns", [1, 2, 6])
def test_periods_of_whole_turns_of_the_timers(mcu: str, turns: int) -> None:
    """What the node does now and then by its timers, it does not do just when pulses come."""
    for off_us in (-4, 0, 4, 12, 20, 28):
        spec = replace(SPEC, bits=8, chip_s=40e-6, frame_period_s=turns * 8.192e-3 + off_us * 1e-6)
        with bench(spec, mcu) as skin:
            number = skin.listen()
            skin.frame(number)  # the first pulse may have found it at work: a period off by 1 µs
            for frame in range(number + 1, number + 12):
                assert_says(skin, skin.frame(frame))


@pytest.mark.parametrize("sensor_v", [-0.5, 0.0, 3.3, 5.0])
def test_sensor_at_the_rails(mcu: str, sensor_v: float) -> None:
    with bench(SPEC, mcu) as skin:
        number = skin.listen()
        skin.press(sensor_v)
        assert_says(skin, skin.frame(number), 0 if sensor_v <= 0 else 1023)


def test_without_discipline_chips_are_the_clocks_own(mcu: str) -> None:
    """And start anew with every sub-slot; a node that doesn't measure need not wait, either."""
    error = 0.01
    spec = SHAPES["restarts"]
    with bench(spec, mcu, clock_hz=8e6 * (1 + error), discipline=False) as skin:
        start = skin.frame(0)
        chip_ns = spec.chip_s * 1e9 / (1 + error)
        wanted = expected(spec, 0, REST, start, chip_ns)
        heard = skin.heard(0, start)
        np.testing.assert_array_equal(heard["level"], wanted["level"])
        lead_error = LEAD_NS / (1 + error) - LEAD_NS
        errors_ns = np.abs(heard["t_ns"] - wanted["t_ns"] - lead_error)
        assert np.median(errors_ns) <= EDGE_NS and errors_ns.max() <= BUSY_NS


def test_clock_that_wanders(mcu: str) -> None:
    """A digitizer whose period changes is followed from frame to frame."""
    with bench(SPEC, mcu) as skin:
        at = POWER_UP_NS
        for number in range(12):
            skin.pulse(at - LEAD_NS)
            skin.run(at + 10_000_000)
            if number > CLOCK_KNOWN:
                wanted = expected(SPEC, 0, REST, at)
                heard = skin.heard(0, at)
                # chips are as long as the last period made them: 0.1 % longer than the one before
                stretch = (heard["t_ns"] - at) / np.maximum(wanted["t_ns"] - at, 1)
                assert abs(stretch[-1] - 1.001 ** (number - 2)) < 2e-4
            at += round(skin.period_ns * 1.001**number)


def test_what_is_no_frame_pulse_is_ignored(mcu: str) -> None:
    """Glitches, restart pulses that nobody waits for, pulses too long, early and doubled ones."""
    with bench(SPEC, mcu) as skin:
        number = skin.listen()
        for frame in range(number, number + 4):
            start = skin.start(frame)
            skin.pulse(start - LEAD_NS)
            skin.pulse(start - LEAD_NS + 40_000, 10_000)  # while it waits for its first chip
            skin.pulse(start + 1_000_000, FRAME * UNIT_NS)  # while it talks
            for at in range(2_000_000, 4_000_000, 7_000):
                skin.pulse(start + at, 1_000)
            at = start + 8_100_000  # the frame is over
            for length_us in (0.1, 0.5, 2, 5, 7, 16, 32, 60, 80, 200):
                skin.pulse(at, round(length_us * 1_000))
                at += round(length_us * 1_000) + 50_000
            skin.pulse(start + round(0.85 * skin.period_ns), FRAME * UNIT_NS)
            skin.pulse(start + round(0.86 * skin.period_ns), 48_000)
            skin.pulse(start + round(0.865 * skin.period_ns), 48_000_0)
            skin.end(start)
            assert_says(skin, start)


def test_missing_and_late_pulses(mcu: str) -> None:
    """A missing pulse costs its frame; a late one is obeyed, and bends no chip."""
    with bench(SPEC, mcu, clock_hz=8.2e6) as skin:
        number = skin.listen()
        assert_says(skin, skin.frame(number))
        skin.run(skin.start(number + 3) - 3_000_000)
        assert not skin.spoke(skin.start(number + 1)) + skin.spoke(skin.start(number + 2))
        assert_says(skin, skin.frame(number + 3))
        late = skin.period_ns // 3
        assert_says(skin, skin.frame(number + 4, late_ns=late))
        assert_says(skin, skin.frame(number + 5, late_ns=late))


JUMPS = (-0.06, -0.0595, -0.05, -0.01, 0.005, 0.01, 0.02, 0.05, 0.06, 0.1, 0.12)
"""Of the phase of frames, in periods."""


@pytest.mark.parametrize("error", [-0.09, -0.02, 0.0, 0.0125, 0.02, 0.09])
@pytest.mark.parametrize("jump", JUMPS)
def test_pulses_that_start_anew_bend_no_chip(mcu: str, error: float, jump: float) -> None:
    """A digitizer that begins again does so in another phase; the node's clock is the same.

    A pulse that meets a node awake may be taken late: the clock does not follow the next period.
    One that comes before the node is ready is lost; to the slowest clock the next one is, too.
    """
    with bench(SPEC, mcu, clock_hz=8e6 * (1 + error)) as skin:
        number = skin.listen()
        assert_says(skin, skin.frame(number))
        late = round(skin.period_ns * jump)
        lost = 0 if late > -400_000 else 2 if error == -0.09 else 1
        for later in range(1, 7):
            start = skin.frame(number + later, late_ns=late)
            if later > lost:
                assert_says(skin, start)
            else:
                assert not skin.spoke(start)


def test_line_without_pulses_for_long(mcu: str) -> None:
    """The node keeps measuring, so that its first word afterwards is true."""
    with bench(SPEC, mcu) as skin:
        number = skin.listen()
        skin.run(skin.start(200))
        skin.press(volts(345, 10))
        assert_says(skin, skin.frame(number + 203), 345)
        assert skin.counters(0).watchdog_resets == 0


@pytest.mark.parametrize(
    ("mcu", "frames"), [*((mcu, 600) for mcu in SLOW), pytest.param(FAST, 900, id=FAST)]
)
def test_restart_pulses_at_any_time_of_the_timers(mcu: str, frames: int) -> None:
    """What else a node does in interrupts makes it miss none."""
    # each frame is 3 µs further in the timers' turns than the one before
    spec = replace(SHAPES["restarts"], frame_period_s=16.387e-3)
    if mcu == FAST:
        spec = replace(fast_spec(31, 32), frame_period_s=2.563e-3)
    with bench(spec, mcu, start_ns=12_345) as skin:
        for number in range(skin.listen(), frames):
            start = skin.frame(number)
            assert_says(skin, start)
            skin.forget(start)


@pytest.mark.parametrize("error", [-0.1, 0.0, 0.1])
def test_sub_slots_of_one_chip_at_any_time_of_the_timer(error: float) -> None:
    """What follows a guard is worked out in time, also where the timer's overflow comes between."""
    spec = SHAPES["a restart for each chip"]
    nodes = [
        node_for(spec, clock_hz=8e6 * (1 + error), start_ns=1373 * phase) for phase in range(24)
    ]
    with Bench(nodes, spec) as skin:
        for number in range(skin.listen(), 9):
            start = skin.frame(number)
            for node in range(len(nodes)):
                assert_says(skin, start, node=node)


@pytest.mark.parametrize("mcu", [*SLOW, FAST, FOUR])
def test_missing_restart_ends_the_frame(mcu: str) -> None:
    spec = fast_spec(15, 16) if mcu == FAST else SHAPES["restarts"]
    assert slots(spec) > 6
    with bench(spec, mcu) as skin:
        number = skin.listen()
        start, after = skin.frame(number, skip=[4]), skin.frame(number + 1)
        for sensor in range(len(skin.sensors)):
            assert_says(skin, start, number=sensor + 1, node=sensor, until_slot=4)
            assert_says(skin, after, number=sensor + 1, node=sensor)


def with_period(memory: bytes, period_us: int) -> bytes:
    """A memory, otherwise good, that asks for another frame period."""
    body = memory[:21] + period_us.to_bytes(4, "little") + memory[25:-4]
    return body + zlib.crc32(body).to_bytes(4, "little")


CROWDED = {
    "the release's interrupt": FrameSpec(nodes=13, order=28, chip_s=96e-6, parity=True,
                                         resync_chips=13, guard_chips=1, frame_period_s=35.052e-3),
    "the timer's overflow": FrameSpec(nodes=2, order=2, chip_s=35.034e-6, parity=True, first_row=0,
                                      resync_chips=2, guard_chips=3, frame_period_s=3.322e-3),
}  # fmt: skip


@pytest.mark.parametrize("shape", CROWDED)
def test_restart_pulse_that_is_over_before_it_is_served(shape: str) -> None:
    """Another interrupt keeps an ATmega328P from it, but not from its sub-slot."""
    spec = CROWDED[shape]
    with bench(spec) as skin:
        for number in range(skin.listen(), 45):
            assert_says(skin, skin.frame(number))


def test_pulse_while_the_node_gets_ready(mcu: str) -> None:
    """A slow clock, not yet known, has it measure just when the pulse comes."""
    spec = FrameSpec(nodes=11, order=12, bits=9, parity=True, chip_s=40e-6, frame_period_s=7.8e-3)
    clocks_hz = 8e6 * (1 - 0.1 + np.arange(-8, 9) * 2e-5)
    nodes = [node_for(spec, mcu=mcu, clock_hz=clock_hz) for clock_hz in clocks_hz]
    with Bench(nodes, spec) as skin:
        for number in range(6):
            start = skin.frame(number)
        assert skin.spoke(start) == list(range(len(nodes)))


def test_end_of_a_pulse_while_an_attiny85s_timer_is_served() -> None:
    """A fast clock and a late look at the end make no glitch of a frame's pulse."""
    spec = FrameSpec(
        nodes=55, order=64, bits=9, parity=True, chip_s=64e-6, frame_period_s=54.718e-3
    )
    with bench(spec, "attiny85", clock_hz=8.8e6) as skin:
        assert_says(skin, skin.frame(skin.listen()))


MEMORIES = {
    "blank": (1, lambda good: b""),
    "zeroed": (1, lambda good: bytes(len(good))),
    "damaged": (2, lambda good: good[:41] + bytes([good[41] ^ 1]) + good[42:]),
    "another version": (3, lambda good: good[:4] + b"\x01" + good[5:]),
    # 8 ms of chips, 64 µs of lead and 900 µs to measure
    "a gap too short by 1 µs": (4, lambda good: with_period(good, 8_963)),
}


@pytest.mark.parametrize("memory", MEMORIES)
def test_node_without_a_memory_is_silent_and_blinks(mcu: str, memory: str) -> None:
    """As often as its fault's number says, then a pause."""
    blinks, spoil = MEMORIES[memory]
    good = node_for(SPEC, mcu=mcu)
    with Bench([replace(good, memory=spoil(good.memory))], SPEC) as skin:
        lit = []
        for number in range(720):
            assert not skin.spoke(skin.frame(number))
            lit.append(skin.led(0))
        changes = np.flatnonzero(np.diff(lit, prepend=False))
        flashes = changes[::2]
        pauses = np.diff(flashes) * SPEC.frame_period_s
        first = np.flatnonzero(pauses > 1.5)
        assert np.all(np.diff(first) == blinks) and len(first) >= 2
        assert first[0] == blinks - 1
        assert skin.counters(0).watchdog_resets == 0


def test_healthy_node_is_dark(mcu: str) -> None:
    with bench(SPEC, mcu, threshold=1, rest=None) as skin:
        for number in range(100):
            skin.frame(number)
            assert not skin.led(0)


@pytest.mark.parametrize("speaks", ["rest", "change"])
def test_events(mcu: str, speaks: str) -> None:
    """Silent at rest; talks of a press, or while it lasts, and of the release; heartbeats."""
    with bench(SPEC, mcu, (1, 2, 3, 4), threshold=2, heartbeat=20, speaks=speaks) as skin:
        heard = {}
        for number in range(60):
            pressed = 2 <= number % 30 < 6 and number > 30
            # node 2 is pressed; node 3 only touched
            skin.press([volts(code, 10) for code in
                             (REST, REST + 300 * pressed, REST - 2 * pressed, REST)])  # fmt: skip
            heard[number] = skin.spoke(skin.frame(number))
        turns = {0: 0, 5: 1, 10: 2, 15: 3}
        for number, nodes in heard.items():
            beating = (
                {turns[number % 20]} if number % 20 in turns and number >= CLOCK_KNOWN else set()
            )
            talks = range(32, 37) if speaks == "rest" else (32, 36)
            pressed = {1} if number in talks else set()
            assert set(nodes) == beating | pressed, number


@pytest.mark.parametrize(
    ("mcu", "clock_hz"), [("atmega328p", 7.92e6), (ON_DATA, 7.92e6), (FAST, 8e6), (FAST, 8.001e6)]
)
def test_groups_speak_by_turns(mcu: str, clock_hz: float) -> None:
    """Those whose number modulo G is g, right to the chip, and the release once in their turn."""
    spec, nodes = spec_of(mcu, least_gap=True), (1, 2, 3, 4)
    with bench(spec, mcu, nodes, clock_hz=clock_hz, threshold=1, heartbeat=0) as skin:
        for number in range(6):
            assert skin.spoke(skin.frame(number, turn=8 + number % 8)) == []
        skin.press(volts(100, 10))
        turns = [*range(4, 8), 2, 3, 2, 0, *range(16, 32), 0]
        for number, turn in enumerate(turns, 6):
            start = skin.frame(number, turn=turn)
            assert skin.spoke(start) == in_turn(nodes, turn), turn
            for node in skin.spoke(start):
                assert_says(skin, start, 100, node + 1, node)
        skin.press(volts(REST, 10))
        for number, turn in enumerate([4, 5, 6, 7, 4, 0], 6 + len(turns)):
            told = in_turn(nodes, turn) if number < 10 + len(turns) else []
            assert skin.spoke(skin.frame(number, turn=turn)) == told


@pytest.mark.parametrize(
    ("mcu", "clock_hz"),
    [*((mcu, hz) for mcu in SLOW for hz in (7.21e6, 8e6, 8.77e6)), (FAST, 8e6), (FAST, 8.001e6)],
)
def test_all_speak_when_they_are_asked(mcu: str, clock_hz: float) -> None:
    """Once, without news, right to the chip; not before the clock is known."""
    spec, nodes = spec_of(mcu, least_gap=True), (1, 2, 3, 4)
    with bench(spec, mcu, nodes, clock_hz=clock_hz, threshold=1, heartbeat=0) as skin:
        assert skin.spoke(skin.frame(0, turn=ASK)) == []
        for number in range(1, 6):
            assert skin.spoke(skin.frame(number)) == []
        for number in range(6, 30):
            asked = number % 3 == 0 or number == 7
            start = skin.frame(number, turn=ASK * asked)
            assert skin.spoke(start) == [0, 1, 2, 3] * asked, number
            for node in skin.spoke(start):
                assert_says(skin, start, REST, node + 1, node)
        skin.press(volts(100, 10))
        start = skin.frame(30, turn=ASK)
        assert skin.spoke(start) == [0, 1, 2, 3]
        skin.press(volts(REST, 10))
        assert skin.spoke(skin.frame(31)) == [0, 1, 2, 3], "what was said when asked is undone"
        assert skin.spoke(skin.frame(32)) == []


@pytest.mark.parametrize("mcu", [*SLOW, FAST])
def test_who_is_asked_by_mistake_or_not_at_all(mcu: str) -> None:
    """A pulse at another place, or one too long, asks nobody; nor does a frame that is lost."""
    with bench(spec_of(mcu), mcu, (1, 2), threshold=1, heartbeat=0) as skin:
        number = 0
        for early_us, length_us, speaks in [
            *[(early_us, 16, False) for early_us in (128, 256, 600, 640, 880)],
            (768, 16, True), (740, 16, True), (796, 16, True), (768, 32, False), (768, 45, False),
        ]:  # fmt: skip
            for _ in range(3):
                assert skin.spoke(skin.frame(number)) == []
                number += 1
            before = {0: (early_us * 1000, length_us * 1000)}
            spoke = skin.spoke(skin.frame(number, before=before))
            assert spoke == ([0, 1] if speaks else []), (early_us, length_us)
            number += 1
        rise = skin.start(number) - LEAD_NS
        skin.pulse(rise - 768_000, UNIT_NS)  # and no frame's pulse
        skin.end(skin.start(number))
        for frame in range(number + 1, number + 4):
            assert skin.spoke(skin.frame(frame)) == []


@pytest.mark.parametrize("mcu", ["atmega328p", ON_DATA, FAST])
def test_all_speak_by_turns_when_they_are_asked(mcu: str) -> None:
    """Those whose number modulo G is g; digit 5 of a number asks nobody but that node."""
    nodes = (1, 2, 3, 4, 6)
    spec = replace(spec_of(mcu), nodes=6)
    with bench(spec, mcu, nodes, threshold=1, heartbeat=0) as skin:
        first = skin.listen(6)
        turns = [*range(ASK + 4, ASK + 8), 4, 5, ASK + 2, ASK + 3, 0, *range(ASK + 16, ASK + 32)]
        for number, turn in enumerate(turns, first):
            asked = in_turn(nodes, turn) if turn >= ASK else []
            assert skin.spoke(skin.frame(number, turn=turn)) == asked, turn
        by_number = skin.frame(first + len(turns), turn=ASK + 1)
        assert skin.spoke(by_number) == [0], "node 1"


def test_pulses_of_any_length(mcu: str) -> None:
    """However little time is left after a pulse, the word is right in time or not said."""
    spec = FrameSpec(nodes=1, order=2, bits=8, chip_s=60e-6, frame_period_s=3e-3)
    with bench(spec, mcu) as skin:
        skin.press(volts(60, 8))
        said = {}
        for number, length_ns in enumerate(range(20_000, 58_000, 62), skin.listen()):
            start = skin.start(number)
            skin.pulse(start - LEAD_NS, length_ns)
            skin.end(start)
            said[length_ns] = skin.spoke(start) == [0]
            if said[length_ns]:
                assert_says(skin, start, 60)
            skin.forget(start)
        lengths = [length_ns for length_ns in said if said[length_ns]]
        assert lengths[0] < 28_000 and 36_000 < lengths[-1] <= 40_000
        assert lengths == [n for n in said if lengths[0] <= n <= lengths[-1]]


def test_turns_are_kept_over_missing_pulses(mcu: str) -> None:
    """Frames are counted by time where they aren't heard."""
    with bench(SPEC, mcu, (1, 2, 3, 4), threshold=100, heartbeat=20) as skin:
        heard = {number: skin.spoke(skin.frame(number)) for number in range(6)}
        for number in (6, 8, 9, 10, 13, 15, 20):
            heard[number] = skin.spoke(skin.frame(number))
        assert heard == {
            **{number: [] for number in range(6)},
            **{5: [1], 6: [], 8: [], 9: [], 10: [2], 13: [], 15: [3], 20: [0]},
        }


def test_clock_is_not_measured_over_missing_pulses(mcu: str) -> None:
    with bench(SPEC, mcu, clock_hz=8.24e6) as skin:
        for number in (0, 2, 3):
            assert not skin.spoke(skin.frame(number))
        assert_says(skin, skin.frame(4))


def test_rest_is_learnt(mcu: str) -> None:
    with bench(SPEC, mcu, threshold=3, heartbeat=0, rest=None) as skin:
        skin.press(volts(777, 10))
        codes = [777] * 10 + [780, 774, 781, 781, 777, 777]
        said = []
        for number, code in enumerate(codes):
            skin.press(volts(code, 10))
            said.append(skin.spoke(skin.frame(number)) == [0])
        assert said == [False] * 12 + [True, True, True, False]


def test_silent_node_sleeps(mcu: str, record_property: Callable[..., None]) -> None:
    """Share of time awake: silent, and talking in every frame."""
    shares = {}
    for name, options in {"silent": {"threshold": 1, "heartbeat": 0}, "talking": {}}.items():
        with bench(SPEC, mcu, **options) as skin:
            number = skin.listen()
            before = skin.counters(0)
            for frame in range(number, number + 50):
                skin.frame(frame)
            after = skin.counters(0)
            awake = after.cycles_awake - before.cycles_awake
            shares[name] = awake / (awake + after.cycles_asleep - before.cycles_asleep)
            record_property(name, shares[name])
            print(mcu, name, f"{shares[name]:.2%}")
    assert shares["silent"] < 0.08
    assert shares["talking"] < 0.5


def test_late_starters_join(mcu: str) -> None:
    """Powered up in the middle of a frame, at any time in it: silent until the clock is known."""
    starts = [round(POWER_UP_NS + share * 12.8e6) for share in np.linspace(0, 1, 9)]
    with Bench([node_for(SPEC, mcu=mcu, start_ns=start) for start in starts], SPEC) as skin:
        for number in range(5):
            start = skin.frame(number)
            for node in skin.spoke(start):
                # a start just at the first pulse finds it awake: some µs
                most_ns = BUSY_NS if mcu == TINY_ON_DATA else EDGE_NS
                assert_says(skin, start, node=node, most_ns=most_ns)
        assert skin.spoke(start) == list(range(len(starts)))


def test_prescalers_at_power_up_are_anywhere(mcu: str) -> None:
    """Time is told right by both timers of an ATtiny85, wherever their prescalers were."""
    nodes = [node_for(SPEC, mcu=mcu, start_ns=2_000 * node) for node in range(16)]
    with Bench(nodes, SPEC) as skin:
        for number in range(skin.listen(), 20):
            start = skin.frame(number)
            for node in range(16):
                assert_says(skin, start, node=node)


def test_node_that_hangs_starts_anew(mcu: str) -> None:
    """A storm on the sync line leaves no time for anything.

    An ATmega328P's clock stands still in it, and the watchdog ends that.
    """
    with bench(SPEC, mcu) as skin:
        number = skin.listen()
        assert_says(skin, skin.frame(number))
        begin = skin.start(number + 1)
        for at in range(begin, begin + 600_000_000, 9_000):
            skin.pulse(at, 4_000)
        for frame in range(number + 50, number + 90):
            skin.frame(frame)
        assert skin.counters(0).watchdog_resets > 0 or mcu in TINY
        assert_says(skin, skin.frame(number + 90))
