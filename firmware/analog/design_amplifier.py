# SPDX-License-Identifier: Apache-2.0

"""Parts of the analog front end and their effect: `make amplifier NODES=64`."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amplifier import (
    ADC_HZ,
    CIRCUITS,
    DIRECT,
    EXACT,
    TOLERANCE,
    FrontEnd,
    Stage,
    design,
    largest_sum,
)
from pulse import OVERLOAD_S, pulled
from tactile_cdma.base.errors import TactileError
from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.arguments import add_skin_options, given
from tactile_cdma.config.parameters import DATA
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.options import Setup, SimOptions
from tactile_cdma.sim.scene import SCENES
from tolerance import COARSE, scatter

LOSS = 1.02
"""Noise power with a sensible converter over that without: 0.09 dB; chosen."""
LEAST_RHO = 3.0
"""ρ of the noisiest line that a sensible converter suffices for; chosen."""
DRAWS = 200
"""Frames of random codes in the estimate of clipping; chosen."""
FRAMES = 12
"""Frames of every scene in it, SCENE_STEP_S apart."""
MEASURE_MS = 1.0
"""Pause after a frame in which nodes measure; chosen, as in config/wired_64.yaml."""
SCENE_STEP_S = 0.37
"""s; chosen, so that FRAMES of them span a period of most scenes."""


def main(argv: Sequence[str] | None = None) -> int:
    """Design the front end and print it; returns the exit code."""
    parser = argparse.ArgumentParser(prog="design_amplifier.py", description=__doc__)
    parser.add_argument("--json", action="store_true", help="as one JSON object")
    for name, kind, default, text in (
        ("--supply", float, 3.3, "supply of nodes and amplifier [V] (3.3)"),
        ("--adc-volts", float, 3.3, "range of the digitizer's converter [V] (3.3)"),
        ("--adc-bits", int, 12, "resolution of the digitizer's converter [bit] (12)"),
        ("--adc-rate", float, ADC_HZ / 1e3, "samples of it at most [kS/s] (500)"),
        (
            "--active",
            float,
            None,
            "largest share of nodes that transmit at once (all, or a sparse frame)",
        ),
    ):
        parser.add_argument(name, type=kind, default=default, help=text)
    text = f"{DIRECT}: a resistor from pin to line; paper: attenuator and follower ({DIRECT})"
    parser.add_argument("--circuit", choices=CIRCUITS, default=DIRECT, help=text)
    text = "capacitance of a line on which sync pulses come [nF] (that of 2 m and all nodes)"
    parser.add_argument("--line-nf", type=float, help=text)
    text = "time of the op-amp to leave a rail, where sync pulses come on the line [µs] (2)"
    parser.add_argument("--recovery-us", type=float, default=OVERLOAD_S * 1e6, help=text)
    add_skin_options(parser, "the driver's; the frame period has no effect")
    arguments = parser.parse_args(argv)
    try:
        spec, front = _designed(arguments)
    except TactileError as error:
        print(f"design_amplifier.py: {error}", file=sys.stderr)
        return 1
    print(json.dumps(report(spec, front)) if arguments.json else describe(spec, front))
    return 0


def _designed(arguments: argparse.Namespace) -> tuple[FrameSpec, FrontEnd]:
    longest_ms = 1e5  # or the default period would refuse larger skins
    config = SkinConfig.of({**given(arguments), "frame_period_ms": longest_ms})
    front = design(
        config.spec,
        config.samples_per_chip,
        supply_v=arguments.supply,
        adc_volts=arguments.adc_volts,
        adc_bits=arguments.adc_bits,
        adc_hz=arguments.adc_rate * 1e3,
        active=arguments.active,
        circuit=arguments.circuit,
    )
    if config.sync_wire == DATA:
        line_f = None if arguments.line_nf is None else arguments.line_nf * 1e-9
        front = pulled(front, line_f, arguments.recovery_us * 1e-6)
    return config.spec, front


@dataclass(frozen=True, slots=True)
class Load:
    """Tells a scene's use of the range. peak: of the line, in A. clipped: share of its chips."""

    peak: float
    clipped: float


def loads(spec: FrameSpec, front: FrontEnd) -> dict[str, Load]:
    """Simulate scenes without noise, by name; nodes that may talk are spread over the skin.

    "random codes": independent ones. The others are the simulator's: in "idle" all nodes have one
    code, in "press" all but those under one press.
    """
    spec = replace(spec, amplitude_v=1.0)
    rng = np.random.default_rng(spec.nodes)
    found = {}
    for name, codes_of_frames in _scenes(spec, rng).items():
        peak, clipped, chips = 0.0, 0, 0
        for codes in codes_of_frames:
            talking = rng.permutation(spec.nodes) < front.talking
            line = np.abs(line_chips(spec, codes, talking))
            peak = max(peak, float(line.max()))
            clipped += int(np.count_nonzero(line > front.room))
            chips += line.size
        found[name] = Load(peak, clipped / chips)
    return found


def gaussian_clipping(front: FrontEnd) -> float:
    """Return the share of chips beyond the range if the nodes' sum is taken as Gaussian."""
    return 0.0 if front.room >= front.talking else 2 * _tail(front.full_scale)


@dataclass(frozen=True, slots=True)
class Resolution:
    """Effect of the converter's steps on one node.

    count: one count, in A. rho: √N·A over the rms of the quantisation, as if every chip were one
    sample. wrong_words: share of wrong words that this alone makes. sensible_bits: the fewest with
    which the converter adds at most LOSS to the noise of a line of LEAST_RHO.
    """

    count: float
    rho: float
    wrong_words: float
    sensible_bits: int


def resolution(spec: FrameSpec, front: FrontEnd) -> Resolution:
    """Return the effect of the converter's steps on one node: a step of q has an rms of q/√12."""
    signal_v = math.sqrt(spec.order) * front.amplitude_v
    rho = signal_v * math.sqrt(12) / front.count_v
    step_v = math.sqrt(12 * (LOSS - 1)) * signal_v / LEAST_RHO
    return Resolution(
        count=front.count_v / front.amplitude_v,
        rho=rho,
        wrong_words=-math.expm1(spec.line_bits * math.log1p(-_tail(rho))),
        sensible_bits=math.ceil(math.log2(front.adc_volts / step_v)),
    )


def report(spec: FrameSpec, front: FrontEnd) -> dict[str, Any]:
    """Tell everything about a front end, as plain values by name."""
    derived = [
        name
        for name, kind in vars(FrontEnd).items()
        if isinstance(kind, property | cached_property) and name != "stages"
    ]
    return {
        "parameters": {
            "polarity": front.polarity,
            "amplitude_mv": round(front.amplitude_v * 1e3, 2),
        },
        "parts": asdict(front) | {name: getattr(front, name) for name in derived},
        "gaussian_clipping": gaussian_clipping(front),
        "loads": {name: asdict(load) for name, load in loads(spec, front).items()},
        "converter": asdict(resolution(spec, front)),
        "scatter": asdict(scatter(front)),
        "coarse_scatter": asdict(scatter(front, COARSE, tolerance=COARSE)),
    }


def describe(spec: FrameSpec, front: FrontEnd) -> str:
    """Describe a front end: parts, what they must be capable of, range and resolution."""
    seen = resolution(spec, front)
    scenes = loads(spec, front)
    worst = max(scenes, key=lambda name: scenes[name].peak)
    clipped = [f"{name} {_share(load.clipped)}" for name, load in scenes.items() if load.clipped]
    spread, coarse = scatter(front), scatter(front, COARSE, tolerance=COARSE)
    used = largest_sum(spec, front.talking) / front.room
    lines = {
        **_node(front),
        **_amplifiers(front),
        "filter": f"R {_si(front.filter_ohm)}Ω, C {_si(front.filter_f)}F "
        f"({_si(front.filter_hz)}Hz)",
        "settling": f"{front.unsettled:.1%} of a step is left at a chip's first sample, after "
        f"{_si(front.sample_s)}s",
        "level": f"A = {_si(front.amplitude_v)}V, one node on the digitized line",
        "range": f"±{_si(front.room_v)}V = ±{front.room:.3g}·A = ±{front.full_scale:.3g}·√n·A, "
        f"n = {front.talking} nodes at once use {used:.0%}",
        "tolerance": f"resistors {TOLERANCE:.1%}, of half the supply {front.half_tolerance:.1%}: "
        f"rest ±{_si(spread.rest_v)}V rms, levels within {spread.level:.1%}; of {spread.skins} "
        f"skins {_share(spread.left)} leave the range",
        "   ": f"all resistors {COARSE:.0%}: rest ±{_si(coarse.rest_v)}V rms, "
        f"{coarse.left:.0%} leave the range; order {TOLERANCE:.0%}",
        "clipping": f"share of chips, simulated: {', '.join(clipped) or 'none'} (largest peak "
        f"{scenes[worst].peak:.3g}·A: {worst}); Gaussian tail: {_share(gaussian_clipping(front))}",
        "converter": f"one count is {_si(front.count_v)}V, {seen.count:.2g}·A; quantisation alone: "
        f"ρ {seen.rho:.3g}, wrong words {_share(seen.wrong_words)}",
        " ": f"bits that matter: {seen.sensible_bits} (on a line with noise of ρ {LEAST_RHO:g})",
    }
    head = (
        f"{spec.nodes} nodes, order {spec.order}, chips of {_si(spec.chip_s)}s; "
        f"{front.supply_v:g} V supply, {front.adc_bits} bits over {front.adc_volts:g} V"
    )
    body = "\n".join(
        f"{name + ':' if name.strip() else '':<11}{text}" for name, text in lines.items()
    )
    parameters = f"polarity: {front.polarity}\namplitude_mv: {front.amplitude_v * 1e3:.2f}"
    if spec.frame_s > FrameSpec.frame_period_s:
        parameters += f"\nframe_period_ms: {math.ceil(spec.frame_s * 1e3 + MEASURE_MS)}"
    return f"{head}\n\n{body}\n\nfor the parameter file:\n{parameters}"


def _node(front: FrontEnd) -> dict[str, str]:
    """Write the lines about what is between a pin and the line."""
    rin = f"Rin {_si(front.nodes_stage.input_ohm)}Ω"
    if front.attenuator is None:
        tail = f"a released pin's level leaves the line with {_si(front.tail_s)}s"
        return {"node": f"{rin} from the pin to the line; {tail}"}
    bias = _si(front.attenuator.bias_ohm)
    return {
        "node": f"R1 {_si(front.attenuator.series_ohm)}Ω from the pin; Rb {bias}Ω to supply and "
        f"{bias}Ω to ground",
        "follower": f"at {front.supply_v / 2:g} V ± {_si(front.node_level_v)}V; gain-bandwidth "
        f"{_si(front.follower_bandwidth_hz)}Hz or more, {_slew(front.follower_slew_v_per_s)}; "
        f"then {rin} to the line",
    }


def _amplifiers(front: FrontEnd) -> dict[str, str]:
    """Write the lines about the amplifiers."""
    half = f"+ input at {front.supply_v / 2:g} V"
    lines, nodes = {}, front.nodes_stage
    speed = f"{_slew(front.slew_v_per_s)}, rail to rail"
    if front.groups_stage is None:
        lines["amplifier"] = f"{_feedback('f', nodes)}, {half}; noise gain {nodes.noise_gain:.3g}"
        lines[""] = f"gain-bandwidth {_si(nodes.gain_bandwidth_hz)}Hz or more, {speed}"
        return lines
    last = front.groups_stage
    lines["groups"] = (
        f"{front.groups} of up to {nodes.inputs} nodes, an amplifier each: "
        f"{_feedback('f', nodes)}, {half};"
    )
    lines["  "] = (
        f"noise gain {nodes.noise_gain:.3g}, gain-bandwidth {_si(nodes.gain_bandwidth_hz)}Hz or "
        f"more, {speed}; then Rg {_si(last.input_ohm)}Ω"
    )
    lines["sum"] = (
        f"{_feedback('s', last)}, {half}; noise gain {last.noise_gain:.3g}, "
        f"gain-bandwidth {_si(last.gain_bandwidth_hz)}Hz or more"
    )
    return lines


def _feedback(name: str, stage: Stage) -> str:
    return (
        f"R{name} {_si(stage.feedback_ohm)}Ω, C{name} {_si(stage.feedback_f)}F "
        f"({_si(stage.corner_hz)}Hz)"
    )


def _scenes(spec: FrameSpec, rng: np.random.Generator) -> dict[str, Iterable[NDArray[np.int64]]]:
    """Return the codes of some frames, (n,) each, by the name of the scene."""
    timed = replace(spec, chip_s=1e-8, frame_period_s=SCENE_STEP_S)
    options = (SimOptions(scene=name, threshold=0) for name in SCENES)
    scenes: dict[str, Iterable[NDArray[np.int64]]] = {
        each.scene: (frame.codes for frame in islice(truth(each, Setup(timed)), FRAMES))
        for each in options
    }
    scenes["random codes"] = rng.integers(0, 2**spec.bits, (DRAWS, spec.nodes))
    return scenes


def _tail(rho: float) -> float:
    """Return Q(ρ): the share of a Gaussian beyond ρ deviations, on one side."""
    return 0.5 * math.erfc(rho / math.sqrt(2))


def _share(share: float) -> str:
    return "none" if share < 1e-15 else f"{share:.1e}"


def _slew(volts_per_s: float) -> str:
    return f"slew {volts_per_s / 1e6:.2g} V/µs"


def _si(value: float) -> str:
    """Write a value with the prefix of its unit: 27000 is "27 k"."""
    power = min(max(math.floor(math.log10(value * EXACT) / 3), -4), 2)
    return f"{value / 1000.0**power:.3g} {'pnµm kM'[power + 4].strip()}"


if __name__ == "__main__":
    sys.exit(main())
