# SPDX-License-Identifier: Apache-2.0

"""The parts' symbols: pins by the data sheets, as remembered; packages are in parts.py."""

from __future__ import annotations

from collections.abc import Sequence

from drawing import MM, Pin, Symbol

LEFT, RIGHT = 0, 180
"""Angles at which a pin on this side of a box leads to it."""
Row = tuple[str, str, str] | None
"""Number, name and KiCad's electrical type of a pin; None: a gap."""


def _line(*points: tuple[float, float], fill: str = "none") -> str:
    path = " ".join(f"(xy {x * MM:g} {y * MM:g})" for x, y in points)
    return f"(polyline (pts {path}) (stroke (width 0.2) (type default)) (fill (type {fill})))"


def _rectangle(left: float, top: float, right: float, bottom: float, fill: str = "none") -> str:
    corners = f"(start {left * MM:g} {top * MM:g}) (end {right * MM:g} {bottom * MM:g})"
    return f"(rectangle {corners} (stroke (width 0.2) (type default)) (fill (type {fill})))"


def _two(
    name: str, prefix: str, *shape: str, body: float = 0.7, names: str = "12", numbers: str = "12"
) -> Symbol:
    """A part of two pins, the first one above. KiCad's diodes have their cathode at pin 1."""
    pins = tuple(
        Pin(numbers[i], names[i], "passive", (0, 1 - 2 * i), 270 - 180 * i, 1 - body)
        for i in range(2)
    )
    return Symbol(name, prefix, pins, shape)


def _box(
    name: str, prefix: str, width: float, left: Sequence[Row], right: Sequence[Row] = ()
) -> Symbol:
    """A box with pins on its sides, downward from the top."""
    rows, half = max(len(left), len(right)), width / 2
    top = float(rows // 2)
    pins = [
        Pin(row[0], row[1], row[2], (side * (half + 1.5), top - i), angle, 1.5)
        for side, angle, column in ((-1, LEFT, left), (1, RIGHT, right))
        for i, row in enumerate(column)
        if row is not None
    ]
    shape = _rectangle(-half, top + 1, half, top - rows, "background")
    return Symbol(name, prefix, tuple(pins), (shape,), 2 * top + 2, names=True)


R = _two("R", "R", _rectangle(-0.3, 0.7, 0.3, -0.7))
C = _two("C", "C", _line((-0.6, 0.2), (0.6, 0.2)), _line((-0.6, -0.2), (0.6, -0.2)), body=0.2)
CRYSTAL = _two(
    "Crystal",
    "Y",
    _line((-0.5, 0.4), (0.5, 0.4)),
    _line((-0.5, -0.4), (0.5, -0.4)),
    _rectangle(-0.5, 0.22, 0.5, -0.22),
    body=0.4,
)
LED = _two(
    "LED",
    "D",
    _line((-0.4, 0.4), (0.4, 0.4), (0, -0.4), (-0.4, 0.4)),
    _line((-0.4, -0.4), (0.4, -0.4)),
    _line((0.5, 0.1), (0.9, -0.3)),
    body=0.4,
    names="AK",
    numbers="21",
)
OPAMP = Symbol(
    "OpAmp",
    "U",
    (
        Pin("3", "+", "input", (-3, 1), 0),
        Pin("4", "-", "input", (-3, -1), 0),
        Pin("1", "OUT", "output", (3, 0), 180),
        Pin("5", "V+", "power_in", (-1, 3), 270, 1.5),
        Pin("2", "V-", "power_in", (-1, -3), 90, 1.5),
    ),
    (
        _line((-2, 2), (2, 0), (-2, -2), (-2, 2), fill="background"),
        _line((-1.75, 1), (-1.25, 1)),
        _line((-1.5, 1.25), (-1.5, 0.75)),
        _line((-1.75, -1), (-1.25, -1)),
    ),
    height=4.0,
)
"""SOT-23-5, the order of pins that Texas Instruments calls DBV."""

NODE_MCU = _box(
    "ATmega328P-M",
    "U",
    11,
    [
        ("4", "VCC", "power_in"),
        ("6", "VCC", "power_in"),
        ("18", "AVCC", "power_in"),
        ("20", "AREF", "passive"),
        None,
        None,
        ("7", "PB6/XTAL1", "input"),
        None,
        ("8", "PB7/XTAL2", "output"),
        None,
        None,
        None,
        ("29", "PC6/RESET", "input"),
        None,
        None,
        None,
        ("23", "PC0/ADC0", "bidirectional"),
        None,
        None,
        None,
        ("12", "PB0/ICP1", "bidirectional"),
        None,
        ("15", "PB3/MOSI", "bidirectional"),
        ("16", "PB4/MISO", "bidirectional"),
        ("17", "PB5/SCK", "bidirectional"),
        None,
        ("3", "GND", "power_in"),
        ("5", "GND", "power_in"),
        ("21", "GND", "power_in"),
        ("33", "GND", "power_in"),
        ("19", "ADC6", "input"),
        ("22", "ADC7", "input"),
    ],
    [
        ("13", "PB1/OC1A", "bidirectional"),
        None,
        ("31", "PD1/TXD", "bidirectional"),
        None,
        ("2", "PD4/XCK", "bidirectional"),
        None,
        None,
        None,
        None,
        ("11", "PD7", "bidirectional"),
        None,
        None,
        None,
        None,
        ("14", "PB2", "bidirectional"),
        ("24", "PC1", "bidirectional"),
        ("25", "PC2", "bidirectional"),
        ("26", "PC3", "bidirectional"),
        ("27", "PC4", "bidirectional"),
        ("28", "PC5", "bidirectional"),
        ("30", "PD0/RXD", "bidirectional"),
        ("32", "PD2", "bidirectional"),
        ("1", "PD3", "bidirectional"),
        ("9", "PD5", "bidirectional"),
        ("10", "PD6", "bidirectional"),
    ],
)
"""QFN-32; pin 33 is its pad."""

_GPIOS = {2: 4, 3: 5, 4: 6, 5: 7, 6: 9, 7: 10, 8: 11, 9: 12, 10: 14, 11: 15, 12: 16, 13: 17}
_GPIOS |= {14: 19, 15: 20, 17: 22, 18: 24, 19: 25, 20: 26, 21: 27, 22: 29, 27: 32, 28: 34}
PICO = _box(
    "Pico",
    "A",
    11,
    [
        ("40", "VBUS", "power_out"),
        None,
        ("35", "ADC_VREF", "passive"),
        None,
        ("31", "GPIO26", "bidirectional"),
        ("33", "AGND", "power_in"),
        None,
        None,
        ("21", "GPIO16", "bidirectional"),
        None,
        ("1", "GPIO0", "bidirectional"),
        ("2", "GPIO1", "bidirectional"),
        None,
        ("36", "3V3", "power_out"),
        None,
        *((number, "GND", "power_in") for number in ("3", "8", "13", "18", "23", "28", "38")),
    ],
    [
        *((str(pin), f"GPIO{gpio}", "bidirectional") for gpio, pin in _GPIOS.items()),
        ("30", "RUN", "input"),
        ("37", "3V3_EN", "input"),
        ("39", "VSYS", "power_in"),
    ],
)
"""The 40 pins of the board's edges, without its three for a debugger."""

CLAMP = _two(
    "Clamp",
    "D",
    _line((-0.4, -0.4), (0.4, -0.4), (0, 0.4), (-0.4, -0.4)),
    _line((-0.5, 0.3), (-0.4, 0.4), (0.4, 0.4), (0.5, 0.5)),
    body=0.4,
    names="KA",
)
CLAMPS = _box(
    "SRV05-4",
    "D",
    5,
    [("1", "IO1", "passive"), ("3", "IO2", "passive"), ("2", "GND", "passive")],
    [("5", "VCC", "passive"), ("4", "IO3", "passive"), ("6", "IO4", "passive")],
)
"""SOT-23-6: of each line a diode to VCC and one to ground, and a Zener diode between these."""
BUFFER = _box(
    "74LVC1G17",
    "U",
    5,
    [None, ("2", "A", "input"), ("1", "NC", "no_connect")],
    [("5", "VCC", "power_in"), ("4", "Y", "output"), ("3", "GND", "power_in")],
)
REGULATOR = _box(
    "TLV1117LV33",
    "U",
    6,
    [("3", "IN", "power_in"), ("1", "GND", "power_in")],
    [("2", "OUT", "power_out")],
)
REFERENCE = _box(
    "REF3033",
    "U",
    6,
    [("1", "IN", "power_in"), ("3", "GND", "power_in")],
    [("2", "OUT", "power_out")],
)
PROGRAMMER = _box(
    "ISP",
    "J",
    6,
    [("1", "MISO", "passive"), ("3", "SCK", "passive"), ("5", "RESET", "passive")],
    [("2", "VCC", "passive"), ("4", "MOSI", "passive"), ("6", "GND", "passive")],
)


def _connector(name: str, *nets: str, end: bool = False) -> Symbol:
    """A connector whose pins are on its right, or at a board's end on its left, from 1."""
    rows = [(str(i), net, "passive") for i, net in enumerate(nets, start=1)]
    return _box(name, "J", 4, *(([], rows) if not end else (rows, [])))


WIRES = ("+3V3", "GND", "LINE", "GND", "SYNC", "GND")
"""Of a skin's cable: ground next to line and sync."""
SKIN = _connector("Skin", *WIRES)
SKIN_END = _connector("SkinEnd", *WIRES, end=True)
SENSOR = _connector("Sensor", "S", "GND")
_CABLE = ("OUT", "GND", "SYNC", "GND")
GROUP = _connector("Group", *_CABLE)
GROUP_END = _connector("GroupEnd", *_CABLE, end=True)
SUPPLY = _connector("Supply5V", "5V", "GND")
UART = _connector("UART", "TX", "RX", "GND")


def _supply(name: str, *shape: str, up: bool = True, kind: str = "power_in") -> Symbol:
    pin = Pin("1", name, kind, (0, 0), 90 if up else 270, 0.0)
    return Symbol(name, "#FLG" if kind == "power_out" else "#PWR", (pin,), shape, power=True)


_ARROW = _line((-0.4, 0.7), (0, 1), (0.4, 0.7)), _line((0, 0), (0, 1))
V3 = _supply("+3V3", *_ARROW)
V5 = _supply("+5V", *_ARROW)
VA = _supply("+3V3A", *_ARROW)
GND = _supply(
    "GND", _line((0, 0), (0, -0.5), (0.5, -0.5), (0, -1), (-0.5, -0.5), (0, -0.5)), up=False
)
FLAG = _supply(
    "PWR_FLAG",
    _line((0, 0), (0, 0.5), (-0.4, 0.75), (0, 1), (0.4, 0.75), (0, 0.5)),
    kind="power_out",
)
ALL = (
    *(
        R,
        C,
        CRYSTAL,
        LED,
        CLAMP,
        CLAMPS,
        OPAMP,
        NODE_MCU,
        PICO,
        BUFFER,
        REGULATOR,
        REFERENCE,
        PROGRAMMER,
    ),
    *(SKIN, SKIN_END, SENSOR, GROUP, GROUP_END, SUPPLY, UART, V3, V5, VA, GND, FLAG),
)
