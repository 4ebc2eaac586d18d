"""What each taxel reads now: words become pressures, silent taxels hold, unheard ones go stale."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from .calibration import AdcScale, PressureCurve
from .decode import Words
from .health import NodeHealth, NodeState


class Status(IntFlag):
    """Status bits of a taxel; the same as the constants of TactileArray.msg."""

    OK = 0
    SILENT = 1
    SATURATED = 2
    LOW_SNR = 4
    STALE = 8
    UNCALIBRATED = 16
    MASKED = 32
    WEAK = 64
    FAULTY = 128


@dataclass(frozen=True, slots=True)
class Readings:
    """The skin at one frame.

    pressure_pa, voltage_v: (n,) float32, NaN where there is no valid reading. status: (n,) uint8,
    bits of Status. Treat them as read-only: frames without news share them.
    """

    pressure_pa: NDArray[np.float32]
    voltage_v: NDArray[np.float32]
    status: NDArray[np.uint8]


class Taxels:
    """Holds the last word of every node.

    A node that says nothing has not changed by more than its own threshold, so its last value
    stands (flag SILENT). Nodes also speak at a slow heartbeat; one unheard for stale_after_s gives
    NaN (flag STALE), as does one that was never heard, and one whose words contradict the code
    (flag FAULTY).
    """

    def __init__(
        self, nodes: int, adc: AdcScale, curve: PressureCurve, stale_after_s: float
    ) -> None:
        self._stale_after_s = stale_after_s
        # A word has few values: every one is converted once, here.
        voltage_v = adc.voltage(np.arange(1 << adc.bits))
        self._voltage_of = voltage_v.astype(np.float32)
        self._pressure_of = curve.pressure(voltage_v).astype(np.float32)
        self._flags_of = np.where(curve.saturated(voltage_v), Status.SATURATED, Status.OK)
        self._flags_of = self._flags_of.astype(np.uint8)
        self._codes = np.zeros(nodes, dtype=np.int32)
        self._flags = np.zeros(nodes, dtype=np.uint8)
        self._heard_s = np.full(nodes, -np.inf)
        self._silence: Readings | None = None  # what silent frames read, until somebody speaks
        self._stale_from_s = -np.inf  # when the next node goes stale
        self._now_s = 0.0

    @property
    def stale_after_s(self) -> float:
        """A node silent for longer is stale, s."""
        return self._stale_after_s

    @stale_after_s.setter
    def stale_after_s(self, seconds: float) -> None:
        self._stale_after_s, self._silence = seconds, None

    @property
    def missing(self) -> list[int]:
        """Numbers, from 1 on, of the nodes not heard for stale_after_s, as of the last frame."""
        unheard = self._now_s - self._heard_s > self._stale_after_s
        numbers: list[int] = (np.flatnonzero(unheard) + 1).tolist()
        return numbers

    def forget(self) -> None:
        """The device's clock starts anew: nobody was heard on it."""
        self._heard_s[:] = -np.inf
        self._silence, self._stale_from_s = None, -np.inf

    def update(self, words: Words, t_device: float, health: NodeHealth) -> Readings:
        """Take one frame's words, spoken at t_device (s)."""
        self._now_s = t_device
        spoke = words.active
        anybody = bool(spoke.any())
        if anybody:
            np.copyto(self._codes, words.codes, where=spoke)
            np.copyto(self._heard_s, t_device, where=spoke)
            flags = self._flags_of[words.codes] | (words.doubtful * _LOW_SNR)
            np.copyto(self._flags, flags, where=spoke)
        elif self._silence is not None and t_device <= self._stale_from_s:
            return self._silence
        readings = self._read(spoke, t_device, health)
        self._silence = None if anybody else readings
        return readings

    def _read(self, spoke: NDArray[np.bool_], t_device: float, health: NodeHealth) -> Readings:
        pressure_pa, voltage_v = self._pressure_of[self._codes], self._voltage_of[self._codes]
        status = self._flags | ~spoke * _SILENT | _FLAGS_OF[health.state]
        invalid = health.invalid
        self._stale_from_s = float(self._heard_s.min()) + self._stale_after_s
        if t_device > self._stale_from_s:
            stale = t_device - self._heard_s > self._stale_after_s
            status[stale] = Status.SILENT | Status.STALE
            fresh_s = self._heard_s[~stale]
            self._stale_from_s = float(fresh_s.min(initial=np.inf)) + self._stale_after_s
            invalid = stale | invalid
        if invalid.any():
            pressure_pa[invalid] = voltage_v[invalid] = np.nan
        return Readings(pressure_pa, voltage_v, status)


_LOW_SNR = np.uint8(Status.LOW_SNR)
_SILENT = np.uint8(Status.SILENT)
_FLAGS_OF = np.zeros(len(NodeState), dtype=np.uint8)
_FLAGS_OF[NodeState.WEAK] = Status.WEAK
_FLAGS_OF[[NodeState.FAULTY, NodeState.DOUBLED]] = Status.FAULTY
