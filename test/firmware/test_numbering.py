# SPDX-License-Identifier: Apache-2.0

"""Sixteen nodes with one image get their numbers by being pressed, with mistakes and repairs."""

import itertools
import queue
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from emulated import EmulatedSkin, Node
from skin import reference_amplifier, reference_nodes
from tactile_cdma.base.errors import LayoutError, PortError
from tactile_cdma.commands.node import check_grid, enumerate_nodes, prompt, write_numbered
from tactile_cdma.config.parameters import read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.driver.session import Session
from tactile_cdma.hardware.node_memory import hearing_data, node_memory
from tactile_cdma.hardware.numbering import TALKING_FRAMES, Numbering
from tactile_cdma.hardware.programmer import node_image
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from tactile_cdma.wire._protocol import TURN_NUMBER_SHIFT, TURN_NUMBERS
from tactile_cdma.words.words import silent
from test.support.emulated_node import DIGIT_NS, LEAD_NS, RESTART, UNIT_NS, Bench

CONFIG = Path(__file__).resolve().parents[2] / "config" / "wired_skin.yaml"
STEP_NS = 5_000_000
REST_V, PRESSED_V = 3.0, 1.5


class Person:
    """Presses taxels of an emulated skin as they are told to; a port for enumerate_nodes.

    plan: what is pressed at each prompt, (m,) places from 0 each, and the line that is typed after
    that. Who is pressed stays so until the next prompt.
    """

    def __init__(self, skin: EmulatedSkin, plan: list[tuple[list[int], str | None]]) -> None:
        self.skin, self.plan, self.typed = skin, plan, queue.Queue[str]()
        self.told: list[str] = []
        self._type_ns, self._line = 0, ""
        self._nodes = len(skin.nodes)
        self.press([])

    def press(self, places: list[int]) -> None:
        volts = np.full(self._nodes, REST_V)
        volts[places] = PRESSED_V - 0.05 * np.array(places)
        self.skin.press(volts)

    def tell(self, text: str) -> None:
        self.told.append(text)
        if text.startswith("press"):
            places, line = self.plan.pop(0)
            self.press(places)
            if line is not None:
                self._type_ns, self._line = self.skin.now_ns + 1_500_000_000, line

    def read(self) -> tuple[bytes, float]:
        self.skin.run(self.skin.now_ns + STEP_NS)
        if self._line and self.skin.now_ns > self._type_ns:
            self.typed.put(self._line)
            self._line = ""
        return self.skin.read(), self.skin.now_ns * 1e-9

    def write(self, data: bytes) -> None:
        self.skin.write(data)


def memory_of(config: SkinConfig, number: int) -> bytes:
    """Of a node that hears sync pulses on the data wire, as the strip's do."""
    return hearing_data(node_memory(config.spec, number), "atmega328p")


@pytest.fixture
def config() -> SkinConfig:
    return SkinConfig.of(read_file(CONFIG))


@pytest.fixture
def nodes(node_images: None, tmp_path: Path, config: SkinConfig) -> list[Node]:
    """All with the same flash; the first one has that of node 9 in its EEPROM, from earlier."""
    memories = [memory_of(config, number) for number in range(1, 17)]
    image = tmp_path / "any.hex"
    image.write_text(node_image("atmega328p", memories, 8, None))
    made = [replace(node, image=image, memory=b"") for node in reference_nodes(config)]
    return [replace(made[0], memory=memories[8]), *made[1:]]


def spoken(skin: EmulatedSkin, config: SkinConfig, frames: int = 150) -> dict[int, set[int]]:
    """Codes that every number said, in ordinary frames."""
    session, pipeline = Session(config), Pipeline(config)
    skin.write(session.open())
    said: dict[int, set[int]] = {}
    while pipeline.counters.frames < frames:
        skin.run(skin.now_ns + STEP_NS)
        for frame in pipeline.feed(skin.read(), skin.now_ns * 1e-9):
            for node in np.flatnonzero(frame.words.active):
                said.setdefault(int(node) + 1, set()).add(int(frame.words.codes[node]))
    skin.write(session.close())
    return said


def test_sixteen_nodes_get_their_numbers(nodes: list[Node], config: SkinConfig) -> None:
    """Place p is to be node p + 1. 3 goes wrong and is taken back; 6: two at once; 7: has one."""
    plan: list[tuple[list[int], str | None]] = [
        *(([place], None) for place in (0, 1, 11)),
        ([], "b"),
        *((places, None) for places in ([2], [3], [4], [5, 6], [5])),
        ([0], "again, please"),
        *(([place], None) for place in range(6, 16)),
    ]
    with EmulatedSkin(nodes, reference_amplifier(config)) as skin:
        person = Person(skin, plan)
        skin.run(300_000_000)
        numbering = enumerate_nodes(person, config, person.typed, person.tell)
        assert numbering.asked is None and not numbering.skipped and not plan
        person.press([])
        spoken(skin, config)  # the end of the last press
        codes = np.random.default_rng(1).permutation(16) * 40 + 100
        skin.press((codes + 0.5) / 1024 * np.array([node.supply_v for node in nodes]))
        said = spoken(skin, config)
        assert not any(skin.led(place) for place in range(16))
    assert "node 3 has lost its number" in person.told
    assert any("several taxels at once" in text for text in person.told)
    assert sorted(said) == list(range(1, 17))
    for place, code in enumerate(codes):
        assert all(abs(own - code) <= 1 for own in said[place + 1]), (place, said[place + 1])


def test_a_number_is_kept(nodes: list[Node], config: SkinConfig) -> None:
    """And nobody has one who was not pressed."""
    with EmulatedSkin(nodes[1:3], reference_amplifier(config)) as skin:
        person = Person(skin, [([0], None), ([], "s"), ([], "q")])
        skin.run(300_000_000)
        numbering = enumerate_nodes(person, config, person.typed, person.tell)
        assert (numbering.asked, numbering.skipped) == (3, [2])
        kept = [skin.memory(node) for node in range(2)]
    assert kept[0][: len(nodes[0].memory)] == memory_of(config, 1)
    assert kept[1][:1] == b"\xff"
    with EmulatedSkin([replace(nodes[1], memory=kept[0])], reference_amplifier(config)) as skin:
        skin.press(REST_V)
        assert list(spoken(skin, config)) == [1]


def test_a_number_is_taken_after_nine_frames_that_agree(
    nodes: list[Node], config: SkinConfig
) -> None:
    """Fewer may be a disturbance. The same goes for what makes a node forget its number."""
    number_2, forget = (TURN_NUMBERS | turn << TURN_NUMBER_SHIFT for turn in (2, 1 << 10 | 2))
    with Bench([nodes[1]], config.spec) as skin:
        frames = itertools.count()

        def announce(turn: int, times: int) -> bytes:
            for number in itertools.islice(frames, times):
                start = skin.start(number)
                for digit in range(15, -1, -1):  # the first one comes while others are measuring
                    if turn >> digit & 1:
                        skin.pulse(start - LEAD_NS - (digit + 1) * DIGIT_NS, RESTART * UNIT_NS)
                skin.pulse(start - LEAD_NS)
                skin.run(start + 8_000_000)
            return skin.memory(0)[: len(memory)]

        memory = memory_of(config, 2)
        announce(0, 12)
        skin.press(PRESSED_V)
        for turn in (number_2, 0, number_2, number_2 ^ 1 << TURN_NUMBER_SHIFT):
            assert announce(turn, 8)[:1] == b"\xff"
        assert announce(number_2, 10 + len(memory)) == memory
        for turn in (forget, 0):
            assert announce(turn, 8) == memory
        assert announce(forget, 10)[:1] == b"\xff"


def test_a_digitizer_that_announces_no_numbers_is_told(
    nodes: list[Node], config: SkinConfig
) -> None:
    """Chips of a code so long that the pause is too short."""
    short = SkinConfig.of(
        read_file(CONFIG) | {"frame_period_ms": 11.1, "resync_chips": 190, "guard_chips": 2}
    )
    with EmulatedSkin(nodes[:1], reference_amplifier(config)) as skin:
        person = Person(skin, [])
        with pytest.raises(PortError, match="announces no numbers"):
            enumerate_nodes(person, short, person.typed, person.tell)


def test_a_layout_without_those_left_out(config: SkinConfig, tmp_path: Path) -> None:
    path = tmp_path / "numbered.yaml"
    write_numbered(path, config.layout, [7])
    layout = read_layout(path, Wiring(16, 1, ""))
    assert layout.nodes.reshape(4, 4)[1].tolist() == [5, 6, 0, 8] and layout.unplaced == (7,)
    odd = replace(config.layout, name="palm: left # [x", masked=(3, 7), aspect=1.5)
    write_numbered(path, odd, [7])
    layout = read_layout(path, Wiring(16, 1, ""))
    assert (layout.name, layout.masked) == (odd.name, (3,))
    assert layout.pitches_m == pytest.approx(odd.pitches_m)
    before = path.read_text()
    with pytest.raises(LayoutError, match="all nodes were left out"):
        write_numbered(path, odd, list(range(1, 17)))
    assert path.read_text() == before
    for wrong in (tmp_path, tmp_path / "none" / "file.yaml"):
        with pytest.raises(
            LayoutError, match="is a folder, or lies in a folder that does not exist"
        ):
            check_grid(wrong, odd)
    assert "row 2, column 4" in prompt(config.layout, 8)
    assert "no place" in prompt(layout, 7)


def test_a_node_that_goes_on_talking_is_told() -> None:
    """It has a number of its own: nobody can press anything before it is silent."""
    numbering = Numbering(16)
    words = replace(silent(16, 1e-3), active=np.arange(16) == 4)
    said = [numbering.take(words) for _ in range(2 * TALKING_FRAMES)]
    told = [text for text in said if text]
    assert len(told) == 2 and "node 5 keeps speaking" in told[0]
    assert numbering.request.forget and not numbering.waits


def test_a_node_with_a_number_of_its_own_is_told_and_does_not_count() -> None:
    """It answers its number at once, and forgets nothing. A pressed one takes 54 frames."""
    numbering, quiet = Numbering(2), silent(2, 1e-3)
    words = replace(quiet, active=np.arange(2) == 0)
    for _ in range(40):
        numbering.take(quiet)
    assert numbering.waits
    said = []
    for _ in range(500):
        said.append(numbering.take(quiet if numbering.request.forget else words))
    assert numbering.asked == 1 and [text for text in said if text] == [
        "node 1 speaks before it is pressed: does it have a number? All nodes take one image "
        "(node --any)"
    ]
    for _ in range(54):
        numbering.take(quiet)
    assert [numbering.take(words) for _ in range(5)][-1] == "node 1 has its number"
