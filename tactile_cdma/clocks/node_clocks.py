# SPDX-License-Identifier: Apache-2.0

"""Clocks of the nodes of a modular skin: each one's delay and chip duration.

All nodes hear the sync edge and then count chips of their own: chip c of node i begins
delay[i] + c·(1 + rate_error[i]) nominal chips after the edge. Its displacement at chip c is what
exceeds c. Times are in nominal chips from the sync edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import Bools, Floats
from ..base.errors import SpecError
from ..code.frame import FrameSpec

MAX_DELAY = 4.0
"""Largest believable delay of a node, chips. Chosen: four times what a roll call searches."""
MAX_CLOCK_ERROR = 0.03
"""Largest believable relative error of a node's clock. Chosen: half more than is searched for."""
HARMLESS = 0.06
"""Crosstalk of plain correlation, RMS in a node's amplitudes, below which clocks need no
decorrelation: at ρ = 6 it adds 13 % to the power of noise, (0.06·6)²; five deviations are 0.3."""


@dataclass(frozen=True, eq=False)
class NodeClocks:
    """Delay and clock error of n nodes.

    delay_chips: (n,) float64, from the sync edge to the first chip, nominal chips.
    rate_error: (n,) float64, duration of a chip over nominal, minus 1.
    known: (n,) bool, False where the entries are a guess.

    Raises SpecError for values beyond MAX_DELAY and MAX_CLOCK_ERROR.
    """

    delay_chips: Floats
    rate_error: Floats
    known: Bools

    def __post_init__(self) -> None:
        for name, kind in (("delay_chips", float), ("rate_error", float), ("known", bool)):
            value = np.array(getattr(self, name), dtype=kind)
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        for name, limit in (("delay_chips", MAX_DELAY), ("rate_error", MAX_CLOCK_ERROR)):
            wrong = np.flatnonzero(~(np.abs(getattr(self, name)) <= limit))
            if wrong.size:
                raise SpecError(
                    f"{name} of node {wrong[0] + 1} is {getattr(self, name)[wrong[0]]:g}; "
                    f"it must lie within ±{limit:g}"
                )

    @property
    def nodes(self) -> int:
        """Number of nodes, n."""
        return self.delay_chips.size

    def displacement(self, chip: ArrayLike) -> Floats:
        """Delay of each node at the begin of a chip: (…) chip numbers to (n, …) chips."""
        at = np.asarray(chip, dtype=np.float64)
        shape = (self.nodes,) + (1,) * at.ndim
        return self.delay_chips.reshape(shape) + self.rate_error.reshape(shape) * at

    def spread_chips(self, spec: FrameSpec) -> float:
        """Largest difference of two nodes' displacements within a frame, chips."""
        late = self.displacement([0, spec.chips])
        return float(np.max(late.max(axis=0) - late.min(axis=0)))

    def moved_chips(self, earlier: NodeClocks, spec: FrameSpec) -> float:
        """Largest change of a displacement within a frame since earlier clocks, chips."""
        at = [0, spec.chips]
        return float(np.abs(self.displacement(at) - earlier.displacement(at)).max())

    def end_s(self, spec: FrameSpec) -> float:
        """When the latest node ends its frame, s after the sync edge."""
        return float(spec.chips + self.displacement(spec.chips).max()) * spec.chip_s


def crosstalk(spec: FrameSpec, clocks: NodeClocks) -> float:
    """What all other nodes add to one correlation of plain decoding, RMS over a node's amplitude.

    Plain decoding fits one start and one chip duration to all nodes. A row that is δ ≤ 1 chips
    late is (1 − δ) of itself and δ of itself one chip later. All of the latter's power falls into
    the rows of the book: n rows leave δ²·n/N in each on average. The worst bit counts, or the worst
    slot where nodes start anew within a frame.
    """
    edges = np.arange(spec.line_bits + 1) * spec.order
    if spec.resync_chips:
        edges = np.array([0, min(spec.resync_chips, spec.chips)])
    late = clocks.displacement(edges)
    apart = np.minimum(np.abs(late - late.mean(axis=0)), 1.0)  # beyond a chip nothing is in common
    power = np.square(apart).mean(axis=0)
    worst = float(np.max((power[:-1] + power[1:]) / 2))
    return math.sqrt(spec.nodes / spec.order * worst)


def needs_decorrelation(spec: FrameSpec, clocks: NodeClocks) -> bool:
    """Whether these clocks are too far apart for plain correlation."""
    return crosstalk(spec, clocks) > HARMLESS
