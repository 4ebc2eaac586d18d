# SPDX-License-Identifier: Apache-2.0

"""Round contacts on a skin, and the driver's way from there to its contacts: for benchmarks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.readings.baseline import LOOK_S
from tactile_cdma.readings.calibration import Calibration, Curves
from tactile_cdma.readings.contact import Contacts, ContactTracker
from tactile_cdma.readings.taxels import Readings
from tactile_cdma.words.decode import silent
from tactile_cdma.words.health import NodeHealth

Floats = NDArray[np.float64]
Profile = Callable[[Floats], Floats]

SIDE = 20
NODES = SIDE * SIDE
CONFIG = SkinConfig.of({"nodes": NODES, "rows": SIDE, "columns": SIDE, "chip_us": 1.0})
LAYOUT = CONFIG.layout
PITCH_M, TAXEL_M = LAYOUT.pitch_m, 5.5e-3
PERIOD_S = 12.8e-3
AREA, POINT = "area", "point"


def hertz(rho: Floats) -> Floats:
    return np.asarray(np.sqrt(np.clip(1 - np.square(rho), 0, None)))


def soft(rho: Floats) -> Floats:
    return hertz(rho) ** 3


SHARE: dict[Profile, float] = {hertz: 2 / 3, soft: 2 / 5}
"""Mean pressure over peak pressure: ∫ profile(ρ) 2ρ dρ."""


def felt(profile: Profile, centre_m: Floats, radius_m: float, sensing: str = AREA) -> Floats:
    """(n,) relative pressure on the taxels: over their sensing areas, or at their centres."""
    steps = (np.arange(9) - 4) / 9 * TAXEL_M if sensing == AREA else np.zeros(1)
    offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    away_m = LAYOUT.flat_m - centre_m
    near = np.hypot(*away_m.T) < radius_m + PITCH_M
    distance_m = np.linalg.norm(away_m[near, None, :] + offsets, axis=-1)
    result = np.zeros(NODES)
    result[near] = profile(distance_m / radius_m).mean(axis=1)
    return result


class Feeling:
    """The driver's way from the nodes' voltages to contacts."""

    def __init__(self, curves: Curves | None = None) -> None:
        """curves: those of the sensors, and of their calibration; None: the default."""
        self.curves = curves or Curves.uniform(CONFIG.curve, NODES)
        self.taxels = Pipeline(CONFIG).taxels
        self.taxels.calibrate(Calibration(self.curves, np.zeros(NODES, dtype=bool)))
        self._health = NodeHealth(CONFIG.spec)
        self._tracker = ContactTracker(LAYOUT, CONFIG.contact)
        self._words = replace(silent(NODES, 0.0), active=np.ones(NODES, dtype=bool))
        self._now_s = 0.0

    def feel(self, voltage_v: Floats, passed_s: float = PERIOD_S) -> tuple[Readings, Contacts]:
        self._now_s += passed_s
        words = replace(self._words, codes=CONFIG.adc.code(voltage_v).astype(np.int32))
        readings = self.taxels.update(words, self._now_s, self._health)
        return readings, self._tracker.update(readings, self._now_s)

    def rest(self, seconds: float) -> None:
        """Nothing touches the skin for a while."""
        for _ in np.arange(0.0, seconds, LOOK_S):
            self.feel(self.curves.voltage(0.0), LOOK_S)
