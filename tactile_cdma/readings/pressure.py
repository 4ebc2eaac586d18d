# SPDX-License-Identifier: Apache-2.0

"""Voltages → pressures of all nodes: drift correction, curve, tare; and how sure they are."""

import math
from typing import NamedTuple

import numpy as np

from ..base.arrays import Bools, Floats, Floats32
from .baseline import LOOK_S, Baseline
from .calibration import Calibration
from .drift import DriftTracker

CODE_LSB2, HELD_LSB2 = 1 / 12, 9 / 12
"""Variance of what a code stands for, LSB²: half a count more or less; of a silent node's, one and
a half, as it speaks once its code has changed by more than a threshold of one."""
STEPS, STEPS_LSB2 = 9.0, 0.5
"""A node's load moves where the mean of its squared second differences exceeds their median: by a
factor, and by so much, LSB²: a code that flickers seldom has a median of 0. Chosen: a step, which
two of six show, exceeds it, noise hardly does (its ratio is 2.2)."""
MEMORY = 1 / 64
"""Weight of a new look at the noise. Chosen: the mean of 8 s, of all nodes, is off by 2 %."""


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
    """Holds what the kernel converts the nodes' voltages to pressures by, see Readout.

    voltage + drift → curve → pressure − tare. Every LOOK_S the readings are passed on to the
    baseline and to the drift tracker; a drift that changes by this takes effect in the next frame
    that is read.

    looked_s: device time of the last look, s; -inf: the next frame must be read. moved: whether
    that changed the drift, since a frame was read. bounds: where voltages mean what they say.
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
        """Pass a frame's readings at t_s, s, on to tare and drift; once every LOOK_S.

        voltage_v: (n,) V, without drift. pressure_pa: (n,) Pa, before the tare. valid: (n,) bool.
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


class Uncertainty:
    """Tells how sure readings are, in pascal: 1 σ per node.

    Independent errors add up as variances: of the node's converter now and at the tare, noise, what
    the calibration left over, drift that came since the node last rested, and the sensor's loop.
    docs/pressure.md says what is not included.
    """

    def __init__(self, chain: PressureChain) -> None:
        self._chain, self._lsb2 = chain, chain.tracker.lsb_v**2
        self._noise_v2: float | None = None
        self._looked_s = -np.inf
        self._was_silent = np.zeros(len(chain.calibration.curves), dtype=bool)

    def sigma_pa(self, pressure_pa: Floats32, spoke: Bools, now_s: float) -> Floats:
        """Return 1 σ of every node's reading, (n,), Pa; NaN where the calibration tells none.

        pressure_pa: (n,) float32, Pa, before the tare. spoke: (n,), who did in this frame.
        """
        chain, curves, baseline = self._chain, self._chain.calibration.curves, self._chain.baseline
        self._look()
        self._was_silent |= ~spoke
        _, gain, width_pa = curves.pieces.transpose(1, 0, 2)
        ends_pa = np.cumsum(width_pa[:-1], axis=0)
        piece = (pressure_pa > ends_pa).sum(axis=0)
        gains = np.abs(gain[piece, np.arange(len(piece))])
        residual_v, loop = curves.errors
        v2 = self._lsb2 * np.where(spoke, CODE_LSB2, HELD_LSB2) + max(self._noise_v2 or 0.0, 0.0)
        v2 += np.maximum(np.square(residual_v) - CODE_LSB2 * self._lsb2, 0.0)
        # As far as drift went since the tare, but no faster than it is followed.
        away_pa = (now_s - chain.tracker.rested_s) * (chain.tracker.rules.drift_pa_per_min / 60)
        drift_v2 = np.mean(np.square(baseline.drift_v - baseline.tared_drift_v))
        v2 += np.minimum(drift_v2, np.square(away_pa / gain[0]))
        tare_v2 = self._lsb2 * np.where(self._was_silent, HELD_LSB2, CODE_LSB2) * baseline.tared
        pa2 = v2 * np.square(gains) + tare_v2 * np.square(gain[0]) + np.square(loop * pressure_pa)
        return np.asarray(np.sqrt(pa2))

    def _look(self) -> None:
        """Take in the noise of the last second."""
        baseline = self._chain.baseline
        if self._chain.looked_s == self._looked_s or not baseline.seen:
            return
        self._looked_s = self._chain.looked_s
        voltage_v, _, valid = baseline.last_second
        twice_v = np.diff(voltage_v[:, valid.all(axis=0)].astype(np.float64), 2, axis=0)
        squares_v2 = np.square(twice_v) / 6  # of independent errors: 1 + 4 + 1 times their variance
        most_v2 = STEPS * np.median(squares_v2, axis=0) + STEPS_LSB2 * self._lsb2
        steady_v2 = (each_v2 := squares_v2.mean(axis=0))[each_v2 <= most_v2]
        if not 2 * steady_v2.size > each_v2.size:
            return  # most of the skin moves
        found_v2 = float(steady_v2.mean()) - CODE_LSB2 * self._lsb2
        before_v2 = found_v2 if self._noise_v2 is None else self._noise_v2
        self._noise_v2 = before_v2 + MEMORY * (found_v2 - before_v2)
