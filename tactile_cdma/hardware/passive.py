# SPDX-License-Identifier: Apache-2.0

"""A line without an amplifier: nodes' pins through a resistor each into two that halve the supply.

    pin ──Rin──┬── … all nodes: the line ── converter
               ├──Rb── supply
               └──Rb── ground

A pin is high, low or released. The line is the mean of what is connected, weighted by conductance:
m pins that drive it, g = 1/Rin each, and the two resistors, G = 2/Rb. So it is off its rest by

    Σ g·(pin − S/2) / (G + m·g)

with one divisor for all pins: the more nodes speak, the less each adds, equally for all; and a node
drives its pin through the whole frame in which it speaks, so m does not change within a frame.
Codes are read by their sign, so nothing is lost but resolution of the converter.

Pins of a higher supply swing about their own half: they add a constant while they speak, which is
on the code row of ones that no node has.
"""

import math
from dataclasses import dataclass

from ..base.errors import SpecError, check_limits
from ..code.frame import BIPOLAR, FrameSpec

BIAS_OHM = 2200.0
"""Each of the two resistors that hold the line at half the supply, Ω. Chosen: they draw 0.75 mA,
and are far below a converter's input with its wire."""
LOAD = 0.2
"""Largest m·g/G of a network that is chosen here: A falls by a sixth at most. Chosen."""
E6 = (10, 15, 22, 33, 47, 68, 100)
"""Values of resistors that are in any drawer."""
LEAST_COUNTS = 10.0
"""A in counts of the converter, below which an amplifier is asked for. Chosen: as noisy as one."""
PIN_F, WIRE_F = 10e-12, 200e-12
"""Capacitance of a pin and its breadboard row, and of 2 m of wire, F, as in firmware/analog."""
LISTEN_F = 2 * PIN_F
"""Capacitance of a node's pins where one of them listens to the line behind Rin, F."""
THRESHOLD_V = 1.24
"""Line below which a comparator may see a pulse, V: bandgap 1.2 V, offset 40 mV (data sheet)."""
LEAST_SUPPLY, RESISTORS = 0.91, 0.01
"""Least share of its supply, 3.0 of 3.3 V, and tolerance, with which a line has to work. Chosen."""
MOST_LATER_S = 6.3e-6
"""A pulse may look longer by this, s: nodes match lengths within 8 µs, by clocks 4 % off. A line
that passes the threshold in this time is at rest, within a count, in 27 of the 32 µs left."""
SETTLED = 0.01
"""Share of a step that may be left at a chip's first sample; as firmware/analog has it."""
FIRST_SAMPLE = 1 / 8
"""Place of the first sample in a chip: the first of four."""


@dataclass(frozen=True, slots=True)
class PassiveLine:
    """The parts: Ω, V. supply_v: of Rb and the digitizer. node_supply_v: of the nodes' pins."""

    nodes: int
    input_ohm: float
    bias_ohm: float = BIAS_OHM
    supply_v: float = 3.3
    node_supply_v: float = 3.3
    adc_volts: float = 3.3
    adc_bits: int = 12

    @property
    def load(self) -> float:
        """Return G/g: the two resistors, in pins."""
        return 2 * self.input_ohm / self.bias_ohm

    def amplitude_v(self, talking: int) -> float:
        """Return A, one node on the line, while so many drive it."""
        return self.node_supply_v / 2 / (self.load + talking)

    @property
    def mean_amplitude_v(self) -> float:
        """Return the middle between A of one node alone and A of all."""
        return (self.amplitude_v(1) + self.amplitude_v(self.nodes)) / 2

    @property
    def shift_v(self) -> float:
        """Return the largest constant that speaking nodes add: that of all of them."""
        high_v = (self.node_supply_v - self.supply_v) / 2
        return high_v * self.nodes / (self.load + self.nodes)

    @property
    def range_v(self) -> tuple[float, float]:
        """Return the line with all pins low, and with all high."""
        middle_v = self.supply_v / 2 + self.shift_v
        swing_v = self.nodes * self.amplitude_v(self.nodes)
        return middle_v - swing_v, middle_v + swing_v

    @property
    def count_v(self) -> float:
        """Return one count of the converter."""
        return self.adc_volts / (1 << self.adc_bits)

    @property
    def usual_f(self) -> float:
        """Return the capacitance of all pins and 2 m of wire, F."""
        return WIRE_F + self.nodes * PIN_F

    def unsettled(self, chip_s: float) -> float:
        """Return the share of a step left at the first sample, with all pins and 2 m of wire."""
        line_s = self.bias_ohm / 2 * self.usual_f
        return math.exp(-FIRST_SAMPLE * chip_s / line_s)

    @property
    def lowest_v(self) -> float:
        """Return the lowest line that pins make: all low, supply and resistors at their limits."""
        up, down = 1 / (1 + RESISTORS), 1 / (1 - RESISTORS)
        pins = self.nodes * self.bias_ohm / (self.input_ohm * (1 - RESISTORS))
        return LEAST_SUPPLY * self.supply_v * up / (up + down + pins)

    def poles_s(self, wire_f: float) -> tuple[float, float]:
        """Return the time constants of the line and of a node's pins behind Rin."""
        line_f = wire_f + self.nodes * LISTEN_F
        return self.bias_ohm / 2 * line_f, self.input_ohm * LISTEN_F

    def later_s(self, wire_f: float) -> float:
        """Return the time from a sync pulse's end until every node sees it, at most."""
        rest_v = LEAST_SUPPLY * self.supply_v / 2
        return -math.log(1 - THRESHOLD_V / rest_v) * sum(self.poles_s(wire_f))


def check_pulled(line: PassiveLine, wire_f: float) -> None:
    """Raise SpecError, naming value, limit and cause, where sync pulses on the line do not work."""
    if line.lowest_v < THRESHOLD_V:
        raise SpecError(
            f"{line.nodes} pins of {line.input_ohm:g} Ω that are low take the line to "
            f"{line.lowest_v:.2f} V at {LEAST_SUPPLY * line.supply_v:.1f} V, and with sync_wire "
            f"'data' {THRESHOLD_V:g} V may be a pulse: use a larger input_ohm or a smaller bias_ohm"
        )
    if (later_s := line.later_s(wire_f)) > MOST_LATER_S:
        raise SpecError(
            f"with sync_wire 'data' nodes see a pulse end {later_s * 1e6:.2g} µs late; it must be "
            f"within {MOST_LATER_S * 1e6:g} µs, or they take it for a longer one: "
            f"{line.bias_ohm / 2:g} Ω charge {wire_f * 1e9:.3g} nF of wire: use a smaller bias_ohm"
        )


def passive_line(spec: FrameSpec, **values: float | None) -> PassiveLine:
    """Design the line for a skin. values: fields of PassiveLine that are given; None: chosen.

    Raises SpecError, naming value, limit and cause, where it takes an amplifier.
    """
    given = {name: value for name, value in values.items() if value is not None}
    for name in ("input_ohm", "bias_ohm"):
        check_limits(name, given.get(name, BIAS_OHM), 100.0, 1e7, "resistors for a pin")
    for name in ("supply_v", "node_supply_v", "adc_volts"):
        check_limits(
            name, given.get(name, 3.3), 1.8, 5.5, "what nodes and digitizers of this kind stand"
        )
    if spec.drive != BIPOLAR:
        raise SpecError(f"drive is {spec.drive!r}, but nodes that release their pins are {BIPOLAR}")
    if "input_ohm" not in given:
        least_ohm = spec.nodes * given.get("bias_ohm", BIAS_OHM) / 2 / LOAD
        decade = 10.0 ** (math.floor(math.log10(least_ohm)) - 1)
        given["input_ohm"] = min(v * decade for v in E6 if v * decade >= least_ohm * (1 - 1e-9))
    line = PassiveLine(spec.nodes, **given)  # type: ignore[arg-type]
    needs = "take an amplifier (make amplifier)"
    if (counts := line.amplitude_v(spec.nodes) / line.count_v) < LEAST_COUNTS:
        raise SpecError(
            f"{spec.nodes} nodes of {line.input_ohm:g} Ω add {counts:.2g} counts of the converter "
            f"each; {LEAST_COUNTS:g} or more are needed: {needs}"
        )
    low_v, high_v = line.range_v
    if low_v < 0 or high_v > line.adc_volts:
        raise SpecError(
            f"the line would reach {low_v:.2f} to {high_v:.2f} V, the converter reads 0 to "
            f"{line.adc_volts:g} V: use a larger input_ohm"
        )
    if line.unsettled(spec.chip_s) > SETTLED:
        raise SpecError(
            f"the line does not settle in an eighth of a chip of {spec.chip_s * 1e6:.3g} µs: use a "
            f"smaller bias_ohm or longer chips, or {needs}"
        )
    return line
