# SPDX-License-Identifier: Apache-2.0

"""Clocks of the nodes: what each one's delay and chip duration are, where a skin is modular.

All nodes hear the sync edge and then count chips of their own: chip c of node i begins
delay[i] + c·(1 + rate_error[i]) nominal chips after the edge. Its displacement at chip c is what
exceeds c. Times are in nominal chips from the sync edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.errors import SpecError
from ..code.frame import FrameSpec

Floats = NDArray[np.float64]

MAX_DELAY = 4.0
"""Largest believable delay of a node, chips."""
MAX_RATE_ERROR = 0.03
"""Largest believable error of a node's clock."""
HARMLESS = 0.06
"""Crosstalk of plain correlation, relative to a node's amplitude, that costs next to nothing: to
noise at ρ = 6 it adds 13 % of power, and five of its deviations are a third of a bit."""


@dataclass(frozen=True, eq=False)
class NodeClocks:
    """Delay and clock error of n nodes.

    delay_chips: (n,) float64, from the sync edge to the first chip, nominal chips.
    rate_error: (n,) float64, duration of a chip over nominal, minus 1.
    known: (n,) bool, measured; the entries of the others are a guess.

    Raises SpecError for entries that no node has.
    """

    delay_chips: Floats
    rate_error: Floats
    known: NDArray[np.bool_]

    def __post_init__(self) -> None:
        for name, kind in (("delay_chips", float), ("rate_error", float), ("known", bool)):
            value = np.array(getattr(self, name), dtype=kind)
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if self.delay_chips.ndim != 1 or not (
            self.delay_chips.shape == self.rate_error.shape == self.known.shape
        ):
            raise SpecError(
                f"delay_chips, rate_error and known have shapes {self.delay_chips.shape}, "
                f"{self.rate_error.shape} and {self.known.shape}; all must be (nodes,)"
            )
        for name, limit in (("delay_chips", MAX_DELAY), ("rate_error", MAX_RATE_ERROR)):
            wrong = np.flatnonzero(~(np.abs(getattr(self, name)) <= limit))
            if wrong.size:
                raise SpecError(
                    f"{name} of node {wrong[0] + 1} is {getattr(self, name)[wrong[0]]:g}; "
                    f"it must lie within ±{limit:g}"
                )

    @classmethod
    def nominal(cls, nodes: int) -> NodeClocks:
        """Clocks of which nothing is known: all on the digitizer's."""
        return cls(np.zeros(nodes), np.zeros(nodes), np.zeros(nodes, bool))

    @property
    def nodes(self) -> int:
        """Number of nodes, n."""
        return self.delay_chips.size

    def displacement(self, chip: ArrayLike) -> Floats:
        """How late each node begins a chip of the frame: (…) chip numbers to (n, …) chips."""
        at = np.asarray(chip, dtype=np.float64)
        shape = (self.nodes,) + (1,) * at.ndim
        late: Floats = self.delay_chips.reshape(shape) + self.rate_error.reshape(shape) * at
        return late

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

    def with_guesses(self) -> NodeClocks:
        """The same, and unknown nodes take the median of the known ones."""
        if not self.known.any():
            return self
        delay = np.where(self.known, self.delay_chips, np.median(self.delay_chips[self.known]))
        rate = np.where(self.known, self.rate_error, np.median(self.rate_error[self.known]))
        return NodeClocks(delay, rate, self.known)


def crosstalk(spec: FrameSpec, clocks: NodeClocks) -> float:
    """What all others add to one correlation of plain decoding, rms over a node's amplitude.

    Plain: one start and one chip duration for all, fitted to them. A row that is δ ≤ 1 chips late
    is (1 − δ) of itself and δ of itself one chip on, and the rows take up all of the latter's
    power: n rows leave δ²·n/N in each on average. The worst bit counts, or the worst slot where
    nodes start anew within a frame.
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
