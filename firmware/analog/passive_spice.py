# SPDX-License-Identifier: Apache-2.0

"""The line without an amplifier in SPICE: each pin drives it, or is released."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from circuit import PIN_OHM, level_points, steps_of
from ngspice import transient
from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.hardware.passive import FIRST_SAMPLE, PIN_F, WIRE_F, PassiveLine, passive_line

NETWORKS = ((4, 22e3, 2.2e3), (16, 100e3, 2e3))
"""Nodes, Rin, Rb of firmware/README.md."""


@dataclass(frozen=True, slots=True)
class PassiveRun:
    """Is a frame in which `talking` nodes send. amplitude_v: (talking,) V, by their chips."""

    config: SkinConfig
    line: PassiveLine
    talking: NDArray[np.bool_]
    codes: NDArray[np.int64]
    amplitude_v: NDArray[np.float64]
    times: NDArray[np.float64]
    volts: NDArray[np.float64]

    @property
    def count_v(self) -> float:
        """Return one count of the converter, V."""
        return self.line.count_v

    @property
    def sample_s(self) -> float:
        """Return the time from a chip's begin to its first sample, s."""
        return FIRST_SAMPLE * self.config.spec.chip_s


def passive_runs() -> Iterator[PassiveRun]:
    """Simulate every network, with one node speaking, with half of them and with all."""
    for nodes, input_ohm, bias_ohm in NETWORKS:
        for talking in (1, nodes // 2, nodes):
            yield passive_run(nodes, input_ohm, bias_ohm, talking)


def passive_run(nodes: int, input_ohm: float, bias_ohm: float, talking: int) -> PassiveRun:
    """Simulate a frame of random words. Raises SpiceError."""
    rng = np.random.default_rng(nodes + talking)
    config = SkinConfig.of({"nodes": nodes})
    line = passive_line(config.spec, input_ohm=input_ohm, bias_ohm=bias_ohm)
    config = SkinConfig.of({"nodes": nodes, "amplitude_mv": round(line.mean_amplitude_v * 1e3, 1)})
    spec = config.spec
    codes = rng.integers(0, 2**spec.bits, nodes)
    talks = rng.permutation(nodes) < talking
    own = [
        line_chips(spec, codes, talks & (np.arange(nodes) == node), amplitude_v=1.0)
        for node in range(nodes)
    ]
    with TemporaryDirectory() as folder:
        files = [str(Path(folder) / f"levels{node}.txt") for node in range(nodes)]
        for file, chips in zip(files, own, strict=True):
            levels = frame_levels(chips, spec).astype(np.float64)
            np.savetxt(file, level_points(levels, spec.chip_s), fmt="%.17g")
        step_s = steps_of(spec.chip_s)
        times, volts = transient(netlist(line, files, spec.frame_period_s, step_s))
    late_v = np.interp((np.arange(spec.chips) + 0.9) * spec.chip_s, times, volts)
    speaking = np.array(own)[talks].reshape(talking, -1)
    model = np.column_stack([*speaking, np.ones(spec.chips)])
    amplitude_v = np.linalg.lstsq(model, late_v, rcond=None)[0][:-1]
    return PassiveRun(config, line, talks, codes, amplitude_v, times, volts)


def netlist(line: PassiveLine, level_files: list[str], end_s: float, step_s: float) -> str:
    """Write an analysis with a file of levels per node: −1, 1, and 0 for a released pin."""
    lines = [
        "* pins, Rin each, and two Rb that halve the supply",
        f"vsupply supply 0 {line.supply_v:g}",
        f"rup supply adc {line.bias_ohm:g}",
        f"rdown adc 0 {line.bias_ohm:g}",
        f"cline adc 0 {WIRE_F:g}",
    ]
    for n, file in enumerate(level_files):
        swing = f"{line.node_supply_v / 2:g}*(1+v(level{n}))"
        lines += [
            f"a{n} %v([level{n}]) levels{n}",
            f'.model levels{n} filesource (file="{file}" amploffset=[0] amplscale=[1])',
            f"bdrive{n} pin{n} 0 i=abs(v(level{n}))*(v(pin{n})-{swing})/{PIN_OHM:g}",
            f"cpin{n} pin{n} 0 {PIN_F:g}",
            f"rin{n} pin{n} adc {line.input_ohm:g}",
        ]
    analysis = f".tran {step_s:g} {end_s:g} 0 {step_s:g}"
    return "\n".join([*lines, analysis, ".save v(adc)", ".end", ""])
