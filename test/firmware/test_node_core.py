# SPDX-License-Identifier: Apache-2.0

"""A sensing node's C core compared with the host: memory, chips, rules, clock, sync pulses."""

import ctypes
import zlib
from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.codes import is_feasible
from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import MEASURING_S, ORTHOGONAL, SPARSE, FrameSpec
from tactile_cdma.config.frame_rate import MCUS, Mcu
from tactile_cdma.hardware.node_memory import (
    CHANGE,
    REST,
    hearing_data,
    node_memory,
    read_node_memory,
)
from tactile_cdma.readings.calibration import AdcScale, PressureCurve
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.nodes import Turns
from tactile_cdma.sim.options import Setup, SimOptions
from tactile_cdma.sim.scene import SkinGeometry
from tactile_cdma.wire._protocol import TURN_ASKED
from tactile_cdma.wire.messages import WIRE
from test.support.examples import examples
from test.support.node_limits import BLANK, CORRUPT, GOOD, INVALID, UNFIT, Limits, limits, load

ORDERS = [order for order in range(1, 421) if is_feasible(order)] + [1024, 4096]
SPEC = FrameSpec(nodes=4, order=16)
LIMITS = Limits(4096, 30_000, 33_000, 34_000, 900_000, 1, False, 900, 80, True, True)
SHORT_ROWS = Limits(1024, 30_000, 33_000, 0, 900_000, 1, False, 900, 80, True, False)
FAST_LIMITS = Limits(4096, 500, 1750, 2000, 16_000, 250, True, 900, 80, True, False)
RECORD_BYTES = WIRE["NodeRecord"].size


def record_of(**changes: int) -> bytes:
    """A good node's memory with other values, valid or not, in its record."""
    record, chips = read_node_memory(node_memory(SPEC, 2))
    values = {**asdict(record), **changes}
    row = np.packbits(np.resize(chips > 0, values["order"]), bitorder="little").tobytes()
    octets = bytes(values["digits"]) if values["digits"] else row
    body = WIRE["NodeRecord"].pack(*values.values()) + octets
    return body + zlib.crc32(body).to_bytes(4, "little")


@st.composite
def specs(draw: st.DrawFn) -> FrameSpec:
    """Frames of every shape that a node supports; nodes use rows from 0 to the last."""
    sparse = draw(st.booleans())
    order = draw(st.integers(8, 420) if sparse else st.sampled_from(ORDERS))
    first_row = 1 if sparse else draw(st.integers(0, order - 1))
    resync = 0 if sparse else draw(st.one_of(st.just(0), st.integers(1, 4000)))
    guard = draw(st.integers(3, 255)) if resync else 0  # 96 µs at least
    seed = draw(st.integers(0, 2**32 - 1) if sparse else st.none() | st.integers(0, 2**32 - 1))
    spec = FrameSpec(
        nodes=draw(st.integers(1, 65_535 if sparse else order - first_row)),
        codes=SPARSE if sparse else ORTHOGONAL,
        bits=draw(st.integers(8, 10)),
        order=order,
        chip_s=draw(st.sampled_from([35e-6, 50e-6, 61.7e-6])),
        frame_period_s=1e6,
        first_row=first_row,
        sign_seed=seed,
        scramble=sparse or (seed is not None and order >= 4 and draw(st.booleans())),
        polarity=draw(st.sampled_from([1, -1])),
        parity=draw(st.booleans()),
        resync_chips=resync,
        guard_chips=guard,
    )
    return replace(spec, frame_period_s=max(spec.frame_s + 2e-3, 1e-3).__round__(6))


@examples(150)
@given(data=st.data())
def test_chips_are_those_of_the_host(core: ctypes.CDLL, data: st.DataObject) -> None:
    spec = data.draw(specs().filter(lambda spec: spec.frame_period_s <= 10))
    node = data.draw(st.integers(1, spec.nodes))
    code = data.draw(st.integers(0, 2**spec.bits - 1))
    memory = node_memory(spec, node)
    fault, record, row = load(core, memory, LIMITS)
    assert fault == GOOD
    levels = np.zeros(spec.span_chips, np.int8)
    span = core.shim_frame(record, row, code, levels.ctypes, spec.span_chips)
    assert span == spec.span_chips
    active = np.arange(spec.nodes) == node - 1
    chips = line_chips(spec, np.full(spec.nodes, code), active, 1.0)
    np.testing.assert_array_equal(levels, spec.polarity * frame_levels(chips, spec))


@pytest.mark.parametrize("memory", [b"", b"\xff" * 1024, b"\0" * 1024])
def test_blank_memory(core: ctypes.CDLL, memory: bytes) -> None:
    assert load(core, memory, LIMITS)[0] == BLANK


@given(st.integers(0, 8 * len(record_of()) - 1))
def test_no_flipped_bit_is_believed(core: ctypes.CDLL, bit: int) -> None:
    memory = bytearray(record_of())
    memory[bit // 8] ^= 1 << bit % 8
    assert load(core, bytes(memory), LIMITS)[0] in (BLANK, CORRUPT, INVALID)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"node": 4}, GOOD),
        ({"node": 5}, INVALID),
        ({"node": 0}, INVALID),
        ({"bits": 7}, INVALID),
        ({"bits": 11}, INVALID),
        ({"sign": 0}, INVALID),
        ({"parity": 2}, INVALID),
        ({"discipline": 2}, INVALID),
        *(({"version": v}, f) for v, f in {1: INVALID, 4: GOOD, 5: GOOD, 6: INVALID}.items()),
        ({"order": 0}, INVALID),
        ({"chip_ns": 499}, INVALID),
        ({"chip_ns": 900_000, "frame_period_us": 200_000}, GOOD),
        ({"chip_ns": 900_001, "frame_period_us": 200_000}, UNFIT),
        ({"chip_ns": 29_999}, UNFIT),
        ({"chip_ns": 30_000}, GOOD),
        ({"chip_ns": 32_999, "scramble": 1}, UNFIT),
        ({"chip_ns": 33_000, "scramble": 1}, GOOD),
        ({"chip_ns": 33_999, "scramble": 1, "digits": 4}, UNFIT),
        ({"chip_ns": 34_000, "scramble": 1, "digits": 4}, GOOD),
        ({"chip_ns": 34_000, "digits": 16}, GOOD),
        ({"digits": 4, "chip_ns": 34_000, "resync_chips": 32, "guard_chips": 4}, UNFIT),
        ({"digits": 3}, INVALID),
        ({"digits": 17}, INVALID),
        ({"resync_chips": 32}, INVALID),
        ({"guard_chips": 2}, INVALID),
        ({"resync_chips": 32, "guard_chips": 2}, GOOD),
        ({"resync_chips": 32, "guard_chips": 1}, UNFIT),
        ({"resync_chips": 160, "guard_chips": 1}, GOOD),
        # 8 ms of chips, 64 µs of lead, 900 µs to measure
        ({"frame_period_us": 8_964}, GOOD),
        ({"frame_period_us": 8_963}, UNFIT),
        ({"frame_period_us": 9_064, "resync_chips": 80, "guard_chips": 2}, GOOD),
        ({"frame_period_us": 9_063, "resync_chips": 80, "guard_chips": 2}, UNFIT),
    ],
)
def test_what_a_node_takes(core: ctypes.CDLL, changes: dict[str, int], fault: int) -> None:
    assert load(core, record_of(**changes), LIMITS)[0] == fault


def test_who_cannot_hear_the_data_wire_refuses_its_records(core: ctypes.CDLL) -> None:
    memory = hearing_data(node_memory(SPEC, 3), "atmega328p")
    assert load(core, memory, LIMITS)[0] == GOOD
    for board in (SHORT_ROWS, FAST_LIMITS):
        assert load(core, memory, board)[0] == INVALID


def test_row_that_is_too_long_for_the_board(core: ctypes.CDLL) -> None:
    memory = node_memory(FrameSpec(nodes=4, order=1032, frame_period_s=1.0), 1)
    assert load(core, memory, LIMITS)[0] == GOOD
    assert load(core, memory, SHORT_ROWS)[0] == UNFIT
    assert load(core, record_of(digits=12, chip_ns=34_000), SHORT_ROWS)[0] == UNFIT


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({}, GOOD),
        ({"resync_chips": 8}, UNFIT),
        ({"resync_chips": 0, "guard_chips": 0}, UNFIT),
        ({"chip_ns": 2250}, GOOD),
        ({"chip_ns": 2100}, UNFIT),
        ({"chip_ns": 16_250}, UNFIT),
        ({"guard_chips": 39}, UNFIT),
        # of an octet that one chip fills, chips could not be left out in pairs
        ({"order": 2, "resync_chips": 2}, GOOD),
        ({"order": 1, "resync_chips": 1}, UNFIT),
    ],
)
def test_what_a_node_of_fast_chips_takes(
    core: ctypes.CDLL, changes: dict[str, int], fault: int
) -> None:
    usual = {"chip_ns": 2000, "resync_chips": 16, "guard_chips": 40}
    assert load(core, record_of(**{**usual, **changes}), FAST_LIMITS)[0] == fault


def talks(
    core: ctypes.CDLL,
    memory: bytes,
    rest: int,
    codes: NDArray[np.int64],
    turns: NDArray[np.int64],
    missed: Sequence[int] = (),
) -> NDArray[np.bool_]:
    """Frames in which the node transmits. missed: those whose pulse it does not hear."""
    result, deaf = np.zeros(len(codes), np.uint8), np.zeros(len(codes), np.uint8)
    deaf[list(missed)] = True
    core.shim_events(
        memory[:RECORD_BYTES],
        rest,
        codes.astype(np.uint16).ctypes,
        deaf.ctypes,
        turns.astype(np.uint8).ctypes,
        result.ctypes,
        ctypes.c_size_t(len(codes)),
    )
    return result.astype(bool)


@examples(50)
@given(
    nodes=st.integers(1, 6),
    threshold=st.integers(0, 40),
    heartbeat=st.integers(0, 20),
    seed=st.integers(0, 2**32 - 1),
    divided=st.dictionaries(st.integers(0, 59), st.integers(0, 3), max_size=4),
    words=st.dictionaries(st.integers(0, 59), st.integers(0, 3), max_size=4),
    speaks=st.sampled_from([REST, CHANGE]),
)
def test_rules_are_those_of_the_simulator(
    core: ctypes.CDLL,
    nodes: int,
    threshold: int,
    heartbeat: int,
    seed: int,
    divided: dict[int, int],
    words: dict[int, int],
    speaks: str,
) -> None:
    """400 frames with random presses, groups and requests to speak: who transmits when.

    Of 10 s, so that a rest follows in 6 of them, and in 12, 24 … while it is pressed.
    """
    spec = FrameSpec(nodes=nodes, order=16, frame_period_s=10.0)
    rng = np.random.default_rng(seed)
    # stays, steps and drifts, so that every rule gets to decide
    size = 400, nodes
    steps = rng.choice([0, 0, 0, 0.1, 1, 10], size) * rng.choice([-1, 1], size)
    pressures = np.abs(np.cumsum(steps, axis=0)) * 1e3 * rng.choice([0, 1], size)
    pressures[200:] = np.repeat(pressures[200:400:40] / 4, 40, axis=0)
    asked = Turns(groups_log2=0)

    def scene(t_s: float, skin: SkinGeometry) -> NDArray[np.float64]:
        return pressures[min(399, round(t_s / spec.frame_period_s))]

    options = SimOptions(threshold=threshold, heartbeat=heartbeat, speaks=speaks)
    coming = truth(options, Setup(spec), asked, scene)
    frames = []
    for number in range(400):
        asked.groups_log2 = divided.get(number, asked.groups_log2)
        asked.words_log2 = words.get(number)
        frames.append(next(coming))
    codes = np.array([frame.codes for frame in frames])
    rest = AdcScale(spec.bits).code(PressureCurve.two_stage().voltage(np.zeros(nodes)))
    turns = np.array([frame.turn | TURN_ASKED * frame.asked for frame in frames])
    for node in range(nodes):
        memory = node_memory(
            spec, node + 1, threshold=threshold, heartbeat=heartbeat, speaks=speaks
        )
        np.testing.assert_array_equal(
            talks(core, memory, int(rest[node]), codes[:, node], turns),
            [frame.active[node] for frame in frames],
        )


def hours(codes: NDArray[np.float64], spec: FrameSpec) -> NDArray[np.int64]:
    """Codes of each frame, of codes of each hour that a line joins."""
    frames = np.arange(0, len(codes) - 1, spec.frame_period_s / 3600)
    return np.round(np.interp(frames, np.arange(len(codes)), codes)).astype(np.int64)


SLOW = FrameSpec(nodes=2, order=16, frame_period_s=0.1)


@pytest.mark.parametrize("begun", [3600, 512 * 600 - 2])  # just before a step of 10 LSB, too
@pytest.mark.parametrize("touch", [10, 20, 500])
def test_no_steady_touch_of_hours_becomes_the_rest(
    core: ctypes.CDLL, touch: int, begun: int
) -> None:
    """One of 1 kPa is 10 LSB; it is told in every frame for 8 hours, and so is its release."""
    memory = node_memory(SLOW, 1, heartbeat=0, speaks=REST)
    rest, pressed = np.full(begun, 1000), np.full(8 * 36_000, 1000 - touch)
    codes = np.concatenate([rest, pressed, rest])
    spoke = talks(core, memory, 1000, codes, np.zeros_like(codes))
    assert not spoke[:begun].any() and spoke[begun : begun + 1 + pressed.size].all()
    by_change = node_memory(SLOW, 1, heartbeat=0, speaks=CHANGE)
    told = np.flatnonzero(talks(core, by_change, 1000, codes, np.zeros_like(codes)))
    assert told.tolist() == [begun, begun + pressed.size]


@pytest.mark.parametrize("drift", [20, -20])
def test_a_day_of_drift_leaves_nobody_speaking(core: ctypes.CDLL, drift: int) -> None:
    """By 2 % of the range; also after a touch of 6 hours that hid some, but for an hour."""
    hour, memories = 36_000, [node_memory(SLOW, 1, heartbeat=0, speaks=s) for s in (REST, CHANGE)]
    codes = hours(np.linspace(900, 900 + drift, 25), SLOW)
    for memory in memories:
        assert talks(core, memory, 900, codes, np.zeros_like(codes)).sum() <= 10
    codes[6 * hour : 12 * hour] -= 300
    rest, change = (talks(core, memory, 900, codes, np.zeros_like(codes)) for memory in memories)
    assert rest[6 * hour : 12 * hour].all() and rest[13 * hour :].sum() <= 5
    assert change.sum() <= 10 + 2


def test_what_is_said_out_of_turn_is_said_in_turn(core: ctypes.CDLL) -> None:
    """Node 6 of 9 in four groups is of group 2: every fourth frame is its own."""
    memory = node_memory(FrameSpec(nodes=9, order=16), 6, threshold=2, heartbeat=18)  # turn 10
    turns = 4 + np.arange(48) % 4
    codes = np.full(48, 500)
    codes[[3, 4, 19]] = 400, 410, 300  # 4 is not its turn any more when it could say 410
    codes[30:33] = 400, 450, 500  # said 500 is the end of it
    heard = np.flatnonzero(talks(core, memory, 500, codes, turns)).tolist()
    assert heard == [10, 30, 34, 46]  # heartbeats of 10 and 28, the press, of 46
    codes[14] = 350  # in its turn: told, and its end in the next
    heard = np.flatnonzero(talks(core, memory, 500, codes, turns)).tolist()
    assert heard == [10, 14, 18, 30, 34, 46]
    # as without groups
    assert 46 not in np.flatnonzero(talks(core, memory, 500, codes, turns, missed=[46]))


def test_digits_of_a_turn_are_where_the_page_says(core: ctypes.CDLL) -> None:
    """(d + 1) · 128 µs before the frame's pulse, within 32 µs."""
    core.shim_turn_digit.restype = ctypes.c_uint16
    for us in range(-1000, 3000):
        places = [d for d in range(16) if abs(us - (d + 1) * 128) <= 32]
        expected = 1 << places[0] if places else 0
        assert core.shim_turn_digit(ctypes.c_uint32(us * 8), 1024) == expected, us


def test_missed_frames_keep_turns(core: ctypes.CDLL) -> None:
    """Heartbeats count all frames, not only those whose pulse was heard."""
    memory = node_memory(SPEC, 3, threshold=1000, heartbeat=8)  # turn 4
    codes, turns = np.full(40, 500), np.zeros(40, np.int64)
    heard = talks(core, memory, 500, codes, turns, missed=[2, 20, 21])
    assert np.flatnonzero(heard).tolist() == [4, 12, 28, 36]


@settings(deadline=None)
@given(
    chip_ns=st.integers(20_000, 1_000_000),
    order=st.integers(1, 4096),
    gap_us=st.integers(1_000, 100_000),
    ticks_per_us=st.sampled_from([4, 8]),
    error=st.floats(-0.1, 0.1),
)
@example(chip_ns=20_000, order=4096, gap_us=1_000, ticks_per_us=8, error=-0.1)
@example(chip_ns=221_000, order=4096, gap_us=1_000, ticks_per_us=8, error=0.1)
def test_edges_stay_within_a_tick_and_a_half(
    core: ctypes.CDLL, chip_ns: int, order: int, gap_us: int, ticks_per_us: int, error: float
) -> None:
    """Of the true time, over the whole frame, for any clock.

    One of the measurement (a tick in the period is less in the frame), a third of the sum, half of
    the rounding to whole ticks.
    """
    chips = 11 * order
    frame_us = chips * chip_ns // 1000 + 1
    period_us = frame_us + gap_us
    if not 1_000 <= period_us <= 10_000_000:
        return
    memory = record_of(chip_ns=chip_ns, order=order, parity=1, frame_period_us=period_us)
    measured = int(period_us * ticks_per_us * (1 + error))
    result = (ctypes.c_uint32 * 4)()
    assert core.shim_discipline(memory, ticks_per_us, measured, result)
    chip_q16, lead_q16, period, _ = result
    assert period == measured
    true_chip = chip_ns * 1e-3 * ticks_per_us * (1 + error)
    assert abs(chips * (chip_q16 / 65_536 - true_chip)) < 1 + 0.35
    assert abs(lead_q16 / 65_536 - 64 * ticks_per_us * (1 + error)) < 0.1


@pytest.mark.parametrize("discipline", [0, 1])
@pytest.mark.parametrize(
    ("measured", "believed"),
    [
        (89_600, True),
        (89_599, False),
        (115_200, True),
        (115_201, False),
        (204_800, False),
        (0, False),
    ],
)
def test_only_credible_periods_count(
    core: ctypes.CDLL, measured: int, believed: bool, discipline: int
) -> None:
    """12.8 ms at 8 MHz, an eighth either way; without discipline chips stay nominal."""
    result = (ctypes.c_uint32 * 4)()
    memory = record_of(discipline=discipline)
    assert bool(core.shim_discipline(memory, 8, measured, result) & 1) == believed
    period = measured if believed else 102_400
    followed = period if discipline else 102_400
    assert list(result) == [
        round(followed / 256 * 65_536),
        followed * 65_536 // 200,
        period,
        102_400 - 102_400 // 8,
    ]


@pytest.mark.parametrize("unit_ticks", [64, 128])
def test_pulses(core: ctypes.CDLL, unit_ticks: int) -> None:
    """Lengths are rounded to units; 1 and 2 are valid."""
    core.shim_pulse.restype = ctypes.c_uint8
    for ticks in [*range(0, 6 * unit_ticks), 65_536, 65_536 + 2 * unit_ticks, 2**32 - 1]:
        units = int(ticks / unit_ticks + 0.5)
        assert core.shim_pulse(ticks, unit_ticks) == (units if units <= 2 else 0)


# Host and firmware agree on a node's memory and its limits


@st.composite
def specs_about_limits(draw: st.DrawFn) -> FrameSpec:
    """Skins about the limits of nodes, on either side of them."""
    sparse = draw(st.booleans())
    order = 912 if sparse else draw(st.sampled_from([1, 2, 20, 32, 1024, 1032]))
    resync = draw(st.sampled_from([0, order] if sparse else [0, 16, 32, order]))
    slow_s = st.integers(20, 100)
    fast_s = st.sampled_from([0.4, 0.5, 0.55, 0.75, 1, 2, 2.1, 15.75, 16, 16.25])
    shape = {
        "nodes": 4000 if sparse else 1,
        "codes": SPARSE if sparse else ORTHOGONAL,
        "first_row": min(1, order - 1),
        "bits": draw(st.integers(8, 10)),
        "order": order,
        "chip_s": draw(slow_s | fast_s) / 1e6,
        "parity": draw(st.booleans()),
        "resync_chips": resync,
        "scramble": sparse or (order >= 4 and draw(st.booleans())),
        "guard_chips": draw(st.integers(1, 5) | st.integers(35, 200)) if resync else 0,
    }
    frame_us = round(FrameSpec(**shape, frame_period_s=100.0).frame_s * 1e6)
    assume(frame_us < 9_990_000)  # a node's longest period is 10 s
    period_us = max(1000, frame_us + draw(st.integers(900, 1100)))  # a node's shortest is 1 ms
    return FrameSpec(**shape, frame_period_s=period_us / 1e6)


@pytest.mark.parametrize("mcu", MCUS)
@examples(200)
@given(spec=specs_about_limits())
def test_what_the_host_writes_the_firmware_takes_and_nothing_more(
    core: ctypes.CDLL, mcu: str, spec: FrameSpec
) -> None:
    busy_s = MCUS[mcu].busy_s
    spec = replace(spec, frame_period_s=min(10.0, spec.frame_period_s + busy_s))
    gap_s = spec.frame_period_s - spec.frame_s - busy_s
    if gap_s < MEASURING_S * (1 - 1e-9):  # the firmware is content with 0.964 ms
        with pytest.raises(
            SpecError,
            match=r"measure in|longer code row|in octets|anew|runs at|cycles|scrambles|sparse",
        ):
            node_memory(spec, 1, mcu=mcu)
        return
    try:
        memory = node_memory(spec, 1, mcu=mcu)
    except SpecError:
        try:
            memory = unchecked_memory(spec)
        except SpecError:  # beyond what a memory can say
            assert spec.chip_s < 0.5e-6
            return
        assert load(core, as_heard(memory, mcu), limits(mcu))[0] == UNFIT
        return
    if not MCUS[mcu].hears_own:
        assert load(core, memory, limits(mcu))[0] == INVALID
    memory = as_heard(memory, mcu)
    fault, record, row = load(core, memory + bytes(100), limits(mcu))  # what else was in it
    assert fault == GOOD
    assert record == memory[: len(record)]
    octets = np.frombuffer(row, np.uint8)
    if spec.sparse:
        assert row[:12].hex() == "9739e2e8db8c04293bde3bd6"  # docs/protocol.md
    else:
        chips = np.unpackbits(octets[: -(-spec.order // 8)], bitorder="little")[-spec.order :]
        assert np.array_equal(chips > 0, spec.node_rows[0] > 0)
    assert load(core, memory[:-1] + bytes([memory[-1] ^ 1]), limits(mcu))[0] == CORRUPT


def as_heard(memory: bytes, mcu: str) -> bytes:
    """For an image that hears sync pulses on the data wire only."""
    return memory if MCUS[mcu].hears_own else hearing_data(memory, mcu)


def unchecked_memory(spec: FrameSpec) -> bytes:
    """The memory of a node that can do anything."""
    restarts = spec.sparse and spec.resync_chips > 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(
            MCUS, "any", Mcu("", 4096, 500, 500, 500, bits_restart=restarts, restart_s=0.0)
        )
        return node_memory(spec, 1, mcu="any")
