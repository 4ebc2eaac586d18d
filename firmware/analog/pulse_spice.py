# SPDX-License-Identifier: Apache-2.0

"""The sync pulse on the data wire in SPICE: `make spice SYNC=data`.

    pin and AIN1 ──Rin──┬── … all nodes: 5 m of wire ──┬── amplifier, or Rb to supply and ground
                        ·                              └── 47 Ω ── open drain

The digitizer pulls the line low while all pins are released; each node compares the line, as it is
behind its own Rin, with its bandgap. Skins whose parts are drawn from their classes see a pulse,
and then the steepest frame there is, with all pins that may agree flipped at once. Of every network
and wire one skin sends a frame of random words, each node's from where it saw the pulse.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amplifier import TOLERANCE, FrontEnd, design, first_sample_s, largest_sum
from circuit import (
    EDGE_S,
    HALF_OHM,
    OPAMP,
    PIN_OHM,
    filter_lines,
    level_points,
    stage_lines,
    steps_of,
)
from ngspice import transients
from pulse import AT_REST_V, pulled, recovery_s, settled_s
from tactile_cdma.base.arrays import Floats
from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.hardware.passive import LISTEN_F, PassiveLine, check_pulled, passive_line
from tactile_cdma.wire._protocol import SYNC_FRAME, SYNC_LEAD, SYNC_UNIT_US

LEAD_S, PULSE_S = SYNC_LEAD * SYNC_UNIT_US * 1e-6, SYNC_FRAME * SYNC_UNIT_US * 1e-6
"""From the pulse's edge to the first chip, and the longest pulse, s."""
WIRES_F = (0.34e-9, 1e-9, 4e-9)
"""Capacitance of the wire, with all that is on it: of 2 m, of 5 m, of a star of shielded ones."""
ACTIVE_NODES = (4, 16, 64)
PASSIVE = {
    (0.34e-9, 1e-9): ((4, 33e3, 2.2e3), (16, 100e3, 2e3)),
    (4e-9,): ((4, 33e3, 1e3), (16, 68e3, 1e3)),
}
"""Networks without an amplifier, by wire: nodes, Rin, Rb, as firmware/README.md has them."""
WIRE_H, WIRE_OHM, PIECES = 3e-6, 0.5, 5
"""Inductance and resistance of 5 m of wire, and the pieces that it is simulated in."""
PULL_OHM, DRAIN_OHM = 47.0, 4.0
"""The resistor at the drain, and a BSS138 at 3.3 V, by its data sheet's curves."""
BANDGAP_V, BANDGAP_TOLERANCE, OFFSET_V = 1.1, 0.1, 0.04
"""A node's threshold, V, its class, and the largest offset of its comparator: by the data sheet."""
SUPPLY_TOLERANCE = 0.05
"""Tolerance of the regulator, which the line's rest follows and a bandgap does not; chosen."""
BEFORE_S, FLIP_S, STEP_S = 2e-6, 20e-6, 5e-9
"""Rest before the pulse, time between flips of all pins, and step of that analysis."""
DRAWS, QUICK_DRAWS, QUICK_NODES = 20, 2, 16
"""Skins drawn of every network and wire; if quick, nodes of the largest skin that sends words."""


@dataclass(frozen=True)
class Network:
    """A skin's nodes and what holds their line. level: largest sum of all pins, over how many."""

    config: SkinConfig
    circuit: FrontEnd | PassiveLine
    input_ohm: float
    level: float

    @property
    def name(self) -> str:
        """Return the kind and the number of nodes."""
        kind = "passive" if isinstance(self.circuit, PassiveLine) else "nodes"
        return f"{kind}={self.config.spec.nodes}"

    @property
    def count_v(self) -> float:
        """Return one count of the converter."""
        return self.circuit.count_v

    @property
    def sample_s(self) -> float:
        """Return the time from a chip's begin to its first sample."""
        return first_sample_s(self.config.spec.chip_s, self.config.samples_per_chip)

    def recovery_s(self, wire_f: float) -> float:
        """Return the time from a pulse's end to rest, as computed."""
        if isinstance(self.circuit, PassiveLine):
            return settled_s(AT_REST_V / self.circuit.supply_v * 2, self.circuit.poles_s(wire_f))
        return recovery_s(self.circuit, wire_f)


def networks() -> Iterator[tuple[Network, float]]:
    """Design all skins, by the calculator, with the wires of each, F."""
    for nodes in ACTIVE_NODES:
        config = SkinConfig.of({"nodes": nodes})
        for wire_f in WIRES_F:
            front = pulled(design(config.spec, config.samples_per_chip), wire_f)
            values = {"amplitude_mv": round(front.amplitude_v * 1e3, 2), "polarity": -1}
            level = largest_sum(config.spec, nodes) / nodes
            loud = SkinConfig.of({"nodes": nodes, **values})
            yield Network(loud, front, front.nodes_stage.input_ohm, level), wire_f
    for wires_f, lines in PASSIVE.items():
        for (nodes, input_ohm, bias_ohm), wire_f in product(lines, wires_f):
            spec = SkinConfig.of({"nodes": nodes}).spec
            line = passive_line(spec, input_ohm=input_ohm, bias_ohm=bias_ohm)
            check_pulled(line, wire_f)
            values = {"amplitude_mv": round(line.mean_amplitude_v * 1e3, 1)}
            loud = SkinConfig.of({"nodes": nodes, **values})
            yield Network(loud, line, input_ohm, 1.0), wire_f


@dataclass(frozen=True, slots=True)
class Skin:
    """Parts of one skin: factors to their values. threshold_v: of every node's comparator."""

    input: Floats
    feedback: float
    halves: tuple[float, float]
    pull: float
    supply: float
    threshold_v: Floats

    @classmethod
    def drawn(cls, nodes: int, rng: np.random.Generator) -> Skin:
        """Draw parts, uniformly in their classes."""

        def parts(size: int) -> Floats:
            return rng.uniform(1 - TOLERANCE, 1 + TOLERANCE, size)

        bandgap_v = BANDGAP_V * rng.uniform(1 - BANDGAP_TOLERANCE, 1 + BANDGAP_TOLERANCE, nodes)
        feedback, up, down, pull = map(float, parts(4))
        return cls(
            input=parts(nodes),
            feedback=feedback,
            halves=(up, down),
            pull=pull,
            supply=float(rng.uniform(1 - SUPPLY_TOLERANCE, 1 + SUPPLY_TOLERANCE)),
            threshold_v=bandgap_v + rng.uniform(-OFFSET_V, OFFSET_V, nodes),
        )


def places(nodes: int) -> NDArray[np.int64]:
    """Return the piece of wire at whose end each node is, spread over all of them."""
    return np.arange(nodes) * PIECES // nodes


def netlist(
    network: Network, skin: Skin, wire_f: float, sources: Sequence[str], end_s: float, step_s: float
) -> str:
    """Write an analysis of digitizer, wire and nodes, those of a piece of wire as one.

    sources: lines that make v(gate), 1 while the line is pulled, v(on), 1 while pins are driven,
    and v(level0) … of each piece's pins, −1 to 1.
    """
    here = places(skin.input.size)
    lines = [
        f"* {network.name}, {wire_f * 1e9:g} nF",
        OPAMP,
        f".param supply={network.circuit.supply_v * skin.supply:g}",
        "vsupply supply 0 {supply}",
        ".nodeset v(line)={supply/2} v(adc)={supply/2}",
        *_digitizer(network, skin),
        f"bpull line 0 i=v(gate)*v(line)/{PULL_OHM * skin.pull + DRAIN_OHM:g}",
        *sources,
    ]
    for piece in range(PIECES):
        begin, end = f"w{piece}" if piece else "line", f"w{piece + 1}"
        lines += [
            f"lwire{piece} {begin} m{piece} {WIRE_H / PIECES:g}",
            f"rwire{piece} m{piece} {end} {WIRE_OHM / PIECES:g}",
            f"rskin{piece} {begin} m{piece} 1k",
            f"cwire{piece} {end} 0 {wire_f / PIECES:g}",
        ]
        own = skin.input[here == piece]
        if own.size:
            lines += [
                f"rin{piece} {end} pin{piece} {network.input_ohm / np.sum(1 / own):g}",
                f"cin{piece} pin{piece} 0 {LISTEN_F * own.size:g}",
                f"bpin{piece} pin{piece} 0 i={own.size / PIN_OHM:g}*v(on)*"
                f"(v(pin{piece})-{{supply}}/2*(1+v(level{piece})))",
                f"ehear{piece} copy{piece} 0 {end} 0 1",  # a silent node, which loads nothing
                f"rhear{piece} copy{piece} hear{piece} {network.input_ohm * (1 - TOLERANCE):g}",
                f"chear{piece} hear{piece} 0 {LISTEN_F:g}",
            ]
    saved = " ".join(f"v(pin{p}) v(hear{p})" for p in np.unique(here))
    return "\n".join(
        [*lines, f".tran {step_s:g} {end_s:g} 0 {step_s:g}", f".save v(adc) {saved}", ".end", ""]
    )


def _digitizer(network: Network, skin: Skin) -> list[str]:
    """Write what holds the line, up to the converter."""
    front, (up, down) = network.circuit, skin.halves
    if isinstance(front, PassiveLine):
        ohm = front.bias_ohm
        return [f"rup supply line {ohm * up:g}", f"rdown line 0 {ohm * down:g}", "radc line adc 1"]
    stage = front.nodes_stage
    drawn = replace(stage, feedback_ohm=stage.feedback_ohm * skin.feedback)
    front = replace(front, supply_v=front.supply_v * skin.supply)
    halves_ohm = HALF_OHM * up, HALF_OHM * down
    return [*filter_lines(front), *stage_lines("out", front, drawn, "line", halves_ohm)]


@dataclass(frozen=True, slots=True)
class Seen:
    """What a skin makes of a pulse. edges_s: (n,) from the gate to where nodes' comparators saw it.

    units: (n,) its length, rounded as nodes do. margin_v: between the line behind Rin and the
    nearest threshold, in the pulse and in the frame. recovery_s: from the pulse's end until the
    converter's input is at rest.
    """

    edges_s: Floats
    units: NDArray[np.int64]
    margin_v: float
    recovery_s: float


def see(network: Network, skin: Skin, wire_f: float) -> Seen:
    """Simulate a pulse and the steepest frame."""
    first_s = BEFORE_S + LEAD_S
    flips = first_s + FLIP_S * np.arange(4)
    end_s = flips[-1] + FLIP_S
    up, down = network.level, -network.level
    steps = _steps(flips[:3], [0.0, up, down, up])
    sources = [
        _source("gate", _steps([BEFORE_S, BEFORE_S + PULSE_S], [0, 1, 0])),
        _source("on", _steps([flips[0], flips[-1]], [0, 1, 0])),
        *(_source(f"level{piece}", steps) for piece in range(PIECES)),
    ]
    found = transients(netlist(network, skin, wire_f, sources, end_s, STEP_S))
    times, adc = found["time"], found["v(adc)"]
    release_s = BEFORE_S + PULSE_S
    here = places(skin.threshold_v.size)
    pulled = times < first_s
    edges, lengths = [], []
    for piece, threshold_v in zip(here, skin.threshold_v, strict=True):
        low = times[pulled & (found[f"v(pin{piece})"] < threshold_v)]
        edges.append(low[0] - BEFORE_S)
        lengths.append(low[-1] - low[0])
    heard = np.array([found[f"v(hear{piece})"] for piece in np.unique(here)])
    pulse_v = heard[:, (times > release_s - 1e-6) & (times < release_s)].max()
    frame_v = heard[:, times > first_s - 1e-6].min()
    margin_v = min(frame_v - skin.threshold_v.max(), skin.threshold_v.min() - pulse_v)
    rest_v = adc[times < BEFORE_S].mean()
    (off,) = np.nonzero((np.abs(adc - rest_v) > AT_REST_V) & (times > release_s) & pulled)
    recovery_s = times[off[-1]] - release_s if off.size else 0.0
    units = np.floor(np.array(lengths) / (SYNC_UNIT_US * 1e-6) + 0.5).astype(np.int64)
    return Seen(np.array(edges), units, float(margin_v), float(recovery_s))


def _steps(times: ArrayLike, values: Sequence[float]) -> str:
    """Return values from 0 s on, each until one of the times, as ngspice's pwl."""
    points = [f"0 {values[0]:g}"]
    for at, (before, after) in zip(np.maximum(times, EDGE_S), pairwise(values), strict=True):
        points.append(f"{at:.9g} {before:g} {at + EDGE_S:.9g} {after:g}")
    return " ".join(points)


def _source(name: str, points: str) -> str:
    return f"v{name} {name} 0 pwl({points})"


def frame(
    network: Network, skin: Skin, wire_f: float, edges_s: Floats, codes: NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """Simulate a frame whose nodes begin so late, and the next one's pulse: times, s; volts."""
    spec = network.config.spec
    here, gate_s = places(spec.nodes), spec.frame_period_s - LEAD_S
    sources = [
        _source("gate", _steps([gate_s, gate_s + PULSE_S], [0, 1, 0])),
        _source("on", _steps([0, spec.frame_s], [0, 1, 0])),
    ]
    with TemporaryDirectory() as folder:
        for piece in np.unique(here):
            own = np.flatnonzero(here == piece)
            file = Path(folder) / f"levels{piece}.txt"
            np.savetxt(file, _mean_levels(spec, codes, skin, edges_s, own), fmt="%.10g")
            sources += [
                f"a{piece} %v([level{piece}]) levels{piece}",
                f'.model levels{piece} filesource (file="{file}" amploffset=[0] amplscale=[1])',
            ]
        end_s = spec.frame_period_s
        text = netlist(network, skin, wire_f, sources, end_s, steps_of(spec.chip_s))
        found = transients(text)
    return found["time"], found["v(adc)"]


def _mean_levels(
    spec: FrameSpec, codes: NDArray[np.int64], skin: Skin, edges_s: Floats, own: NDArray[np.int64]
) -> Floats:
    """Return times and mean level of some nodes' pins, each weighted by its resistor."""
    curves = []
    for node in own:
        chips = line_chips(spec, codes, np.arange(spec.nodes) == node, spec.polarity)
        points = level_points(frame_levels(chips, spec).astype(np.float64), spec.chip_s)
        points[:, 0] += edges_s[node]
        curves.append(points)
    grid = np.unique(np.concatenate([[0.0], *(points[:, 0] for points in curves)]))
    levels = [np.interp(grid, *points.T) for points in curves]
    return np.column_stack((grid, np.average(levels, axis=0, weights=1 / skin.input[own])))
