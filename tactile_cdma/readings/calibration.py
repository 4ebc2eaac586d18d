# SPDX-License-Identifier: Apache-2.0

"""ADC code → voltage → pressure: the curve of one sensor and the curves of a whole skin."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.arrays import Bools, Floats, Floats32
from ..base.errors import SpecError
from .stages import convert

MOST_PA = 5e6
"""Highest pressure of a curve, Pa. Chosen: robots' skins end at 0.1 to 2 MPa, and a gauge in grams
that is read in newtons gives 102 times as much."""


@dataclass(frozen=True, slots=True)
class AdcScale:
    """The sensing node's ADC of k bits: V = code · vref / 2ᵏ.

    The paper's decoded examples (1.18, 1.80 and 2.14 V) fit 2¹⁰ exactly, and 2¹⁰ − 1 not.
    """

    bits: int = 10
    vref_v: float = 3.3

    @property
    def lsb_v(self) -> float:
        """One count (LSB), V."""
        return self.vref_v / (1 << self.bits)

    def voltage(self, code: ArrayLike) -> Floats:
        """ADC codes to V."""
        return np.asarray(code, dtype=np.float64) * self.lsb_v

    def code(self, voltage_v: ArrayLike) -> NDArray[np.int64]:
        """The nearest code to a voltage (V), clamped to the converter's range.

        An ideal ATmega328P changes from code 0 to 1 at half a count (data sheet, "ADC accuracy
        definitions"), so `voltage` returns the centre of a code's interval.
        """
        counts = np.floor(np.asarray(voltage_v, dtype=np.float64) / self.lsb_v + 0.5)
        return np.clip(counts, 0, (1 << self.bits) - 1).astype(np.int64)


@dataclass(frozen=True, slots=True)
class PressureCurve:
    """A piecewise linear sensor characteristic; the voltage falls as the pressure rises.

    pressure_pa: rising corner pressures, Pa, the first one 0.
    voltage_v: falling voltages at those corners, V.

    Raises SpecError unless both are strictly monotone.
    """

    pressure_pa: tuple[float, ...]
    voltage_v: tuple[float, ...]

    def __post_init__(self) -> None:
        rising, falling = np.diff(self.pressure_pa), np.diff(self.voltage_v)
        if len(rising) != len(falling) or not len(rising):
            raise SpecError("a pressure curve needs two or more corners, each with a voltage")
        if not (np.all(rising > 0) and np.all(falling < 0)):
            raise SpecError(
                "a pressure curve must fall strictly: corners at "
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
    ) -> PressureCurve:
        """The paper's sensor: V0 − 0.033 V/kPa up to 50 kPa, then −0.0059 V/kPa to 140 kPa.

        Raises SpecError where the knee is not inside the range, a sensitivity is not positive, or
        the voltage would fall below 0 inside the range.
        """
        if not 0 < knee_pa < range_pa:
            raise SpecError(
                f"the knee at {knee_pa / 1e3:g} kPa must lie between 0 and the range's end at "
                f"{range_pa / 1e3:g} kPa"
            )
        if stage1_v_per_pa <= 0 or stage2_v_per_pa <= 0:
            raise SpecError(
                "sensitivities are given as positive V/kPa (the voltage falls with pressure), got "
                f"{stage1_v_per_pa * 1e3:g} and {stage2_v_per_pa * 1e3:g}"
            )
        knee_v = v0_v - stage1_v_per_pa * knee_pa
        end_v = knee_v - stage2_v_per_pa * (range_pa - knee_pa)
        if end_v < 0:
            raise SpecError(
                f"the curve falls to {end_v:.3f} V at {range_pa / 1e3:g} kPa; a node cannot "
                f"measure below 0 V: lower the sensitivities or the range, or raise V0 ({v0_v:g} V)"
            )
        return cls((0.0, knee_pa, range_pa), (v0_v, knee_v, end_v))

    def voltage(self, pressure_pa: ArrayLike) -> Floats:
        """Pa to V, clamped to the curve's ends."""
        return np.interp(np.asarray(pressure_pa, np.float64), self.pressure_pa, self.voltage_v)

    def pressure(self, voltage_v: ArrayLike) -> Floats:
        """V to Pa, clamped to the curve's ends."""
        volts = np.asarray(voltage_v, np.float64)
        return np.interp(volts, self.voltage_v[::-1], self.pressure_pa[::-1])


@dataclass(frozen=True, eq=False)
class Curves:
    """The curves of n sensors, evaluated together.

    pressure_pa, voltage_v: (c, n) float64, Pa and V, corner by corner as in PressureCurve; a curve
        with fewer corners repeats its last one.
    """

    pressure_pa: Floats
    voltage_v: Floats

    @classmethod
    def of(cls, curves: Sequence[PressureCurve]) -> Curves:
        """One curve per sensor, in their order."""
        corners = max(len(curve.pressure_pa) for curve in curves)

        def column(values: tuple[float, ...]) -> tuple[float, ...]:
            return values + values[-1:] * (corners - len(values))

        return cls(
            np.array([column(curve.pressure_pa) for curve in curves]).T,
            np.array([column(curve.voltage_v) for curve in curves]).T,
        )

    def __len__(self) -> int:
        return int(self.pressure_pa.shape[1])

    @cached_property
    def checksum(self) -> str:
        """CRC-32 of the corners in whole mPa and µV, as eight hexadecimal digits."""
        corners = np.rint(np.stack([self.pressure_pa * 1e3, self.voltage_v * 1e6]))
        return f"{zlib.crc32(corners.astype('<i8').tobytes()):08x}"

    def __getitem__(self, index: int) -> PressureCurve:
        """The curve of one sensor, without repeated corners."""
        pressure_pa, voltage_v = self.pressure_pa[:, index], self.voltage_v[:, index]
        new = np.append(True, np.diff(pressure_pa) > 0)
        return PressureCurve(tuple(pressure_pa[new].tolist()), tuple(voltage_v[new].tolist()))

    @property
    def range_pa(self) -> Floats:
        """(n,) highest pressure of each curve, Pa."""
        return np.asarray(self.pressure_pa[-1])

    def pressure(self, voltage_v: Floats32) -> Floats32:
        """V to Pa, (n,) float32 both, clamped to each curve's ends."""
        return convert(voltage_v, self.pieces)

    def voltage(self, pressure_pa: ArrayLike) -> Floats:
        """Pa to V, (n,) float64, clamped to each curve's ends."""
        pressure = np.broadcast_to(np.asarray(pressure_pa, dtype=np.float64), (len(self),))
        result = np.array(self.voltage_v[0])
        corners = zip(self.pressure_pa, self.voltage_v, strict=True)
        for (low_pa, low_v), (high_pa, high_v) in pairwise(corners):
            width_pa = np.where(high_pa > low_pa, high_pa - low_pa, 1.0)
            result += np.clip((pressure - low_pa) / width_pa, 0.0, 1.0) * (high_v - low_v)
        return result

    def fall_v(self, pressure_pa: float) -> Floats32:
        """By how much a pressure, Pa, pulls each voltage down from its rest, V, (n,) float32."""
        return np.asarray(self.voltage_v[0] - self.voltage(pressure_pa), dtype=np.float32)

    @cached_property
    def begin_v(self) -> Floats32:
        """Voltage at the start of every curve, V, (n,) float32."""
        return np.asarray(self.voltage_v[0], dtype=np.float32)

    @cached_property
    def end_v(self) -> Floats32:
        """Voltage at the end of every curve, V, (n,) float32."""
        return np.asarray(self.voltage_v[-1], dtype=np.float32)

    @cached_property
    def pieces(self) -> Floats32:
        """Start (V), width (V) and gain (Pa/V) of every piece, (p, 3, n) float32."""
        width_v = -np.diff(self.voltage_v, axis=0)
        gain = np.diff(self.pressure_pa, axis=0) / np.where(width_v > 0, width_v, 1.0)
        pieces = np.stack((self.voltage_v[:-1], width_v, gain), axis=1)
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
    def default(cls, curve: PressureCurve, nodes: int) -> Calibration:
        """The same curve for all nodes."""
        return cls(Curves.of([curve] * nodes), np.zeros(nodes, dtype=bool))

    @classmethod
    def of_nodes(
        cls, curves: Mapping[int, PressureCurve], default: PressureCurve, nodes: int
    ) -> Calibration:
        """Curves by node number, 1…nodes; nodes without one are uncalibrated."""
        numbers = range(1, nodes + 1)
        return cls(
            Curves.of([curves.get(number, default) for number in numbers]),
            np.array([number not in curves for number in numbers]),
        )


def _points(values: tuple[float, ...], scale: float, unit: str) -> str:
    return ", ".join(f"{value * scale:g}" for value in values) + f" {unit}"
