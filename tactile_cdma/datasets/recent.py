# SPDX-License-Identifier: Apache-2.0

"""The last frames of a stream as one contiguous array that is never copied."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class RecentFrames:
    """The last `length` frames, oldest first, always at hand as one view.

    Every frame is written twice into a buffer of twice the length, half of it apart, so that any
    `length` successive frames lie side by side somewhere: push() costs two short writes, and
    `window` nothing. count: frames pushed so far.
    """

    def __init__(self, length: int, shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> None:
        self._length = length
        self._frames = np.zeros((2 * length, *shape), dtype=dtype)
        self.count = 0

    def push(self, frame: NDArray[Any]) -> None:
        """Add the newest frame; it takes the place of the oldest."""
        place = self.count % self._length
        self._frames[place] = self._frames[place + self._length] = frame
        self.count += 1

    @property
    def window(self) -> NDArray[Any]:
        """(length, *shape) a view, zeros before the first frames; the next push() changes it."""
        begin = self.count % self._length
        return self._frames[begin : begin + self._length]
