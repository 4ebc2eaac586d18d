# SPDX-License-Identifier: Apache-2.0

"""Keeping the nodes' clocks while they drift: from ordinary frames whose words are decided.

A node is all but alone in a frame from which the words of all others have been subtracted. What
their clocks' errors leave over is noise, whose power tells how large errors are just now. So a
few clocks around the present one are tried, as in a roll call, and their mean, weighted by
likelihood and by how likely such an error is, is where the clock moves.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .decorrelate import Decorrelator
from .node_clocks import NodeClocks
from .roll_call import RowSearch, raster

MAX_ERROR, MIN_ERROR = 0.15, 0.01
"""Mean error of all clocks at which a frame no longer counts as clean, and the least that is ever
expected, chips."""
REBUILD = 0.05
"""A decorrelator whose clocks have moved farther than this, chips, should be built anew."""
BATCH = 8
"""Nodes that are looked at in one frame; the next ones in the next."""


class ClockTracker:
    """Follows the clocks of the nodes that speak.

    clocks: as they are now. A displacement moves by less than MAX_ERROR in one frame.
    """

    def __init__(self, clocks: NodeClocks) -> None:
        self.clocks = clocks
        self._turn = 0

    def update(
        self,
        decorrelator: Decorrelator,
        samples: NDArray[np.float32],
        words: NDArray[np.float32],
        noise_rms_v: float,
    ) -> bool:
        """Learn from a frame; False where it isn't clean, which changes nothing.

        decorrelator: which took the frame apart. samples: (m,) V, as it got them. words: (k, n) V,
        its estimates as they were decided: each node's bits ± one amplitude, 0 for a silent node.
        noise_rms_v: of one sample.
        """
        model = decorrelator.line(words)
        left = samples[: model.size].astype(np.float64) - model
        power, own = float(left @ left) / left.size, float(model @ model) / left.size
        # An edge that is τ chips off leaves 4a²·|τ|, and every other chip begins with one.
        error = (power - noise_rms_v**2) / (2 * own) if own > 0 else math.inf
        if not error < MAX_ERROR:
            return False
        error = max(error, MIN_ERROR)
        speaking = np.flatnonzero(np.abs(words).max(axis=0))
        nodes = np.roll(speaking, -int(np.searchsorted(speaking, self._turn)))[:BATCH]
        self._turn = int(nodes[-1]) + 1
        spec = decorrelator.spec
        late = self.clocks.displacement([0, spec.chips])
        for node in nodes:
            alone = left + decorrelator.line(words[:, [node]], [node])
            begins, ends = raster(late[node], error, 1)
            energy = RowSearch(alone, spec.node_rows[node], spec, decorrelator.sampling).energy(
                begins, ends
            )
            apart = np.square(begins - late[node, 0]) + np.square(ends - late[node, 1])
            weight = np.exp((energy - energy.max()) / (2 * power) - apart / (2 * error**2))
            weight /= weight.sum()
            late[node] = weight @ begins, weight @ ends
        rate = (late[:, 1] - late[:, 0]) / spec.chips
        self.clocks = NodeClocks(late[:, 0], rate, self.clocks.known)
        return True
