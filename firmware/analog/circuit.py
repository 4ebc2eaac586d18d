# SPDX-License-Identifier: Apache-2.0

"""The analog chain as a netlist for ngspice: firmware/README.md's circuit, from pin to converter.

Op-amps have the slowest bandwidth and slew rate that `make amplifier` allows, a second pole at
SECOND_POLE times their bandwidth, an output resistance, input capacitances and voltage noise, and
leave a rail as fast as real ones; wires have capacitance.

Nodes that are alike and linear are lumped exactly: the current of n pins, or followers, through Rin
each is that of one through Rin/n with the mean of their voltages. So are groups. What slews is not
linear: a follower at its own node's step. So the step of a node, against which settling is judged,
is that of a node by itself. A pin that was released is a source, too: of the charge that it keeps,
while that leaves through Rin.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from amplifier import INPUT_F, FrontEnd, Stage

EDGE_S = 10e-9
"""Rise and fall of a pin, s: an AVR's into some pF."""
PIN_OHM = 30.0
"""Resistance of a pin's driver, Ω: an ATmega328P's at 3.3 V, by its data sheet's curves."""
OUTPUT_OHM = 50.0
"""Output of an op-amp without feedback, Ω. Chosen, like the next one, as is usual of the kind."""
SECOND_POLE = 3.0
"""Frequency of an op-amp's second pole over its gain-bandwidth: a phase margin of 72°."""
OPEN_LOOP = 1e5
OVERDRIVE = 2.36
"""Inner voltage of an op-amp whose output is at a rail, over half the supply. Without this limit
the model would wind up for as long, as no real one does; with it it is off its rail after 0.6 µs at
7 V/µs (data sheets: OPA323 0.13, OPA310 0.75, OPA170 2 µs)."""
NOISE_OHM = 3.9e3
"""A resistor whose noise is that of an op-amp's input: 8 nV/√Hz."""
TAIL_STEPS = np.arange(0, 7, 0.125)
"""Points of a released pin's tail, in its time constants: 0.2 % of it off between them."""
HALF_OHM, HALF_F = 10e3, 10e-12
"""Resistance and capacitance of half the supply at an amplifier's + input."""
GUARD_OHM, INPUT_OHM, CLAMP_F = 68.0, 150.0, 3e-12
"""From the line to the digitizer's second clamp, from there to the amplifier's − input, and the
clamp's two diodes. With 120 in place of 150 Ω a discharge of 8 kV is 12 mA in the op-amp's input,
which stands 10 (esd_spice.py); with 82 in place of 68 Ω the line dips deeper in a frame."""
FOLLOWER_F = 3e-12
"""Capacitance of a follower's op-amp at its input, F."""

OPAMP = f"""\
.subckt opamp plus minus out supply bandwidth=1e6 slew=1e6 half=1.65
cplus plus 0 {FOLLOWER_F:g}
cminus minus 0 {FOLLOWER_F:g}
rnoise plus quiet {NOISE_OHM:g}
.param gm={{2*3.14159265358979*bandwidth*1n}}
bgm 0 x i={{slew*1n}}*tanh({{gm/(slew*1n)}}*(v(quiet)-v(minus)))
cx x 0 1n
rx x 0 {{{OPEN_LOOP:g}/gm}}
dtop x top limit
vtop top 0 {{{OVERDRIVE:g}*half}}
dbottom bottom x limit
vbottom bottom 0 {{-{OVERDRIVE:g}*half}}
.model limit d(is=1e-12 n=0.4)
rsecond x y 1k
csecond y 0 {{1/(2*3.14159265358979*{SECOND_POLE:g}*bandwidth*1k)}}
bout o 0 v={{half}}+{{half}}*tanh(v(y)/{{half}})
rout o out {OUTPUT_OHM:g}
.ends
"""


def netlist(front: FrontEnd, level_files: Sequence[str], end_s: float, step_s: float) -> str:
    """Write a transient analysis of a front end whose nodes' levels, −1…1, are in files.

    One file: the mean level of all. Two: that of the first node, and the mean of the others. n:
    that of each, in one group.
    """
    counts = [1.0] * len(level_files)
    counts[-1] += front.nodes / front.groups - len(level_files)
    lines = [f"* {front.nodes} nodes, line, amplifiers, filter", *_head(front)]
    for number, (file, count) in enumerate(zip(level_files, counts, strict=True)):
        lines += [
            f"a{number} %v([level{number}]) levels{number}",
            f'.model levels{number} filesource (file="{file}" amploffset=[0] amplscale=[1])',
            *_node(front, number, f"level{number}", count),
        ]
    half = "".join(f" v({name})={front.supply_v / 2:g}" for name in _amplified(front))
    lines += _summed(front)
    lines += [f".tran {step_s:g} {end_s:g} 0 {step_s:g}", f".nodeset{half}", ".save v(adc)", ".end"]
    return "\n".join([*lines, ""])


def noise_netlist(front: FrontEnd, depth: int, highest_hz: float) -> str:
    """Write an analysis of noise at the converter, 10 Hz to a frequency; it prints onoise_total, V.

    depth: amplifiers, counted from the converter, that are real in one path; one more than there
    are: a follower, too. All other paths end in their resistors. So the difference of two powers is
    what one amplifier, or one follower, adds.
    """
    lines = [f"* noise of {front.nodes} nodes' line", *_head(front), "vrest rest 0 {supply/2}"]
    last = front.groups_stage
    size, node = front.nodes_stage.inputs, len(front.stages)
    lines += [*filter_lines(front), "valone alone 0 dc 0 ac 1"]
    if last is not None:
        lines += stage_lines("out", front, last, "sum")
        alone = depth >= 2
        others = front.groups - alone
        lines.append(f"rgroups rest sum {last.input_ohm / others:g}")
        if alone:
            lines.append(f"rgroup nodes sum {last.input_ohm:g}")
    if last is None or depth >= 2:
        lines += stage_lines("out" if last is None else "nodes", front, front.nodes_stage, "line")
        alone = depth > node
        if size > alone:
            lines.append(f"rothers rest line {front.nodes_stage.input_ohm / (size - alone):g}")
        if alone:
            lines += _node(front, 0, "alone", 1.0)
    return "\n".join(
        [
            *lines,
            f".noise v(adc) valone dec 20 10 {highest_hz:g}",
            ".control",
            "run",
            "print onoise_total",
            "quit",
            ".endc",
            ".end",
            "",
        ]
    )


def _head(front: FrontEnd) -> list[str]:
    return [OPAMP, f".param supply={front.supply_v:g}", "vsupply supply 0 {supply}"]


def _summed(front: FrontEnd) -> list[str]:
    """Write what is from the line to the converter; all groups as one, through Rg/groups."""
    nodes, last, groups = front.nodes_stage, front.groups_stage, front.groups
    lines = filter_lines(front)
    lines.append(f"cline line 0 {nodes.wire_f:g}")
    if last is None:
        return lines + stage_lines("out", front, nodes, "line")
    return [
        *lines,
        *stage_lines("nodes", front, nodes, "line"),
        f"rgroups nodes sum {last.input_ohm / groups:g}",
        f"csum sum 0 {last.wire_f:g}",
        *stage_lines("out", front, last, "sum"),
    ]


def _amplified(front: FrontEnd) -> list[str]:
    """List nodes at half the supply when nobody talks: where ngspice begins to look."""
    followers = ["pins0"] if front.attenuator else []
    return ["out", "adc", "line", *followers, *(["nodes", "sum"] if front.groups_stage else [])]


def filter_lines(front: FrontEnd) -> list[str]:
    """Write the filter from the amplifiers to the converter."""
    return [f"rfilter out adc {front.filter_ohm:g}", f"cfilter adc 0 {front.filter_f:g}"]


def _node(front: FrontEnd, number: int, level: str, count: float) -> list[str]:
    """Write one node for `count` of them: pin, attenuator and follower, if any, Rin/count."""
    n, rin = number, front.nodes_stage.input_ohm / count
    pin = f"bpin{n} pin{n} 0 v={{supply}}/2*(1+v({level}))"
    if front.attenuator is None:
        return [pin, f"rin{n} pin{n} line {rin + PIN_OHM / count:g}"]
    speed = f"bandwidth={front.follower_bandwidth_hz:g} slew={front.follower_slew_v_per_s:g}"
    return [
        pin,
        f"rpin{n} pin{n} driven{n} {PIN_OHM:g}",
        f"rseries{n} driven{n} node{n} {front.attenuator.series_ohm:g}",
        f"rup{n} supply node{n} {front.attenuator.bias_ohm:g}",
        f"rdown{n} node{n} 0 {front.attenuator.bias_ohm:g}",
        f"cnode{n} node{n} 0 {INPUT_F - FOLLOWER_F:g}",
        f"xfollower{n} node{n} pins{n} pins{n} supply opamp {speed} half={front.supply_v / 2:g}",
        f"rin{n} pins{n} line {rin:g}",
    ]


def stage_lines(
    name: str,
    front: FrontEnd,
    stage: Stage,
    summing: str,
    halves_ohm: tuple[float, float] = (HALF_OHM, HALF_OHM),
) -> list[str]:
    """Write a summing amplifier with its output at `name`. halves_ohm: to supply and to ground.

    Where there is one amplifier, as on the digitizer's board, the line's second clamp is before it:
    Rf is at the line, Cf behind GUARD_OHM, so that levels stay as they are, and wire does not load
    the amplifier.
    """
    speed = f"bandwidth={stage.gain_bandwidth_hz:g} slew={front.slew_v_per_s:g}"
    held, minus, guard = summing, summing, []
    if front.groups_stage is None and front.attenuator is None:
        held, minus = f"held{name}", f"minus{name}"
        guard = [
            f"rguard{name} {summing} {held} {GUARD_OHM:g}",
            f"cclamp{name} {held} 0 {CLAMP_F:g}",
            f"rminus{name} {held} {minus} {INPUT_OHM:g}",
        ]
    return [
        *guard,
        f"rup{name} supply half{name} {halves_ohm[0]:g}",
        f"rdown{name} half{name} 0 {halves_ohm[1]:g}",
        f"chalf{name} half{name} 0 {HALF_F:g}",
        f"x{name} half{name} {minus} {name} supply opamp {speed} half={front.supply_v / 2:g}",
        f"rf{name} {name} {summing} {stage.feedback_ohm:g}",
        f"cf{name} {name} {held} {stage.feedback_f:g}",
    ]


def level_points(
    levels: NDArray[np.float64],
    chip_s: float,
    tail_s: float = 0.0,
    released: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Return a file's times and levels (m, 2): steps at the chips' ends, (span,) levels from 0 on.

    tail_s: time constant with which a released pin's level leaves it. released: (span + 1,) levels
    of the pins that are released when a chip begins; without it those of a pin by itself.
    """
    before, after = np.append(0.0, levels), np.append(levels, 0.0)
    if released is None:
        released = np.where(after == 0, before, 0.0)
    changes = np.flatnonzero((before != after) | (released != 0))
    times = changes * chip_s
    points = np.zeros((2 * changes.size + 2, 2))
    points[1:-1:2] = np.column_stack((times + 1e-12, before[changes]))
    points[2:-1:2] = np.column_stack((times + EDGE_S, after[changes]))
    points[-1, 0] = (levels.size + 1) * chip_s
    if not tail_s:
        return points
    (begins,) = np.nonzero(released)
    finer = begins[:, None] * chip_s + EDGE_S + tail_s * TAIL_STEPS
    grid = np.unique(np.append(points[:, 0], finer[finer < points[-1, 0]]))
    kept = np.zeros_like(grid)
    for begin, level in zip(begins, released[begins], strict=True):
        since_s = grid - begin * chip_s - EDGE_S
        kept += np.where(since_s >= 0, level * np.exp(-np.maximum(since_s, 0.0) / tail_s), 0.0)
    return np.column_stack((grid, np.interp(grid, *points.T) + kept))


def steps_of(chip_s: float, tail_s: float = 0.0) -> float:
    """Choose the largest step of an analysis, s: 40 in a chip of 2 µs, 200 at most; 2 in a tail."""
    step_s = max(50e-9, chip_s / 200)
    return min(step_s, tail_s / 2) if tail_s else step_s
