# SPDX-License-Identifier: Apache-2.0

"""What follows a frame: silence, or chips, which tell that it is longer or another one."""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from ..code.frame import BIPOLAR, UNIPOLAR, FrameSpec
from ..wire._protocol import TAIL_CHIPS
from .fit import ODD_SHARE, Fit, Line, dot

PROVEN = 30
"""After so many frames in a row that end in silence their length is known to be right."""
REST = 0.4
"""Share of the weakest word's amplitude below which a line is at rest."""


class End(IntEnum):
    """What follows a frame: other chips, those of some late nodes, or silence.

    LATE: among those who speak. MISLED: late words may appear as those of silent nodes.
    """

    OTHER = 0
    MISLED = 1
    LATE = 2
    SILENCE = 3


class FrameEnds:
    """Looks at the line after each frame of a stream."""

    def __init__(self, spec: FrameSpec) -> None:
        self._spec = spec
        self._silent = 0  # ends in a row, until proven

    def after(
        self,
        line: Line,
        fit: Fit,
        amplitude: NDArray[np.float32],
        noise: float,
        level_known: bool,
    ) -> End:
        """Whether the line is at rest after the fitted end.

        This tells a stretched frame from a shorter fit of its words, and words of more bits than
        specified. Once frames are proven to be of this length, some nodes among many may be late.
        SILENCE where nothing was received after the end. A level of rest that is not known yet is
        the frame's mean where row 0 is free, else it has to be 0, and seen: row 0 would take any
        other for a node.

        amplitude: (n,) V, of every node's word, 0 where silent. noise: variance of a chip's level,
        V². level_known: of the line at rest.
        """
        spec, end = self._spec, fit.end(self._spec) + 0.5
        begin, stop = math.ceil(end + 0.25 * fit.chip), math.floor(end + TAIL_CHIPS * fit.chip)
        tail = line.volts[begin:stop]
        if tail.size < 0.5 * fit.chip:
            return End.SILENCE if level_known or spec.first_row > 0 else End.OTHER
        if not level_known and spec.drive == UNIPOLAR:
            return End.SILENCE
        least = float(amplitude[amplitude > 0].min(initial=np.inf))
        if spec.first_row == 0:
            mean = float(tail.sum()) / tail.size
            if abs(mean) > REST * least + 4 * math.sqrt(noise * fit.chip / tail.size):
                return End.OTHER
        most = noise * fit.chip * (2 + 8 / math.sqrt(tail.size))  # the fewer the more by chance
        rest, left = (REST * least) ** 2 + most, dot(tail, tail) / tail.size
        if left >= rest and spec.first_row > 0 and spec.drive == BIPOLAR:
            tail = tail - self._baseline(line, fit, 0.5 * (begin + stop))
            left = min(left, dot(tail, tail) / tail.size)
        if left < rest:
            self._silent += 1
            return End.SILENCE
        if self._silent < PROVEN:
            self._silent = 0
            return End.OTHER
        quiet = int(np.count_nonzero(amplitude == 0))
        late = int(ODD_SHARE * (amplitude.size - quiet + 1))
        if left >= late * float(np.square(amplitude).max()) + most:
            return End.OTHER
        return End.LATE if quiet <= late else End.MISLED

    def _baseline(self, line: Line, fit: Fit, at: float) -> float:
        """What is under the words, hum for example, as the last bits tell: their means are it."""
        end, bit = fit.end(self._spec), self._spec.order * fit.chip
        before, last = line.means(end + bit * np.arange(-2.0, 1.0))
        return float(last + (last - before) * ((at - end) / bit + 0.5))
