# SPDX-License-Identifier: Apache-2.0

"""Chooses the part to buy for each symbol and value, and tells what it costs.

Data sheet figures and pin-outs are as remembered where checked.csv has not compared them, prices
are estimates for late 2026 at some hundred pieces, in US dollars: check both before ordering.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass


class PartError(ValueError):
    """Names a symbol or value that there is no part for, or whose fields tell another."""


TYPICAL = 1.25
"""An op-amp's typical figures over the computed need, at least: they scatter by some 20 %."""


@dataclass(frozen=True, slots=True)
class Part:
    """Is a part that one can buy. footprint: of KiCad's libraries; cost in US dollars."""

    maker: str
    number: str
    cost: float
    footprint: str
    what: str


@dataclass(frozen=True, slots=True)
class OpAmp(Part):
    """Typical figures of its data sheet: Hz, V/s; all are unity-gain stable at 3.3 V.

    rail_to_rail: input and output. overload_s: until the output has left its rail, if known.
    """

    gain_bandwidth_hz: float
    slew_v_per_s: float
    rail_to_rail: bool = True
    overload_s: float = math.inf


_SOT = "Package_TO_SOT_SMD:SOT-23-5"
_TI = "Texas Instruments"
OPA365 = OpAmp(
    _TI, "OPA365AIDBVR", 1.20, _SOT, "op-amp, 50 MHz, 25 V/µs", 50e6, 25e6, overload_s=1e-7
)
TLV3541 = OpAmp(_TI, "TLV3541IDBVR", 1.60, _SOT, "op-amp, 100 MHz, 150 V/µs", 100e6, 150e6)
OPAMPS = {
    "amplifier": OPA365,
    "group amplifier": TLV3541,
    "sum": TLV3541,
}
"""Op-amps by their use, as the schematics name it."""

_0402, _C0402 = "Resistor_SMD:R_0402_1005Metric", "Capacitor_SMD:C_0402_1005Metric"
_LARGE_CAPACITORS = {
    "10n": ("GRM155R71H103KA88D", 0.01, _C0402, "X7R 50 V"),
    "100n": ("GRM155R71C104KA88D", 0.01, _C0402, "X7R 16 V"),
    "1u": ("GRM155R61E105MA12D", 0.02, _C0402, "X5R 25 V"),
    "10u": ("GRM21BR61C106KE15L", 0.12, "Capacitor_SMD:C_0805_2012Metric", "X5R 16 V"),
    "100u": ("GRM32ER60J107ME20L", 0.60, "Capacitor_SMD:C_1210_3225Metric", "X5R 6.3 V"),
}
_JST = "Connector_JST:JST_GH_BM{0:02d}B-GHS-TBT_1x{0:02d}-1MP_P1.25mm_Vertical"


def _gh(pins: int, cost: float) -> Part:
    return Part(
        "JST", f"BM{pins:02d}B-GHS-TBT", cost, _JST.format(pins), f"connector GH, {pins} pins"
    )


_OTHERS = {
    "ATmega328P-M": Part(
        "Microchip",
        "ATMEGA328P-MU",
        2.00,
        "Package_DFN_QFN:QFN-32-1EP_5x5mm_P0.5mm_EP3.1x3.1mm",
        "microcontroller",
    ),
    "ATmega328P-MM": Part(
        "Microchip",
        "ATMEGA328P-MMH",
        2.00,
        "Package_DFN_QFN:QFN-28-1EP_4x4mm_P0.45mm_EP2.4x2.4mm",
        "microcontroller, 28 pads",
    ),
    "Crystal": Part(
        "YXC",
        "X32258MOB4SI",
        0.15,
        "Crystal:Crystal_SMD_3225-4Pin_3.2x2.5mm",
        "crystal 8 MHz, 12 pF, ±10 ppm, ±20 ppm over its range",
    ),
    "LED": Part("Würth", "150040GS73220", 0.10, "LED_SMD:LED_0402_1005Metric", "LED, green"),
    "Clamp": Part("onsemi", "ESD9X5.0ST5G", 0.04, "Diode_SMD:D_SOD-923", "clamp, 5 V, one way"),
    "BAV99": Part(
        "onsemi",
        "BAV99LT1G",
        0.03,
        "Package_TO_SOT_SMD:SOT-23",
        "clamp to supply and ground, 1.5 pF",
    ),
    "SRV05-4": Part(
        "Littelfuse", "SRV05-4HTG-D", 0.15, "Package_TO_SOT_SMD:SOT-23-6", "clamps of 4 lines, 5 V"
    ),
    "Fuse": Part(
        "Bourns",
        "MF-NSMF075-2",
        0.20,
        "Fuse:Fuse_1206_3216Metric",
        "resettable fuse, holds 0.75 A, 6 V",
    ),
    "Pico": Part("Raspberry Pi", "SC0915", 4.00, "Module:RaspberryPi_Pico_SMD", "RP2040 board"),
    "74LVC1G17": Part(_TI, "SN74LVC1G17DBVR", 0.10, _SOT, "buffer, Schmitt trigger, ±24 mA"),
    "TLV1117LV33": Part(
        _TI,
        "TLV1117LV33DCYR",
        0.40,
        "Package_TO_SOT_SMD:SOT-223-3_TabPin2",
        "regulator 3.3 V, 1 A, ±1.5 %",
    ),
    "REF3033": Part(
        _TI, "REF3033AIDBZR", 1.10, "Package_TO_SOT_SMD:SOT-23", "reference 3.3 V, 25 mA, ±0.2 %"
    ),
    "BSS138": Part(
        "onsemi",
        "BSS138LT1G",
        0.05,
        "Package_TO_SOT_SMD:SOT-23",
        "N-MOSFET, threshold of 1.5 V at most",
    ),
    "Skin": _gh(6, 0.45),
    "Skin3": _gh(3, 0.30),
    "Group": _gh(4, 0.35),
    "Electrodes": Part(
        "Harwin",
        "M20-9981045",
        0.60,
        "Connector_PinHeader_2.54mm:PinHeader_2x10_P2.54mm_Vertical",
        "pin header, 2 × 10",
    ),
    "UART": _gh(3, 0.30),
    "Supply5V": Part(
        "Phoenix Contact",
        "1935161",
        0.60,
        "TerminalBlock_Phoenix:TerminalBlock_Phoenix_PT-1,5-2-5.0-H_1x02_P5.00mm_Horizontal",
        "terminal, 2 poles",
    ),
}


def part(symbol: str, value: str = "") -> Part:
    """Choose a symbol's part; value: of a resistor or capacitor, or what an op-amp is used for.

    Raises PartError where there is none.
    """
    if symbol == "R":
        return _resistor(value)
    if symbol == "C":
        return _capacitor(value)
    found = OPAMPS.get(value) if symbol == "OpAmp" else _OTHERS.get(symbol.removesuffix("End"))
    if found is None:
        raise PartError(f"parts.py has no {symbol} {value}")
    return found


def _resistor(value: str) -> Part:
    """Name Yageo's part, whose numbers tell the value: 3.9k is 3K9, 820 is 820R."""
    digits, letter = _digits(value, "R", "k?")
    unit = letter.upper() or "R"
    code = digits.replace(".", unit) if "." in digits else digits + unit
    what = f"{value} Ω, 1 %".replace("k Ω", " kΩ")
    return Part("Yageo", f"RC0402FR-07{code}L", 0.01, _0402, what)


def _capacitor(value: str) -> Part:
    """Name Murata's part; of C0G up to 1 nF, whose numbers tell the value: 220 pF is 221."""
    if value in _LARGE_CAPACITORS:
        number, cost, footprint, what = _LARGE_CAPACITORS[value]
        return Part("Murata", number, cost, footprint, f"{_farad(value)}, {what}")
    digits, letter = _digits(value, "C", "[pn]")
    pico = float(digits) * {"p": 1, "n": 1000}[letter]
    zeros = len(f"{pico:g}") - 2
    code = f"{pico / 10**zeros:g}{zeros}"
    return Part("Murata", f"GRM1555C1H{code}JA01D", 0.02, _C0402, f"{_farad(value)}, C0G 50 V, 5 %")


def _digits(value: str, symbol: str, letters: str) -> tuple[str, str]:
    """Return digits and prefix of a value."""
    found = re.fullmatch(rf"([0-9]+(?:\.[0-9]+)?)({letters})", value)
    if found is None:
        raise PartError(f"{value!r} is no value of a {symbol}, as 3.9k, 820, 220p or 1u are")
    return found[1], found[2]


def _farad(value: str) -> str:
    return f"{value[:-1]} {value[-1].replace('u', 'µ')}F"


SENSOR_SHEET = Part("Adafruit", "1361", 5.00, "", "Velostat, 280 mm × 280 mm × 0.1 mm")
SUPPLY_5V = Part("Mean Well", "LRS-50-5", 18.00, "", "supply 5 V, 10 A")
"""Parts that no schematic shows."""
