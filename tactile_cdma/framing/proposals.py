# SPDX-License-Identifier: Apache-2.0

"""Proposes durations of chips for a marked frame that no known timing explains.

The nodes share a board, whose clock may be off by up to 11 % (Liu et al.). Once a duration explains
a frame it is carried from frame to frame; so this is for the first frame, and after a change.
"""

from __future__ import annotations

import math

import numpy as np

from ..base.arrays import Floats, Floats32
from ..code.frame import MAX_STRETCH
from .frame_reader import FrameReader

SEARCH_PER_S = 8e6
"""Chips that a search may integrate per second of stream. At 0.02 µs each (measured at order 912)
that is 0.16 s: a disturbed line must not hold up the stream."""
LARGEST_SEARCH = SEARCH_PER_S
"""Most chips that one search may integrate: one second's worth."""
SURVIVORS = 8
"""Durations that are searched near by all bits, of those that suit the first bits best."""


class Proposer:
    """Proposes durations of chips, at a bounded cost."""

    def __init__(self, reader: FrameReader) -> None:
        self._reader, self._spec, self._chip = reader, reader.spec, reader.chip
        self._budget = LARGEST_SEARCH

    def propose(self, volts: Floats32, noise_v2: float, frames: int) -> float | None:
        """Return the duration of a chip, samples, that explains most of a frame's energy, if any.

        volts: (m,) from the mark on, V, without the level of rest. noise_v2: variance of a chip's
        level, V². frames: how many there were since the last call, which earn the time for this.
        """
        earned = frames * SEARCH_PER_S * self._spec.frame_period_s
        self._budget = min(self._budget + earned, LARGEST_SEARCH)
        self._reader.learn_rest(0.0, noise_v2)
        chips = np.append(self._all(volts), self._reader.duration(volts, -0.5))
        best = chips[np.argmax(self._reader.gains(volts, chips, self._spec.line_bits))]
        return float(best) or None

    def _all(self, volts: Floats32) -> Floats:
        """Return all durations of frames that end within the samples.

        If these are more than the budget has: those near the best by so many bits as it has for
        all. None if these are fewer than two, of which any chips make words.
        """
        spec, budget = self._spec, max(0.0, self._budget)
        bits = min(int(math.sqrt(budget / (2 * MAX_STRETCH)) / spec.order), spec.line_bits)
        if bits < 2:
            return np.empty(0)
        step = 0.5 / (bits * spec.order)
        chip: Floats = self._chip * np.arange(1, 1 + MAX_STRETCH + step, step)
        chip = chip[chip * spec.chips <= volts.size + self._chip]
        self._budget -= chip.size * bits * spec.order
        if bits < spec.line_bits and chip.size:
            best = chip[np.argsort(-self._reader.gains(volts, chip, bits))[:SURVIVORS]]
            fine, reach = 0.5 * self._chip / spec.chips, math.ceil(spec.line_bits / bits)
            chip = fine * np.unique(np.rint(best[:, None] / fine + np.arange(-reach, reach + 1)))
            self._budget -= chip.size * spec.chips
        return chip
