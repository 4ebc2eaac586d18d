# SPDX-License-Identifier: Apache-2.0

"""The subcommand `tactile-cdma amplifier`: parts between the nodes' pins and the digitizer."""

import argparse

from ..base.errors import SpecError
from ..config.arguments import add_skin_options, given
from ..config.skin_config import SkinConfig
from ..hardware.passive import PassiveLine, passive_line

LONGEST_MS = 1e5
"""The frame period has no effect, and the default one would refuse larger skins."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    add = parser.add_argument
    text = "no amplifier: resistors only, for up to some 24 nodes"
    add("--passive", action="store_true", help=text)
    add("--input-ohm", type=float, help="from a node's pin to the line [Ω] (chosen)")
    add("--bias-ohm", type=float, help="from the line to supply and to ground, each [Ω] (2200)")
    add("--supply", type=float, help="of the digitizer and these two [V] (3.3)")
    text = "of the nodes: 5 for an Arduino Uno or Nano [V] (3.3)"
    add("--node-supply", type=float, help=text)
    add_skin_options(parser, "the driver's; the frame period has no effect")


def run(arguments: argparse.Namespace) -> int:
    """Print the parts and what follows from them; returns the exit code."""
    if not arguments.passive:
        raise SpecError(
            "only --passive is computed here; a summing amplifier is by `make amplifier` in the "
            "folder of the sources"
        )
    spec = SkinConfig.of({**given(arguments), "frame_period_ms": LONGEST_MS}).spec
    line = passive_line(
        spec,
        input_ohm=arguments.input_ohm,
        bias_ohm=arguments.bias_ohm,
        supply_v=arguments.supply,
        node_supply_v=arguments.node_supply,
    )
    print(describe(line, spec.chip_s))
    return 0


def describe(line: PassiveLine, chip_s: float) -> str:
    """Return a passive line as text."""
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
    text = "\n".join(f"{name + ':':<10}{value}" for name, value in lines.items())
    parameters = f"polarity: 1\namplitude_mv: {line.mean_amplitude_v * 1e3:.1f}"
    return f"{text}\n\nfor the parameter file:\n{parameters}"
