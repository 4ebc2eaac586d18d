"""What a skin at rest reads: tare and slow drift, which readings are freed of."""

from __future__ import annotations

import numpy as np


class Baseline:
    """Per node, what is taken off.

    tare_pa: (n,) float32, Pa, pressure at rest (mounting, preload), subtracted from readings.
    drift_v: (n,) float32, V, added to measured voltages to undo what temperature and age do.
    """

    def __init__(self, nodes: int) -> None:
        self.tare_pa = np.zeros(nodes, dtype=np.float32)
        self.drift_v = np.zeros(nodes, dtype=np.float32)
