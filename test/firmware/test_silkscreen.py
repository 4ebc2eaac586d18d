# SPDX-License-Identifier: Apache-2.0

"""What is printed on boards: references, and where pin 1, a cathode and a node's number are."""

import math
from collections.abc import Iterator

import pytest

from kicad import enlarged
from kicad_file import Item, load
from layout import Copper, read_board
from netlist import Netlist, read
from test.support.firmware import KICAD

POLAR = {"LED": "1", "Clamp": "1", "SRV05-4": "1", "ATmega328P-M": "1", "ISP": "4", "OpAmp": "1"}
POLAR |= {"Skin3": "1", "Skin3End": "1", "UART": "1", "TLV1117LV33": "1"}
POLAR |= {"Skin": "1", "SkinEnd": "1", "ATmega328P-MM": "1"}
"""The pin that a mark is at, by symbol: cathodes, pins 1, and MOSI."""
NEAR_MM = 1.7
"""From a mark to the middle of its pad, at most; chosen."""
WHERE = {"gr_text": "at", "gr_circle": "center", "gr_line": "start"}
Place = tuple[float, float]
SENSORS = [f"J{node}0{sensor}" for node in (1, 2) for sensor in range(1, 5)]
"""On the strip of nodes of four."""


def printed(board: str, *kinds: str) -> Iterator[tuple[Item, Item]]:
    """Texts or shapes on a silkscreen that are the board's, with their place."""
    tree = load(KICAD / f"{board}.kicad_pcb")
    for item in tree.all(*kinds):
        if item.one("layer").text().endswith("SilkS"):
            yield item, item.one(WHERE[item.kind])


def marks(board: str) -> list[Place]:
    """Dots, bars, and ones beside connectors."""
    found = [
        (place.number(), place.number(1)) for _, place in printed(board, "gr_circle", "gr_line")
    ]
    return found + [
        (place.number(), place.number(1))
        for text, place in printed(board, "gr_text")
        if text.text() == "1" and place.number() < 0  # else it is node 1
    ]


@pytest.mark.parametrize("board", ["strip", "strip-four", "strip-fast", "digitizer"])
def test_a_mark_tells_how_every_polar_part_is_turned(board: str) -> None:
    """It is nearer to that pin than to any other of the part."""
    schematic: Netlist = read(KICAD / f"{board}.kicad_sch")
    pads: dict[str, list[Copper]] = {}
    for item in read_board(KICAD / f"{board}.kicad_pcb"):
        if item.terminal and item.kind == "pad":
            pads.setdefault(item.terminal[0], []).append(item)
    places, polar = marks(board), 0
    for name, component in schematic.components.items():
        if component.symbol not in POLAR:
            continue
        polar += 1
        pin = POLAR[component.symbol]
        own = [pad.points[0] for pad in pads[name] if pad.terminal == (name, pin)]
        others = [pad.points[0] for pad in pads[name] if pad.terminal != (name, pin)]
        told = [
            place
            for place in places
            if min(math.dist(place, at) for at in own)
            < min(NEAR_MM, *(math.dist(place, at) for at in others))
        ]
        assert told, (name, component.symbol)
    nodes = {"strip": 8 * 4, "strip-four": 2 * 7, "strip-fast": 8 * 4, "digitizer": 2}
    assert polar == nodes[board] + 3


def test_every_part_of_the_digitizer_is_named_on_it() -> None:
    schematic = read(KICAD / "digitizer.kicad_sch")
    words = {word for text, _ in printed("digitizer", "gr_text") for word in text.text().split()}
    assert words >= schematic.components.keys()
    assert words >= {"5V", "GND", "3V3", "HALF", "LINE", "PULL"}


@pytest.mark.parametrize("side", ["F.SilkS", "B.SilkS"])
@pytest.mark.parametrize("strip", ["strip", "strip-fast"])
def test_a_nodes_number_is_at_its_sensor_and_at_its_controller(strip: str, side: str) -> None:
    """On the parts' side nearer to its own controller than to any other node's."""
    pins = {i.terminal: i.points[0] for i in read_board(KICAD / f"{strip}.kicad_pcb") if i.terminal}
    for node in range(1, 9):
        (at,) = (
            (place.number(), place.number(1))
            for text, place in printed(strip, "gr_text")
            if text.text() == str(node)
            and text.one("layer").text() == side
            and place.number() > 0  # not a connector's pin 1
        )
        near = {n: math.dist(at, pins[f"U{n}01", "13"]) for n in range(1, 9)}
        assert min(near, key=near.__getitem__) == node


def test_a_node_of_four_sensors_tells_its_taxels_and_each_is_told_at_its_ring() -> None:
    told: dict[str, dict[str, Place]] = {"F.SilkS": {}, "B.SilkS": {}}
    for text, place in printed("strip-four", "gr_text"):
        told[text.one("layer").text()][text.text()] = (place.number(), place.number(1))
    pads = {i.terminal: i.points[0] for i in read_board(KICAD / "strip-four.kicad_pcb")}
    for taxel in range(1, 9):
        node, sensor = (taxel + 3) // 4, (taxel - 1) % 4 + 1
        rings = {r: math.dist(told["F.SilkS"][str(taxel)], pads[r, "2"]) for r in SENSORS}
        assert min(rings, key=rings.__getitem__) == f"J{node}0{sensor}"
        for what in (f"node {node}", f"taxels {4 * node - 3}-{4 * node}"):
            chips = [math.dist(told["B.SilkS"][what], pads[f"U{n}01", "33"]) for n in (1, 2)]
            assert chips[node - 1] == min(chips)


def test_a_drawing_fills_a_page_across() -> None:
    drawn = '<svg width="50mm" height="20mm" viewBox="0 0 50 20"><g stroke-width="1"/></svg>'
    assert enlarged(drawn) == drawn.replace('"50mm" height="20mm"', '"270mm" height="108mm"')
