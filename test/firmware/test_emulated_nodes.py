# SPDX-License-Identifier: Apache-2.0

"""The emulated nodes compared with the data sheets: small programs of known timing on both MCUs.

An ATmega328P and an ATtiny85 run at 8 MHz, 125 ns a cycle, unless a test says otherwise.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from emulated import Amplifier, EmulatedNodes, EmulationError, Node
from tactile_cdma.readings.calibration import AdcScale
from test.support.firmware import Specimen

CYCLE_NS = 125
MS = 1_000_000
MCUS = ("atmega328p", "attiny85")


def pulses(skin: EmulatedNodes, starts_ns: list[int], length_ns: int = 32_000) -> None:
    for start_ns in starts_ns:
        skin.sync(start_ns, True)
        skin.sync(start_ns + length_ns, False)


def widths(skin: EmulatedNodes, node: int = 0) -> np.ndarray:
    """Lengths of all pulses high, in cycles of 125 ns."""
    edges = skin.edges(node)
    rises = np.flatnonzero(edges["level"] == 1)
    return np.diff(edges["t_ns"])[rises] // CYCLE_NS


@pytest.mark.parametrize("mcu", MCUS)
def test_high_low_and_released_are_told_apart(specimen: Specimen, mcu: str) -> None:
    with EmulatedNodes([specimen("levels", mcu)]) as skin:
        assert not skin.led(0)
        skin.run(MS)
        edges = skin.edges(0)
        assert edges["level"].tolist() == [-1, 1, -1, 0]
        assert np.diff(edges["t_ns"]).tolist() == [10 * CYCLE_NS] * 3
        assert skin.led(0)
        assert skin.counters(0).pull_ups == 1


def test_clock_error_scales_time(specimen: Specimen) -> None:
    node = specimen("levels")
    fast = replace(node, clock_hz=8e6 * 1.25, start_ns=12_345)
    with EmulatedNodes([node, fast]) as skin:
        skin.run(MS)
        right, wrong = skin.edges(0), skin.edges(1)
        assert right.size == 4
        assert (wrong["t_ns"] == 12_345 + right["t_ns"] * 4 // 5).all()


@pytest.mark.parametrize("options", [(), ("-DAWAKE",)], ids=["asleep", "awake"])
def test_edges_are_captured_and_put_out_at_their_cycle(
    specimen: Specimen, options: tuple[str, ...]
) -> None:
    # at every phase of the instructions that the node is just executing
    edges_ns = [MS + 300_000 * i + CYCLE_NS * i for i in range(40)]
    with EmulatedNodes([specimen("capture", "atmega328p", *options)]) as skin:
        for i, edge_ns in enumerate(edges_ns):
            skin.sync(edge_ns, i % 2 == 0)
        for i, edge_ns in enumerate(edges_ns):
            skin.run(edge_ns + 201 * CYCLE_NS + 1)
            assert skin.edges(0).size == 2 + i  # known as soon as it is over
        edges = skin.edges(0)
        assert edges["level"].tolist() == [-1] + [1, -1] * 20
        assert edges["t_ns"][1:].tolist() == [t + 201 * CYCLE_NS for t in edges_ns]


def test_an_edge_between_two_clock_edges_takes_effect_at_the_later_one(specimen: Specimen) -> None:
    with EmulatedNodes([specimen("capture")]) as skin:
        skin.sync(MS + 1, True)
        skin.run(2 * MS)
        assert skin.edges(0)["t_ns"][1] == MS + (1 + 201) * CYCLE_NS


# 4 cycles of response, 4 more out of sleep; then jmp or rjmp, and sbi
@pytest.mark.parametrize(("mcu", "cycles"), [("atmega328p", 8 + 3 + 2), ("attiny85", 8 + 2 + 2)])
def test_interrupts_take_as_long_as_the_data_sheets_say(
    specimen: Specimen, mcu: str, cycles: int
) -> None:
    with EmulatedNodes([specimen("respond", mcu)]) as skin:
        pulses(skin, [MS, 2 * MS + CYCLE_NS])
        skin.run(3 * MS)
        edges = skin.edges(0)
        rises = edges["t_ns"][edges["level"] == 1]
        if mcu == "attiny85":
            rises = rises[::2]  # INT0 takes both edges
        assert rises.tolist() == [MS + cycles * CYCLE_NS, 2 * MS + (1 + cycles) * CYCLE_NS]


def test_pulses_before_int0_hears_edges_are_no_interrupts(specimen: Specimen) -> None:
    with EmulatedNodes([specimen("respond", "attiny85")]) as skin:
        pulses(skin, [0, 1_000], length_ns=500)
        skin.run(MS)
        assert skin.edges(0)["level"].tolist() == [-1]


@pytest.mark.parametrize("mcu", MCUS)
def test_only_matches_and_force_change_the_output_latch(specimen: Specimen, mcu: str) -> None:
    with EmulatedNodes([specimen("latch", mcu)]) as skin:
        skin.run(30 * MS)  # the timer overflows at least three times after the last change
        edges = skin.edges(0)
        # driven high, forced low, toggled nine times; the PORT bit; set, and low no more
        assert edges["level"].tolist() == [1, -1] + [1, -1] * 5 + [1]
        assert np.diff(edges["t_ns"])[2:10].tolist() == [400 * CYCLE_NS] * 8
        assert skin.counters(0).pull_ups == 0


def test_what_lasts_no_time_does_not_happen(specimen: Specimen) -> None:
    node = specimen("release")
    with EmulatedNodes([replace(node, memory=bytes([cycle])) for cycle in range(32)]) as skin:
        skin.run(MS)
        ends = [skin.edges(number)["level"].tolist() for number in range(32)]
        # the match comes before the release, in later nodes after it
        lows = ends.count([1, -1, 0])
        assert 8 < lows < 24
        assert ends == [[1, -1, 0]] * lows + [[1, 0]] * (32 - lows)
        low_ns = [np.diff(skin.edges(number)["t_ns"])[-1] for number in range(lows)]
        assert low_ns == [(lows - number) * CYCLE_NS for number in range(lows)]


@pytest.mark.parametrize("mcu", MCUS)
def test_the_converter_is_ideal(specimen: Specimen, mcu: str) -> None:
    supply_v = 2.9
    node = replace(specimen("convert", mcu), supply_v=supply_v)
    lsb = supply_v / 1024
    volts = [-0.1, 0.0]
    for code in range(1, 1024):
        volts += [(code - 0.5) * lsb * (1 - 1e-9), (code - 0.5) * lsb * (1 + 1e-9)]
    volts += [supply_v, supply_v + 1]
    with EmulatedNodes([node] * 8) as skin:
        shares = np.resize(volts, (-(-len(volts) // 8), 8))
        for i, share in enumerate(shares):
            skin.press(share)
            pulses(skin, [MS * (i + 1)])
            skin.run(MS * (i + 2))
        shown = np.stack([widths(skin, node) for node in range(8)], axis=1)
        assert all(skin.counters(node).faults == 0 for node in range(8))
    codes = (shown - shown[0, 0]) / 4
    expected = AdcScale(10, supply_v).code(shares)
    assert (codes == expected).all()
    assert set(expected.ravel()) == set(range(1024))


@pytest.mark.parametrize("mcu", MCUS)
def test_eeprom_content_is_seen_and_the_rest_is_blank(specimen: Specimen, mcu: str) -> None:
    memory = bytes([0, 7, 200, 255, 1])
    with EmulatedNodes([replace(specimen("memory", mcu), memory=memory)]) as skin:
        pulses(skin, [MS * (i + 1) for i in range(8)])
        skin.run(10 * MS)
        shown = widths(skin)
        assert ((shown - shown[0]) // 4).tolist() == [*memory, 255, 255, 255]


@pytest.mark.parametrize("mcu", MCUS)
def test_the_watchdog_resets_and_lets_the_pin_go(specimen: Specimen, mcu: str) -> None:
    with EmulatedNodes([specimen("hang", mcu)]) as skin:
        skin.run(15 * MS)
        assert skin.counters(0).watchdog_resets == 0
        assert not skin.led(0)
        skin.run(100 * MS)
        assert skin.counters(0).watchdog_resets == 6  # every 16 ms and a bit
        assert skin.led(0)
        edges = skin.edges(0)
        assert edges["level"].tolist() == [-1, 1, 0] * 6 + [-1, 1]  # the latch is reset, too
        assert np.abs(np.diff(edges["t_ns"][::3]) - 16 * MS).max() < 20_000


def test_the_sync_line_is_heard_after_a_reset_as_before(specimen: Specimen) -> None:
    node = specimen("reheard")
    with EmulatedNodes([node]) as skin:
        skin.sync(20 * MS, True)  # in the node's second life
        skin.sync(40 * MS, False)  # in its third one, which began with the line high
        skin.run(47 * MS)
        edges = skin.edges(0)
        assert skin.counters(0).watchdog_resets == 2
        changes = edges[(edges["t_ns"] > 17 * MS) & (edges["t_ns"] < 46 * MS)]
        # followed within a few instructions, from power-up on, too
        assert changes["level"].tolist() == [1, 0, -1, 1, -1]
        assert 0 < changes["t_ns"][0] - 20 * MS < 2_000
        assert 0 < changes["t_ns"][3] - changes["t_ns"][2] < 2_000
        assert 0 < changes["t_ns"][4] - 40 * MS < 2_000


@pytest.mark.parametrize("mcu", MCUS)
def test_flags_clear_one_by_one_and_interrupt_when_enabled(specimen: Specimen, mcu: str) -> None:
    with EmulatedNodes([specimen("flags", mcu)]) as skin:
        skin.run(60_000)
        edges = skin.edges(0)
        rises = edges["t_ns"][edges["level"] == 1]
        assert rises.size == 2
        assert rises[1] - rises[0] < 100 * CYCLE_NS


@pytest.mark.parametrize(("mcu", "cleared"), [("atmega328p", 100), ("attiny85", 200)])
def test_interrupts_that_were_cleared_neither_come_nor_keep_others_back(
    specimen: Specimen, mcu: str, cleared: int
) -> None:
    with EmulatedNodes([specimen("cleared", mcu, f"-DCLEARED={cleared}")]) as skin:
        pulses(skin, [MS + 100_000 * i for i in range(100)])  # INT0 takes both edges
        skin.run(30 * MS)
        assert np.count_nonzero(skin.edges(0)["level"] == 1) == 1


def test_cycles_awake_and_asleep_are_counted(specimen: Specimen) -> None:
    with EmulatedNodes([specimen("respond")]) as skin:
        skin.run(MS)
        before = skin.counters(0)
        pulses(skin, [2 * MS + i * MS for i in range(100)])
        skin.run(200 * MS)
        after = skin.counters(0)
        awake = after.cycles_awake - before.cycles_awake
        asleep = after.cycles_asleep - before.cycles_asleep
        assert awake + asleep == pytest.approx(199 * MS / CYCLE_NS, abs=8)
        # response, jmp, sbi, cbi, reti; then in, andi, out, rjmp, in, ori, out, sleep
        assert awake / 100 == 8 + 3 + 2 + 2 + 4 + 9


@pytest.mark.parametrize("mcu", MCUS)
def test_what_the_emulator_cannot_follow_is_counted(specimen: Specimen, mcu: str) -> None:
    with EmulatedNodes([specimen("wrong", mcu), specimen("levels", mcu)]) as skin:
        skin.run(MS)
        assert skin.counters(0).faults == 1
        assert skin.counters(0).deep_sleeps == 1
        assert (skin.counters(1).faults, skin.counters(1).deep_sleeps) == (0, 0)


def test_a_node_that_is_plugged_in_later_finds_the_line_as_it_is(specimen: Specimen) -> None:
    late = replace(specimen("capture"), start_ns=5 * MS)
    with EmulatedNodes([late]) as skin:
        pulses(skin, [MS, 2 * MS])
        skin.sync(3 * MS, True)
        skin.run(4 * MS)
        assert skin.edges(0).size == 0
        skin.sync(6 * MS, False)
        pulses(skin, [7 * MS])
        skin.run(8 * MS)
        edges = skin.edges(0)
        assert edges["level"].tolist() == [-1, 1, -1]
        assert edges["t_ns"][0] > 5 * MS
        assert edges["t_ns"][1] == 7 * MS + 201 * CYCLE_NS
        assert skin.counters(0).cycles_asleep < 3 * MS / CYCLE_NS


def test_levels_add_up_on_the_line(specimen: Specimen) -> None:
    # gain · supply / 2: 0.165 V and 0.25 V; the second is 20 cycles later
    first = replace(specimen("levels"), gain=0.1)
    second = replace(first, supply_v=5.0, start_ns=20 * CYCLE_NS)
    with EmulatedNodes([first, second], Amplifier(polarity=-1)) as skin:
        skin.run(MS)
        expected = np.full(400, 1.65)  # in every cycle
        for node, swing_v in enumerate((0.165, 0.25)):
            edges = skin.edges(node)
            begins = edges["t_ns"] // CYCLE_NS
            for edge, begin, end in zip(edges[:-1], begins, begins[1:], strict=False):
                expected[begin:end] -= swing_v * edge["level"]
        assert skin.volts(0, CYCLE_NS, 400) == pytest.approx(expected, abs=1e-12)
        assert expected.max() == pytest.approx(1.65 + 0.165 + 0.25)
        # from any instant on, at any distance
        t_ns = 1_000.5 + 312.5 * np.arange(100)
        at = (t_ns // CYCLE_NS).astype(int)
        assert skin.volts(t_ns[0], 312.5, 100) == pytest.approx(expected[at], abs=1e-12)


def test_the_line_clips_at_the_rails(specimen: Specimen) -> None:
    loud = replace(specimen("levels"), gain=1.5)
    with EmulatedNodes([loud], Amplifier(low_v=0.2, high_v=3.1)) as skin:
        skin.run(MS)
        assert sorted(set(skin.volts(0, 125, 400))) == [0.2, 1.65, 3.1]


def test_noise_has_its_size_and_follows_its_seed(emulator: None) -> None:
    def line(seed: int) -> np.ndarray:
        with EmulatedNodes([], Amplifier(noise_v=0.1, seed=seed)) as skin:
            return skin.volts(0, 1000, 100_000) - 1.65

    noise = line(1)
    assert noise.std() == pytest.approx(0.1, rel=0.01)
    assert abs(noise.mean()) < 4 * 0.1 / np.sqrt(noise.size)
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.015
    assert (noise == line(1)).all()
    assert abs(np.corrcoef(noise, line(2))[0, 1]) < 0.015


def test_what_is_forgotten_leaves_the_line_after_it_alone(specimen: Specimen) -> None:
    with EmulatedNodes([specimen("capture")]) as skin:
        pulses(skin, [MS, 2 * MS])
        skin.run(3 * MS)
        line, edges = skin.volts(1.5 * MS, 5_000, 250), skin.edges(0)
        skin.forget(int(1.5 * MS))
        assert (skin.volts(1.5 * MS, 5_000, 250) == line).all()
        assert skin.edges(0).tolist() == edges[edges["t_ns"] >= 1.5 * MS].tolist()
        pulses(skin, [4 * MS])
        skin.run(5 * MS)
        assert skin.edges(0)["t_ns"][-2] == 4 * MS + 201 * CYCLE_NS


def test_edges_of_the_sync_line_come_in_order(specimen: Specimen) -> None:
    with EmulatedNodes([specimen("capture")]) as skin:
        skin.sync(MS, True)
        with pytest.raises(EmulationError, match="999999 ns is before the last one"):
            skin.sync(MS - 1, False)
        skin.run(2 * MS)
        with pytest.raises(EmulationError, match="in the past"):
            skin.sync(2 * MS - 1, False)


def test_errors_name_the_cause(specimen: Specimen, tmp_path: Path) -> None:
    node = specimen("levels")

    def refused(node: Node, match: str) -> None:
        with pytest.raises(EmulationError, match=match):
            EmulatedNodes([node])

    refused(replace(node, image=tmp_path / "no.elf"), "No such file.*make -C firmware node")
    (tmp_path / "text.elf").write_text("no image, but long enough to be one")
    refused(replace(node, image=tmp_path / "text.elf"), "no ELF image for an AVR")
    refused(replace(node, mcu="atmega1"), "no wiring for the MCU atmega1")
    refused(replace(node, memory=bytes(1025)), "memory larger than its EEPROM for the atmega328p")
    with pytest.raises(EmulationError, match="make -C firmware sim"):
        EmulatedNodes([], library=tmp_path / "libskin.so")
    with EmulatedNodes([node]) as skin, pytest.raises(IndexError, match="sensor 1: there are 1"):
        skin.edges(1)
