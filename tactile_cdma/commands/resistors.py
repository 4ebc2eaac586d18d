# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma resistors`: a line of resistors only, without an amplifier."""

import argparse

from ..config.arguments import add_skin_options, given
from ..config.parameters import DATA
from ..config.skin_config import SkinConfig
from ..hardware.passive import PassiveLine, check_pulled, passive_line

LONGEST_MS = 1e5
"""The frame period has no effect, and the default one would refuse larger skins."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    add = parser.add_argument
    add("--input-ohm", type=float, help="resistor from a node's pin to the line [Ω] (chosen)")
    add("--bias-ohm", type=float, help="from the line to supply and to ground, each [Ω] (2200)")
    add("--supply", type=float, help="supply of the digitizer and these two [V] (3.3)")
    text = "supply of the nodes: 5 for an Arduino Uno or Nano [V] (3.3)"
    add("--node-supply", type=float, help=text)
    text = "capacitance of a line on which sync pulses come [nF] (0.2, and 0.01 for each node)"
    add("--line-nf", type=float, help=text)
    add_skin_options(parser, "the driver's; the frame period has no effect")


def run(arguments: argparse.Namespace) -> int:
    """Print the parts and what follows from them; returns the exit code."""
    config = SkinConfig.of({**given(arguments), "frame_period_ms": LONGEST_MS})
    spec = config.spec
    line = passive_line(
        spec,
        input_ohm=arguments.input_ohm,
        bias_ohm=arguments.bias_ohm,
        supply_v=arguments.supply,
        node_supply_v=arguments.node_supply,
    )
    line_f = line.usual_f if arguments.line_nf is None else arguments.line_nf * 1e-9
    if config.sync_wire == DATA:
        check_pulled(line, line_f)
    print(describe(line, spec.chip_s, line_f if config.sync_wire == DATA else None))
    return 0


def describe(line: PassiveLine, chip_s: float, pulled_f: float | None = None) -> str:
    """Return a passive line as text. pulled_f: its capacitance, F, if sync pulses come on it."""
    alone_v, all_v = line.amplitude_v(1), line.amplitude_v(line.nodes)
    low_v, high_v = line.range_v
    lines = {
        "node": f"{line.input_ohm:g} Ω from the pin to the line",
        "line": f"{line.bias_ohm:g} Ω to {line.supply_v:g} V and {line.bias_ohm:g} Ω to ground, "
        f"{line.supply_v / line.bias_ohm * 500:.2g} mA; straight to the converter",
        "level": f"A = {alone_v * 1e3:.1f} mV if one node speaks, {all_v * 1e3:.1f} mV if all do "
        f"({all_v / alone_v:.0%}); {all_v / line.count_v:.0f} counts",
        "range": f"{low_v:.2f} to {high_v:.2f} V, at rest {line.supply_v / 2:.2f} V"
        + (f"; speaking nodes add up to {line.shift_v * 1e3:.0f} mV" if line.shift_v else ""),
        "settling": f"{line.unsettled(chip_s):.1%} of a step is left at 1/8 of a chip",
    }
    if pulled_f is not None:
        lines["sync"] = (
            f"on {pulled_f * 1e9:.3g} nF: a pulse seems {line.later_s(pulled_f) * 1e6:.2g} µs "
            "longer"
        )
    text = "\n".join(f"{name + ':':<10}{value}" for name, value in lines.items())
    parameters = f"polarity: 1\namplitude_mv: {line.mean_amplitude_v * 1e3:.1f}"
    return f"{text}\n\nfor the parameter file:\n{parameters}"
