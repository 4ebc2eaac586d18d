# SPDX-License-Identifier: Apache-2.0

"""Tells by what follows a frame whether it has the length that was fitted."""

import math
from enum import Enum

import numpy as np

from ..base.arrays import Floats32
from ..base.sums import dot, sums
from ..code.frame import BIPOLAR, UNIPOLAR, FrameSpec
from ..wire._protocol import TAIL_CHIPS
from .fit import Fit, Line
from .limits import LIMITS


class End(Enum):
    """What follows a frame.

    OTHER: chips, so it is another frame. MISLED: chips of a few nodes that are late, and whose
    words may appear as those of silent nodes. SILENCE: rest, or chips of late nodes that spoke.
    """

    OTHER, MISLED, SILENCE = range(3)


def tail_of(fit: Fit, spec: FrameSpec) -> tuple[int, int]:
    """Where the line is looked at after a frame, samples: begin and end."""
    end = fit.end(spec) + 0.5
    return math.ceil(end + 0.25 * fit.chip), math.floor(end + TAIL_CHIPS * fit.chip)


class FrameEnds:
    """Looks at the line after each frame of a stream.

    silent: how many frames ended in silence, or with the chips of few late nodes among many, in a
        row until that is proven. Of frames that go on, all nodes' chips seldom cancel to those.
    """

    def __init__(self, spec: FrameSpec) -> None:
        self._spec = spec
        self.silent = 0

    def observe(
        self, line: Line, fit: Fit, amplitude: Floats32, noise: float, level_known: bool
    ) -> End:
        """Look at what follows the fitted end, and count it.

        This tells a stretched frame from a shorter fit of its words, and words of more bits than
        specified. Once frames are proven to be of this length, some nodes among many may be late.
        SILENCE where nothing was received after the end. A level of rest that is unknown yet is the
        frame's mean, or where row 0 is used, 0, and has to be seen: row 0 takes others for a node.

        amplitude: (n,) V, of every node's word, 0 where silent. noise: variance of a chip's level,
        V². level_known: of the line at rest.
        """
        spec, (begin, stop) = self._spec, tail_of(fit, self._spec)
        tail = line.received[begin:stop]
        if tail.size < LIMITS.least_tail * fit.chip:
            return End.SILENCE if level_known or spec.first_row > 0 else End.OTHER
        if not level_known and spec.drive == UNIPOLAR:
            return End.SILENCE
        total, squares = sums(tail)
        mean = total / tail.size - line.level_v
        left = max(squares / tail.size - line.level_v * (2 * mean + line.level_v), 0.0)
        by_chance = LIMITS.tail_level * math.sqrt(noise * fit.chip / tail.size)
        most = noise * fit.chip * (LIMITS.tail_noise + LIMITS.tail_scatter / math.sqrt(tail.size))
        if left < most and (spec.first_row > 0 or abs(mean) <= by_chance):
            self.silent += 1
            return End.SILENCE
        least = float(amplitude[amplitude > 0].min(initial=np.inf))
        if spec.first_row == 0 and abs(mean) > LIMITS.rest * least + by_chance:
            return End.OTHER
        rest = (LIMITS.rest * least) ** 2 + most
        if left >= rest and spec.first_row > 0 and spec.drive == BIPOLAR:
            # Without the level under the words (hum, for example), which the last bits' means tell.
            last_bit, bit = fit.end(spec), spec.order * fit.chip
            before, last = line.means(last_bit + bit * np.arange(-2.0, 1.0))
            bits_on = (0.5 * (begin + stop) - last_bit) / bit + 0.5
            tail = line.volts[begin:stop] - float(last + (last - before) * bits_on)
            left = min(left, dot(tail, tail) / tail.size)
        if left < rest:
            self.silent += 1
            return End.SILENCE
        quiet = int(np.count_nonzero(amplitude == 0))
        late = int(LIMITS.odd_share * (amplitude.size - quiet + 1))
        few = left < late * float(np.square(amplitude).max()) + most
        if self.silent < LIMITS.proven_ends:
            self.silent = self.silent + 1 if few else 0
            return End.OTHER
        if not few:
            return End.OTHER
        return End.SILENCE if quiet <= late else End.MISLED
