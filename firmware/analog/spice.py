# SPDX-License-Identifier: Apache-2.0

"""The analog chain in SPICE against what `make amplifier` computed: `make spice`.

For each skin a frame in which all nodes send random words goes through the circuit, is sampled and
quantised as the RP2040 does that, and decoded by the driver's pipeline. Before that, what cables,
discharges and inexact parts do (effects.py). CIRCUIT=paper: with the paper's nodes. QUICK=1: 16
nodes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amplifier import CIRCUITS, DIRECT, RAIL_V, FrontEnd, design
from decoding import PERIODS, wrong_words
from effects import run_effects
from ngspice import SpiceError, noise_v, waveform
from passive_spice import passive_runs
from pulse import LEFT_S
from pulse_spice import DRAWS, LEAD_S, QUICK_DRAWS, QUICK_NODES, Skin, frame, networks, see
from tactile_cdma.base.errors import TactileError
from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.parameters import Value, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.wire._protocol import SYNC_FRAME

CONFIG = Path(__file__).resolve().parents[2] / "config"
SKINS = (16, 64, 900, 4000)
"""Numbers of nodes."""
FILES = {900: "thousand_skin.yaml", 4000: "sparse_skin.yaml"}
"""Parameter files of skins; those of the others are the driver's defaults."""
WIRES = "own", "data"
"""Wires that carry the sync pulses: one of their own, or the line."""
STEP_CHIPS = 8
"""Chips of a step response: of the time before, and after."""


@dataclass(frozen=True, slots=True)
class Figures:
    """Holds what SPICE says of a skin. A: as computed.

    amplitude_v: of one node. unsettled: share of a step that is left at a chip's first sample.
    overshoot: of a step, share. noise_v: RMS at the converter. headroom_v: from the frame's
    extremes to the nearest rail. wrong: words of all frames decoded that are wrong or missing.
    """

    amplitude_v: float
    unsettled: float
    overshoot: float
    noise_v: float
    headroom_v: float
    words: int
    wrong: int


def parameters(nodes: int) -> dict[str, Value]:
    """Read a skin's parameters but for its amplitude, which is computed. Raises ParameterError."""
    found = read_file(CONFIG / FILES[nodes]) if nodes in FILES else {}
    given = {name: value for name, value in found.items() if name not in ("port", "amplitude_mv")}
    return {"nodes": nodes, **({"frame_period_ms": 36.0} if nodes == 64 else {}), **given}


def simulate(
    nodes: int, seed: int = 1, circuit: str = DIRECT
) -> tuple[SkinConfig, FrontEnd, Figures]:
    """Design, simulate and decode a skin."""
    values = parameters(nodes)
    asked = SkinConfig.of(values)
    front = design(asked.spec, asked.samples_per_chip, circuit=circuit)
    config = SkinConfig.of(
        {
            **values,
            "polarity": front.polarity,
            "amplitude_mv": round(front.amplitude_v * 1e3, 2),
        }
    )
    spec, chip_s = config.spec, config.spec.chip_s
    amplitude_v, unsettled, overshoot = _step(front, chip_s)
    codes = np.random.default_rng(seed).integers(0, 2**spec.bits, nodes)
    talking = np.random.default_rng(seed + 1).permutation(nodes) < front.talking
    levels, released = _mean_levels(spec, codes, talking)
    times, volts = waveform(front, levels[None], chip_s, spec.frame_period_s, released)
    wrong = wrong_words(config, front, times, volts, np.where(talking, codes, -1))
    top_v = min(front.supply_v - RAIL_V, front.adc_volts)
    headroom_v = min(top_v - volts.max(), volts.min() - RAIL_V)
    figures = Figures(
        amplitude_v,
        unsettled,
        overshoot,
        noise_v(front),
        float(headroom_v),
        PERIODS * nodes,
        wrong,
    )
    return config, front, figures


def _mean_levels(
    spec: FrameSpec, codes: NDArray[np.int64], talking: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean level of all pins in every chip, and of those that are released when it begins."""
    mean_v = spec.polarity / spec.nodes
    chips = line_chips(spec, codes, talking, amplitude_v=mean_v)
    levels = frame_levels(chips, spec).astype(np.float64)
    speaking = np.zeros(spec.span_chips + 2, dtype=bool)
    speaking[spec.places + 1] = True
    ends = speaking[:-1] & ~speaking[1:]
    return levels, np.where(ends, np.append(0.0, levels), 0.0)


def _step(front: FrontEnd, chip_s: float) -> tuple[float, float, float]:
    """Return a node's amplitude, V; what a step leaves at the first sample; overshoot."""
    groups = front.groups  # lumped: the node steps in all of them at once, by a share within range
    share = min(1.0, front.room_v / (2 * groups * front.amplitude_v))
    alone = share * np.repeat([-1.0, 1.0, 1.0], STEP_CHIPS)
    others = np.zeros_like(alone)  # they cancel out
    times, volts = waveform(front, np.array([alone, others]), chip_s, alone.size * chip_s)
    turn_s = STEP_CHIPS * chip_s
    before, after = (np.interp(turn_s + at * chip_s, times, volts) for at in (-0.1, STEP_CHIPS - 1))
    sampled = np.interp(turn_s + front.sample_s, times, volts)
    later = volts[(times > turn_s) & (times < 2 * turn_s)]
    beyond = max(((later - after) / (after - before)).max(), 0.0)
    amplitude_v = abs(after - before) / 2
    left = abs(after - sampled) / (2 * amplitude_v)
    return float(amplitude_v / (groups * share)), float(left), float(beyond)


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line per skin and the wrong words last; exit code 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--circuit", choices=CIRCUITS, default=DIRECT, help="of a node")
    parser.add_argument("--sync-wire", choices=WIRES, default=WIRES[0], help="of the pulses")
    parser.add_argument("--quick", action="store_true", help="fewer skins, words and effects")
    asked = parser.parse_args(argv)
    try:
        wired = asked.sync_wire == WIRES[0]
        return run(asked.circuit, asked.quick) if wired else run_pulses(asked.quick)
    except (SpiceError, TactileError) as error:
        print(f"spice: {error}", file=sys.stderr)
        return 1


def run_pulses(quick: bool) -> int:
    """Simulate pulses on the data wire; returns the exit code. Raises SpiceError and SpecError."""
    words = wrong = 0
    margins_v, recoveries_s = [], []
    for network, wire_f in networks():
        spec, rng = network.config.spec, np.random.default_rng(1)
        skins = [Skin.drawn(spec.nodes, rng) for _ in range(QUICK_DRAWS if quick else DRAWS)]
        seen = [see(network, skin, wire_f) for skin in skins]
        lengths = np.concatenate([each.units for each in seen])
        edges_s = np.concatenate([each.edges_s for each in seen])
        missed = int(np.sum(lengths != SYNC_FRAME))
        sent = PERIODS * spec.nodes if not quick or spec.nodes <= QUICK_NODES else 0
        if sent:
            codes = rng.integers(0, 2**spec.bits, spec.nodes)
            volts = frame(network, skins[0], wire_f, seen[0].edges_s, codes)
            missed += wrong_words(network.config, network, *volts, codes, LEAD_S)
        margins_v.append(min(each.margin_v for each in seen))
        recoveries_s.append(max(each.recovery_s for each in seen))
        print(
            f"{network.name} wire_nf={wire_f * 1e9:g} skins={len(skins)} "
            f"edges_us={edges_s.min() * 1e6:.2f}…{edges_s.max() * 1e6:.2f} "
            f"margin_v={margins_v[-1]:.3f} recovery_us={recoveries_s[-1] * 1e6:.1f} "
            f"computed={network.recovery_s(wire_f) * 1e6:.1f} words={sent} wrong={missed}",
            flush=True,
        )
        words, wrong = words + sent, wrong + missed
    print(
        f"sync=data words={words} wrong={wrong} least_margin_v={min(margins_v):.3f} "
        f"recovery_us={max(recoveries_s) * 1e6:.1f}"
    )
    return int(wrong > 0 or min(margins_v) <= 0 or max(recoveries_s) > LEFT_S)


def run(circuit: str, quick: bool) -> int:
    """Simulate all skins; returns the exit code. Raises SpiceError and ParameterError."""
    words, wrong = run_effects(quick) if circuit == DIRECT else (0, 0)
    for nodes in SKINS[:1] if quick else SKINS:
        config, front, found = simulate(nodes, circuit=circuit)
        print(
            f"nodes={nodes} chip_us={config.spec.chip_s * 1e6:g} groups={front.groups} "
            f"amplitude_mv={found.amplitude_v * 1e3:.2f} computed={front.amplitude_v * 1e3:.2f} "
            f"unsettled={found.unsettled:.4f} computed={front.unsettled:.4f} "
            f"overshoot={found.overshoot:.4f} noise_mv={found.noise_v * 1e3:.3f} "
            f"headroom_mv={found.headroom_v * 1e3:.0f} words={found.words} wrong={found.wrong}",
            flush=True,
        )
        words, wrong = words + found.words, wrong + found.wrong
    for run in () if quick else passive_runs():
        nodes, talking = run.line.nodes, int(run.talking.sum())
        low_v, high_v = run.amplitude_v.min(), run.amplitude_v.max()
        missed = wrong_words(
            run.config, run, run.times, run.volts, np.where(run.talking, run.codes, -1)
        )
        print(
            f"passive={nodes} talking={talking} amplitude_mv={low_v * 1e3:.2f}…{high_v * 1e3:.2f} "
            f"computed={run.line.amplitude_v(talking) * 1e3:.2f} words={PERIODS * nodes} "
            f"wrong={missed}",
            flush=True,
        )
        words, wrong = words + PERIODS * nodes, wrong + missed
    print(f"words={words} wrong={wrong}")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
