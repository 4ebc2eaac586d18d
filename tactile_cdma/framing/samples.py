# SPDX-License-Identifier: Apache-2.0

"""Samples of a line, and their mean between instants that lie within samples.

Times are in samples relative to the first one; sample i is the line's level at instant i: it stands
for [i − ½, i + ½).
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..base.arrays import Floats, Floats32, Indices
from .frame_reader import BLUR


class Line:
    """Samples of a line and their running integral, evaluated at fractional instants.

    received: (m,) float64, V; the line is taken to be at rest outside. level_v: of rest, V.
    """

    def __init__(self, received: Floats, level_v: float = 0.0) -> None:
        self.received, self.level_v = received, level_v

    @cached_property
    def volts(self) -> Floats:
        """(m,) float64, V, without the level of rest."""
        return self.received - self.level_v if self.level_v else self.received

    @cached_property
    def sums(self) -> Floats:
        """Running integral, (m + 1,); float64 keeps 1e-16·m relative, far below any ADC count."""
        sums = np.empty(self.received.size + 1)
        sums[0] = 0.0
        np.cumsum(self.volts, out=sums[1:])
        return sums

    def means(self, edges: Floats) -> Floats32:
        """Mean level between consecutive edges, V: (…, e) samples to (…, e − 1) float32."""
        whole, share = _split(edges, self.volts.size)
        total, number = self.sum_before(whole, share), whole + share
        number = np.maximum(number[..., 1:] - number[..., :-1], 0.5)
        levels: Floats = (total[..., 1:] - total[..., :-1]) / number
        return levels.astype(np.float32)

    def sum_before(self, whole: Indices, share: Floats) -> Floats:
        """Sum of so many whole samples and a share of the next one, V."""
        return self.sums[whole] + share * self.volts[whole]


def _split(times: Floats, size: int) -> tuple[Indices, Floats]:
    """Samples taken before each instant: how many whole ones, and the share of the next one.

    A sample tells the level at its own instant, so it counts on one side of an edge only: to
    share it by areas would blur every chip with its neighbours.
    """
    whole, share = _place(times, size)
    return whole, np.minimum(np.maximum((share - 0.5) / BLUR + 0.5, 0.0), 1.0)


def _place(times: Floats, size: int) -> tuple[Indices, Floats]:
    """The sample that each instant lies in, 0…size − 1, and the share of it that has passed."""
    shifted = np.minimum(np.maximum(times + 0.5, 0.0), float(size))
    whole = np.minimum(shifted.astype(np.intp), size - 1)
    return whole, shifted - whole
