# SPDX-License-Identifier: Apache-2.0

"""Defines the flags of a taxel's reading."""

from enum import IntFlag

import numpy as np

from ..base.arrays import Bools, Uint8s


class Status(IntFlag):
    """Status bits of a taxel; the same as the constants of TactileArray.msg.

    UNHEARD is a pair of bits: the value is held, and not certain, for since its node was last heard
    for certain a frame was lost, or its word or silence was doubtful.
    """

    OK = 0
    SILENT = 1
    SATURATED = 2
    LOW_SNR = 4
    STALE = 8
    UNCALIBRATED = 16
    MASKED = 32
    WEAK = 64
    FAULTY = 128
    UNHEARD = SILENT | LOW_SNR


def is_in_service(status: Uint8s) -> Bools:
    """Find the taxels in service: with a node, not masked, nor counted as dead; same shape."""
    return np.asarray(status & np.uint8(Status.MASKED) == 0)


def is_certain(status: Uint8s) -> Bools:
    """Find the taxels whose value, if any, was heard and has not changed; same shape."""
    return np.asarray(status & np.uint8(Status.LOW_SNR) == 0)
