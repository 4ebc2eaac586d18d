# SPDX-License-Identifier: Apache-2.0

"""Largest spread of samples for which the digitizer may send QUIET instead of them."""

from ..code.frame import FrameSpec

HEARD_SHARE = 0.135
"""Share of a node's amplitude from which on a faint word is no silence. Chosen: words at 0.15 A are
to be heard, and a tenth is for rounding of counts."""


def quiet_uv(spec: FrameSpec) -> int:
    """Largest difference of two samples of a frame that is certainly silent, µV.

    0 where no frame is: with the amplitude unknown, or with row 0 assigned, whose node may
    hold one level for a whole frame.

    Samples within Q of each other have chips within Q. These have a variance of at most (Q/2)²
    (Popoviciu), and a correlation with any row but 0 of at most Q/2, whatever the line's offset:
    a row has as many chips of either sign. Both lie below what a faint word has. The samples need
    not reach to the frame's end: a node that speaks is heard in the first bit.
    """
    if spec.node_swing_v is None or spec.first_row == 0:
        return 0
    return min(int(HEARD_SHARE * 2e6 * spec.node_swing_v), 2**32 - 1)
