# SPDX-License-Identifier: Apache-2.0

"""Statistics of features over a whole dataset, kept while it is written, for normalising."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...base.arrays import Bools


class Statistics:
    """Minimum, maximum, mean and standard deviation of one feature, per element.

    shape: of the feature; of an axis that is pooled, a value may have more elements. pooled: axes
    along which elements share one statistic, so that a taxel that nothing ever touched is not
    scaled up to noise. not_finite: elements that were NaN or infinite.

    Summed are differences to the first value, pooled to the mean of the first ones: the square of a
    Unix time in ns has 37 digits, of which float64 keeps 16.
    """

    def __init__(self, shape: tuple[int, ...], pooled: tuple[int, ...] = ()) -> None:
        self._shape, self._pooled = shape, pooled
        kept = tuple(1 if axis in pooled else size for axis, size in enumerate(shape))
        self._count, self._origin = np.zeros(kept), np.full(kept, np.nan)
        self._sum, self._squares = np.zeros(kept), np.zeros(kept)
        self._low, self._high = np.full(kept, np.inf), np.full(kept, -np.inf)
        self.not_finite = 0

    def add(self, values: NDArray[Any], valid: Bools | None = None) -> None:
        """Take in one value of the feature; elements that are not valid are left out.

        So are those that are not finite, which are counted.
        """
        values = np.asarray(values, dtype=np.float64)
        kept = np.isfinite(values)
        self.not_finite += int(np.count_nonzero(~kept))
        if valid is not None:
            kept &= valid
        along: dict[str, Any] = {"axis": self._pooled, "keepdims": True}
        count = kept.sum(**along)
        first = np.where(kept, values, 0.0).sum(**along) / np.maximum(count, 1)
        self._origin = np.where(np.isnan(self._origin) & (count > 0), first, self._origin)
        differences = np.where(kept, values - self._origin, 0.0)
        self._count += count
        self._sum += differences.sum(**along)
        self._squares += np.square(differences).sum(**along)
        low, high = (np.where(kept, values, limit) for limit in (np.inf, -np.inf))
        self._low = np.minimum(self._low, low.min(**along))
        self._high = np.maximum(self._high, high.max(**along))

    def content(self) -> dict[str, Any]:
        """Return what meta/stats.json holds; zeros where there was no value."""
        count = np.maximum(self._count, 1)
        mean = self._sum / count  # of the differences
        variance = np.maximum(self._squares / count - np.square(mean), 0.0)
        some = self._count > 0
        values = {
            "min": np.where(some, self._low, 0.0),
            "max": np.where(some, self._high, 0.0),
            "mean": np.where(some, self._origin + mean, 0.0),
            "std": np.sqrt(variance),
        }
        full = {name: np.broadcast_to(value, self._shape) for name, value in values.items()}
        content = {name: value.tolist() for name, value in full.items()}
        return content | {"count": [int(self._count.max())]}


def mask_content(shape: tuple[int, ...], count: int) -> dict[str, Any]:
    """Return a mask's statistics, by which normalising leaves it as it is.

    The true ones of a mask that is 1 throughout would make the first 0 that a robot sees −10⁸.
    """
    zeros, ones = np.zeros(shape).tolist(), np.ones(shape).tolist()
    return {"min": zeros, "max": ones, "mean": zeros, "std": ones, "count": [count]}
