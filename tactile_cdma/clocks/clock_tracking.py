# SPDX-License-Identifier: Apache-2.0

"""Follows the nodes' clocks while they drift, from ordinary frames whose words are decided.

A node is all but alone in a frame from which the words of all others have been subtracted. The
errors of their clocks leave noise, whose power tells how large these errors are. A few clocks
around the present one are tried, as in a roll call; the clock moves to their mean, weighted by
likelihood and by the prior probability of such an error.
"""

import math

import numpy as np

from ..base.arrays import Floats32
from .decorrelate import Decorrelator
from .node_clocks import NodeClocks
from .roll_call import RowSearch, raster

MAX_ERROR, MIN_ERROR = 0.15, 0.01
"""Mean error of all clocks, chips: the largest of a frame to learn from, and the least that is ever
assumed. Chosen: with larger errors the noise is no longer small beside the words."""
REBUILD = 0.05
"""Movement of a clock, chips, at which the decorrelator is rebuilt. Chosen: above the 0.03 chip to
which delays have to be known (design), since rebuilding 256 nodes takes a tenth of a second."""
NODES_PER_FRAME = 8
"""Nodes that are followed per frame, in turns. Chosen: bounds the time of an update."""


class ClockTracker:
    """Follows the clocks of the nodes that speak.

    clocks: as they are now. A displacement moves by less than MAX_ERROR in one frame.
    """

    def __init__(self, clocks: NodeClocks) -> None:
        self.clocks = clocks
        self._turn = 0

    def update(
        self, decorrelator: Decorrelator, samples: Floats32, words: Floats32, noise_rms_v: float
    ) -> bool:
        """Learn from a frame; returns False and changes nothing where the frame isn't clean.

        decorrelator: took the frame apart. samples: (m,) V, its input. words: (k, n) V, its
        decided estimates: each node's bits ± one amplitude, 0 for a silent node. noise_rms_v: of
        one sample.
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
        nodes = np.roll(speaking, -int(np.searchsorted(speaking, self._turn)))[:NODES_PER_FRAME]
        self._turn = int(nodes[-1]) + 1
        spec = decorrelator.spec
        late = self.clocks.displacement([0, spec.chips])
        for node in nodes:
            alone = left + decorrelator.line(words[:, [node]], [node])
            begins, ends = raster(late[node], error, 1)
            energy = RowSearch(alone, spec.node_rows[node], spec, decorrelator.per_chip).energy(
                begins, ends
            )
            apart = np.square(begins - late[node, 0]) + np.square(ends - late[node, 1])
            weight = np.exp((energy - energy.max()) / (2 * power) - apart / (2 * error**2))
            weight /= weight.sum()
            late[node] = weight @ begins, weight @ ends
        rate = (late[:, 1] - late[:, 0]) / spec.chips
        self.clocks = NodeClocks(late[:, 0], rate, self.clocks.known)
        return True
