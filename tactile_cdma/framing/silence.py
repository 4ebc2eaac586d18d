# SPDX-License-Identifier: Apache-2.0

"""Silence: how alike samples must be for the digitizer to leave them out (packet Quiet)."""

from __future__ import annotations

import math

from ..code.frame import FrameSpec
from .fit import least_power

MARGIN = 0.9
"""Of the limit: room for rounding."""


def quiet_uv(spec: FrameSpec) -> int:
    """Largest difference of two samples of a frame in which nobody spoke for certain, µV.

    0 where nothing is certain: with the amplitude unknown, or with row 0 assigned, whose node may
    hold one level for a whole frame.

    Samples within Q of each other have chips within Q. These have a variance of at most (Q/2)²
    (Popoviciu), and a correlation with any row but 0 of at most Q/2, whatever the line's offset:
    a row has as many chips of either sign. Both lie below the least power of a node, so that such
    a frame is idle to the decoder, too, if it gets all samples. The stretch need not cover a frame
    to its end: who speaks is heard in the first bit.
    """
    if spec.node_swing_v is None or spec.first_row == 0:
        return 0
    return min(int(MARGIN * 2e6 * math.sqrt(least_power(spec))), 2**32 - 1)
