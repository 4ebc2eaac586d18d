# SPDX-License-Identifier: Apache-2.0

"""The demonstrator: its nodes' C core, and its image in the emulated RP2040, to the pin."""

import ctypes
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from demo import (
    MOST_BLIND,
    NODES,
    PARAMS,
    PULLED,
    RESISTORS,
    REST,
    Codes,
    Heard,
    Nodes,
    all_scenes,
    count_words,
    floating,
    listen,
)
from rp2040 import Line, Network, Rp2040
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.parameters import DATA, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.wire._protocol import SYNC_LEAD, SYNC_UNIT_US, Result, Scene, SyncWire
from tactile_cdma.wire.identity import kind_of
from tactile_cdma.wire.messages import (
    Ack,
    Ask,
    Command,
    Configure,
    FrameLayout,
    Info,
    Samples,
    Start,
    Stop,
    Touch,
)
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.rp2040_bench import Bench
from trial import expected_edges

SPEC = SkinConfig.of(read_file(PARAMS)).spec
MODES: dict[str, Line | Network] = {"wired": RESISTORS, "wireless": floating}
MOST_OFF_NS = 50
"""Of an edge at a pin: the sync input's delay on the chip is 20 ns, and the emulator has none."""


@pytest.fixture(scope="module")
def image(rp2040_image: Path) -> Path:
    return rp2040_image.with_name("demo.bin")


# The nodes, without a board


def words_of(chips: NDArray[np.uint32]) -> tuple[Codes, NDArray[np.bool_]]:
    """Codes and who speaks, (16,), by correlation of a frame's chips with the book's rows."""
    talks = (chips[:, np.newaxis] >> np.arange(16, 32) & 1).astype(bool)
    assert (talks == talks[0]).all(), "from the first chip to the last"
    levels = np.where(chips[:, np.newaxis] >> np.arange(NODES) & 1, 1, -1)
    rows = SPEC.book.rows(SPEC.rows) * SPEC.signs[:, np.newaxis]  # (16, order)
    assert SPEC.flips is not None, "ours are scrambled"
    sent = levels.reshape(SPEC.bits, SPEC.order, NODES) * SPEC.flips[:, :, np.newaxis]
    sums = np.einsum("bkn,nk->bn", sent, rows)
    assert (np.abs(sums[:, talks[0]]) == SPEC.order).all(), "whole words only"
    return (sums > 0).T @ (1 << np.arange(SPEC.bits)[::-1]), talks[0]


class Core:
    """The nodes, asked for one frame after another."""

    def __init__(self, core: ctypes.CDLL) -> None:
        self._core, self._chips = core, np.empty(SPEC.chips + 1, np.uint32)
        assert core.shim_demo_begin(-1) == SPEC.chips

    def frame(self) -> tuple[Codes, NDArray[np.bool_]]:
        self._core.shim_demo_pulse()
        return self.planned()

    def planned(self) -> tuple[Codes, NDArray[np.bool_]]:
        """The next frame, whose pulse may have been heard before or is yet to come."""
        self._core.shim_demo_frame(self._chips.ctypes.data_as(ctypes.c_void_p))
        assert self._chips[-1] == self._chips[-2] & 0xFFFF, "all release the line as it is"
        return words_of(self._chips[:-1])

    def touch(self, scene: int, node: int = 0, code: int = 0) -> int:
        return int(self._core.shim_demo_touch(scene, node, code))


def test_every_word_of_the_table(core: ctypes.CDLL) -> None:
    nodes, board, spoke = Nodes(), Core(core), np.zeros(NODES, int)
    for number in range(2 * 724):
        codes, talks = board.frame()
        expected = all_scenes(number)
        np.testing.assert_array_equal(talks, nodes.speak(number, expected), f"{number}")
        np.testing.assert_array_equal(codes[talks], expected[talks], f"frame {number}")
        spoke += talks
    assert (spoke > 2 * 724 // 78).all(), "all of them were touched"
    assert all_scenes(350).min() < REST - 200, "… and not lightly"


def test_all_are_asked_to_speak(core: ctypes.CDLL) -> None:
    """Once, with what they measure: in the frame announced, or the first one planned since."""
    board = Core(core)
    board.touch(Scene.REST)
    asked = {3, 40, 61}
    for number in range(70):
        if number == 60:
            quiet = board.planned()[1]  # ahead of its pulse
            core.shim_demo_ask()
            core.shim_demo_pulse()
            assert not quiet.all()
            continue
        if number in asked - {61}:
            core.shim_demo_ask()
        codes, talks = board.frame()
        assert talks.all() == (number in asked), number
        assert (codes[talks] == REST).all()
    core.shim_demo_ask()  # before the frame's first pulse, which the next one still is
    assert board.frame()[1].all()


def test_a_touch_of_the_hosts(core: ctypes.CDLL) -> None:
    board = Core(core)
    assert board.touch(Scene.HOST, 3, 100) == Result.OK
    codes, talks = board.frame()
    assert talks[2] and codes[2] == 100 and not talks[3:].any()
    assert board.touch(Scene.HOST, 16, 1023) == board.touch(Scene.HOST, 1, 0) == Result.OK
    codes, talks = board.frame()
    assert (codes[[0, 2, 15]].tolist(), talks.sum()) == ([0, 100, 1023], 3)
    assert board.touch(Scene.HOST, 0, 500) == Result.OK
    codes, talks = board.frame()
    assert talks.all() and (codes == 500).all()
    for wrong in ((5, 0, 0), (Scene.HOST, 17, 0), (Scene.HOST, 1, 1024)):
        assert board.touch(*wrong) == Result.OUT_OF_RANGE
    assert board.touch(Scene.REST) == Result.OK
    codes, talks = board.frame()
    assert talks.all() and (codes == REST).all(), "a release is told, too"
    assert board.touch(Scene.HOST, 1, 7) == Result.OK
    codes, talks = board.frame()
    assert np.flatnonzero(talks & (codes != REST)).tolist() == [0], "nothing of earlier touches"


def test_a_damaged_memory_is_refused(core: ctypes.CDLL) -> None:
    for place in (0, 46, 47 * 15 + 40):
        assert core.shim_demo_begin(place) == 0


# The image


def some_codes(seed: int) -> Codes:
    return np.random.default_rng(seed).integers(0, REST - 1, NODES)


def touches(codes: Codes) -> list[Command]:
    return [Touch(Scene.HOST, node, int(code)) for node, code in enumerate(codes, 1)]


def right_since(heard: Heard, codes: Codes, first: int) -> list[int]:
    """Numbers of the frames from `first` on; in each every word must be one of these."""
    numbers = [number for number in heard.codes if number >= first]
    for number in numbers:
        active = heard.active[number]
        np.testing.assert_array_equal(heard.codes[number][active], codes[active], f"{number}")
    return numbers


@pytest.mark.parametrize("mode", MODES)
def test_every_word_of_the_hosts_scene(image: Path, mode: str) -> None:
    codes = some_codes(1)
    heard = listen(MODES[mode], 0.9, {0.1: touches(codes)})
    numbers = right_since(heard, codes, first=8)
    assert len(numbers) > 50 and heard.lost_samples == 0
    assert all(heard.active[number].all() for number in numbers)
    known = {"wired": "its pins wired", "wireless": "nothing wired"}[mode]
    assert known in kind_of(heard.digitizer_id)


@pytest.mark.parametrize("mode", MODES)
def test_every_word_from_power_up_on(image: Path, mode: str) -> None:
    """At rest only heartbeats speak."""
    heard = listen(MODES[mode], 1.2, lose_every=9)
    assert heard.lost_samples == 0
    right, wrong = count_words(heard, all_scenes)
    assert wrong == 0 and right >= NODES - 3
    lossy = heard.lossy
    assert lossy is not None and lossy.lost >= 8
    assert (lossy.wrong, lossy.unflagged) == (0, 0)
    assert 0 < lossy.most_blind <= MOST_BLIND
    assert any(active.all() for active in heard.active.values()), "the driver has asked them"


@pytest.mark.parametrize("mode", MODES)
def test_all_speak_when_the_host_asks(image: Path, mode: str) -> None:
    heard = listen(MODES[mode], 0.9, {0.1: [Touch(Scene.REST)], 0.4: [Ask()], 0.6: [Ask(2)]})
    assert heard.lost_samples == 0
    everybody = [number for number in heard.codes if heard.active[number].all()]
    assert len(everybody) == 2 and everybody[0] > 25
    assert 12 <= everybody[-1] - everybody[0] <= 20, "once for each request"
    for number in everybody:
        assert (heard.codes[number] == REST).all()


def test_pins_change_where_chips_do(image: Path) -> None:
    """Every edge of every pin within a frame, from release to release."""
    codes, rises = some_codes(2), []
    changes: list[tuple[float, int, int]] = []
    listen(
        replace(RESISTORS, told=True),
        0.18,
        {0.1: touches(codes)},
        on_sync=lambda t_ns, high: rises.append(t_ns) if high else None,
        on_pin=lambda t_ns, pin, level: changes.append((t_ns, pin, level)),
    )
    lead_ns, chip_ns = SYNC_LEAD * SYNC_UNIT_US * 1e3, SPEC.chip_s * 1e9
    begin_ns, end_ns = rises[-3] + lead_ns / 2, rises[-2] + lead_ns / 2
    for node, code in enumerate(codes):
        seen = [(t, level) for t, pin, level in changes if pin == node and begin_ns < t < end_ns]
        expected = expected_edges(SPEC, node, int(code))
        levels = {-1: 0, 1: 1, 0: 2}
        assert [level for _, level in seen] == [levels[int(level)] for level in expected["level"]]
        wanted_ns = rises[-3] + lead_ns + expected["t_ns"] * chip_ns
        assert np.abs([t for t, _ in seen] - wanted_ns).max() < MOST_OFF_NS


def test_a_line_that_is_pulled_low_says_the_same_words(image: Path) -> None:
    """… and the board tells of pulses that its line does not follow, where nothing pulls it."""
    codes = some_codes(4)
    for line, blind in ((PULLED, False), (RESISTORS, True)):
        heard = listen(line, 1.2, {0.1: touches(codes)}, wire=DATA)
        numbers = right_since(heard, codes, first=8)
        assert len(numbers) > 70 and heard.lost_samples == 0
        assert (heard.sync_faults > 60) == blind
        assert (heard.sync_faults == 0) != blind


def test_without_a_wire_there_is_none_to_pull(image: Path) -> None:
    data = Configure(FrameLayout.of(SPEC, 4), sync_wire=SyncWire.DATA)
    with Bench(image, shape=floating) as bench:
        bench.send(data, Configure(FrameLayout.of(SPEC, 4)))
        bench.run(0.01)
        assert [ack.result for ack in bench.of(Ack)] == [Result.UNSUPPORTED, Result.OK]


def test_a_node_without_its_resistor_is_not_heard(image: Path) -> None:
    ohms = tuple(None if node == 4 else 100e3 * (1 + 0.01 * (-1) ** node) for node in range(NODES))
    codes = some_codes(3)
    heard = listen(Network(ohms), 0.6, {0.1: touches(codes)})
    numbers = right_since(heard, codes, first=8)
    for number in numbers:
        assert np.flatnonzero(~heard.active[number]).tolist() == [4]
    assert len(numbers) > 30


@pytest.mark.parametrize("node", [0, 15])
def test_a_single_resistor_makes_it_wired(image: Path, node: int) -> None:
    ohms: list[float | None] = [None] * NODES
    ohms[node] = 100e3
    assert "its pins wired" in kind_of(listen(Network(tuple(ohms)), 0.2).digitizer_id)


def test_what_it_refuses(image: Path) -> None:
    """Other layouts than its nodes', and touches that it does not know; then it goes on."""
    layout = FrameLayout.of(SPEC, 4)
    with Bench(image, shape=floating) as bench:
        larger = FrameLayout.of(FrameSpec(nodes=64, frame_period_s=40e-3), 4)
        plain = FrameLayout.of(replace(SPEC, scramble=False), 4)
        bench.send(Configure(larger), Configure(plain), Configure(replace(layout, polarity=-1)))
        bench.send(Touch(Scene.HOST, 17, 0), Configure(replace(layout, samples_per_chip=8)))
        bench.write(b"\0" + bytes.fromhex("02"))  # a broken packet
        bench.run(0.01)
        assert [ack.result for ack in bench.of(Ack)] == [
            Result.UNSUPPORTED,
            Result.UNSUPPORTED,
            Result.UNSUPPORTED,
            Result.OUT_OF_RANGE,
            Result.OK,
        ]
        assert bench.of(Info)[-1].frame == replace(layout, samples_per_chip=8)
        bench.send(Start())
        bench.run(0.1)
        assert bench.of(Samples)


def test_a_digitizer_does_not_know_touches(rp2040_image: Path) -> None:
    with Bench(rp2040_image) as bench:
        bench.send(Touch(Scene.PRESS))
        bench.run(0.01)
        assert bench.of(Ack)[-1].result == Result.UNKNOWN_COMMAND


@pytest.mark.parametrize("mode", MODES)
def test_a_stalled_processor_costs_frames_and_no_word(
    image: Path, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames that could not be planned in time are none: the stream begins anew, and says so."""
    codes = some_codes(4)

    def stalling(chip: object, until: float, run: Callable = Rp2040.run) -> None:  # type: ignore[type-arg]
        if 0.4 < until < 0.42:
            chip.stall(0.03)
        run(chip, until)

    monkeypatch.setattr(Rp2040, "run", stalling)
    heard = listen(MODES[mode], 0.9, {0.1: touches(codes)})
    assert len(right_since(heard, codes, first=8)) > 40


def test_start_and_stop_at_any_time(image: Path) -> None:
    """Even in the middle of a frame: pins are released, and the next stream is whole."""
    with Bench(image, shape=floating) as bench:
        for part in (0.0523, 0.0301, 0.0107, 0.0333):
            bench.send(Start())
            bench.run(part)
            bench.send(Stop())
            bench.run(0.005)
        assert [ack.result for ack in bench.of(Ack)] == [Result.OK] * 8


def test_silent_pins_leave_the_line_at_half_the_supply(image: Path) -> None:
    """They are released, and nothing in their pads pulls."""
    writer, layout = PacketWriter(), FrameLayout.of(SPEC, 4)
    with Rp2040(image, RESISTORS) as chip:
        chip.plug_usb()
        chip.run(0.05)
        chip.write_usb(b"\0" + writer.encode(Configure(layout)) + writer.encode(Start()))
        chip.run(0.15)
        packets = PacketParser().feed(chip.read_usb())
    gaps = [p.counts for p in packets if isinstance(p, Samples) and not p.sync]
    assert np.concatenate(gaps).size > 500
    assert np.concatenate(gaps).mean() == pytest.approx(2047.5, abs=1)
