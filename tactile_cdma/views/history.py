# SPDX-License-Identifier: Apache-2.0

"""What a value was over the last seconds, for a curve a few characters or pixels wide."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray


class History:
    """Keeps the values of the last span_s seconds."""

    def __init__(self, span_s: float) -> None:
        self.span_s = span_s
        self._values: deque[tuple[float, float]] = deque()

    def add(self, now_s: float, value: float) -> None:
        """A value at a time that never falls; NaN: unknown."""
        self._values.append((now_s, value))
        while now_s - self._values[0][0] > self.span_s:
            self._values.popleft()

    def bins(self, now_s: float, count: int) -> NDArray[np.float64]:
        """(count,) the greatest value in each of so many equal parts of the span; NaN: none.

        The last part ends now, so that what was short stays seen.
        """
        greatest = np.full(count, -np.inf)
        known = [(t, value) for t, value in self._values if value == value]
        if known:
            age_s, values = now_s - np.array(known).T[0], np.array(known).T[1]
            place = count - 1 - np.floor(age_s / self.span_s * count).astype(int)
            inside = (place >= 0) & (place < count)
            np.maximum.at(greatest, place[inside], values[inside])
        return np.where(np.isinf(greatest), np.nan, greatest)
