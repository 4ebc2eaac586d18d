# SPDX-License-Identifier: Apache-2.0

"""The analog front end between the nodes' pins and the digitizer: values of its parts.

    pin ──Rin──┬── … all nodes: the line
               ├── Rf ∥ Cf ──┐
               └─▶ −         │
      half the supply ──▶ + amplifier ┴──R──┬──▶ converter
                                            C

The amplifier holds the line at half the supply S, so a pin that is high or low sends ±S/2/Rin into
it, and a released one nothing. Its output is half the supply, minus Rf/Rin times the sum of all
node levels: the polarity is −1, and A = node level · Rf/Rin, with a level of S/2. A pin that is
released keeps its charge, which leaves through Rin: a tail of PIN_F·Rin, after a node's last chip.

The paper's circuit (Liu et al. 2025, Fig. 4) is the other one, PAPER: a follower at every node

    pin ──R1──┬──▶ follower ──Rin── line
              ├──Rb── supply
              └──Rb── ground

which rests at half the supply, plus or minus a node level of 0.3 V. It leaves no tail, and wants
more of the amplifier, since the same A takes a larger Rf/Rin.

The noise gain 1 + n·Rf/Rin divides an amplifier's bandwidth. Where that leaves too little, nodes
are wired in groups with an amplifier each, and another one adds up these, through Rg each, with
Rs ∥ Cs: it inverts once more, so the polarity is +1, and A = node level · Rf/Rin · Rs/Rg.

The sum of n nodes with random row signs has a peak of CREST·√n·A in the scenes that occur
(test_amplifier.py), with natural signs n·A. A is as large as the converter has room for that,
with a margin for the rest of the line, which parts are not exact enough to keep at half the supply.
`make spice` simulates the circuit; its figures are in docs/results.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from tactile_cdma.base.errors import SpecError, check_limits
from tactile_cdma.code.frame import BIPOLAR, DEFAULT_AMPLITUDE_V, FrameSpec
from tactile_cdma.framing.load import capacity
from tactile_cdma.hardware.passive import PIN_F, WIRE_F

DIRECT, PAPER = "direct", "paper"
CIRCUITS = (DIRECT, PAPER)
"""Between a node's pin and the line: a resistor, or the paper's attenuator and follower."""
CREST = 5.5
"""Peak of the sum in √n·A with random signs: above that of all simulated scenes (5.4)."""
RAIL_V = 0.05
"""Distance that a rail-to-rail output keeps from its rails, V; chosen."""
NODE_LEVEL_V = DEFAULT_AMPLITUDE_V
"""Level of a node behind its follower, V: the paper's; small, for the follower's range and slew."""
SUM_OHMS = (2e3, 1e3, 510.0)
"""Rf of nodes without followers, Ω: the first, or where the wire's capacitance makes its amplifier
too fast a lower one. Chosen: an output drives them, and they take a large Cf, to which wire and
disturbances on the line matter little, and small Rin, through which released pins soon settle."""
NODE_F = 2e-12
"""Capacitance of every node's copper on the line, F; of its wire: WIRE_F."""
GROUP_NODES = 72
"""Nodes of a group at most. Chosen: nine strips of 8, for a regulator of 1 A and a sync buffer."""
SETTLED = 0.01
"""Share of a step that may be left when the first sample of a chip is taken; chosen."""
ADC_HZ = 500e3
"""Samples per second at most of the usual digitizer: an RP2040's converter."""
LEAST_SAMPLES = 4
"""Fewest samples of a chip that is long enough for them: the digitizer sends their mean. Of a
shorter chip it takes a single sample, late (firmware/core/setup.h)."""
LATE_SAMPLE = 7 / 8
"""Place in a chip of its only sample."""
LOOP_GAIN = 10.0
"""Loop gain of an amplifier at the corner of the feedback, so that parts set the corner. Chosen."""
MOST_GAIN_BANDWIDTH_HZ = 80e6
"""Gain-bandwidth of an amplifier above which nodes are wired in groups. Chosen: with a margin for
cheap ones of the kind (100 MHz at 3.3 V, rail to rail, unity-gain stable: TLV3541)."""
INPUT_F = 8e-12
"""Capacitance at a follower's input with its copper and the released pin, F: data sheets give 3 to
6 pF for the op-amp; the rest is chosen."""
TOLERANCE, BIAS_TOLERANCE = 0.01, 0.001
"""Tolerances of resistors, and of the two that make half the supply for an amplifier's + input: its
noise gain multiplies their error."""
SIGMAS = 3.0
"""Standard deviations of the rest of the line that the range leaves room for; chosen."""
E24 = (  # of the resistors; capacitors have every other value
    *(10, 11, 12, 13, 15, 16, 18, 20, 22, 24, 27, 30),
    *(33, 36, 39, 43, 47, 51, 56, 62, 68, 75, 82, 91),
)
E12 = E24[::2]
E96 = tuple(round(100 * 10 ** (step / 96)) for step in range(96))
"""Three digits: of Rin without followers, as usual for resistors of 1 %."""
EXACT = 1 + 1e-9
"""Forgives rounding where values of a series are compared."""
LEAST_USED = 1 / 4
"""Share of the room that the sum of all nodes has to reach. Chosen: two bits of the converter."""
FINE = 1e-3
"""Share of the room to which its use is found: far finer than neighbours in E24."""
FILTER_OHM = 300.0
"""Least resistance of the filter, Ω, an easy load for the amplifier; the design stays below ten
times that, for the converter. Chosen."""


@dataclass(frozen=True, slots=True)
class Stage:
    """Adds up its inputs: Ω, F. wire_f: capacitance of what its summing point is wired to.

    speed: of its amplifier, over what chips need.
    """

    inputs: int
    input_ohm: float
    feedback_ohm: float
    feedback_f: float
    wire_f: float
    speed: float = 1.0

    @property
    def gain(self) -> float:
        """Return the gain of one input: Rf/Rin, or Rs/Rg."""
        return self.feedback_ohm / self.input_ohm

    @property
    def noise_gain(self) -> float:
        """Return the factor to the amplifier's own offset and noise."""
        return 1 + self.inputs * self.gain

    @property
    def corner_hz(self) -> float:
        """Return the corner of the feedback, Hz."""
        return 1 / (2 * math.pi * self.feedback_ohm * self.feedback_f)

    @property
    def gain_bandwidth_hz(self) -> float:
        """Return the least gain-bandwidth of the amplifier, Hz.

        At the corner, inputs and wire divide it by |1 + (n·Rf/Rin + j·wire/Cf)/(1 + j)|, and that
        is at most 1 + the larger one of the two.
        """
        divisor = max(self.noise_gain, 1 + self.wire_f / self.feedback_f)
        return self.speed * LOOP_GAIN * divisor * self.corner_hz


@dataclass(frozen=True, slots=True)
class Attenuator:
    """Holds what a node of the paper's circuit has before its follower: R1 and Rb, Ω."""

    series_ohm: float
    bias_ohm: float

    @property
    def share(self) -> float:
        """Return the share of the pin's swing at the follower."""
        return self.bias_ohm / (2 * self.series_ohm + self.bias_ohm)

    @property
    def time_s(self) -> float:
        """Time constant of the follower's input."""
        return INPUT_F / (1 / self.series_ohm + 2 / self.bias_ohm)


@dataclass(frozen=True)
class FrontEnd:
    """Holds the parts, and what follows from them, named as in the drawing above; Ω, F, V, s, Hz.

    talking: nodes that may send at once. room_v: largest swing of the output about its rest.
    nodes_stage: adds up nodes, all or those of a group. groups_stage: adds up groups, if there are
    any. sample_s: from a chip's begin to its first sample. attenuator: of the paper's circuit.
    """

    nodes: int
    talking: int
    supply_v: float
    adc_volts: float
    adc_bits: int
    room_v: float
    nodes_stage: Stage
    groups_stage: Stage | None
    filter_ohm: float
    filter_f: float
    sample_s: float
    attenuator: Attenuator | None

    @property
    def stages(self) -> tuple[Stage, ...]:
        """Return the amplifiers between a node and the converter."""
        return (self.nodes_stage, *([self.groups_stage] if self.groups_stage else []))

    @property
    def groups(self) -> int:
        """Return the number of groups that nodes are wired in."""
        return self.groups_stage.inputs if self.groups_stage else 1

    @property
    def polarity(self) -> int:
        """Tell whether the line rises (1) or falls (−1) with a pin."""
        return 1 if self.groups_stage else -1

    @property
    def node_level_v(self) -> float:
        """Tell what a high pin adds to half the supply before Rin."""
        return self.supply_v / 2 * (self.attenuator.share if self.attenuator else 1)

    @property
    def tail_s(self) -> float:
        """Time constant with which a released pin's level leaves the line; 0 with followers."""
        return 0.0 if self.attenuator else PIN_F * self.nodes_stage.input_ohm

    @property
    def gain(self) -> float:
        """Return the gain from a node's level to the converter."""
        return math.prod(stage.gain for stage in self.stages)

    @property
    def amplitude_v(self) -> float:
        """Return A, one node on the digitized line."""
        return self.node_level_v * self.gain

    @property
    def room(self) -> float:
        """Return the room in units of A: so many nodes may agree."""
        return self.room_v / self.amplitude_v

    @property
    def full_scale(self) -> float:
        """Return the room in units of √n·A, n nodes talking."""
        return self.room / math.sqrt(self.talking)

    @property
    def filter_hz(self) -> float:
        """Return the corner of the filter behind the amplifiers, Hz."""
        return 1 / (2 * math.pi * self.filter_ohm * self.filter_f)

    @property
    def slew_v_per_s(self) -> float:
        """Return the least slew rate: end to end in one time constant of the feedback."""
        last = self.stages[-1]
        return 2 * self.room_v * last.speed * 2 * math.pi * last.corner_hz

    @property
    def half_tolerance(self) -> float:
        """Return the tolerance of the two resistors that make half the supply."""
        return half_tolerance(self.attenuator)

    @property
    def follower_bandwidth_hz(self) -> float:
        """Return the least gain-bandwidth of a follower, Hz, where there are any."""
        return LOOP_GAIN * self.nodes_stage.corner_hz

    @property
    def follower_slew_v_per_s(self) -> float:
        """Return the least slew rate of a follower: a step in half a time constant.

        With a whole one, 1.0 % of a step is left at 16 nodes' first sample, so 0.8 % (make spice).
        """
        return 2 * 2 * self.node_level_v * 2 * math.pi * self.nodes_stage.corner_hz

    @cached_property
    def unsettled(self) -> float:
        """Return the share of a step left at a chip's first sample by parts as slow as allowed."""
        poles = [self.filter_ohm * self.filter_f]
        if self.attenuator:
            poles += [self.attenuator.time_s, 1 / (2 * math.pi * self.follower_bandwidth_hz)]
        for stage in self.stages:
            feedback_s = stage.feedback_ohm * stage.feedback_f
            poles += [feedback_s, feedback_s / LOOP_GAIN]
        return step_left(self.sample_s, poles)

    @property
    def count_v(self) -> float:
        """Return one count of the converter, V."""
        return self.adc_volts / (1 << self.adc_bits)


def design(
    spec: FrameSpec,
    samples_per_chip: int,
    *,
    supply_v: float = 3.3,
    adc_volts: float = 3.3,
    adc_bits: int = 12,
    adc_hz: float = ADC_HZ,
    active: float | None = None,
    circuit: str = DIRECT,
) -> FrontEnd:
    """Design the front end for a skin. circuit: of CIRCUITS.

    active: largest share of the nodes that talk at once; None: all, or of sparse codes as many as a
    frame holds.

    supply_v: of nodes and amplifier. adc_volts: the converter's range is 0…adc_volts. adc_hz: its
    samples per second at most; of shorter chips fewer are taken than asked for.

    Raises SpecError, naming value, limit and cause.
    """
    check_limits("supply_v", supply_v, 1.8, 5.5, "what nodes and amplifiers of this kind stand")
    check_limits("adc_volts", adc_volts, 0.1, 10.0, "what converters have")
    check_limits("adc_bits", adc_bits, 4, 24, "what converters have")
    check_limits("adc_hz", adc_hz, 1.0, 1e9, "what converters have")
    if active is None:
        active = capacity(spec) / spec.nodes
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
    attenuator = _attenuator(2 * NODE_LEVEL_V / supply_v) if circuit == PAPER else None
    sample_s = first_sample_s(spec.chip_s, samples_per_chip, adc_hz)
    stages, tau = _within(room_v, spec, active, supply_v, sample_s, attenuator)
    filter_f = 10.0 ** math.floor(math.log10(tau / FILTER_OHM))
    return FrontEnd(
        nodes=spec.nodes,
        talking=talking,
        supply_v=supply_v,
        adc_volts=adc_volts,
        adc_bits=adc_bits,
        room_v=room_v - _margin_v(stages, supply_v, attenuator),
        nodes_stage=stages[0],
        groups_stage=stages[1] if len(stages) > 1 else None,
        filter_ohm=_below(tau / filter_f),
        filter_f=filter_f,
        sample_s=sample_s,
        attenuator=attenuator,
    )


def first_sample_s(chip_s: float, samples_per_chip: int, adc_hz: float = ADC_HZ) -> float:
    """Tell when the first sample of a chip is taken, s after it begins."""
    most = int(chip_s * adc_hz * EXACT)
    if most < LEAST_SAMPLES:
        return LATE_SAMPLE * chip_s
    return chip_s / (2 * min(max(samples_per_chip, LEAST_SAMPLES), most))


def step_left(t_s: float, poles_s: Sequence[float]) -> float:
    """Return the share of a step that low passes in a row, of these time constants, have left.

    By partial fractions: Σ e^(−t/τᵢ) · Πⱼ τᵢ/(τᵢ − τⱼ).
    """
    # equal ones are moved apart, by far less than parts are accurate to
    tau = np.array(poles_s) * (1 + 1e-3 * np.arange(len(poles_s)))
    ratio = 1 - tau[None, :] / tau[:, None]
    np.fill_diagonal(ratio, 1.0)
    return float(np.sum(np.exp(-t_s / tau) / ratio.prod(axis=1)))


@cache
def low_pass_s(sample_s: float, stages: int, attenuator: Attenuator | None) -> float:
    """Time constant of each feedback and of the filter with which a step settles in time, s.

    With followers, if any, and amplifiers that are LOOP_GAIN times as fast. Raises SpecError where
    an attenuator leaves no time.
    """
    amplifiers, others = (stages + 1, [attenuator.time_s]) if attenuator else (stages, [])

    def left(tau: float) -> float:
        low_passes = [tau] * (stages + 1) + [tau / LOOP_GAIN] * amplifiers
        return step_left(sample_s, [*others, *low_passes])

    low, high = 1e-3 * sample_s, sample_s
    if attenuator and left(low) > SETTLED:
        raise SpecError(
            f"the first sample of a chip is taken after {sample_s * 1e6:.3g} µs, in which the "
            f"followers' inputs, with {attenuator.time_s * 1e9:.0f} ns, don't settle: use longer "
            "chips"
        )
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if left(middle) < SETTLED else (low, middle)
    return low


def half_tolerance(attenuator: Attenuator | None) -> float:
    """Return the tolerance of the resistors that make half the supply: 1 % at small noise gains."""
    return BIAS_TOLERANCE if attenuator else TOLERANCE


def rest_deviation_v(
    stages: Sequence[Stage], supply_v: float, attenuator: Attenuator | None
) -> float:
    """Return the deviation of the output's rest, V, RMS: of dividers within tolerance.

    Two resistors with errors uniform in ±t shift a supply's half by S/4·√2·t/√3. Pins have the
    whole supply, which has no such error.
    """

    def divider_v(tolerance: float) -> float:
        return supply_v / 4 * math.sqrt(2 / 3) * tolerance

    deviation = divider_v(TOLERANCE) if attenuator else 0.0  # of a node
    for stage in stages:
        inputs = stage.gain * math.sqrt(stage.inputs) * deviation
        half = stage.noise_gain * divider_v(half_tolerance(attenuator))
        deviation = math.hypot(inputs, half)
    return deviation


def _margin_v(stages: Sequence[Stage], supply_v: float, attenuator: Attenuator | None) -> float:
    return SIGMAS * rest_deviation_v(stages, supply_v, attenuator)


def _within(
    room_v: float,
    spec: FrameSpec,
    active: float,
    supply_v: float,
    sample_s: float,
    attenuator: Attenuator | None,
) -> tuple[list[Stage], float]:
    """Find the stages of the largest swing that leaves their own margin free, by bisection.

    A larger gain takes a larger margin: most of the room, where few of many nodes talk. It needs
    faster amplifiers, too. Raises SpecError where LEAST_USED needs too fast ones.
    """
    level_v = supply_v / 2 * (attenuator.share if attenuator else 1)
    low_v, high_v = 0.0, room_v
    best: tuple[list[Stage], float] | None = None
    while high_v - low_v > FINE * room_v:
        swing_v = (low_v + high_v) / 2
        found = _stages(spec, active, swing_v / level_v, sample_s, attenuator)
        if found and swing_v + _margin_v(found[0], supply_v, attenuator) <= room_v:
            low_v, best = swing_v, found
        else:
            high_v = swing_v
    talking = math.ceil(active * spec.nodes)
    all_v = low_v * largest_sum(spec, spec.nodes) / largest_sum(spec, talking)
    if best is None or all_v < LEAST_USED * room_v:
        raise SpecError(
            f"with a sample {sample_s * 1e6:.3g} µs after a chip's begin, even groups of few nodes "
            f"need amplifiers of more than {MOST_GAIN_BANDWIDTH_HZ / 1e6:g} MHz: use longer chips"
        )
    return best


def _stages(
    spec: FrameSpec, active: float, level: float, sample_s: float, attenuator: Attenuator | None
) -> tuple[list[Stage], float] | None:
    """Design amplifiers, and the time constant of each. level: the room in units of a node's level.

    Nodes are divided into as few groups of up to GROUP_NODES, else larger ones, as an amplifier of
    MOST_GAIN_BANDWIDTH_HZ allows; None where it allows no number of groups.
    """
    tau = low_pass_s(sample_s, 1, attenuator)
    gain = level / largest_sum(spec, math.ceil(active * spec.nodes))
    whole = _nodes_stage(spec.nodes, gain, tau, attenuator)
    if whole.gain_bandwidth_hz <= MOST_GAIN_BANDWIDTH_HZ:
        return [whole], tau
    tau = low_pass_s(sample_s, 2, attenuator)
    least = max(2, -(-spec.nodes // GROUP_NODES))
    for groups in (*range(least, spec.nodes + 1), *range(2, least)):
        size = -(-spec.nodes // groups)
        group_gain = level / largest_sum(spec, math.ceil(active * size))
        first = _nodes_stage(size, group_gain, tau, attenuator)
        count = -(-spec.nodes // size)
        second = _stage(count, _summing(gain / first.gain), tau, count * NODE_F)
        if max(first.gain_bandwidth_hz, second.gain_bandwidth_hz) <= MOST_GAIN_BANDWIDTH_HZ:
            return [first, second], tau
    return None


def largest_sum(spec: FrameSpec, talking: int) -> float:
    """Return the largest sum of so many nodes, in units of one."""
    if spec.sign_seed is None:
        return float(talking)
    return min(float(talking), CREST * math.sqrt(talking))


def _nodes_stage(nodes: int, gain: float, tau: float, attenuator: Attenuator | None) -> Stage:
    wire_f = WIRE_F + nodes * NODE_F
    if attenuator:
        return _stage(nodes, _summing(gain), tau, wire_f)
    for ohm in SUM_OHMS if nodes <= GROUP_NODES else SUM_OHMS[:1]:
        stage = _stage(nodes, (_above(ohm / gain, E96), ohm), tau, wire_f)
        if stage.gain_bandwidth_hz <= MOST_GAIN_BANDWIDTH_HZ:
            break
    return stage


def _stage(inputs: int, ohms: tuple[float, float], tau: float, wire_f: float) -> Stage:
    return Stage(inputs, *ohms, _below(tau / ohms[1], E12), wire_f)


def _attenuator(share: float) -> Attenuator:
    """Choose R1 and Rb that leave the share of a pin's swing that is nearest to this one.

    Rb is 10 to 22 kΩ: little current, and fast with a follower's input capacitance.
    """
    return min(
        (
            Attenuator(1e3 * series, 1e3 * bias)
            for bias in E24
            if bias <= 22
            for series in _decades(10, 2)
        ),
        key=lambda parts: abs(parts.share - share),
    )


def _summing(gain: float) -> tuple[float, float]:
    """Choose Rin and Rf, Ω, with the largest ratio Rf/Rin up to this gain.

    The smaller one is 2 to 4.3 kΩ: an output drives it, and wire capacitance matters little.
    """
    small = [100.0 * value for value in E24 if 20 <= value <= 43]
    if gain <= 1:
        pairs = [(_above(ohm / gain), ohm) for ohm in small]
    else:
        pairs = [(ohm, _below(ohm * gain)) for ohm in small]
    return max(pairs, key=lambda pair: pair[1] / pair[0])


def _decades(first: float, count: int) -> list[float]:
    """Return the values of E24 in so many decades from the first one on."""
    return [value * first / 10 * 10.0**decade for decade in range(count) for value in E24]


def _below(value: float, series: Sequence[int] = E24) -> float:
    """Return the largest value of a series up to this one."""
    decade = _decade(value)
    return max(part * decade for part in series if part * decade <= value * EXACT)


def _above(value: float, series: Sequence[int] = E24) -> float:
    """Return the smallest value of a series from this one on."""
    decade = _decade(value) * 10 / series[0]
    parts = (*series, 10 * series[0])
    return min(part * decade for part in parts if part * decade * EXACT >= value)


def _decade(value: float) -> float:
    """Return the factor to the two digits of a series, for values about this one."""
    return float(10.0 ** (math.floor(math.log10(value * EXACT)) - 1))
