# SPDX-License-Identifier: Apache-2.0

"""Draws what an oscilloscope should show while a skin is put to work: `make scope`.

Pins are those of the nodes' images under simavr; the circuit between them and the converter is in
SPICE, like a pulse that pulls the line. The digitizer's pulses are those of docs/protocol.md.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "firmware" / folder) for folder in ("analog", "sim")]
from amplifier import FrontEnd, design  # noqa: E402
from emulated import EmulatedNodes, EmulationError  # noqa: E402
from ngspice import SpiceError, transient, transients, waveform  # noqa: E402
from pulse import pulled  # noqa: E402
from pulse_spice import (  # noqa: E402
    BEFORE_S,
    PIECES,
    PULSE_S,
    STEP_S,
    Network,
    Skin,
    netlist,
)
from skin import Spread, reference_nodes  # noqa: E402
from tactile_cdma.base.errors import TactileError  # noqa: E402
from tactile_cdma.config.frame_rate import FAST  # noqa: E402
from tactile_cdma.config.parameters import read_file  # noqa: E402
from tactile_cdma.config.skin_config import SkinConfig  # noqa: E402
from tactile_cdma.wire._protocol import SYNC_FRAME, SYNC_LEAD, SYNC_RESTART, SYNC_UNIT_US  # noqa: E402

IMAGES, CONFIG = ROOT / "docs" / "img", ROOT / "config"
WARM_UP_FRAMES = 20
"""Frames until nodes have learnt their code at rest and the period."""
SENSOR_V = 2.14
"""Voltage of every sensor, V: a code with ones and zeros."""
LEAD_S = SYNC_LEAD * SYNC_UNIT_US * 1e-6
SYNC_OHM = 33.0
"""Resistor between a group's buffer and its sync line of 70 nodes and 2 m, Ω: with it an edge
overshoots by less than a pin stands (test_boards.py)."""
BUFFER_OHM = 15.0
"""Output of a 74LVC1G17 at 3.3 V, Ω, by its data sheet's curves."""
WIRE_H, WIRE_F = 600e-9, 60e-12
"""Inductance and capacitance of a metre of sync wire beside ground: 100 Ω, 6 ns."""
WIRE_M, INPUT_F = 2.0, 10e-12
"""Length of the wire, and capacitance of a node's sync input with its copper."""
LINE_F = 1e-9
"""Capacitance of a line of 5 m with its nodes."""


@dataclass(frozen=True, slots=True)
class Trace:
    """Times, s after the rising edge of a frame's pulse, and voltages."""

    name: str
    times: NDArray[np.float64]
    volts: NDArray[np.float64]


def pulses(config: SkinConfig) -> NDArray[np.float64]:
    """Begin and end of every pulse of a frame, s after its first one: (m, 2)."""
    spec = config.spec
    step = spec.resync_chips or spec.chips
    begins = spec.places[::step] * spec.chip_s
    units = np.where(np.arange(begins.size) == 0, SYNC_FRAME, SYNC_RESTART)
    return np.column_stack((begins, begins + units * SYNC_UNIT_US * 1e-6))


def pins(config: SkinConfig, mcu: str, step_s: float, span_s: float) -> NDArray[np.float64]:
    """Return levels of the nodes' pins, −1…1, from a frame's pulse on: (n, span/step)."""
    period_s = config.spec.frame_period_s
    with EmulatedNodes(reference_nodes(config, Spread(clock=50e-6), mcu=mcu, threshold=0)) as nodes:
        nodes.press(SENSOR_V)
        for frame in range(1, WARM_UP_FRAMES + 1):
            begin_s = frame * period_s
            for rise, fall in pulses(config):
                nodes.sync(round((begin_s + rise) * 1e9), True)
                nodes.sync(round((begin_s + fall) * 1e9), False)
            nodes.run(round((begin_s + period_s - 1e-3) * 1e9))
        instants = (begin_s + np.arange(0, span_s, step_s)) * 1e9
        levels = np.zeros((len(nodes.nodes), instants.size))
        for node, row in enumerate(levels):
            edges = nodes.edges(node)
            before = np.searchsorted(edges["t_ns"], instants, side="right")
            row[:] = np.append(0, edges["level"])[before]
        return levels


def line(front: FrontEnd, levels: NDArray[np.float64], step_s: float, name: str) -> Trace:
    """Return the voltage at the converter; levels of all nodes, or of one that speaks alone."""
    if len(levels) == 1:
        apart, released = np.append(levels, np.zeros_like(levels), axis=0), None
    else:
        before, after = (np.pad(levels, ((0, 0), side)) for side in ((1, 0), (0, 1)))
        apart = levels.mean(axis=0)[None]
        released = np.where(after == 0, before, 0.0).mean(axis=0)
    times, volts = waveform(front, apart, step_s, levels.shape[1] * step_s, released)
    if len(levels) == 1:  # groups are lumped: the node is in each of them
        rest_v = front.supply_v / 2
        volts = rest_v + (volts - rest_v) / front.groups
    return Trace(name, times, volts)


def sync(config: SkinConfig, end_s: float) -> Trace:
    """Return the sync pin of a frame."""
    edges = [
        (t, level) for pulse in pulses(config) for t, level in zip(pulse, (3.3, 0), strict=True)
    ]
    times, volts = [0.0], [0.0]
    for t, level in edges:
        times += [t, t]
        volts += [volts[-1], level]
    return Trace("sync", np.array([*times, end_s]), np.array([*volts, volts[-1]]))


def pull(config: SkinConfig) -> tuple[Trace, Trace]:
    """Simulate a pulse on the line: at its far end, behind a node's resistor, and at GPIO26."""
    spec = config.spec
    front = pulled(design(spec, config.samples_per_chip), LINE_F)
    network = Network(config, front, front.nodes_stage.input_ohm, 0.0)
    ones = np.ones(spec.nodes)
    nominal = Skin(ones, 1.0, (1.0, 1.0), 1.0, 1.0, ones)
    gate = f"vgate gate 0 pwl(0 0 {BEFORE_S:g} 0 {BEFORE_S + 1e-8:g} 1 {BEFORE_S + PULSE_S:g} 1"
    sources = [f"{gate} {BEFORE_S + PULSE_S + 1e-8:g} 0)", "von on 0 0"]
    sources += [f"vlevel{piece} level{piece} 0 0" for piece in range(PIECES)]
    found = transients(netlist(network, nominal, LINE_F, sources, BEFORE_S + LEAD_S, STEP_S))
    times = found["time"] - BEFORE_S
    heard = Trace("AIN1 of the last node", times, found[f"v(pin{PIECES - 1})"])
    return heard, Trace("GPIO26", times, found["v(adc)"])


def with_pulse(trace: Trace, pulse: Trace, lead_s: float = LEAD_S) -> Trace:
    """Put a pulse before a trace whose first chip begins after a time, s."""
    before, after = pulse.times < lead_s, trace.times >= lead_s
    return Trace(
        trace.name,
        np.append(pulse.times[before], trace.times[after]),
        np.append(pulse.volts[before], trace.volts[after]),
    )


def sync_edge(nodes: int, at: int, ohm: float) -> Trace:
    """Simulate the rising edge at a node, counted from 1: buffer, resistor, wire and inputs."""
    henry, farad = (each * WIRE_M / nodes for each in (WIRE_H, WIRE_F))
    lines = ["* sync line", "vpin pin 0 pulse(0 3.3 20n 2n 2n 1u 2u)"]
    lines.append(f"rpin pin n0 {BUFFER_OHM + ohm:g}")
    for node in range(1, nodes + 1):
        lines.append(f"l{node} n{node - 1} n{node} {henry:g}")
        lines.append(f"c{node} n{node} 0 {farad + INPUT_F:g}")
    lines += [".tran 0.2n 500n 0 0.2n", f".save v(n{at})", ".end", ""]
    times, volts = transient("\n".join(lines))
    return Trace(f"node {at} of {nodes}", times - 20e-9, volts)


def draw(file: str, panels: list[tuple[str, float, list[Trace]]]) -> None:
    """Draw a screen per panel: title, seconds per unit of its axis, traces with their scales."""
    figure = Figure(figsize=(9, 2.6 * len(panels)), layout="constrained")
    for axes, (title, unit_s, traces) in zip(
        np.atleast_1d(figure.subplots(len(panels))), panels, strict=True
    ):
        _screen(axes, title, unit_s, traces)
    figure.savefig(IMAGES / file, dpi=100, pil_kwargs={"optimize": True})
    print(f"docs/img/{file}")


def _screen(axes: Axes, title: str, unit_s: float, traces: list[Trace]) -> None:
    for trace, color in zip(traces, ("#D55E00", "#0072B2"), strict=False):
        axes.plot(trace.times / unit_s, trace.volts, color=color, lw=1.5, label=trace.name)
    unit = {1e-3: "ms", 1e-6: "µs", 1e-9: "ns"}[unit_s]
    axes.set_title(title, loc="left")
    axes.set(xlabel=f"after the pulse's edge [{unit}]", ylabel="V")
    axes.grid(alpha=0.4)
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False)  # off the traces


def cut(trace: Trace, begin_s: float, end_s: float) -> Trace:
    """Return a part of a trace."""
    inside = (trace.times >= begin_s) & (trace.times <= end_s)
    return Trace(trace.name, trace.times[inside], trace.volts[inside])


def main() -> int:
    """Draw the pictures of docs/building.md; returns the exit code."""
    matplotlib.use("Agg")
    try:
        draw_all()
    except (EmulationError, SpiceError, TactileError) as error:
        print(f"scope: {error}", file=sys.stderr)
        return 1
    return 0


def draw_all() -> None:
    """Draw the pictures. Raises EmulationError, SpiceError and ParameterError."""
    slow = SkinConfig.of(read_file(CONFIG / "wired_skin.yaml"))
    front, period_s = design(slow.spec, slow.samples_per_chip), slow.spec.frame_period_s
    pulse = sync(slow, period_s)
    twice = Trace("GPIO16", np.append(pulse.times, pulse.times + period_s), np.tile(pulse.volts, 2))
    heard, answer = pull(slow)
    title = "1  digitizer alone: a pulse of 32 µs for every frame"
    ends = np.append(answer.times, period_s), np.append(answer.volts, front.supply_v / 2)
    both = np.append(ends[0], ends[0] + period_s), np.tile(ends[1], 2)
    draw("scope-digitizer.png", [(title, 1e-3, [twice, Trace("GPIO26", *both)])])

    title = "2  a pulse on the line, with 16 nodes on 5 m"
    draw("scope-sync.png", [(title, 1e-6, [heard, answer])])

    step_s = 1e-6
    levels = pins(slow, "atmega328p", step_s, LEAD_S + slow.spec.frame_s + 1e-3)
    alone = with_pulse(line(front, levels[:1], step_s, "GPIO26"), answer)
    title = f"3  one node: ±{front.amplitude_v * 1e3:.0f} mV about half the supply, then released"
    first = "3  its first chips of 50 µs, from 64 µs after the pulse's edge on"
    draw("scope-node.png", [(title, 1e-3, [alone]), (first, 1e-6, [cut(alone, 0.0, 700e-6)])])
    everyone = with_pulse(line(front, levels, step_s, "GPIO26"), answer)
    draw("scope-all.png", [("4  all 16 nodes, sensors at one voltage", 1e-3, [everyone])])

    values = read_file(CONFIG / "thousand_skin.yaml")
    fast = SkinConfig.of(values)
    front, step_s = design(fast.spec, fast.samples_per_chip), 0.125e-6
    single = SkinConfig.of(values | {"nodes": 1, "rows": 1, "columns": 1})
    alone = line(front, pins(single, FAST, step_s, 110e-6), step_s, "GPIO26")
    title = "5  one fast node of 900: 3 µs of chips that nobody uses, from 64 µs on chips of 2 µs"
    draw("scope-fast.png", [(title, 1e-6, [cut(alone, 50e-6, 105e-6)])])


if __name__ == "__main__":
    sys.exit(main())
