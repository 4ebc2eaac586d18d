# Copyright 2026 tactile_cdma maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Silence: how alike samples must be for the digitizer to leave them out (packet Quiet)."""

from __future__ import annotations

import math

from .fit import least_power
from .frame import FrameSpec

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
