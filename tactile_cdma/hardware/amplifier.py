# SPDX-License-Identifier: Apache-2.0

"""The analog front end between the nodes' pins and the digitizer: values of its parts.

    pin ──R1──┬──▶ follower ──Rin──┬── … all nodes: the line
              ├──Rb── supply       │
              └──Rb── ground       ├── Rf ∥ Cf ──┐
                                   └─▶ −         │
                 half the supply ────▶ + amplifier ┴──R──┬──▶ converter
                                                         C

A pin that is high, low or released puts the follower at half the supply plus, minus or no node
level: Liu et al. 2025, Fig. 4, where the reference that a released pin rests at is two resistors at
every node, so that no wire is needed for it. The amplifier holds the line at half the supply and
adds up the nodes' currents. Its output is half the supply, minus Rf/Rin times the sum of all node
levels: the polarity is −1, and A = node level · Rf/Rin.

The sum of n nodes with random row signs has a peak of CREST·√n·A in the scenes that occur
(`benchmarks/crest.py`), with natural signs n·A. A is as large as the converter has room for that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ..base.errors import SpecError, check_limits
from ..code.frame import BIPOLAR, DEFAULT_AMPLITUDE_V, FrameSpec

CREST = 5.5
"""Peak of the sum in √n·A with random signs: above all that bench-crest has seen (5.4)."""
RAIL_V = 0.05
"""Distance that a rail-to-rail output keeps from its rails, V; chosen."""
NODE_LEVEL_V = DEFAULT_AMPLITUDE_V
"""Level of a node behind its follower, V: the paper's; small, for the follower's range and slew."""
SETTLED = 0.01
"""Share of a step that may be left when the first sample of a chip is taken; chosen."""
SETTLING = 6.638
"""Time constants in which two equal low passes settle to that: (1 + x)·e⁻ˣ = SETTLED."""
LEAST_SAMPLES = 4
"""Samples of a chip at least: a digitizer that sends one mean per chip takes several for it."""
LOOP_GAIN = 10.0
"""Of an amplifier at the corner of the feedback, so that the parts set the corner; chosen."""
E24 = (  # of the resistors; capacitors have every other value
    *(10, 11, 12, 13, 15, 16, 18, 20, 22, 24, 27, 30),
    *(33, 36, 39, 43, 47, 51, 56, 62, 68, 75, 82, 91),
)
E12 = E24[::2]
EXACT = 1 + 1e-9
"""Forgives rounding where values of a series are compared."""
FILTER_OHM = 300.0
"""Least resistance of the filter, Ω, an easy load for the amplifier; the design stays below ten
times that, for the converter. Chosen."""


@dataclass(frozen=True, slots=True)
class FrontEnd:
    """The parts, and what follows from them. Names as in the drawing above; Ω, F, V, s, Hz.

    talking: nodes that may send at once. room_v: largest swing of the output about its rest.
    """

    nodes: int
    talking: int
    supply_v: float
    adc_volts: float
    adc_bits: int
    room_v: float
    series_ohm: float
    bias_ohm: float
    input_ohm: float
    feedback_ohm: float
    feedback_f: float
    filter_ohm: float
    filter_f: float

    @property
    def node_level_v(self) -> float:
        """What a high pin adds to the rest of its follower."""
        bias = self.bias_ohm / 2
        return self.supply_v / 2 * bias / (self.series_ohm + bias)

    @property
    def gain(self) -> float:
        """Rf/Rin."""
        return self.feedback_ohm / self.input_ohm

    @property
    def amplitude_v(self) -> float:
        """A, one node on the digitized line."""
        return self.node_level_v * self.gain

    @property
    def noise_gain(self) -> float:
        """Factor to the amplifier's own offset and noise, and divisor of its bandwidth."""
        return 1 + self.nodes * self.gain

    @property
    def room(self) -> float:
        """Room in units of A: so many nodes may agree."""
        return self.room_v / self.amplitude_v

    @property
    def full_scale(self) -> float:
        """Room in units of √n·A, n nodes talking."""
        return self.room / math.sqrt(self.talking)

    @property
    def corner_hz(self) -> float:
        """Corner of the amplifier's feedback."""
        return 1 / (2 * math.pi * self.feedback_ohm * self.feedback_f)

    @property
    def filter_hz(self) -> float:
        """Corner of the filter behind it."""
        return 1 / (2 * math.pi * self.filter_ohm * self.filter_f)

    @property
    def gain_bandwidth_hz(self) -> float:
        """Least gain-bandwidth of the amplifier."""
        return LOOP_GAIN * self.noise_gain * self.corner_hz

    @property
    def slew_v_per_s(self) -> float:
        """Least slew rate of the amplifier: end to end in one time constant of the feedback."""
        return 2 * self.room_v * 2 * math.pi * self.corner_hz

    @property
    def follower_bandwidth_hz(self) -> float:
        """Least gain-bandwidth of a follower."""
        return LOOP_GAIN * self.corner_hz

    @property
    def follower_slew_v_per_s(self) -> float:
        """Least slew rate of a follower."""
        return 2 * self.node_level_v * 2 * math.pi * self.corner_hz

    @property
    def count_v(self) -> float:
        """One count of the converter."""
        return self.adc_volts / (1 << self.adc_bits)


def design(
    spec: FrameSpec,
    samples_per_chip: int,
    *,
    supply_v: float = 3.3,
    adc_volts: float = 3.3,
    adc_bits: int = 12,
    active: float = 1.0,
) -> FrontEnd:
    """The front end for a skin. active: largest share of the nodes that talk at once.

    supply_v: of nodes and amplifier. adc_volts: the converter's range is 0…adc_volts.

    Raises SpecError, naming value, limit and cause.
    """
    check_limits("supply_v", supply_v, 1.8, 5.5, "what nodes and amplifiers of this kind stand")
    check_limits("adc_volts", adc_volts, 0.1, 10.0, "what converters have")
    check_limits("adc_bits", adc_bits, 4, 24, "what converters have")
    check_limits("active", active, 1e-6, 1.0, "it is a share of the nodes")
    if spec.drive != BIPOLAR:
        raise SpecError(f"drive is {spec.drive!r}, but nodes that rest at mid-supply are {BIPOLAR}")
    rest_v = supply_v / 2
    room_v = min(rest_v - RAIL_V, min(supply_v - RAIL_V, adc_volts) - rest_v)
    if room_v < supply_v / 10:
        raise SpecError(
            f"adc_volts is {adc_volts:g} V, but the line rests at {rest_v:g} V, half the supply, "
            f"and needs {supply_v / 10:g} V or more on either side: use a lower supply_v"
        )
    talking = math.ceil(active * spec.nodes)
    peak = float(talking)
    if spec.sign_seed is not None:
        peak = min(peak, CREST * math.sqrt(talking))
    series_ohm, bias_ohm = _attenuator(2 * NODE_LEVEL_V / supply_v)
    level_v = supply_v * bias_ohm / (4 * series_ohm + 2 * bias_ohm)
    input_ohm, feedback_ohm = _summing(room_v / peak / level_v)
    samples = max(samples_per_chip, LEAST_SAMPLES)
    low_pass_s = spec.chip_s / (2 * samples) / SETTLING  # the first sample is half a period in
    filter_f = 10.0 ** math.floor(math.log10(low_pass_s / FILTER_OHM))
    return FrontEnd(
        nodes=spec.nodes,
        talking=talking,
        supply_v=supply_v,
        adc_volts=adc_volts,
        adc_bits=adc_bits,
        room_v=room_v,
        series_ohm=series_ohm,
        bias_ohm=bias_ohm,
        input_ohm=input_ohm,
        feedback_ohm=feedback_ohm,
        feedback_f=_below(low_pass_s / feedback_ohm, E12),
        filter_ohm=_below(low_pass_s / filter_f),
        filter_f=filter_f,
    )


def _attenuator(share: float) -> tuple[float, float]:
    """R1 and Rb, Ω, that leave the share of a pin's swing that is nearest to this one.

    Rb is 10 to 22 kΩ: little current, and fast with a follower's input capacitance.
    """
    return min(
        ((1e3 * series, 1e3 * bias) for bias in E24 if bias <= 22 for series in _decades(10, 2)),
        key=lambda pair: abs(pair[1] / (2 * pair[0] + pair[1]) - share),
    )


def _summing(gain: float) -> tuple[float, float]:
    """Rin and Rf, Ω, with the largest ratio Rf/Rin up to this gain.

    The smaller one is 2 to 4.3 kΩ: an output drives it, and wire capacitance matters little.
    """
    small = [100.0 * value for value in E24 if 20 <= value <= 43]
    if gain <= 1:
        pairs = [(_above(ohm / gain), ohm) for ohm in small]
    else:
        pairs = [(ohm, _below(ohm * gain)) for ohm in small]
    return max(pairs, key=lambda pair: pair[1] / pair[0])


def _decades(first: float, count: int) -> list[float]:
    """The values of E24 in so many decades from the first one on."""
    return [value * first / 10 * 10.0**decade for decade in range(count) for value in E24]


def _below(value: float, series: Sequence[int] = E24) -> float:
    """The largest value of a series up to this one."""
    decade = _decade(value)
    return max(part * decade for part in series if part * decade <= value * EXACT)


def _above(value: float) -> float:
    """The smallest value of E24 from this one on."""
    decade = _decade(value)
    return min(part * decade for part in (*E24, 100) if part * decade * EXACT >= value)


def _decade(value: float) -> float:
    """Factor to the two digits of a series, for values about this one."""
    return float(10.0 ** (math.floor(math.log10(value * EXACT)) - 1))
