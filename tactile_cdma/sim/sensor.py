# SPDX-License-Identifier: Apache-2.0

"""The sensor between pressure and voltage; docs/paper.md has where its figures come from.

A pressure P first passes a first-order lag, slow while it rises and quick while it falls, then
hysteresis, a Prandtl–Ishlinskii operator on the logarithmic axis l = ln(1 + P/SCALE_PA):

    v = (1 − Σ wⱼ)·l + Σ wⱼ·pⱼ,   pⱼ ← max(l, min(l + widthⱼ, pⱼ)),   apparent P = SCALE_PA·(eᵛ − 1)

A play pⱼ follows while the pressure rises; after a turn it rests until the pressure has fallen by
widthⱼ. So rising loads read as the static curve says, falling ones read more, loops grow with the
load, and almost nothing remains at zero.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..base.arrays import Floats, Indices
from ..base.errors import SpecError
from ..readings.calibration import AdcScale, Calibration, Curves, PressureCurve
from ..readings.calibration_file import read_any

IDEAL, PAPER, FSR = "ideal", "paper", "fsr"
FSR_CURVE = PressureCurve.power_law(half_pa=40e3, exponent=0.9, range_pa=140e3, supply_v=3.3)
"""Curve of a force sensing resistor; chosen: the voltage rises to 3/4 of the supply."""
MOST_HYSTERESIS = 7.0
"""Largest option `hysteresis`: 6.69 gives the paper's figure at 55 kPa (docs/paper.md)."""
MOST_MISMATCH = 0.1
"""Largest option `mismatch`, rms. Chosen: slopes then differ by up to 20 %."""
WANDER_S = 600.0
"""Period of the slow drift of sensors and clocks, s; chosen, like that of a room's temperature."""
SCALE_PA = 2e3
"""Above this loops are proportional to the load, Pa; chosen: far below the paper's loads."""
SOME_LOAD = 0.25
"""Share of the range that two curves are compared at. Chosen: most loads are below it."""
_FARTHEST = 2.0
"""Mismatch is clipped at this many rms deviations, so that every curve stays above 0 V."""


@dataclass(frozen=True, slots=True)
class Dynamics:
    """Lag and hysteresis common to all sensors of a skin.

    rise_s, fall_s: time constants of the lag, s, above 0.
    widths: of the plays, on the logarithmic axis. weights: their shares, less than 1 in all.
    """

    rise_s: float
    fall_s: float
    widths: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()


PAPER_DYNAMICS = Dynamics(
    rise_s=0.085,
    fall_s=0.024 / math.log(100),
    widths=tuple(round(0.068 * play, 3) for play in range(1, 9)),
    weights=(0.0375,) * 8,
)
"""Fitted to response, recovery, and the hysteresis at 90 and 140 kPa, of Liu et al., IV.A."""


@dataclass(frozen=True, slots=True)
class SensorModel:
    """Properties of a simulated skin's sensors, without their nodes' converters.

    kind: "ideal" or "fsr", the curve alone, or "paper", with lag and hysteresis. hysteresis: factor
    to the paper's loops, 0…7. mismatch: spread of the taxels' curves, rms, as a share, 0…0.1.
    warming_v: largest drift of a voltage, V. noise_v: rms, V. dead, stuck: numbers, from 1 on, of
    nodes that do not speak from dead_after_s on, s since START, and of nodes that always measure
    the same; those beyond the skin are left out. seed: of everything random. calibration: path of
    the file whose curves, and reference, the sensors have; empty: those of their kind.
    """

    kind: str = IDEAL
    hysteresis: float = 1.0
    mismatch: float = 0.0
    warming_v: float = 0.0
    noise_v: float = 0.0
    dead: tuple[int, ...] = ()
    dead_after_s: float = 0.0
    stuck: tuple[int, ...] = ()
    seed: int = 0
    calibration: str = ""

    @property
    def curve(self) -> PressureCurve:
        """Curve of a taxel without mismatch."""
        return FSR_CURVE if self.kind == FSR else PressureCurve.two_stage()

    @property
    def dynamics(self) -> Dynamics | None:
        """Lag and hysteresis; None for ideal sensors.

        Weights and widths of plays each take the root of the factor, so that loops open by it, and
        wide ones are not cut off by the load's own extent.
        """
        if self.kind != PAPER:
            return None
        root = math.sqrt(self.hysteresis)
        return replace(
            PAPER_DYNAMICS,
            widths=tuple(width * root for width in PAPER_DYNAMICS.widths),
            weights=tuple(weight * root for weight in PAPER_DYNAMICS.weights),
        )

    @staticmethod
    def indices(numbers: Sequence[int], nodes: int) -> Indices:
        """Convert node numbers to indices; those beyond the skin are left out."""
        return np.array([number - 1 for number in numbers if number <= nodes], dtype=np.intp)

    def curves(self, nodes: int) -> Curves:
        """Return the true static curves; raises SpecError for a file of another skin.

        Corners (the knee too) and the falls between them have errors of their own; the voltage at
        rest has half as much, and only downwards: a node's converter sees nothing above.
        """
        if self.calibration:
            content = read_any(Path(self.calibration))
            if content.nodes != nodes:
                made = f"the calibration {self.calibration} is for {content.nodes} nodes"
                raise SpecError(f"{made}, the skin has {nodes}")
            return content.calibration(self.curve).curves
        if not self.mismatch:
            return Curves.of([self.curve] * nodes)
        rng = np.random.default_rng([self.seed, nodes, 1])
        corner_pa = np.array(self.curve.pressure_pa)
        falls = np.diff(self.curve.voltage_v) / np.diff(corner_pa)

        def errors(count: int) -> Floats:
            drawn = rng.standard_normal((count, nodes))
            return self.mismatch * np.clip(drawn, -_FARTHEST, _FARTHEST)

        knees_pa = corner_pa[1:-1, None] * (1 + errors(len(corner_pa) - 2))
        ends_pa = np.broadcast_to(corner_pa[[0, -1], None], (2, nodes))
        pressure_pa = np.concatenate((ends_pa[:1], knees_pa, ends_pa[1:]))
        steps_v = falls[:, None] * (1 + errors(len(falls))) * np.diff(pressure_pa, axis=0)
        rest_v = self.curve.voltage_v[0] * (1 - 0.5 * np.abs(errors(1)))
        return Curves(pressure_pa, np.concatenate((rest_v, rest_v + np.cumsum(steps_v, axis=0))))

    def adc(self, bits: int) -> AdcScale:
        if not self.calibration:
            return AdcScale(bits)
        return AdcScale(bits, read_any(Path(self.calibration)).adc.vref_v)

    def is_read_by(self, calibration: Calibration, curve: PressureCurve, adc: AdcScale) -> bool:
        """Tell whether a driver's curves and converter are those of these sensors and nodes.

        curve: of taxels without a curve of their own. Measured curves are, if most taxels read a
        load within half of it.
        """
        if not (calibration.identity or self.calibration):
            return curve == self.curve and adc == self.adc(adc.bits)
        theirs = calibration.curves
        load_pa = float(theirs.range_pa.min()) * SOME_LOAD
        loads_pa = np.array([[0.0], [load_pa]]) + 0 * theirs.range_pa
        codes = self.adc(adc.bits).code(self.curves(len(theirs)).voltage(loads_pa))
        nothing_pa, read_pa = theirs.pressure(adc.voltage(codes).astype(np.float32))
        error_pa = float(np.median(np.abs(read_pa - nothing_pa - load_pa)))
        return error_pa < 0.5 * load_pa


class Sensor:
    """The n sensors of a skin, with the memory of lag and hysteresis."""

    def __init__(self, model: SensorModel, nodes: int) -> None:
        self._model, self._curves, self._dynamics = model, model.curves(nodes), model.dynamics
        self._lagged_pa: Floats | None = None
        self._plays: tuple[Floats, ...] = ()
        if self._dynamics is not None:
            self._plays = (np.zeros(nodes),) * len(self._dynamics.widths)
        self._rng = np.random.default_rng([model.seed, nodes, 2])
        self._warming_v = model.warming_v * self._rng.uniform(0.5, 1.0, nodes)
        self._last_s: float | None = None

    @property
    def rest_v(self) -> Floats:
        """Return (n,) V: what nodes learn at power-up, before anything touches the skin."""
        return self._curves.voltage(0.0)

    def step(self, pressure_pa: Floats, t_s: float) -> Floats:
        """Return voltages (n,), V, at t_s (s), which never goes back, under pressures (n,), Pa.

        The pressures have been there since the last step; the first ones for ever, rising before.
        """
        passed_s = 0.0 if self._last_s is None else t_s - self._last_s
        self._last_s = t_s
        if self._dynamics is not None:
            before_pa = pressure_pa if self._lagged_pa is None else self._lagged_pa
            self._lagged_pa = delayed(before_pa, pressure_pa, passed_s, self._dynamics, np)
            self._plays, pressure_pa = followed(self._plays, self._lagged_pa, self._dynamics, np)
        voltage_v = self._curves.voltage(pressure_pa)
        if self._model.warming_v:
            voltage_v += self._warming_v * math.sin(2 * math.pi * t_s / WANDER_S)
        if self._model.noise_v:
            voltage_v += self._rng.normal(0.0, self._model.noise_v, len(voltage_v))
        return voltage_v


def followed(
    plays: Sequence[Any], pressure_pa: Any, dynamics: Dynamics, xp: Any
) -> tuple[tuple[Any, ...], Any]:
    """Take a step of hysteresis: the plays after it, and apparent pressures, Pa; at any pace.

    plays: one for each of the widths, of the pressures' shape; 0 at first, as if pressures had only
    risen. pressure_pa: 0 or more. xp: the arrays' namespace, by the array API standard.
    """
    level = xp.log1p(pressure_pa / SCALE_PA)
    value = (1 - sum(dynamics.weights)) * level
    moved = []
    for play, width, weight in zip(plays, dynamics.widths, dynamics.weights, strict=True):
        moved.append(xp.maximum(level, xp.minimum(level + width, play)))
        value = value + weight * moved[-1]
    return tuple(moved), SCALE_PA * xp.expm1(value)


def delayed(before_pa: Any, pressure_pa: Any, passed_s: float, dynamics: Dynamics, xp: Any) -> Any:
    """Take one step of lag: from before_pa, with pressure_pa, both Pa, applied for passed_s."""
    rise, fall = (-math.expm1(-passed_s / s) for s in (dynamics.rise_s, dynamics.fall_s))
    missing_pa = pressure_pa - before_pa
    return before_pa + xp.where(missing_pa > 0, rise * missing_pa, fall * missing_pa)
