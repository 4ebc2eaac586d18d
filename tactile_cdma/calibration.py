"""ADC code → voltage → pressure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import SpecError


@dataclass(frozen=True, slots=True)
class AdcScale:
    """The sensing node's converter: V = code · vref / 2ᵏ.

    The paper's decoded examples (1.18, 1.80 and 2.14 V) fit 2¹⁰ exactly and 2¹⁰ − 1 not.
    """

    bits: int = 10
    vref_v: float = 3.3

    def __post_init__(self) -> None:
        if not 0 < self.vref_v <= 100:
            raise SpecError(f"vref is {self.vref_v} V; it must lie within 0…100 V")

    @property
    def lsb_v(self) -> float:
        """One count, V."""
        return self.vref_v / (1 << self.bits)

    def voltage(self, code: ArrayLike) -> NDArray[np.float64]:
        """ADC codes to V."""
        return np.asarray(code, dtype=np.float64) * self.lsb_v

    def code(self, voltage_v: ArrayLike) -> NDArray[np.int64]:
        """The code that the converter gives for a voltage: rounded down, clamped to its range."""
        counts = np.floor(np.asarray(voltage_v, dtype=np.float64) / self.lsb_v)
        return np.clip(counts, 0, (1 << self.bits) - 1).astype(np.int64)


@dataclass(frozen=True, slots=True)
class PressureCurve:
    """A piecewise linear sensor characteristic; the voltage falls as the pressure rises.

    pressure_pa: rising corner pressures, Pa, the first one 0.
    voltage_v: falling voltages at those corners, V.

    Raises SpecError where the curve is not strictly monotone.
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

    @property
    def range_pa(self) -> float:
        """The highest pressure that the curve covers, Pa."""
        return self.pressure_pa[-1]

    def voltage(self, pressure_pa: ArrayLike) -> NDArray[np.float64]:
        """Pa to V, clamped to the curve's ends."""
        return np.interp(
            np.asarray(pressure_pa, dtype=np.float64), self.pressure_pa, self.voltage_v
        )

    def pressure(self, voltage_v: ArrayLike) -> NDArray[np.float64]:
        """V to Pa, clamped to 0…range: above V0 there is no pressure, below the end full range."""
        volts = np.asarray(voltage_v, dtype=np.float64)
        return np.interp(volts, self.voltage_v[::-1], self.pressure_pa[::-1])

    def saturated(self, voltage_v: ArrayLike) -> NDArray[np.bool_]:
        """Where the voltage lies beyond the end of the range, so that the pressure is clamped."""
        return np.asarray(voltage_v) < self.voltage_v[-1]


def _points(values: tuple[float, ...], scale: float, unit: str) -> str:
    return ", ".join(f"{value * scale:g}" for value in values) + f" {unit}"
