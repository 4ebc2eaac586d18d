# SPDX-License-Identifier: Apache-2.0

"""A discharge at a connector in SPICE: what the clamp leaves for the pin behind it.

    contact ─┬─ guard, if any ─┬─ series resistor, if any ── trace ─┬─ pin's own diodes to its
             clamp to 3.3 V    second clamp, and Cf to the          C, if any     supply and ground
             and ground        amplifier's output

The current is that of IEC 61000-4-2's contact discharge, whatever the circuit; positive and
negative. A pin is within its data sheet's limits if it stays within 0.5 V of its supply and ground,
or, where a series resistor has its diodes conduct, below the current that these stand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from amplifier import E12
from circuit import GUARD_OHM, INPUT_OHM, OUTPUT_OHM
from ngspice import transients
from tactile_cdma.base.arrays import Floats

PULSES = ((16.6, 1.1e-9, 2e-9), (9.3, 12e-9, 37e-9))
"""The standard's two pulses at 4 kV: ampere, rise and decay, s (its ed. 2, the figure of the ideal
waveform)."""
RISE_POWER = 1.8
STATED_KV = 4.0
STRIKE_KV = 8.0
"""Contact discharge of level 4."""
SUPPLY_V = 3.3
CLAMP_OHM, CLAMP_ZENER_V = 0.35, 7.2
"""SRV05-4: resistance of each steering diode and of the zener, and its knee. By its data sheet 8.8,
11.5 and 13.2 V at 1, 5 and 8 A, 0.7 Ω in all, from a contact to ground."""
SENSOR_V, SENSOR_OHM = 8.2, 0.6
"""ESD9X5.0ST5G: 9.8 V or less at 1 A, and its slope; chosen from the kind's curves."""
SECOND_A, SECOND_N, SECOND_OHM, SECOND_F = 1.4e-9, 2.05, 2.0, 1.5e-12
"""A diode of a BAV99, the clamp behind the line's guard: through the most volts of its data sheet,
0.715, 0.855, 1 and 1.25 V at 1, 10, 50 and 150 mA."""
CLAMP_H = 1e-9
"""Inductance of a clamp's lead to supply or ground; chosen: a via beside the pad."""
TRACE_H = 5e-9
"""From the clamp to the pin; chosen: 5 to 8 mm."""
RAIL_F, RAIL_OHM, RAIL_H = 100e-9, 20e-3, 0.6e-9
"""The ceramic capacitor at the clamp, and another one at the chip, with their own inductance."""
CHIP_H, FAR_F = 5e-9, 6e-6
"""From the clamp's supply to the chip's; the other capacitors of the board, as far away."""
PIN_OHM, PIN_F = 2.0, 4e-12
"""Resistance of a pin's own diodes, and its capacitance; chosen low, which leaves it more."""
BEYOND_V = 0.5
"""Beyond supply and ground, the limit of both chips' inputs, V (absolute maximum ratings)."""
OP_AMP_A, AVR_A, BUFFER_A = 10e-3, 1e-3, 50e-3
"""What input diodes of an OPA365 stand (absolute maximum ratings), of an AVR (Microchip's AVR182
asks for no more), and an SN74LVC1G17's output (absolute maximum ratings)."""
FEEDBACK_F = 390e-12
"""Cf of the digitizer's board."""
END_S, STEP_S = 300e-9, 50e-12


@dataclass(frozen=True, slots=True)
class Contact:
    """A connector's contact and the pin behind it.

    series_ohm: between; 0: none. limit_a: of the pin's diodes. pin_f: capacitor
    at the pin. sensor: its clamp is the sensor's, to ground. guard_ohm: to a second clamp before
    series_ohm; 0: none. feedback_f: from there to the amplifier's output.
    """

    name: str
    series_ohm: float
    limit_a: float
    pin_f: float = 0.0
    sensor: bool = False
    guard_ohm: float = 0.0
    feedback_f: float = 0.0


CONTACTS = (
    Contact("sensor-PC0", 1e3, AVR_A, 10e-9, sensor=True),
    Contact("line-PB1", 34e3, AVR_A),
    Contact("line-opamp", INPUT_OHM, OP_AMP_A, guard_ohm=GUARD_OHM, feedback_f=FEEDBACK_F),
    Contact("sync-buffer", 33.0, BUFFER_A),
    Contact("sync-PB0", 0.0, AVR_A),
)
"""Contacts of strip and digitizer, by their schematics; the last two only where there is a sync
wire, as on boards of fast nodes."""


@dataclass(frozen=True, slots=True)
class Struck:
    """What a pin sees: the most volts beyond supply or ground, and amperes through its diodes.

    output_a: through those of the amplifier's output, which a discharge reaches through Cf.
    """

    beyond_v: float
    pin_a: float
    output_a: float = 0.0

    def within(self, contact: Contact) -> bool:
        """Tell whether the pin stays within its limits."""
        return self.beyond_v <= BEYOND_V or self.pin_a <= contact.limit_a


def discharge_a(times: Floats, kilovolt: float) -> Floats:
    """Return the standard's current, A, s after it begins."""
    total = np.zeros_like(times)
    for ampere, rise_s, decay_s in PULSES:
        share = RISE_POWER * decay_s / rise_s
        peak = math.exp(-rise_s / decay_s * share ** (1 / RISE_POWER))
        rise = (times / rise_s) ** RISE_POWER
        total += ampere / peak * rise / (1 + rise) * np.exp(-times / decay_s)
    return total * kilovolt / STATED_KV


def strike(contact: Contact, kilovolt: float = STRIKE_KV) -> Struck:
    """Simulate a discharge of either sign, and return the worse. Raises SpiceError."""
    found = [_struck(contact, sign * kilovolt) for sign in (1, -1)]
    return Struck(
        max(one.beyond_v for one in found),
        max(one.pin_a for one in found),
        max(one.output_a for one in found),
    )


def needed_ohm(contact: Contact) -> float:
    """Return the least series resistor of E12 with which a pin stays within. Raises SpiceError."""
    values = [value * 10.0**power for power in range(5) for value in E12]
    low, high = -1, len(values) - 1
    while high - low > 1:
        middle = (low + high) // 2
        tried = replace(contact, series_ohm=values[middle])
        low, high = (low, middle) if strike(tried).within(tried) else (middle, high)
    return values[high]


def _struck(contact: Contact, kilovolt: float) -> Struck:
    found = transients(netlist(contact, kilovolt))
    rail_v, pin_v = found["v(chip)"], found["v(pin)"]
    beyond_v = max(float((pin_v - rail_v).max()), float(-pin_v.min()))
    through_a = {
        pin: max(float(abs(found[f"v({way}{pin})"]).max()) for way in ("up", "down")) / PIN_OHM
        for pin in (("pin", "out") if contact.feedback_f else ("pin",))
    }
    return Struck(beyond_v, through_a["pin"], through_a.get("out", 0.0))


def netlist(contact: Contact, kilovolt: float) -> str:
    """Write an analysis of one discharge. v(uppin), v(downpin): across its resistances."""
    times = np.concatenate([np.arange(0, 5e-9, 0.1e-9), np.arange(5e-9, END_S, 1e-9)])
    points = " ".join(
        f"{at + 1e-9:.6g} {ampere:.6g}"
        for at, ampere in zip(times, discharge_a(times, kilovolt), strict=True)
    )
    clamp = [
        "dsteer contact tosupply steer",
        f"lsupply tosupply rail {CLAMP_H:g}",
        "dground fromground contact steer",
        f"lground fromground 0 {CLAMP_H:g}",
        "dzener fromground tosupply zener",
    ]
    if contact.sensor:
        clamp = ["dsensor fromground contact sensor", f"lground fromground 0 {CLAMP_H:g}"]
    held = "contact"
    guard = []
    if contact.guard_ohm:
        held = "held"
        guard = [
            f"rguard contact guarded {contact.guard_ohm:g}",
            f"lguard guarded held {TRACE_H:g}",
            f"dabove held tochip second\nlabove tochip chip {CLAMP_H:g}",
            f"dbelow toground held second\nlbelow toground 0 {CLAMP_H:g}",
        ]
    if contact.feedback_f:
        half = f"routput out half {OUTPUT_OHM:g}\nvhalf half 0 {SUPPLY_V / 2:g}"
        guard += [f"cfeedback held out {contact.feedback_f:g}", half, *_own_diodes("out")]
    ways = [f"v({way}{pin})" for way in ("up", "down") for pin in ("pin", "out")]
    saved = " ".join(ways if contact.feedback_f else ways[::2])
    return "\n".join(
        [
            f"* {kilovolt:g} kV at {contact.name}",
            f".model steer d(is=1e-14 n=1.1 rs={CLAMP_OHM:g} cjo=1p)",
            f".model zener d(is=1e-14 n=1.1 rs={CLAMP_OHM:g} bv={CLAMP_ZENER_V:g} ibv=1m)",
            f".model sensor d(is=1e-14 n=1.1 rs={SENSOR_OHM:g} bv={SENSOR_V:g} ibv=1m cjo=5p)",
            ".model own d(is=1e-14 n=1.1)",
            f"istrike 0 contact pwl(0 0 {points})",
            *clamp,
            f"rsource supply rail 1\nvsupply supply 0 {SUPPLY_V:g}",
            f"crail rail n1 {RAIL_F:g}\nrrail n1 n2 {RAIL_OHM:g}\nlrail n2 0 {RAIL_H:g}",
            f"cfar rail far {FAR_F:g}\nlfar far 0 {CHIP_H:g}\nlchip rail chip {CHIP_H:g}",
            f"cchip chip n3 {RAIL_F:g}\nrchip n3 n4 {RAIL_OHM:g}\nlown n4 0 {RAIL_H:g}",
            f".model second d(is={SECOND_A:g} n={SECOND_N:g} rs={SECOND_OHM:g} cjo={SECOND_F:g})",
            *guard,
            f"rseries {held} behind {max(contact.series_ohm, 1e-3):g}",
            f"ltrace behind pin {TRACE_H:g}",
            f"cpin pin 0 {PIN_F + contact.pin_f:g}",
            *_own_diodes("pin"),
            f".tran {STEP_S:g} {END_S:g} 0 {STEP_S:g}",
            f".save v(contact) v(chip) v(pin) {saved}",
            ".end",
            "",
        ]
    )


def _own_diodes(pin: str) -> list[str]:
    """Write a pin's diodes to its chip's supply and to ground, and what their resistances see."""
    return [
        f"dup{pin} {pin} above{pin} own\nrup{pin} above{pin} chip {PIN_OHM:g}",
        f"eup{pin} up{pin} 0 above{pin} chip 1",
        f"ddown{pin} below{pin} {pin} own\nrdown{pin} 0 below{pin} {PIN_OHM:g}",
        f"edown{pin} down{pin} 0 below{pin} 0 1",
    ]
