# SPDX-License-Identifier: Apache-2.0

"""The analog chain in SPICE against what `make amplifier` computed: `make spice`.

For each skin a frame in which all nodes send random words goes through the circuit, is sampled and
quantised as the RP2040 does that, and decoded by the driver's pipeline. CIRCUIT=paper: with the
paper's nodes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amplifier import CIRCUITS, DIRECT, RAIL_V, FrontEnd, design
from ngspice import SpiceError, noise_v, waveform
from passive_spice import PassiveRun, passive_runs
from tactile_cdma.base.errors import TactileError
from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.parameters import Value, read_file
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.wire._protocol import SyncMode
from tactile_cdma.wire.messages import FrameLayout, Info, Packet, Samples
from tactile_cdma.wire.packets import PacketWriter

CONFIG = Path(__file__).resolve().parents[2] / "config"
SKINS = (16, 64, 900, 4000)
"""Numbers of nodes."""
FILES = {900: "thousand_skin.yaml", 4000: "sparse_skin.yaml"}
"""Parameter files of skins; those of the others are the driver's defaults."""
PERIODS = 3
"""Periods that the decoder sees, all of them the same frame."""
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
    wrong = _wrong(config, front, times, volts, np.where(talking, codes, -1))
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


def _wrong(
    config: SkinConfig,
    front: FrontEnd | PassiveRun,
    times: NDArray[np.float64],
    volts: NDArray[np.float64],
    sent: NDArray[np.int64],
) -> int:
    """Count words of PERIODS frames that are not as sent (−1: by nobody), or are missing."""
    decoded = [*_decoded(config, front, times, volts)]
    wrong = sum(int(np.sum(np.where(active, said, -1) != sent)) for active, said in decoded)
    return wrong + (PERIODS - len(decoded)) * config.spec.nodes


def _decoded(
    config: SkinConfig,
    front: FrontEnd | PassiveRun,
    times: NDArray[np.float64],
    volts: NDArray[np.float64],
) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.int32]]]:
    """Yield who spoke, and the codes, of the frames found in PERIODS of these volts."""
    spec, per_chip = config.spec, config.samples_per_chip
    integrated = per_chip == 1
    if integrated:
        instants = spec.places * spec.chip_s + front.sample_s
        period = spec.chips
    else:
        period = round(spec.frame_period_s / spec.chip_s * per_chip)
        instants = (np.arange(period) + 0.5) * spec.chip_s / per_chip
    count_v = front.line.count_v if isinstance(front, PassiveRun) else front.count_v
    counts = np.clip(np.interp(instants, times, volts) / count_v, 0, 4095).astype(np.int16)
    step_s = spec.chip_s / per_chip
    info = Info(
        frame=FrameLayout.of(spec, per_chip),
        sample_rate_uhz=round(1e6 / step_s),
        volts_per_count=count_v,
        zero_count=2048,
        min_count=0,
        max_count=4095,
        sync_mode=SyncMode.DRIVE,
        integrated=integrated,
    )
    packets: list[Packet] = [info]
    for number in range(PERIODS + 1):  # the last one ends the frame before it
        begin_us = round((1 + number * spec.frame_period_s) * 1e6)
        for first in range(0, period, 4096):
            part = counts[first : first + 4096]
            late_us = (spec.places[first] * spec.chip_s if integrated else first * step_s) * 1e6
            index = number * period + first
            packets.append(Samples(begin_us + round(late_us), index, part, sync=first == 0))
    pipeline, writer = Pipeline(config), PacketWriter()
    frames = [f for p in packets for f in pipeline.feed(writer.encode(p), 0.0)]
    yield from ((frame.words.active, frame.words.codes) for frame in frames[:PERIODS])


def main(argv: Sequence[str] | None = None) -> int:
    """Print a line per skin and the wrong words last; exit code 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--circuit", choices=CIRCUITS, default=DIRECT, help="of a node")
    try:
        return run(parser.parse_args(argv).circuit)
    except (SpiceError, TactileError) as error:
        print(f"spice: {error}", file=sys.stderr)
        return 1


def run(circuit: str) -> int:
    """Simulate all skins; returns the exit code. Raises SpiceError and ParameterError."""
    words = wrong = 0
    for nodes in SKINS:
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
    for run in passive_runs():
        nodes, talking = run.line.nodes, int(run.talking.sum())
        low_v, high_v = run.amplitude_v.min(), run.amplitude_v.max()
        missed = _wrong(run.config, run, run.times, run.volts, np.where(run.talking, run.codes, -1))
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
