# SPDX-License-Identifier: Apache-2.0

"""Expected samples of a code row, given the clocks of node and digitizer."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats, Floats32

RAMP = 1e-3
"""Width of the ramp that an edge is seen as, samples: so a sample at an edge has a value. Chosen:
far below the 0.03 chip to which edges have to be known."""


class RunningSum:
    """Sums of samples up to any instant; a sample at the instant counts in part.

    The difference of two sums is the correlation with a level of 1 V between their instants.
    """

    def __init__(self, samples: Floats, per_chip: float) -> None:
        """samples: (m,) float64, V, from the sync edge on; the line is taken as 0 outside.

        per_chip: samples in a nominal chip.
        """
        self._per_chip = per_chip
        self._samples = np.append(samples, 0.0)
        self._sums = np.concatenate(([0.0], np.cumsum(samples)))

    def until(self, chips: Floats) -> tuple[Floats, Floats]:
        """Sums up to instants of any shape, in nominal chips from the sync edge.

        Returns the sums, V, and the number of samples in them, which need not be whole.
        """
        position = np.clip(chips * self._per_chip, 0.0, float(self._samples.size - 1))
        whole = position.astype(np.intp)
        position -= whole
        part = np.clip((position - 0.5) / RAMP + 0.5, 0.0, 1.0)
        return self._sums[whole] + part * self._samples[whole], whole + part


def row_samples(
    rows: NDArray[np.int8], begin: Floats, chip: Floats, first: int, stop: int, per_chip: float
) -> Floats32:
    """Samples first…stop − 1 of code rows: (n, stop − first) float32, 0 outside a row.

    rows: (n, N) of ±1. begin, chip: (n,) start of each row and duration of its chips, nominal
    chips. per_chip: samples in a nominal chip. Sample s stands at instant s + ½ from the sync edge.
    """
    chips = rows.shape[1]
    sums = np.zeros((len(rows), chips + 1))
    np.cumsum(rows, axis=1, out=sums[:, 1:])
    levels = np.pad(rows, ((0, 0), (0, 1)))

    def integral(instant: NDArray[Any]) -> Floats:
        """∫ row up to instants in samples, in the row's own chips."""
        at = (instant / per_chip - begin[:, None]) / chip[:, None]
        np.clip(at, 0.0, chips, out=at)
        whole = at.astype(np.intp)
        at -= whole
        area: Floats = np.take_along_axis(sums, whole, 1)
        area += at * np.take_along_axis(levels, whole, 1)
        return area

    middle = np.arange(first + 0.5, stop)
    area = integral(middle + RAMP / 2) - integral(middle - RAMP / 2)
    area *= chip[:, None] * (per_chip / RAMP)
    return area.astype(np.float32)
