# SPDX-License-Identifier: Apache-2.0

"""The boards of a skin, drawn: node, strip of nodes, digitizer, and for fast nodes the group board.

Values are those that `make amplifier` computes. Slow boards are for 16 nodes; where 64 need
another value, the part says so.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import symbols as s
from drawing import Placed, Point, Sheet, Symbol
from parts import part
from tactile_cdma.config.skin_config import SkinConfig

sys.path.append(str(Path(__file__).resolve().parents[1] / "analog"))
from amplifier import FrontEnd, Stage, design
from circuit import HALF_F, HALF_OHM
from spice import SKINS

STRIP_NODES = 8
FEW, MORE, MANY = 16, 64, 900
"""Nodes of the skins that there are boards for: the same boards for the first two."""
REF_OHM = 3.3e3
"""Of a sensor's divider, to begin with: the geometric mean of what docs/building.md cites."""
SYNC_OHM, FAST_SYNC_OHM = 68.0, 33.0
"""Between a buffer and its sync line: with that of 16 to 64 slow nodes on some metres, and of a
group's 70 on 2 m, an edge overshoots by less than a pin stands (test_boards.py, in SPICE)."""
SYNC_DOWN_OHM = 100e3
"""At the input of a sync line's buffer."""
CABLE_OHM = 51.0
"""Keeps a group's amplifier from ringing with its cable; 0.4 % of Rg."""
BYPASS_F = 100e-9
NODE_BULK_F = 1e-6
"""Of a node. Eight take 0.25 V from the digitizer's 100 µF when a strip is plugged in, which leaves
3.0 V; 4.7 µF each would take 0.9 V, and every node would be reset (below 2.7 V)."""
GUARD_OHM = 1e3
"""Between a sensor and a pin, behind the clamp: what is left of a discharge is some mA."""
SENSOR_PADS = {"Footprint": "tactile:Comb_8x8mm"}
ISP_PADS = {"Footprint": "tactile:ISP_Pads_2x03_P1.27mm"}
CRYSTAL_F = 22e-12
"""For a crystal of 18 pF with some 5 pF of copper and pin: the most that the data sheet allows."""


def front_end(nodes: int) -> FrontEnd:
    """The front end of a skin, as `make spice` simulates it."""
    config = SkinConfig.of({"nodes": nodes, **SKINS[nodes]})
    return design(config.spec, config.samples_per_chip)


@dataclass(frozen=True, slots=True)
class Fronts:
    """The design that a board is drawn for, and that of more nodes on the same boards, if any."""

    first: FrontEnd
    more: FrontEnd | None = None


def all_boards() -> list[Sheet]:
    """Every sheet, by itself: nodes, the strips that they are shown in, the other boards."""
    slow, fast = Fronts(front_end(FEW), front_end(MORE)), Fronts(front_end(MANY))
    sheets = []
    for fronts, suffix in ((slow, ""), (fast, "-fast")):
        outer = strip(f"strip{suffix}", f"node{suffix}.kicad_sch")
        paths = [outer.child_path(i + 1) for i in range(STRIP_NODES)]
        sheets += [node(f"node{suffix}", fronts, (outer.name, paths), fast=bool(suffix)), outer]
    return [*sheets, digitizer(slow), group(fast.first), fast_digitizer(fast.first)]


def quantity(value: float) -> str:
    """A resistor's or capacitor's value as it is printed on a drawing: 3.9k, 220p."""
    for factor, letter in ((1e3, "k"), (1.0, ""), (1e-6, "u"), (1e-9, "n"), (1e-12, "p")):
        if value >= factor * (1 - 1e-9):
            return f"{round(value / factor, 3):g}{letter}"
    raise ValueError(f"{value:g} is less than any part's value")


def _bought(symbol: str, value: str = "") -> dict[str, str]:
    """Properties of a part that is in the table of parts."""
    found = part(symbol, value)
    return {"Footprint": found.footprint, "MPN": found.number}


def _resistor(
    sheet: Sheet,
    at: Point,
    ohm: float,
    *,
    turn: int = 0,
    more: float | None = None,
) -> Placed:
    """more: the value with MORE nodes."""
    value = quantity(ohm)
    fields = _bought("R", value)
    if more is not None and more != ohm:
        fields |= {
            "Note": f"{quantity(more)}: {MORE} nodes",
            f"MPN{MORE}": part("R", quantity(more)).number,
        }
    return sheet.place(s.R, at, value, turn=turn, fields=fields)


def _capacitor(sheet: Sheet, at: Point, farad: float, *, turn: int = 0, use: str = "") -> Placed:
    value = quantity(farad)
    fields = _bought("C", value) | ({"Note": use} if use else {})
    return sheet.place(s.C, at, value, turn=turn, fields=fields)


def _bypass(sheet: Sheet, at: Point, supply: Symbol, farads: Sequence[tuple[float, str]]) -> None:
    """Capacitors in a row between a supply and ground; what each is for."""
    x, y = at
    for i, (farad, use) in enumerate(farads):
        column = x + 5 * i
        _capacitor(sheet, (column, y + 2), farad, use=use)
        sheet.wire((column, y + 3), (column, y + 4))
        if i:
            sheet.wire((column - 5, y + 1), (column, y + 1))
            sheet.wire((column - 5, y + 4), (column, y + 4))
    sheet.power(supply, (x, y + 1))
    sheet.power(s.GND, (x, y + 4))


def _half(sheet: Sheet, at: Point, supply: Symbol) -> None:
    """Half a supply at this point, from its left: two resistors and a small capacitor."""
    x, y = at
    _resistor(sheet, (x - 6, y - 2), HALF_OHM)
    _resistor(sheet, (x - 6, y + 2), HALF_OHM)
    _capacitor(sheet, (x - 11, y + 2), HALF_F)
    sheet.wire((x - 6, y - 1), (x - 6, y), (x - 6, y + 1))
    sheet.wire((x - 11, y + 1), (x - 11, y), (x - 6, y), (x, y))
    sheet.power(supply, (x - 6, y - 3))
    sheet.power(s.GND, (x - 6, y + 3))
    sheet.power(s.GND, (x - 11, y + 3))
    sheet.label("HALF", (x - 9.5, y))


def _opamp(sheet: Sheet, at: Point, use: str, supply: Symbol) -> Placed:
    bought = _bought("OpAmp", use)
    amplifier = sheet.place(s.OPAMP, at, bought["MPN"], fields={**bought, "Use": use})
    sheet.power(supply, amplifier.pin("V+"))
    sheet.power(s.GND, amplifier.pin("V-"))
    return amplifier


def _stage(sheet: Sheet, at: Point, stage: Stage, use: str, supply: Symbol) -> tuple[Point, Point]:
    """A summing amplifier; returns the place of its summing point, and that of its output."""
    x, y = at
    amplifier = _opamp(sheet, at, use, supply)
    plus = amplifier.pin("+")
    sheet.wire(plus, (x - 5, plus[1]), (x - 5, y - 7))
    _half(sheet, (x - 5, y - 7), supply)
    summing, output = (x - 5, y + 1), (x + 5, y)
    sheet.wire(summing, amplifier.pin("-"))
    sheet.wire(amplifier.pin("OUT"), output)
    for row, passive in enumerate(("R", "C")):
        level = y + 7 + 3 * row
        if passive == "R":
            _resistor(sheet, (x, level), stage.feedback_ohm, turn=90)
        else:
            _capacitor(sheet, (x, level), stage.feedback_f, turn=90)
        above = y + 7 if row else None
        sheet.wire((summing[0], above or summing[1]), (summing[0], level), (x - 1, level))
        sheet.wire((x + 1, level), (output[0], level), (output[0], above or output[1]))
    return summing, output


def _buffer(
    sheet: Sheet, at: Point, supply: Symbol, source: str, ohm: float, *, to_nodes: bool = True
) -> None:
    """A sync line's buffer from a net to SYNC."""
    buffer = sheet.place(s.BUFFER, at, "74LVC1G17", fields=_bought("74LVC1G17"))
    (x, y), output = buffer.pin("A"), buffer.pin("Y")
    sheet.label(source, (x - 3, y), 180)
    sheet.wire((x - 3, y), (x, y))
    _resistor(sheet, (x - 3, y + 1), SYNC_DOWN_OHM)
    sheet.power(s.GND, (x - 3, y + 2))
    sheet.power(supply, buffer.pin("VCC"))
    sheet.power(s.GND, buffer.pin("GND"))
    end = (output[0] + 5, output[1])
    sheet.wire(output, (end[0] - 2, end[1]))
    _resistor(sheet, (end[0] - 1, end[1]), ohm, turn=90)
    sheet.stub("SYNC", end, everywhere=to_nodes)


def _regulator(sheet: Sheet, at: Point, symbol: Symbol, output: Symbol) -> None:
    """A regulator or reference, from 5 V."""
    regulator = sheet.place(symbol, at, symbol.name, fields=_bought(symbol.name))
    for supply, pin in ((s.V5, "IN"), (s.GND, "GND"), (output, "OUT")):
        sheet.power(supply, regulator.pin(pin))


def _grounds(sheet: Sheet, placed: Placed, numbers: Sequence[str], column: float) -> None:
    """Pins of a part, from the top, to one wire at this column with ground at its end."""
    ends = [placed.pin(number) for number in numbers]
    for end in ends:
        sheet.wire(end, (column, end[1]))
    last = ends[-1][1] + 1
    for upper, lower in pairwise(ends):
        sheet.wire((column, upper[1]), (column, lower[1]))
    sheet.wire((column, ends[-1][1]), (column, last))
    sheet.power(s.GND, (column, last))


def _skin_connector(sheet: Sheet, at: Point, *, end: bool = False) -> Point:
    """The cable to nodes, with supply, ground and sync; returns the place of its line.

    end: at the sheet's right.
    """
    skin = sheet.place(s.SKIN_END if end else s.SKIN, at, "Skin", fields=_bought("Skin"))
    (x, y), outward = skin.pin("+3V3"), -1 if end else 1
    sheet.wire((x, y), (x + 2 * outward, y))
    sheet.power(s.V3, (x + 2 * outward, y))
    _grounds(sheet, skin, ("2", "4", "6"), x + outward)
    sheet.stub("SYNC", skin.pin("SYNC"), 180 if end else 0, length=2, everywhere=True)
    return skin.pin("LINE")


def _clamps(sheet: Sheet, at: Point, nets: dict[str, bool]) -> None:
    """Diodes at two lines of a cable: nets, and whether they go beyond the sheet."""
    clamps = sheet.place(s.CLAMPS, at, "SRV05-4", fields=_bought("SRV05-4"))
    for pin, (net, everywhere) in zip(("IO1", "IO2"), nets.items(), strict=True):
        sheet.stub(net, clamps.pin(pin), 180, everywhere=everywhere)
    sheet.unconnected(clamps.pin("IO3"), clamps.pin("IO4"))
    sheet.power(s.V3, clamps.pin("VCC"))
    sheet.power(s.GND, clamps.pin("GND"))


def _flags(sheet: Sheet, at: Point, *supplies: Symbol) -> None:
    """Marks, for the check, of nets that a connector supplies."""
    for i, supply in enumerate(supplies):
        place = (at[0] + 9 * i, at[1])
        sheet.power(s.FLAG, place)
        end = (place[0] + 4, place[1])
        sheet.wire(place, end)
        sheet.power(supply, end)


def node(name: str, fronts: Fronts, users: tuple[str, Sequence[str]], *, fast: bool) -> Sheet:
    """A sensing node: ATmega328P, sensor, the resistor to the line."""
    front, more = fronts.first, fronts.more
    sheet = Sheet(name, f"sensing node{', fast' if fast else ''}", (86, 44), users)
    mcu = sheet.place(s.NODE_MCU, (35, 20), "ATmega328P-MU", fields=_bought("ATmega328P-M"))
    x, top = mcu.pin("4")
    for number in ("4", "6", "18"):
        pin = mcu.pin(number)
        sheet.wire(pin, (x - 2, pin[1]))
    sheet.wire((x - 2, top - 1), (x - 2, top), (x - 2, top + 1), (x - 2, top + 2))
    sheet.power(s.V3, (x - 2, top - 1))
    aref = mcu.pin("AREF")
    sheet.wire(aref, (x - 16, aref[1]))
    _capacitor(sheet, (x - 16, aref[1] + 1), BYPASS_F)
    sheet.power(s.GND, (x - 16, aref[1] + 2))

    first, second = mcu.pin("PB6/XTAL1"), mcu.pin("PB7/XTAL2")
    if fast:
        sheet.place(s.CRYSTAL, (x - 6, first[1] + 1), "8MHz", fields=_bought("Crystal"))
        for pin, column in ((first, x - 12), (second, x - 9)):
            sheet.wire(pin, (x - 6, pin[1]), (column, pin[1]))
            _capacitor(sheet, (column, second[1] + 1), CRYSTAL_F)
            sheet.power(s.GND, (column, second[1] + 2))
        sheet.wire((x - 12, first[1]), (x - 12, second[1]))
    else:
        sheet.unconnected(first, second)

    reset = mcu.pin("PC6/RESET")
    _resistor(sheet, (x - 3, reset[1] - 1), 10e3)
    sheet.power(s.V3, (x - 3, reset[1] - 2))
    sheet.wire(reset, (x - 3, reset[1]))
    sheet.stub("RESET", (x - 3, reset[1]), 180)

    sense = mcu.pin("PC0/ADC0")
    sensor = sheet.place(s.SENSOR, (x - 22.5, sense[1] + 1), "Sensor", fields=SENSOR_PADS)
    sheet.wire(sense, (x - 6, sense[1]), (x - 8, sense[1]))
    _capacitor(sheet, (x - 6, sense[1] + 1), 10e-9)
    sheet.power(s.GND, (x - 6, sense[1] + 2))
    _resistor(sheet, (x - 9, sense[1]), GUARD_OHM, turn=90)
    sheet.wire((x - 10, sense[1]), (x - 13, sense[1]), (x - 16, sense[1]), sensor.pin("S"))
    sheet.label("SENSE", (x - 18, sense[1]))
    _resistor(sheet, (x - 13, sense[1] - 1), REF_OHM)
    sheet.power(s.V3, (x - 13, sense[1] - 2))
    sheet.place(s.CLAMP, (x - 16, sense[1] + 1), "5 V", fields=_bought("Clamp"))
    sheet.power(s.GND, (x - 16, sense[1] + 2))
    sheet.power(s.GND, sensor.pin("GND"))

    sync = mcu.pin("PB0/ICP1")
    sheet.stub("SYNC", sync, 180, everywhere=True)
    programmer = sheet.place(s.PROGRAMMER, (x - 14, sync[1] + 4), "ISP pads", fields=ISP_PADS)
    for net, name_ in (("MOSI", "PB3/MOSI"), ("MISO", "PB4/MISO"), ("SCK", "PB5/SCK")):
        sheet.stub(net, mcu.pin(name_), 180)
        sheet.stub(net, programmer.pin(net), 0 if net == "MOSI" else 180)
    sheet.stub("RESET", programmer.pin("RESET"), 180)
    sheet.power(s.V3, programmer.pin("VCC"))
    sheet.power(s.GND, programmer.pin("GND"))
    _grounds(sheet, mcu, ("3", "5", "21", "33", "19", "22"), x - 1)

    line, other = ("PD1/TXD", "PB1/OC1A") if fast else ("PB1/OC1A", "PD1/TXD")
    begin = mcu.pin(line)
    right, y = begin
    sheet.wire(begin, (right + 5, y))
    input_ohm = more.nodes_stage.input_ohm if more else None
    _resistor(sheet, (right + 6, y), front.nodes_stage.input_ohm, turn=90, more=input_ohm)
    sheet.stub("LINE", (right + 7, y), everywhere=True)

    led = mcu.pin("PD7")
    _resistor(sheet, (right + 3, led[1]), 1e3, turn=90)
    sheet.wire(led, (right + 2, led[1]))
    sheet.wire((right + 4, led[1]), (right + 6, led[1]), (right + 6, led[1] + 1))
    sheet.place(s.LED, (right + 6, led[1] + 2), "green", fields=_bought("LED"))
    sheet.power(s.GND, (right + 6, led[1] + 3))
    sheet.unconnected(mcu.pin(other), mcu.pin("PD4/XCK"))
    sheet.unconnected(
        *(mcu.pin(n) for n in ("14", "24", "25", "26", "27", "28", "30", "32", "1", "9", "10"))
    )
    _bypass(
        sheet,
        (right + 10, 27),
        s.V3,
        [
            (BYPASS_F, "VCC"),
            (BYPASS_F, "AVCC"),
            (NODE_BULK_F, "node"),
        ],
    )
    where = (
        "Line from PD1 (TXD): its pull-up is off, or a released line would sit half a level high.\n"
        "PD4 (XCK) is an output, the chips' clock: leave it unconnected. PB1 is free."
        if fast
        else "Line from PB1 (OC1A). PD1 and PD4 are free: a fast node has its line at PD1.\n"
        "No crystal: chips follow the sync edge."
    )
    sheet.note(
        f"{where}\nUnused pins are pulled up by the firmware.\n"
        "Rref of the sensor: its resistance at mid range, so measure it.",
        (right + 10, 34),
    )
    return sheet


def strip(name: str, file: str) -> Sheet:
    """A strip of nodes between two connectors: all on the same four wires."""
    sheet = Sheet(name, f"strip of {STRIP_NODES} nodes", (62, 26))
    for i in range(STRIP_NODES):
        at = (18.0 + 7 * (i % 4), 6.0 + 5 * (i // 4))
        sheet.child(f"node {i + 1}", file, at, (6, 4))
    for at, end in (((4.5, 11.0), False), ((57.5, 11.0), True)):
        line = _skin_connector(sheet, at, end=end)
        sheet.stub("LINE", line, 180 if end else 0, length=2, everywhere=True)
    _clamps(sheet, (44, 20), {"LINE": True, "SYNC": True})
    _flags(sheet, (4, 22), s.V3, s.GND)
    sheet.note(
        "Every node is on the same line, sync line, supply and ground. Chain strips end to end.\n"
        "Supply and ground: wires of one cross-section; ground runs beside line and sync.\n"
        "The sync line has nothing at its far end.",
        (26, 20),
    )
    return sheet


def _summed_line(sheet: Sheet, stage: Stage, use: str) -> Point:
    """A cable to nodes and the amplifier of their line; returns the place of its output."""
    line = _skin_connector(sheet, (4.5, 17))
    summing, output = _stage(sheet, (32, line[1] - 1), stage, use, s.V3)
    sheet.wire(line, summing)
    sheet.label("LINE", (line[0] + 3, line[1]))
    return output


def _pico(sheet: Sheet, at: Point, reference: Symbol) -> Placed:
    """The digitizer's RP2040 board with its reference, ground and USB's supply."""
    pico = sheet.place(s.PICO, at, "Raspberry Pi Pico", fields=_bought("Pico"))
    for name, supply, length in (("VBUS", s.V5, 1.5), ("ADC_VREF", reference, 4)):
        x, y = pico.pin(name)
        sheet.wire((x, y), (x - length, y))
        sheet.power(supply, (x - length, y))
    x, y = pico.pin("AGND")
    sheet.wire((x, y), (x - 1, y))
    sheet.power(s.GND, (x - 1, y))
    _grounds(sheet, pico, ("3", "8", "13", "18", "23", "28", "38"), x - 1)
    sheet.stub("SYNC_PICO", pico.pin("GPIO16"), 180)
    uart = sheet.place(s.UART, (at[0] - 19, at[1] + 11), "UART", fields=_bought("UART"))
    for gpio, net in (("GPIO0", "TX"), ("GPIO1", "RX")):
        sheet.stub(net, pico.pin(gpio), 180)
        sheet.stub(net, uart.pin(net))
    sheet.power(s.GND, uart.pin("GND"))
    used = {"VBUS", "ADC_VREF", "AGND", "GND", "GPIO16", "GPIO26", "GPIO0", "GPIO1", "3V3"}
    sheet.unconnected(*(pico.pin(p.number) for p in s.PICO.pins if p.name not in used))
    sheet.note(
        "GPIO23, inside the Pico, is its regulator's mode pin: the firmware\n"
        "drives it high, or the regulator's ripple would reach the converter.\n"
        "ADC_VREF is supplied from outside: the Pico's own is some 30 mV low.",
        (at[0] - 14, at[1] + 14),
    )
    return pico


def _filter(sheet: Sheet, front: FrontEnd, begin: Point, pin: Point) -> None:
    """The filter between the last amplifier and the converter's pin, close to the latter."""
    x, y = begin[0] + 4, begin[1]
    sheet.wire(begin, (x - 1, y))
    _resistor(sheet, (x, y), front.filter_ohm, turn=90)
    sheet.wire((x + 1, y), (x + 3, y), pin)
    _capacitor(sheet, (x + 3, y + 1), front.filter_f)
    sheet.power(s.GND, (x + 3, y + 2))


def digitizer(fronts: Fronts) -> Sheet:
    """The digitizer of slow nodes: their supply, the amplifier, the RP2040 board."""
    front = fronts.first
    if fronts.more and (fronts.more.nodes_stage.feedback_ohm, fronts.more.filter_ohm) != (
        front.nodes_stage.feedback_ohm,
        front.filter_ohm,
    ):
        raise ValueError(f"{MORE} nodes need another amplifier than {FEW}: draw two boards")
    sheet = Sheet("digitizer", "digitizer", (82, 51))
    output = _summed_line(sheet, front.nodes_stage, "amplifier")
    pico = _pico(sheet, (64, 23), s.V3)
    _filter(sheet, front, output, pico.pin("GPIO26"))
    sheet.unconnected(pico.pin("3V3"))
    _buffer(sheet, (16, 33), s.V3, "SYNC_PICO", SYNC_OHM)
    _clamps(sheet, (12, 5), {"LINE": False, "SYNC": True})
    _regulator(sheet, (9, 42), s.REGULATOR, s.V3)
    _bypass(sheet, (20, 40), s.V5, [(10e-6, "regulator")])
    _bypass(
        sheet, (26, 40), s.V3, [(100e-6, "skin"), (BYPASS_F, "amplifier"), (BYPASS_F, "buffer")]
    )
    _flags(sheet, (8, 48), s.GND)
    sheet.note(
        "The nodes' supply is the amplifier's and the converter's reference, too:\n"
        "then its error moves nothing.",
        (20, 46.5),
    )
    return sheet


def group(front: FrontEnd) -> Sheet:
    """The board of a group of fast nodes: supply, first amplifier, buffer of the sync line."""
    sheet = Sheet("group", f"group of up to {front.nodes_stage.inputs} fast nodes", (72, 41))
    output = _summed_line(sheet, front.nodes_stage, "group amplifier")
    _resistor(sheet, (output[0] + 3, output[1]), CABLE_OHM, turn=90)
    sheet.wire(output, (output[0] + 2, output[1]))
    out = sheet.place(s.GROUP_END, (64.5, output[1] + 2), "Digitizer", fields=_bought("Group"))
    sheet.wire((output[0] + 4, output[1]), out.pin("OUT"))
    x, _ = out.pin("OUT")
    _grounds(sheet, out, ("2", "4"), x - 1)
    sheet.stub("SYNC_IN", out.pin("SYNC"), 180, 2)
    _buffer(sheet, (54, 28), s.V3, "SYNC_IN", FAST_SYNC_OHM)
    _clamps(sheet, (12, 5), {"LINE": False, "SYNC": True})
    supply = sheet.place(s.SUPPLY, (4.5, 31), "5 V", fields=_bought("Supply5V"))
    sheet.power(s.V5, supply.pin("5V"))
    sheet.power(s.GND, supply.pin("GND"))
    _regulator(sheet, (16, 31), s.REGULATOR, s.V3)
    _bypass(sheet, (26, 29), s.V5, [(10e-6, "regulator")])
    _bypass(
        sheet, (32, 29), s.V3, [(100e-6, "group"), (BYPASS_F, "amplifier"), (BYPASS_F, "buffer")]
    )
    _flags(sheet, (8, 38), s.GND, s.V5)
    sheet.note(
        "Each group: a regulator, half a supply and a sync buffer of its own.\n"
        "Cable to the digitizer: ground beside OUT and SYNC; all of the same length, within 10 m.",
        (22, 35.5),
    )
    return sheet


def fast_digitizer(front: FrontEnd) -> Sheet:
    """The digitizer of fast nodes in groups: the second amplifier, the RP2040 board."""
    last = front.groups_stage
    if last is None:
        raise ValueError(f"{front.nodes} nodes need no groups: draw a digitizer without them")
    sheet = Sheet("digitizer-fast", f"digitizer of {last.inputs} groups", (110, 60))
    rows = -(-last.inputs // 2)
    buses = []
    for column in range(2):
        places = [(4.5 + 17 * column, 6 + 8 * row) for row in range(rows)]
        ends = []
        for at in places[: last.inputs - column * rows]:
            cable = sheet.place(s.GROUP, at, "Group", fields=_bought("Group"))
            x, y = cable.pin("OUT")
            sheet.wire((x, y), (x + 3, y))
            _resistor(sheet, (x + 4, y), last.input_ohm, turn=90)
            ends.append((x + 7, y))
            sheet.wire((x + 5, y), ends[-1])
            _grounds(sheet, cable, ("2", "4"), x + 1)
            sheet.stub("SYNC", cable.pin("SYNC"), length=2)
        for upper, lower in pairwise(ends):
            sheet.wire(upper, lower)
        buses.append(ends[0])
    middle = (60, 20)
    summing, output = _stage(sheet, middle, last, "sum", s.VA)
    sheet.wire(buses[0], (buses[0][0], 2), (buses[1][0], 2), buses[1])
    sheet.wire((buses[1][0], 2), (buses[1][0] + 6, 2), (buses[1][0] + 6, summing[1]), summing)
    sheet.label("SUM", (buses[1][0] + 1, 2))
    pico = _pico(sheet, (92, 28), s.VA)
    _filter(sheet, front, output, pico.pin("GPIO26"))
    x, y = pico.pin("3V3")
    sheet.wire((x, y), (x - 4, y))
    sheet.power(s.V3, (x - 4, y))
    _buffer(sheet, (48, 38), s.V3, "SYNC_PICO", FAST_SYNC_OHM, to_nodes=False)
    _regulator(sheet, (41, 47), s.REFERENCE, s.VA)
    _bypass(sheet, (50, 45), s.V5, [(10e-6, "reference")])
    _bypass(sheet, (56, 45), s.VA, [(1e-6, "reference"), (BYPASS_F, "amplifier")])
    _bypass(sheet, (67, 45), s.V3, [(BYPASS_F, "buffer")])
    _flags(sheet, (39, 53), s.GND)
    sheet.note(
        "Amplifier and converter have an exact reference; groups have regulators of their own.\n"
        "Keep the summing point (SUM) short.",
        (50, 51.5),
    )
    return sheet
