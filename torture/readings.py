# SPDX-License-Identifier: Apache-2.0

"""What words mean: the pressures that a driver has to show that has heard them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.config.skin_config import SkinConfig


def pressures(config: SkinConfig) -> NDArray[np.float64]:
    """What every code of every node means by its curve, (n, codes) Pa.

    The highest code says "so much or more": no pressure, where the sensor rests above it.
    """
    volts = config.adc.voltage(np.arange(1 << config.adc.bits))
    curves = [config.calibration.curves[node] for node in range(config.spec.nodes)]
    volts[-1] = max(volts[-1], *(curve.voltage_v[0] for curve in curves))
    return np.array([curve.pressure(volts) for curve in curves])


class Held:
    """What a driver reads that has heard these words: the last one of every node.

    pressure_pa: (n,) float64, Pa; NaN where it is not known.
    """

    def __init__(self, config: SkinConfig) -> None:
        self._pressure_of = pressures(config)
        self._nodes = np.arange(config.spec.nodes)
        self.pressure_pa = np.full(config.spec.nodes, np.nan)

    def after(
        self, active: NDArray[np.bool_], codes: NDArray[np.integer[Any]]
    ) -> NDArray[np.float64]:
        """What pressure_pa would be after these words, (n,) each."""
        return np.where(active, self._pressure_of[self._nodes, codes], self.pressure_pa)

    def hear(self, active: NDArray[np.bool_], codes: NDArray[np.integer[Any]]) -> None:
        """Take in words, (n,) each."""
        self.pressure_pa = self.after(active, codes)

    def miss(self, nodes: NDArray[np.bool_]) -> None:
        """Words of these nodes, (n,) bool, may have been lost."""
        self.pressure_pa[nodes] = np.nan
