# SPDX-License-Identifier: Apache-2.0

"""Proposes durations of chips for a marked frame that no known timing explains.

The nodes share a board, whose clock may be off by up to 11 % (Liu et al.). Once a duration explains
a frame it is carried from frame to frame; so this is for the first frame, and after a change.
"""

from __future__ import annotations

import math

import numpy as np

from ..base.arrays import Floats, Floats32
from ..code.frame import MAX_STRETCH, FrameSpec
from ..code.transform import correlate
from ..words.limits import LIMITS
from .samples import Line

SEARCH_PER_S = 8e6
"""Chips that a search may integrate per second of stream. At 0.04 µs each (measured) that is 0.3 s:
a disturbed line must not hold up the stream."""
LARGEST_SEARCH = 1 << 23
"""Most chips that one search may integrate: one second's worth."""
SURVIVORS = 8
"""Durations that are searched near by all bits, of those that suit the first bits best."""
CHIPS_AT_ONCE = 1 << 18
"""Chips that are integrated at once: bounds the memory to some 10 MB."""


class Proposer:
    """Proposes durations of chips, at a bounded cost."""

    def __init__(self, spec: FrameSpec, chip: float) -> None:
        """chip: nominal duration, samples."""
        self._spec, self._chip = spec, chip
        self._budget = float(LARGEST_SEARCH)

    def propose(self, volts: Floats32, noise_v2: float, frames: int) -> float | None:
        """Return the duration of a chip, samples, that explains most of a frame's energy, if any.

        volts: (m,) from the mark on, V, without the level of rest. noise_v2: variance of a chip's
        level, V². frames: how many there were since the last call, which earn the time for this.
        """
        earned = frames * SEARCH_PER_S * self._spec.frame_period_s
        self._budget = min(self._budget + earned, LARGEST_SEARCH)
        line = Line(volts.astype(np.float64))
        chips = np.concatenate((self._by_end(line, noise_v2), self._all(line)))
        if not chips.size:
            return None
        return float(chips[np.argmax(self._gains(line, chips, self._spec.line_bits))])

    def _by_end(self, line: Line, noise_v2: float) -> Floats:
        """Return durations with which a frame ends where the line falls silent, or a bit later."""
        least = LIMITS.deviations * math.sqrt(noise_v2 * self._chip)
        least = max(least, 0.1 * (self._spec.node_swing_v or 0.0))
        loud = np.flatnonzero(np.abs(line.volts) > least)
        end = int(loud[-1]) + 1 if loud.size else 0
        chip: Floats = (end + self._chip * np.arange(-1.0, 3.0, 0.5)) / self._spec.chips
        return np.clip(chip, self._chip, (1 + MAX_STRETCH) * self._chip)

    def _all(self, line: Line) -> Floats:
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
        chip = chip[chip * spec.chips <= line.volts.size + self._chip]
        self._budget -= chip.size * bits * spec.order
        if bits < spec.line_bits and chip.size:
            best = chip[np.argsort(-self._gains(line, chip, bits))[:SURVIVORS]]
            fine, reach = 0.5 * self._chip / spec.chips, math.ceil(spec.line_bits / bits)
            chip = fine * np.unique(np.rint(best[:, None] / fine + np.arange(-reach, reach + 1)))
            self._budget -= chip.size * spec.chips
        return chip

    def _gains(self, line: Line, chip: Floats, bits: int) -> Floats:
        """Return the energy that words of constant amplitude explain of the first bits, (c,).

        All nodes count, even if faint: what noise has there is the same for all durations.
        """
        spec, gains = self._spec, []
        edges = np.arange(bits * spec.order + 1.0)
        for some in np.array_split(chip, 1 + chip.size * edges.size // CHIPS_AT_ONCE):
            chips = line.means(some[:, None] * edges - 0.5).reshape(-1, bits, spec.order)
            flipped = chips if spec.flips is None else chips * spec.flips[:bits]
            level = np.abs(correlate(flipped, spec.book)[..., spec.node_slice]).sum(axis=1)
            gains.append(np.einsum("cn,cn->c", level, level) * some)
        return np.concatenate(gains)
