# SPDX-License-Identifier: Apache-2.0

"""Nodes as Arduinos on a breadboard: memories in flash, other clocks, and no amplifier."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from breadboard import breadboard_line, breadboard_nodes
from emulated import EmulatedSkin, Node
from skin import PressedSkin
from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.parameters import DATA, OWN, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.hardware.node_memory import hearing_data, node_memory
from tactile_cdma.hardware.passive import passive_line
from tactile_cdma.hardware.programmer import node_image
from test.support.emulated_node import REST, Bench, assert_says, hearing
from trial import press_and_decode

pytestmark = pytest.mark.usefixtures("node_images")
CONFIG = Path(__file__).resolve().parents[2] / "config" / "breadboard.yaml"
SPEC = FrameSpec(nodes=4, order=8)
LONG = 150
"""Frames after which an LED tells that a clock is wrong."""


@pytest.fixture(params=[OWN, DATA])
def flashed(tmp_path: Path, request: pytest.FixtureRequest) -> Callable[..., Node]:
    """A node flashed with a record of a number, as `tactile-cdma node --hex` makes it.

    On the data wire it shows its LED at another pin.
    """
    on_data = request.param == DATA

    def node(number: int, crystal_mhz: int = 8, **plan: object) -> Node:
        memory = node_memory(SPEC, number, threshold=0, rest=REST)
        memory = hearing_data(memory, "atmega328p") if on_data else memory
        image = tmp_path / f"{number}.hex"
        image.write_text(node_image("atmega328p", [memory], crystal_mhz, None))
        plain = Node(image, "atmega328p")
        return replace(hearing(plain) if on_data else plain, **plan)

    return node


def leds(skin: Bench, first: int) -> set[bool]:
    """What the LED showed over as many frames as it takes to tell, from one on."""
    shown = set()
    for number in range(first, first + LONG):
        skin.frame(number)
        if number > first + LONG - 60:
            shown.add(skin.led(0))
    return shown


@pytest.mark.parametrize("crystal_mhz", [8, 16])
def test_a_node_takes_its_record_from_flash(flashed: Callable[..., Node], crystal_mhz: int) -> None:
    with Bench([flashed(3, crystal_mhz, clock_hz=crystal_mhz * 1.01e6)], SPEC) as skin:
        number = skin.listen()
        assert_says(skin, skin.frame(number), number=3)
        assert leds(skin, number + 1) == {False}


def test_a_number_that_was_flashed_goes_before_an_older_one(flashed: Callable[..., Node]) -> None:
    """Boot loaders do not write the EEPROM, where a number that was taken by pressing is."""
    own = node_memory(SPEC, 2, threshold=0, rest=REST)
    if flashed(3).bandgap_v:
        own = hearing_data(own, "atmega328p")
    damaged = own[:-1] + bytes([own[-1] ^ 1])
    for memory, number in ((own, 3), (damaged, 3), (b"", 3)):
        with Bench([flashed(3, memory=memory)], SPEC) as skin:
            assert_says(skin, skin.frame(skin.listen()), number=number)


@pytest.mark.parametrize(("crystal_mhz", "clock_hz"), [(8, 16e6), (16, 8e6), (8, 4e6), (8, 12e6)])
def test_at_another_clock_a_node_is_silent_and_its_led_blinks(
    flashed: Callable[..., Node], crystal_mhz: int, clock_hz: float
) -> None:
    with Bench([flashed(1, crystal_mhz, clock_hz=clock_hz)], SPEC) as skin:
        assert leds(skin, 0) == {False, True}
        assert len(skin.edges(0)) == 0


def test_the_led_tells_of_another_frame_period_until_it_is_right(
    flashed: Callable[..., Node],
) -> None:
    slow = replace(SPEC, frame_period_s=1.25 * SPEC.frame_period_s)
    with Bench([flashed(1)], slow) as skin:
        assert leds(skin, 0) == {False, True}
        assert len(skin.edges(0)) == 0
        skin.spec = SPEC
        behind = LONG * 5 // 4 + 1
        assert leds(skin, behind) == {False}
        assert len(skin.edges(0)) > 0


def test_a_node_that_is_flashed_for_the_other_wire_drives_no_pin(
    flashed: Callable[..., Node],
) -> None:
    """Its LED is where the sync wire is, or at the line's pin: neither is touched."""
    node = flashed(1)
    wired = replace(node, bandgap_v=0.0 if node.bandgap_v else 1.1)
    with Bench([wired], SPEC) as skin:
        assert leds(skin, 0) == {False}
        assert len(skin.edges(0)) == 0


@pytest.mark.parametrize("talking", [1, 2, 4])
def test_without_an_amplifier_each_adds_less_the_more_speak(talking: int) -> None:
    """Equally for all, of which one has 16 MHz and 5 V; and the words are right."""
    config = SkinConfig.of(read_file(CONFIG))
    spec, chip_ns = config.spec, round(config.spec.chip_s * 1e9)
    line, speaks = passive_line(spec, input_ohm=33e3), np.arange(4) >= 4 - talking
    with (
        breadboard_nodes(config, unos=1, silent=4 - talking) as nodes,
        EmulatedSkin(nodes, breadboard_line(line, config)) as skin,
    ):
        rest = PressedSkin(config, lambda t, place: np.zeros(4), skin, skin)
        trial = press_and_decode(rest, config, 12)
        mark_ns, codes = max(trial.words.items())
        sampled_v = skin.volts(mark_ns + chip_ns // 2, chip_ns, spec.chips)
    assert trial.silent == (4 - talking) * trial.frames
    truth = int(rest.codes(mark_ns)[0])
    for words in trial.words.values():
        assert np.abs(words[speaks] - truth).max() <= 1
    own = [line_chips(spec, codes, np.arange(4) == node, amplitude_v=1.0) for node in range(4)]
    model = np.column_stack([*np.array(own)[speaks].reshape(talking, -1), np.ones(spec.chips)])
    levels_v = np.linalg.lstsq(model, sampled_v, rcond=None)[0][:-1]
    total_s = 2 / 2.2e3 + (talking - 1) / 33e3 + 1 / 49.5e3
    by_hand_v = [*[1.65 / 33e3 / total_s] * (talking - 1), 2.5 / 49.5e3 / total_s]
    assert levels_v == pytest.approx(by_hand_v, rel=0.01)


def test_a_passive_line_is_computed_as_kirchhoff_has_it() -> None:
    """All resistors and pins as one linear system, solved by numpy."""
    spec = replace(FrameSpec(nodes=16), frame_period_s=1.0)
    line = passive_line(spec, input_ohm=100e3, bias_ohm=2e3, node_supply_v=5.0)
    for talking in (1, 5, 16):
        pins_v = np.where(np.arange(talking) < talking // 2, 5.0, 0.0)
        flips_v = pins_v.copy()
        flips_v[-1] = 5.0
        before, after = (_kirchhoff(100e3, 2e3, 3.3, pins) for pins in (pins_v, flips_v))
        assert (after - before) / 2 == pytest.approx(line.amplitude_v(talking))
    assert line.range_v == pytest.approx(
        [_kirchhoff(100e3, 2e3, 3.3, np.full(16, pin_v)) for pin_v in (0.0, 5.0)]
    )


def _kirchhoff(input_ohm: float, bias_ohm: float, supply_v: float, pins_v: np.ndarray) -> float:
    """The line's voltage, V: branch currents and it are unknown, and the currents sum to 0."""
    ends_v = np.array([supply_v, 0.0, *pins_v])
    ohms = np.array([bias_ohm, bias_ohm, *np.full(pins_v.size, input_ohm)])
    system = np.zeros((ends_v.size + 1, ends_v.size + 1))
    system[:-1, :-1], system[:-1, -1], system[-1, :-1] = np.diag(ohms), 1.0, 1.0
    return float(np.linalg.solve(system, np.append(ends_v, 0.0))[-1])


def test_a_skin_for_an_amplifier_is_refused() -> None:
    spec = FrameSpec(nodes=4)
    for other, values, message in (
        (replace(spec, nodes=64, order=68, frame_period_s=1.0), {}, "counts of the converter each"),
        (spec, {"input_ohm": 400.0, "node_supply_v": 5.0}, "the converter reads 0 to 3.3 V"),
        (replace(spec, chip_s=1e-6), {"bias_ohm": 22e3}, "does not settle"),
        (spec, {"bias_ohm": 1.0}, "bias_ohm is 1"),
    ):
        with pytest.raises(SpecError, match=message):
            passive_line(other, **values)
