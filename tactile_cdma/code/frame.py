# SPDX-License-Identifier: Apache-2.0

"""FrameSpec, which defines a frame's shape and its levels on the line."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Indices
from ..base.errors import SpecError, check_limits
from .codes import CodeBook, chip_flips, code_book, default_order, row_signs, smallest_order
from .sparse import MOST_NODES, ORDERS, code_digits, code_numbers, code_places

BIPOLAR, UNIPOLAR = "bipolar", "unipolar"
ORTHOGONAL, SPARSE = "orthogonal", "sparse"
LEAST_SCRAMBLED = 4
"""Least order of which chips are flipped."""
DEFAULT_AMPLITUDE_V = 0.3
"""Level of one node on the line, V, in the paper: about 300 mV."""
MAX_STRETCH = 0.11
"""Largest relative stretch that is searched for: the paper's 0.10 (8.0 to 8.8 ms) and a margin."""
MEASURING_S = 1e-3
"""Least gap after a frame, s, in which nodes measure and get ready for the next sync edge."""
_RANGES = {
    "nodes": (1, 65_536),
    "bits": (8, 16),
    "chip_s": (1e-8, 1.0),
    "first_row": (0, 65_535),
    "resync_chips": (0, 65_535),
    "guard_chips": (0, 255),
    "sign_seed": (0, 2**32 - 1),
    "amplitude_v": (1e-6, 100.0),
}
"""Range of each field that is not None."""


@dataclass(frozen=True)
class FrameSpec:
    """How n nodes share the line. Immutable; all other quantities follow from these fields.

    nodes: number of sensing nodes, n.
    bits: length of a node's ADC word, sent most significant bit first.
    order: chips per bit, N; 0 picks codes.default_order for the rows needed.
    chip_s: nominal chip duration, s.
    frame_period_s: from one frame's first chip to the next one's, s.
    first_row: code row of the first node; node i uses row first_row + i. 1 keeps the all-ones
        row free, 0 is the paper's assignment.
    sign_seed: seed of the row signs, 0…2³²−1; None for natural signs.
    drive: "bipolar" (a chip is ±A) or "unipolar" (0 or A).
    polarity: −1 where the amplifier inverts.
    amplitude_v: A, the level of one node on the digitized line, V; None learns it from each frame.
    parity: every word is followed by a bit that makes its number of ones even.
    resync_chips: chips after which nodes with clocks of their own start anew, at a sync edge; 0: at
        the frame's first chip only.
    guard_chips: pause before each such restart, chips, in which slow nodes finish.
    scramble: all nodes flip their chips alike, by a pseudo-random sequence as long as the frame, so
        that no row looks like another one that is late, and a frame like none that is shifted.
    codes: "orthogonal", or "sparse" (sparse.py): then order is free, there may be more nodes than
        chips, as long as few of them speak in a frame, and chips are always flipped.

    Raises SpecError for a field out of range or a combination that cannot work.
    """

    nodes: int = 16
    bits: int = 10
    order: int = 0
    chip_s: float = 50e-6
    frame_period_s: float = 12.8e-3
    first_row: int = 1
    sign_seed: int | None = 1
    drive: str = BIPOLAR
    polarity: int = 1
    amplitude_v: float | None = DEFAULT_AMPLITUDE_V
    parity: bool = False
    resync_chips: int = 0
    guard_chips: int = 0
    scramble: bool = False
    codes: str = ORTHOGONAL

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            if (value := getattr(self, name)) is not None:
                check_limits(name, value, low, high)
        if self.drive not in (BIPOLAR, UNIPOLAR):
            raise SpecError(f"drive is {self.drive!r}; it must be {BIPOLAR!r} or {UNIPOLAR!r}")
        if self.polarity not in (1, -1):
            raise SpecError(f"polarity is {self.polarity}; it must be 1 or -1")
        if self.codes == SPARSE:
            self._check_sparse()
        else:
            self._check_orthogonal()
        self._check_drive()
        if bool(self.resync_chips) != bool(self.guard_chips):
            raise SpecError(
                f"resync_chips is {self.resync_chips} and guard_chips {self.guard_chips}: "
                "restarts within a frame need both"
            )
        self._check_period()

    def _check_drive(self) -> None:
        """Raise SpecError for a drive that goes with neither row 0 nor scrambling."""
        if self.drive == UNIPOLAR and self.first_row == 0:
            raise SpecError(
                "unipolar drive cannot use code row 0: a 0 bit on the all-ones row looks like "
                "silence; set first_row to 1 or drive to bipolar"
            )
        if self.scramble and self.drive == UNIPOLAR:
            raise SpecError(
                "unipolar drive cannot be scrambled: the level that its nodes have in common would "
                "show in all rows; set scramble to false or drive to bipolar"
            )
        if self.scramble and self.order < LEAST_SCRAMBLED:
            raise SpecError(
                f"order is {self.order}: rows of fewer than {LEAST_SCRAMBLED} chips are not told "
                "apart by flipping chips; set scramble to false or use a longer order"
            )
        if self.scramble and self.sign_seed is None:
            raise SpecError("scramble takes its sequence from sign_seed: set that to 0 or more")

    def _check_period(self) -> None:
        """Raise SpecError for a frame that is longer than its period."""
        if not self.frame_s <= self.frame_period_s:
            guards = self.span_chips - self.chips
            guard_text = f"and {guards} guard chips " if guards else ""
            raise SpecError(
                f"a frame of {self.line_bits} bits × {self.order} chips × {self.chip_s * 1e6:g} µs "
                f"{guard_text}lasts {self.frame_s * 1e3:g} ms, longer than its period of "
                f"{self.frame_period_s * 1e3:g} ms: set frame_period_ms to "
                f"{self.roomy_period_ms:g} or more, or use shorter chips"
            )

    @property
    def roomy_period_ms(self) -> float:
        """Least period that leaves time to measure, and to see that a frame is over, ms."""
        return math.ceil((self.frame_s + MEASURING_S) * 1e4 - 1e-6) / 10

    def _check_orthogonal(self) -> None:
        if self.codes != ORTHOGONAL:
            raise SpecError(f"codes is {self.codes!r}; it must be {ORTHOGONAL!r} or {SPARSE!r}")
        needed = self.nodes + self.first_row
        if self.order == 0:
            object.__setattr__(self, "order", default_order(needed))
        else:
            code_book(self.order)  # raises where there is none, naming the nearest ones
        if self.order < needed:
            raise SpecError(
                f"{self.nodes} nodes from row {self.first_row} on need {needed} code rows, but "
                f"order {self.order} has {self.order}; use order {smallest_order(needed)}, or "
                "sparse codes"
            )

    def _check_sparse(self) -> None:
        least, most = ORDERS
        if not least <= self.order <= most:
            raise SpecError(
                f"order is {self.order}: sparse codes have {least} to {most} chips per bit, "
                "twice as many as nodes that speak in one frame, or more"
            )
        if self.nodes > MOST_NODES:
            raise SpecError(f"nodes is {self.nodes}: sparse codes have {MOST_NODES} at most")
        if self.first_row != 1:
            raise SpecError(
                f"first_row is {self.first_row}: the sparse code of a node is that of its number; "
                "set first_row to 1"
            )
        if self.drive == UNIPOLAR:
            raise SpecError(
                "sparse codes are scrambled, and unipolar drive cannot be: the level that its "
                "nodes have in common would show in all rows; set drive to bipolar"
            )
        object.__setattr__(self, "scramble", True)

    @cached_property
    def sparse(self) -> bool:
        """Whether codes are sparse."""
        return self.codes == SPARSE

    @cached_property
    def row_count(self) -> int:
        """Rows of which a frame's chips have a level: N, or of sparse codes 2^m ≥ n + 1."""
        return 1 << code_digits(self.nodes, self.order) if self.sparse else self.order

    @cached_property
    def code_places(self) -> Indices:
        """Where the chips of sparse codes are in a frame's 2^m places, (k·N,) into (k, 2^m)."""
        bit = np.arange(self.line_bits)[:, None] * self.row_count
        return (bit + code_places(self.nodes, self.line_bits, self.order)).ravel()

    @cached_property
    def code_numbers(self) -> Indices:
        """The number of the sparse code of every row, (2^m,)."""
        return code_numbers(code_digits(self.nodes, self.order))

    @cached_property
    def line_bits(self) -> int:
        """Bits of a word on the line, k: with its parity bit."""
        return self.bits + self.parity

    @cached_property
    def chips(self) -> int:
        """Coded chips per frame, k·N."""
        return self.line_bits * self.order

    @cached_property
    def span_chips(self) -> int:
        """Length of a frame in chips, with the guards between its sub-slots."""
        if not self.resync_chips:
            return self.chips
        return self.chips + (self.chips - 1) // self.resync_chips * self.guard_chips

    @cached_property
    def places(self) -> Indices:
        """Begin of each coded chip, chips after the frame's start, (k·N,)."""
        chip = np.arange(self.chips)
        if self.resync_chips:
            chip += chip // self.resync_chips * self.guard_chips
        return chip

    @cached_property
    def flips(self) -> NDArray[np.float32] | None:
        """What nodes that scramble multiply their chips by, (k, N) float32 of ±1; else None."""
        if not self.scramble:
            return None
        assert self.sign_seed is not None
        return chip_flips(self.line_bits, self.order, self.sign_seed).astype(np.float32)

    @property
    def frame_s(self) -> float:
        """Nominal duration of a frame, s."""
        return self.span_chips * self.chip_s

    @cached_property
    def node_swing_v(self) -> float | None:
        """Amplitude of one node's ± code on the line, V: A, or A/2 where the drive is unipolar."""
        if self.amplitude_v is None:
            return None
        return self.amplitude_v / (2 if self.drive == UNIPOLAR else 1)

    @cached_property
    def book(self) -> CodeBook:
        """The code book whose transform takes the rows apart: of this order, or of 2^m."""
        return code_book(self.row_count)

    @cached_property
    def rows(self) -> Indices:
        """Code row of every node, (n,)."""
        return np.arange(self.first_row, self.first_row + self.nodes)

    @cached_property
    def node_rows(self) -> NDArray[np.int8]:
        """The chips of a bit of every node, (n, N) int8 of ±1, row signs not applied."""
        return self.book.rows(self.rows)

    @cached_property
    def signs(self) -> NDArray[np.int8]:
        """Fixed sign of every node, (n,) int8 of ±1."""
        return row_signs(self.rows, self.sign_seed)

    @cached_property
    def sign_mask(self) -> NDArray[np.int32]:
        """XOR mask from the signs of a node's levels to its word, (n,) int32: all ones or 0."""
        inverted = self.signs * self.polarity < 0
        return np.where(inverted, np.int32((1 << self.line_bits) - 1), np.int32(0))

    @cached_property
    def spare_rows(self) -> slice:
        """Rows that no node uses and that carry no DC level; they show the noise floor."""
        after = slice(self.first_row + self.nodes, self.row_count)
        before = slice(1, max(1, self.first_row))
        return max(after, before, key=lambda rows: rows.stop - rows.start)
