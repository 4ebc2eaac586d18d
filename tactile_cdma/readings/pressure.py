# SPDX-License-Identifier: Apache-2.0

"""Voltages → pressures of all nodes: drift correction, curve, tare."""

import math
from typing import NamedTuple

import numpy as np

from ..base.arrays import Bools, Floats32
from .baseline import LOOK_S, Baseline
from .calibration import Calibration
from .drift import DriftTracker


class Bounds(NamedTuple):
    """Where the voltages of every node mean what they say, (n,) float32, V.

    Pressure pulls voltages down where sign is 1. There rest_v, where the curve begins, is the least
    that the highest code stands for, since that means "this or more". margin_v: by how much the
    lightest contact pulls a voltage down from there: one that lies higher above the rest is no
    reading, and a highest code that lies lower below it hides contacts. end_v: below it, a word may
    stand for a voltage beyond the end of the curve. Where sign is −1 all this is upside down.
    """

    sign: Floats32
    rest_v: Floats32
    margin_v: Floats32
    end_v: Floats32


class PressureChain:
    """Converts the nodes' voltages to pressures, frame by frame.

    voltage + drift → curve → pressure − tare. Every LOOK_S the
    readings are passed on to the baseline and to the drift tracker; a drift that changes by this
    takes effect in the next update.

    looked_s: device time of the last look, s; -inf: the next frame must be updated. moved: whether
    that changed the drift, since the last update. bounds: where voltages mean what they say.
    """

    def __init__(self, calibration: Calibration, baseline: Baseline, tracker: DriftTracker) -> None:
        self.calibration = calibration
        self.baseline = baseline
        self.tracker = tracker
        self.looked_s = -math.inf
        self.bounds = self._found_bounds()
        self.moved = False
        # Of the last silent frame: voltages, pressures before the tare, and whether they count.
        self._last: tuple[Floats32, Floats32, Bools] | None = None

    def hold(self, voltage_v: Floats32, pressure_pa: Floats32, valid: Bools) -> None:
        """Remember the last frame's readings, as the next ones may be the same; see try_hold."""
        self._last = voltage_v, pressure_pa, valid

    def look(self, voltage_v: Floats32, pressure_pa: Floats32, valid: Bools, t_s: float) -> None:
        """Pass a frame's readings on to tare and drift; to be called once every LOOK_S.

        As in `update`; pressure_pa: (n,) float32, Pa, before the tare.
        """
        self.moved = False
        self.looked_s, baseline, tracker = t_s, self.baseline, self.tracker
        baseline.look(voltage_v, pressure_pa, valid)
        if tracker.rules.drift_pa_per_min and tracker.is_due(t_s):
            before_v, reading_pa = baseline.drift_v, pressure_pa - baseline.tare_pa
            curves = self.calibration.curves
            tracker.follow(baseline, curves, voltage_v, reading_pa, valid, t_s)
            self.moved = baseline.drift_v is not before_v

    def try_hold(self, t_s: float) -> bool:
        """Keep the last pressures for the same voltages at t_s (s), if an update would give them.

        Returns whether they stand; if so, this counts as an update.
        """
        if self.moved or self._last is None or self.looked_s == -math.inf:
            return False
        if not 0 <= t_s - self.looked_s < LOOK_S:
            self.look(*self._last, t_s)
        return True

    def forget(self) -> None:
        """Start over: the device's clock was reset."""
        self.baseline.forget()
        self.tracker.forget()
        self.unsettle()

    def unsettle(self) -> None:
        """Have the next frame updated: something other than the voltages has changed."""
        self.looked_s, self.bounds = -math.inf, self._found_bounds()

    def _found_bounds(self) -> Bounds:
        """By the tracker's lightest contact and a count."""
        curves, adc = self.calibration.curves, self.tracker.adc
        # A code stands for half a count more or less, too, and the last ones for all beyond.
        end_v = np.clip(curves.end_v, 0, np.float32(adc.vref_v - adc.lsb_v))
        end_v += curves.sign * np.float32(adc.lsb_v / 2)
        margin_v = curves.pull_v(self.tracker.rules.contact_pa)
        return Bounds(curves.sign, curves.begin_v, margin_v, end_v)
