# SPDX-License-Identifier: Apache-2.0

"""Reads frames whose samples are at hand, without a stream around them."""

from typing import Any

import numpy as np

from tactile_cdma.base import kernel
from tactile_cdma.base.arrays import Floats32
from tactile_cdma.framing.frame_reader import FrameReader
from tactile_cdma.framing.frames import LineFrame, Rejections, rejections_of


class SingleReader(FrameReader):
    """Reads one frame after the other, each from its first sample on."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._rejected = [0] * kernel.lib.FRAME_VERDICTS

    def read(self, volts: Floats32, first_index: int = 0) -> LineFrame | None:
        """Read one frame; volts: (m,), NaN where absurd; None: it is rejected.

        first_index: of the first sample in the stream.
        """
        verdict = self.verdict(np.ascontiguousarray(volts, np.float32))
        if verdict <= kernel.lib.FRAME_READ:
            return self.taken(first_index)
        self._rejected[verdict] += 1
        return None

    @property
    def rejections(self) -> Rejections:
        """Frames that were rejected."""
        return rejections_of(self._rejected)
