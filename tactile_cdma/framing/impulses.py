# SPDX-License-Identifier: Apache-2.0

"""Removes impulses of a single sample, which switching loads couple into the line."""

import numpy as np

from ..base.arrays import Floats

_USUAL = 0.9
"""Share of samples that are no impulses, and of those whose height sets the limit. Chosen: ringing
edges are more than a tenth of a frame's samples, impulses fewer."""
_FARTHER = 6.0
"""Heights beyond this multiple of the usual one are impulses. Derived: a tenth of normal samples
stand off both neighbours by 0.9 deviations or more; 5.5 deviations occur less than once in 10⁷."""


def without_impulses(volts: Floats) -> Floats:
    """The samples with each impulse at the level of its nearer neighbour.

    volts: (m,) V. Returns the same array where there is none. An impulse stands off both neighbours
    by far more than most samples of this stretch do. Chips of two or more samples are left as they
    are, and so are the first and the last sample.
    """
    if volts.size < 3:
        return volts
    left, middle, right = volts[:-2], volts[1:-1], volts[2:]
    low, high = np.minimum(left, right), np.maximum(left, right)
    height = np.maximum(middle - high, low - middle)
    usual = int(_USUAL * height.size)
    limit = _FARTHER * max(float(np.partition(height, usual)[usual]), 0.0)
    at = np.flatnonzero(height > limit)
    if not at.size:
        return volts
    cleaned = volts.copy()
    cleaned[at + 1] = np.minimum(np.maximum(middle[at], low[at]), high[at])
    return cleaned
