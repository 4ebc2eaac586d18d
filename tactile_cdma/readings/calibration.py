# SPDX-License-Identifier: Apache-2.0

"""ADC code → voltage → pressure: the curve of one sensor and the curves of a whole skin."""

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import Bools, Floats, Floats32, Int64s
from ..base.errors import SpecError

MOST_PA = 5e6
"""Highest pressure of a curve, Pa. Chosen: robots' skins end at 0.1 to 2 MPa, and a gauge in grams
that is read in newtons gives 102 times as much."""

POWER_PIECES = 16
"""Pieces of a power law's curve."""


@dataclass(frozen=True, slots=True)
class AdcScale:
    """The sensing node's ADC of k bits: V = code · vref / 2ᵏ.

    The paper's decoded examples (1.18, 1.80 and 2.14 V) fit 2¹⁰ exactly, and 2¹⁰ − 1 not.
    """

    bits: int = 10
    vref_v: float = 3.3

    @property
    def lsb_v(self) -> float:
        """Return one count (LSB), V."""
        return self.vref_v / (1 << self.bits)

    def voltage(self, code: ArrayLike) -> Floats:
        """Convert ADC codes to V."""
        return np.asarray(code, dtype=np.float64) * self.lsb_v

    def code(self, voltage_v: ArrayLike) -> Int64s:
        """Return the nearest code to a voltage (V), clamped to the converter's range.

        An ideal ATmega328P changes from code 0 to 1 at half a count (data sheet, "ADC accuracy
        definitions"), so `voltage` returns the centre of a code's interval.
        """
        counts = np.floor(np.asarray(voltage_v, dtype=np.float64) / self.lsb_v + 0.5)
        return np.clip(counts, 0, (1 << self.bits) - 1).astype(np.int64)


@dataclass(frozen=True, slots=True)
class PressureCurve:
    """A piecewise linear sensor characteristic.

    pressure_pa: rising corner pressures, Pa, the first one 0.
    voltage_v: voltages at those corners, V, which fall all along, or rise all along.
    residual_v, loop: how far a measurement is beside the curve, rms: in V, and as a share of the
        pressure, between loading and unloading; NaN: unknown.

    Raises SpecError unless both are strictly monotone.
    """

    pressure_pa: tuple[float, ...]
    voltage_v: tuple[float, ...]
    residual_v: float = field(default=math.nan, compare=False)
    loop: float = field(default=math.nan, compare=False)

    def __post_init__(self) -> None:
        rising, steps_v = np.diff(self.pressure_pa), np.diff(self.voltage_v)
        if len(rising) != len(steps_v) or not len(rising):
            raise SpecError("a pressure curve needs two or more corners, each with a voltage")
        if not (np.all(rising > 0) and np.all(steps_v * steps_v[0] > 0)):
            raise SpecError(
                "a pressure curve must fall, or rise, strictly: corners at "
                f"{_points(self.pressure_pa, 1e-3, 'kPa')} have {_points(self.voltage_v, 1, 'V')}"
            )

    @classmethod
    def two_stage(
        cls,
        v0_v: float = 3.3,
        knee_pa: float = 50e3,
        range_pa: float = 140e3,
        stage1_v_per_pa: float = 0.033e-3,
        stage2_v_per_pa: float = 0.0059e-3,
        vref_v: float = 3.3,
    ) -> Self:
        """Make the paper's sensor: V0 − 0.033 V/kPa up to 50 kPa, then −0.0059 V/kPa to 140 kPa.

        With negative sensitivities the voltage rises.
        Raises SpecError where the knee is not inside the range, the sensitivities are not of one
        sign, or the voltage would leave 0…vref_v inside the range.
        """
        if not 0 < knee_pa < range_pa:
            raise SpecError(
                f"the knee at {knee_pa / 1e3:g} kPa must lie between 0 and the range's end at "
                f"{range_pa / 1e3:g} kPa"
            )
        if stage1_v_per_pa * stage2_v_per_pa <= 0:
            raise SpecError(
                "both sensitivities are positive (the voltage falls with pressure) or both "
                f"negative (it rises), got {stage1_v_per_pa * 1e3:g} and "
                f"{stage2_v_per_pa * 1e3:g} V/kPa"
            )
        knee_v = v0_v - stage1_v_per_pa * knee_pa
        end_v = knee_v - stage2_v_per_pa * (range_pa - knee_pa)
        if end_v < 0 or end_v > max(v0_v, vref_v):
            raise SpecError(
                f"the curve reaches {end_v:.3f} V at {range_pa / 1e3:g} kPa; a node measures "
                f"0…{vref_v:g} V: lower the sensitivities or the range, or change V0 ({v0_v:g} V)"
            )
        return cls((0.0, knee_pa, range_pa), (v0_v, knee_v, end_v))

    @classmethod
    def power_law(
        cls, half_pa: float, exponent: float, range_pa: float, supply_v: float, rises: bool = True
    ) -> Self:
        """Make a curve in pieces: an FSR, R ∝ P^−exponent, in a divider with a fixed resistor.

        At half_pa, Pa, both resistances are the same. supply_v: of the divider, V. The voltage
        rises where the fixed resistor is at ground. The pieces are as far off in the middle of
        each, which makes their density that of the root of the second derivative: below 0.3 % of
        the range where the voltage reaches nine tenths of the supply.
        """
        fine_v = np.linspace(0.0, 1.0, 2001) / (1 + (half_pa / range_pa) ** exponent)
        fine_pa = half_pa * (fine_v / (1 - fine_v)) ** (1 / exponent)
        passed = np.cumsum(np.sqrt(np.abs(np.diff(fine_pa, 2, prepend=0, append=range_pa))))
        share = np.interp(np.linspace(passed[0], passed[-1], POWER_PIECES + 1), passed, fine_v)
        share[0], share[-1] = fine_v[[0, -1]]
        corner_pa = half_pa * (share / (1 - share)) ** (1 / exponent)
        corner_v = supply_v * (share if rises else 1 - share)
        return cls(tuple(corner_pa.tolist()), tuple(corner_v.tolist()))

    def voltage(self, pressure_pa: ArrayLike) -> Floats:
        """Convert Pa to V, clamped to the curve's ends."""
        return np.interp(np.asarray(pressure_pa, np.float64), self.pressure_pa, self.voltage_v)

    def pressure(self, voltage_v: ArrayLike) -> Floats:
        """Convert V to Pa, clamped to the curve's ends."""
        volts, step = np.asarray(voltage_v, np.float64), 1 if self.rises else -1
        return np.interp(volts, self.voltage_v[::step], self.pressure_pa[::step])

    @property
    def rises(self) -> bool:
        """Tell whether the voltage rises with the pressure."""
        return self.voltage_v[1] > self.voltage_v[0]


@dataclass(frozen=True, eq=False)
class Curves:
    """The curves of n sensors, evaluated together.

    pressure_pa, voltage_v: (c, n) float64, Pa and V, corner by corner as in PressureCurve; a curve
        with fewer corners repeats its last one. known: residual_v and loop of each; empty: unknown.
    """

    pressure_pa: Floats
    voltage_v: Floats
    known: tuple[tuple[float, float], ...] = ()

    @classmethod
    def of(cls, curves: Sequence[PressureCurve]) -> Self:
        """Take one curve per sensor, in their order."""
        corners = max(len(curve.pressure_pa) for curve in curves)

        def column(values: tuple[float, ...]) -> tuple[float, ...]:
            return values + values[-1:] * (corners - len(values))

        return cls(
            np.array([column(curve.pressure_pa) for curve in curves]).T,
            np.array([column(curve.voltage_v) for curve in curves]).T,
            tuple((curve.residual_v, curve.loop) for curve in curves),
        )

    def __len__(self) -> int:
        return int(self.pressure_pa.shape[1])

    @cached_property
    def checksum(self) -> str:
        """Return the CRC-32 of the corners in whole mPa and µV, as eight hexadecimal digits."""
        corners = np.rint(np.stack([self.pressure_pa * 1e3, self.voltage_v * 1e6]))
        return f"{zlib.crc32(corners.astype('<i8').tobytes()):08x}"

    def __getitem__(self, index: int) -> PressureCurve:
        """Return the curve of one sensor, without repeated corners."""
        pressure_pa, voltage_v = self.pressure_pa[:, index], self.voltage_v[:, index]
        new = np.append(True, np.diff(pressure_pa) > 0)
        known = self.known[index] if self.known else (math.nan, math.nan)
        corners = tuple(pressure_pa[new].tolist()), tuple(voltage_v[new].tolist())
        return PressureCurve(*corners, *known)

    @cached_property
    def errors(self) -> Floats:
        """Return residuals, V, NaN where they are unknown, and loops, 0 there, (2, n)."""
        errors = np.array(self.known or ((math.nan, math.nan),) * len(self)).T
        return np.stack([errors[0], np.nan_to_num(errors[1])])

    @property
    def range_pa(self) -> Floats:
        """Return (n,) highest pressure of each curve, Pa."""
        return np.asarray(self.pressure_pa[-1])

    def pressure(self, voltage_v: Floats32) -> Floats32:
        """Convert V to Pa, (…, n) float32 both, clamped to each curve's ends.

        Every piece adds what of its width the voltage has passed, so no piece is looked up.
        """
        pressure_pa = np.zeros_like(voltage_v)
        for begin_v, gain, width_pa in self.pieces:
            passed_pa = begin_v - voltage_v
            passed_pa *= gain
            pressure_pa += np.clip(passed_pa, 0.0, width_pa, out=passed_pa)
        return pressure_pa

    def voltage(self, pressure_pa: ArrayLike) -> Floats:
        """Convert Pa, (…, n) or one number, to V, clamped to each curve's ends."""
        pressure = np.asarray(pressure_pa, dtype=np.float64)
        result: Floats = np.zeros_like(pressure) + self.voltage_v[0]
        corners = zip(self.pressure_pa, self.voltage_v, strict=True)
        for (low_pa, low_v), (high_pa, high_v) in pairwise(corners):
            width_pa = np.where(high_pa > low_pa, high_pa - low_pa, 1.0)
            result += np.clip((pressure - low_pa) / width_pa, 0.0, 1.0) * (high_v - low_v)
        return result

    def pull_v(self, pressure_pa: float) -> Floats32:
        """Tell how far a pressure, Pa, pulls each voltage from its rest, (n,) float32, V, ≥ 0."""
        return np.asarray(np.abs(self.voltage_v[0] - self.voltage(pressure_pa)), np.float32)

    @cached_property
    def sign(self) -> Floats32:
        """Return (n,) float32: 1 where pressure pulls the voltage down, −1 where it pulls it up."""
        return np.asarray(np.sign(self.voltage_v[0] - self.voltage_v[1]), np.float32)

    @cached_property
    def begin_v(self) -> Floats32:
        """Return the voltage at the start of every curve, V, (n,) float32."""
        return np.asarray(self.voltage_v[0], dtype=np.float32)

    @cached_property
    def end_v(self) -> Floats32:
        """Return the voltage at the end of every curve, V, (n,) float32."""
        return np.asarray(self.voltage_v[-1], dtype=np.float32)

    @cached_property
    def pieces(self) -> Floats32:
        """Start (V), gain (Pa per V below it) and width (Pa) of every piece, (p, 3, n) float32."""
        width_pa, fall_v = np.diff(self.pressure_pa, axis=0), -np.diff(self.voltage_v, axis=0)
        gain = width_pa / np.where(fall_v != 0, fall_v, 1.0)
        pieces = np.stack((self.voltage_v[:-1], gain, width_pa), axis=1)
        return np.ascontiguousarray(pieces, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Calibration:
    """The calibration of a skin's n nodes.

    curves: of nodes 1…n, in this order.
    uncalibrated: (n,) bool, nodes with the default curve although others have curves of their own.
    identity: short hash of the calibration file's content; empty if all nodes have the default
        curve.
    """

    curves: Curves
    uncalibrated: Bools
    identity: str = ""

    @classmethod
    def default(cls, curve: PressureCurve, nodes: int) -> Self:
        """Give all nodes the same curve."""
        return cls(Curves.of([curve] * nodes), np.zeros(nodes, dtype=bool))

    @classmethod
    def of_nodes(
        cls, curves: Mapping[int, PressureCurve], default: PressureCurve, nodes: int
    ) -> Self:
        """Curves by node number, 1…nodes; nodes without one are uncalibrated."""
        numbers = range(1, nodes + 1)
        return cls(
            Curves.of([curves.get(number, default) for number in numbers]),
            np.array([number not in curves for number in numbers]),
        )


def _points(values: tuple[float, ...], scale: float, unit: str) -> str:
    return ", ".join(f"{value * scale:g}" for value in values) + f" {unit}"
