"""What each taxel reads now: words become pressures, silent taxels hold, unheard ones go stale."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from .calibration import AdcScale, PressureCurve
from .decode import Words


class Status(IntFlag):
    """Status bits of a taxel; the same as the constants of TactileArray.msg."""

    OK = 0
    SILENT = 1
    SATURATED = 2
    LOW_SNR = 4
    STALE = 8
    UNCALIBRATED = 16
    MASKED = 32


@dataclass(frozen=True, slots=True)
class Readings:
    """The skin at one frame.

    pressure_pa, voltage_v: (n,) float32, NaN where stale. status: (n,) uint8, bits of Status.
    """

    pressure_pa: NDArray[np.float32]
    voltage_v: NDArray[np.float32]
    status: NDArray[np.uint8]


class Taxels:
    """Holds the last word of every node.

    A node that says nothing has not changed by more than its own threshold, so its last value
    stands (flag SILENT). Nodes also speak at a slow heartbeat; one unheard for stale_after_s gives
    NaN (flag STALE), as does one that was never heard.
    """

    def __init__(
        self, nodes: int, adc: AdcScale, curve: PressureCurve, stale_after_s: float
    ) -> None:
        self.stale_after_s = stale_after_s
        self._adc, self._curve = adc, curve
        self._voltage_v = np.full(nodes, np.nan, dtype=np.float32)
        self._pressure_pa = np.full(nodes, np.nan, dtype=np.float32)
        self._flags = np.zeros(nodes, dtype=np.uint8)
        self._heard_s = np.full(nodes, -np.inf)

    def forget(self) -> None:
        """The device's clock starts anew: nobody was heard on it."""
        self._heard_s[:] = -np.inf

    def update(self, words: Words, t_device: float) -> Readings:
        """Take one frame's words, spoken at t_device (s)."""
        spoke = words.active
        if spoke.any():
            voltage_v = self._adc.voltage(words.codes[spoke])
            self._voltage_v[spoke] = voltage_v
            self._pressure_pa[spoke] = self._curve.pressure(voltage_v)
            self._heard_s[spoke] = t_device
            flags = np.where(self._curve.saturated(voltage_v), Status.SATURATED, Status.OK)
            flags |= np.where(words.doubtful[spoke], Status.LOW_SNR, Status.OK)
            self._flags[spoke] = flags
        stale = t_device - self._heard_s > self.stale_after_s
        status = self._flags | np.where(spoke, Status.OK, Status.SILENT).astype(np.uint8)
        status[stale] = Status.SILENT | Status.STALE
        nan = np.float32(np.nan)
        return Readings(
            np.where(stale, nan, self._pressure_pa), np.where(stale, nan, self._voltage_v), status
        )
