# SPDX-License-Identifier: Apache-2.0

"""The force of a frame, and a value's history over the last seconds, for a small curve."""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Floats, Floats32
from ..readings.taxels import Coverage


def force_n(pressure_pa: Floats32, status: NDArray[np.uint8], areas_m2: Floats32) -> float:
    """Sum pressure × area, N: a lower bound unless all is read; NaN where most is not, or no area.

    pressure_pa, status, areas_m2: (t,).
    """
    if not (Coverage.of(pressure_pa, status).is_most and (areas_m2 > 0).all()):
        return math.nan
    return float(np.nansum(pressure_pa * areas_m2))


class History:
    """Keeps the values of the last span_s seconds."""

    def __init__(self, span_s: float) -> None:
        self.span_s = span_s
        self._values: deque[tuple[float, float]] = deque()

    def add(self, now_s: float, value: float) -> None:
        """Append a value (NaN: unknown) at a time that never decreases, s."""
        self._values.append((now_s, value))
        while now_s - self._values[0][0] > self.span_s:
            self._values.popleft()

    @property
    def latest(self) -> float:
        """Return the value added last; NaN: unknown, or none yet."""
        return self._values[-1][1] if self._values else math.nan

    def bins(self, now_s: float, count: int) -> Floats:
        """Return the maximum in each of count equal parts of the span, (count,); NaN: no value.

        The last part ends now. Maxima keep short peaks visible.
        """
        t_s, values = np.array(self._values).reshape(-1, 2).T
        part = count - 1 - np.floor((now_s - t_s) / self.span_s * count).astype(int)
        inside = (part >= 0) & (part < count)
        greatest = np.full(count, np.nan)
        np.fmax.at(greatest, part[inside], values[inside])
        return greatest
