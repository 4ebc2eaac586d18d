# SPDX-License-Identifier: Apache-2.0

"""Faults of nodes: what they put on the line instead of their words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.code.codes import row_signs, smallest_order
from tactile_cdma.code.encode import frame_levels, with_parity, word_bits
from tactile_cdma.code.frame import DEFAULT_AMPLITUDE_V, UNIPOLAR, FrameSpec
from tactile_cdma.code.transform import chips_of
from tactile_cdma.sim.line import Waveform

Floats = NDArray[np.float64]
Level = NDArray[np.float32]

LONG_S = 1e3
"""Frame period for specifications whose frames may be longer than the true period."""


Waveforms = list[Waveform]


@dataclass(frozen=True)
class Turn:
    """One frame of a broken node.

    node, other: indices of the node and of a sound one. code: its word; None: it is silent.
    edges_s: (span_chips + 1,) edges of its chips, s.
    life: random generator seeded once per episode; chance: anew for every frame.
    """

    spec: FrameSpec
    node: int
    other: int
    code: int | None
    edges_s: Floats
    life: np.random.Generator
    chance: np.random.Generator

    @property
    def row(self) -> int:
        """Its code row."""
        return self.spec.first_row + self.node

    @property
    def heard(self) -> int:
        """Its word, or a random one if it should be silent: broken nodes speak out of turn."""
        return self.any_word(self.chance) if self.code is None else self.code

    def any_word(self, rng: np.random.Generator) -> int:
        """A random word."""
        return int(rng.integers(1 << self.spec.bits))

    def levels(self) -> Level:
        """Levels of its word, or of any, on the line: (span_chips,) V."""
        return spoken(self.spec, self.heard, self.row)

    def says(self, code: int | None, row: int | None = None, gain: float = 1.0) -> Waveforms:
        """A word on a row, its own if None, on the nodes' clock; nothing for no word."""
        if code is None:
            return []
        return [(spoken(self.spec, code, self.row if row is None else row, gain), self.edges_s)]


def spoken(spec: FrameSpec, code: int, row: int, gain: float = 1.0) -> Level:
    """Levels (span_chips,) V of a word on a code row, row sign and amplifier's polarity applied."""
    bits = word_bits(np.array([code]), spec.bits)
    bits = with_parity(bits) if spec.parity else bits
    rows = np.zeros((spec.line_bits, spec.row_count), np.float32)
    rows[:, row] = (2.0 * bits[0] - 1.0) * row_signs(np.array([row]), spec.sign_seed)[0]
    chips = chips_of(rows, spec).astype(np.float64)
    chips = (chips + 1) / 2 if spec.drive == UNIPOLAR else chips
    volts = gain * (spec.amplitude_v or DEFAULT_AMPLITUDE_V) * spec.polarity
    return frame_levels((volts * chips).astype(np.float32), spec)


Broken = Callable[[Turn], Waveforms]
"""What a broken node adds to the line in its turn."""


def dead(_turn: Turn) -> Waveforms:
    """Nothing."""
    return []


def stuck(turn: Turn) -> Waveforms:
    """Say one word in every frame, also when it should be silent."""
    return turn.says(turn.any_word(turn.life))


def doubled(others: int) -> Broken:
    """Its word, and those of so many other nodes with the same number, in the same turn."""

    def both(turn: Turn) -> Waveforms:
        if turn.code is None:
            return []
        words = [turn.code, *(turn.any_word(turn.chance) for _ in range(others))]
        return [waveform for word in words for waveform in turn.says(word)]

    return both


def chattering(turn: Turn) -> Waveforms:
    """Random chips in half of the frames, otherwise its word."""
    if turn.chance.random() < 0.5:
        return turn.says(turn.code)
    levels = turn.levels()
    return [(levels * turn.chance.choice([-1, 1], levels.size).astype("f4"), turn.edges_s)]


def switching_on(turn: Turn) -> Waveforms:
    """Only the end of its word."""
    levels = turn.levels()
    levels[: turn.chance.integers(1, levels.size)] = 0
    return [(levels, turn.edges_s)]


def cut_off(turn: Turn) -> Waveforms:
    """Only the beginning of its word."""
    levels = turn.levels()
    levels[turn.chance.integers(1, levels.size) :] = 0
    return [(levels, turn.edges_s)]


def late(most: float) -> Broken:
    """Its word, late by up to this share of the frame, another one in every frame."""

    def delayed(turn: Turn) -> Waveforms:
        delay_s = turn.chance.uniform(0, most) * (turn.edges_s[-1] - turn.edges_s[0])
        return [(turn.levels(), turn.edges_s + delay_s)]

    return delayed


def chips_late(turn: Turn) -> Waveforms:
    """Its word, late by whole chips: with some orders that is another row."""
    chips = turn.chance.integers(1, turn.spec.order)
    delay_s = chips * (turn.edges_s[-1] - turn.edges_s[0]) / turn.spec.span_chips
    return [(turn.levels(), turn.edges_s + delay_s)]


def half_twice(turn: Turn) -> Waveforms:
    """The first half of its word, twice."""
    levels = turn.levels()
    half = levels.size // 2
    levels[half : 2 * half] = levels[:half]
    return [(levels, turn.edges_s)]


def unused_row(turn: Turn) -> Waveforms:
    """Its word on a row that no node has."""
    spare = turn.spec.spare_rows
    return turn.says(turn.code, int(turn.life.integers(spare.start, spare.stop)))


def other_row(turn: Turn) -> Waveforms:
    """Its word on the row of a sound node."""
    return turn.says(turn.code, turn.spec.first_row + turn.other)


def inverted(turn: Turn) -> Waveforms:
    """Every chip of its word with the wrong sign."""
    return turn.says(turn.code, gain=-1.0)


def louder(gain: float) -> Broken:
    """Its word, so many times as loud."""
    return lambda turn: turn.says(turn.code, gain=gain)


def other_order(turn: Turn) -> Waveforms:
    """Its word in the code book of the next order."""
    order = smallest_order(turn.spec.order + 1)
    return _of_another(turn, replace(turn.spec, order=order, frame_period_s=LONG_S))


def other_bits(turn: Turn) -> Waveforms:
    """Its word with two bits more."""
    bits = turn.spec.bits + 2
    return _of_another(turn, replace(turn.spec, bits=bits, frame_period_s=LONG_S))


def one_of(*faults: Broken) -> Broken:
    """One of these faults, chosen per episode."""
    return lambda turn: faults[turn.life.integers(len(faults))](turn)


def _of_another(turn: Turn, theirs: FrameSpec) -> Waveforms:
    levels = spoken(theirs, turn.heard, turn.row)
    ours = turn.spec.span_chips
    levels = np.concatenate((levels, np.zeros(max(0, ours - levels.size), "f4")))
    chip_s = (turn.edges_s[-1] - turn.edges_s[0]) / ours
    return [(levels, turn.edges_s[0] + chip_s * np.arange(levels.size + 1))]
