# SPDX-License-Identifier: Apache-2.0

"""Counts of the digitizer's converter → volts, compiled or in numpy."""

from __future__ import annotations

import numpy as np

from ..base import kernel
from ..base.arrays import Counts, Floats32


def numpy_volts(counts: Counts, zero: int, per_count_v: float) -> Floats32:
    """The line in V, float32, of counts (m,). zero: count at 0 V. per_count_v: V per count."""
    volts = counts.astype(np.float32)
    volts -= np.float32(zero)
    volts *= np.float32(per_count_v)
    return volts


def compiled_volts(counts: Counts, zero: int, per_count_v: float) -> Floats32:
    """As numpy_volts."""
    assert kernel.compiled is not None
    volts = np.empty(counts.size, np.float32)
    kernel.compiled.to_volts(zero, per_count_v, counts, volts)
    return volts


to_volts = numpy_volts if kernel.compiled is None else compiled_volts
