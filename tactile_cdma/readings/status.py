# SPDX-License-Identifier: Apache-2.0

"""What is to be said of a taxel's reading."""

from __future__ import annotations

from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools


class Status(IntFlag):
    """Status bits of a taxel; the same as the constants of TactileArray.msg."""

    OK = 0
    SILENT = 1
    SATURATED = 2
    LOW_SNR = 4
    STALE = 8
    UNCALIBRATED = 16
    MASKED = 32
    WEAK = 64
    FAULTY = 128


def is_in_service(status: NDArray[np.uint8]) -> Bools:
    """Of the same shape: taxels with a node that the layout does not mask."""
    return np.asarray(status & np.uint8(Status.MASKED) == 0)
