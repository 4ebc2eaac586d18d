# SPDX-License-Identifier: Apache-2.0

"""What broken nodes put on the line instead of their words."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tactile_cdma.code.codes import row_signs, smallest_order
from tactile_cdma.code.encode import frame_levels, with_parity, word_bits
from tactile_cdma.code.frame import DEFAULT_AMPLITUDE_V, UNIPOLAR, FrameSpec
from tactile_cdma.sim.disturbance import Waveform

Floats = NDArray[np.float64]
Level = NDArray[np.float32]

LONG_S = 1e3
"""Period of frames that may be longer than they should be: what follows the true one is cut off."""


@dataclass(frozen=True)
class Turn:
    """What a node would say in one frame, and what chance has for it.

    node, other: from 0 on, the latter a sound one. code: its word; None: it is silent.
    edges_s: (span_chips + 1,) of its chips.
    life: drawn once for each time that the node breaks; chance: anew in every frame.
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
        """Its word, or any where it has none to say: broken nodes speak out of turn."""
        return self.any_word(self.chance) if self.code is None else self.code

    def any_word(self, rng: np.random.Generator) -> int:
        """A word drawn at random."""
        return int(rng.integers(1 << self.spec.bits))

    def said(self, code: int | None, row: int | None = None, gain: float = 1.0) -> Iterator[Level]:
        """The word's levels on the line, (span_chips,) V; nothing for None."""
        if code is not None:
            yield spoken(self.spec, code, self.row if row is None else row, gain)

    def on_time(self, levels: Iterator[Level]) -> Iterator[Waveform]:
        """The levels on the clock of the nodes."""
        for one in levels:
            yield one, self.edges_s


def spoken(spec: FrameSpec, code: int, row: int, gain: float = 1.0) -> Level:
    """Levels (span_chips,) V of a word on a code row, row sign and amplifier's polarity applied."""
    bits = word_bits(np.array([code]), spec.bits)
    bits = with_parity(bits) if spec.parity else bits
    sign = row_signs(np.array([row]), spec.sign_seed)[0]
    chips = np.outer(2.0 * bits[0] - 1.0, sign * spec.book.rows([row])[0])
    chips = (chips + 1) / 2 if spec.drive == UNIPOLAR else chips
    volts = gain * (spec.amplitude_v or DEFAULT_AMPLITUDE_V) * spec.polarity
    return frame_levels((volts * chips).astype(np.float32), spec)


Broken = Callable[[Turn], Iterator[Waveform]]
"""What a broken node adds to the line in its turn."""


def dead(_turn: Turn) -> Iterator[Waveform]:
    """Nothing."""
    return iter(())


def stuck(turn: Turn) -> Iterator[Waveform]:
    """Always the same, and always something."""
    return turn.on_time(turn.said(turn.any_word(turn.life)))


def doubled(others: int) -> Broken:
    """Its word, and so many others of nodes that were given the same number, and so its turn."""

    def both(turn: Turn) -> Iterator[Waveform]:
        words = [turn.code, *(turn.any_word(turn.chance) for _ in range(others))]
        for word in words if turn.code is not None else ():
            yield from turn.on_time(turn.said(word))

    return both


def chattering(turn: Turn) -> Iterator[Waveform]:
    """Every chip is as it comes, in half of the frames; else its word."""
    if turn.chance.random() < 0.5:
        return turn.on_time(turn.said(turn.code))
    (levels,) = turn.said(turn.heard)
    return turn.on_time(iter([levels * turn.chance.choice([-1, 1], levels.size).astype("f4")]))


def switching_on(turn: Turn) -> Iterator[Waveform]:
    """Only the end of its word."""
    (levels,) = turn.said(turn.heard)
    levels[: turn.chance.integers(1, levels.size)] = 0
    return turn.on_time(iter([levels]))


def cut_off(turn: Turn) -> Iterator[Waveform]:
    """Only the begin of its word."""
    (levels,) = turn.said(turn.heard)
    levels[turn.chance.integers(1, levels.size) :] = 0
    return turn.on_time(iter([levels]))


def late(most: float) -> Broken:
    """Its word, late by up to such a share of the frame, another one in every frame."""

    def delayed(turn: Turn) -> Iterator[Waveform]:
        delay_s = turn.chance.uniform(0, most) * (turn.edges_s[-1] - turn.edges_s[0])
        for levels in turn.said(turn.heard):
            yield levels, turn.edges_s + delay_s

    return delayed


def chips_late(turn: Turn) -> Iterator[Waveform]:
    """Its word, late by whole chips: with some orders that is another row."""
    chips = turn.chance.integers(1, turn.spec.order)
    delay_s = chips * (turn.edges_s[-1] - turn.edges_s[0]) / turn.spec.span_chips
    for levels in turn.said(turn.heard):
        yield levels, turn.edges_s + delay_s


def half_twice(turn: Turn) -> Iterator[Waveform]:
    """The first half of its word, twice."""
    (levels,) = turn.said(turn.heard)
    half = levels.size // 2
    levels[half : 2 * half] = levels[:half]
    return turn.on_time(iter([levels]))


def unused_row(turn: Turn) -> Iterator[Waveform]:
    """Its word on a row that no node has."""
    spare = turn.spec.spare_rows
    row = int(turn.life.integers(spare.start, spare.stop))
    return turn.on_time(turn.said(turn.code, row))


def other_row(turn: Turn) -> Iterator[Waveform]:
    """Its word on the row of a sound node."""
    return turn.on_time(turn.said(turn.code, turn.spec.first_row + turn.other))


def inverted(turn: Turn) -> Iterator[Waveform]:
    """Every chip of its word with the wrong sign."""
    return turn.on_time(turn.said(turn.code, gain=-1.0))


def louder(gain: float) -> Broken:
    """Its word, so many times as loud."""
    return lambda turn: turn.on_time(turn.said(turn.code, gain=gain))


def other_order(turn: Turn) -> Iterator[Waveform]:
    """Its word in the code book of the next order."""
    order = smallest_order(turn.spec.order + 1)
    return _of_another(turn, replace(turn.spec, order=order, frame_period_s=LONG_S))


def other_bits(turn: Turn) -> Iterator[Waveform]:
    """Its word with two bits more."""
    bits = turn.spec.bits + 2
    return _of_another(turn, replace(turn.spec, bits=bits, frame_period_s=LONG_S))


def one_of(*faults: Broken) -> Broken:
    """One of these, for as long as the node is broken."""
    return lambda turn: faults[turn.life.integers(len(faults))](turn)


def _of_another(turn: Turn, theirs: FrameSpec) -> Iterator[Waveform]:
    levels = spoken(theirs, turn.heard, turn.row)
    ours = turn.spec.span_chips
    levels = np.concatenate((levels, np.zeros(max(0, ours - levels.size), "f4")))
    chip_s = (turn.edges_s[-1] - turn.edges_s[0]) / ours
    yield levels, turn.edges_s[0] + chip_s * np.arange(levels.size + 1)
