# SPDX-License-Identifier: Apache-2.0

"""Encodes words as the nodes do: to the chips that they put on the line."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.arrays import Floats32
from ..base.errors import SpecError
from .frame import DEFAULT_AMPLITUDE_V, UNIPOLAR, FrameSpec
from .transform import chips_of


def word_bits(codes: ArrayLike, bits: int) -> NDArray[np.uint8]:
    """Bits of ADC words, most significant first: (n,) integers to (n, bits) uint8.

    Raises SpecError where a code does not fit.
    """
    words = np.asarray(codes, dtype=np.int64)
    if words.size and not 0 <= words.min() <= words.max() < 1 << bits:
        bad = words[(words < 0) | (words >= 1 << bits)][0]
        raise SpecError(f"code {bad} does not fit {bits} bits (0…{(1 << bits) - 1})")
    return ((words[:, None] >> np.arange(bits - 1, -1, -1)) & 1).astype(np.uint8)


def with_parity(bits: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Words (n, b) of bits, each followed by the bit that makes its ones even: (n, b + 1)."""
    return np.column_stack((bits, bits.sum(axis=1, dtype=np.uint8) & 1))


def line_chips(
    spec: FrameSpec,
    codes: ArrayLike,
    active: ArrayLike | None = None,
    amplitude_v: ArrayLike | None = None,
) -> Floats32:
    """Level of the digitized line in every chip of one frame.

    codes: (n,) ADC words. active: (n,) bool, all by default; a silent node adds nothing.
    amplitude_v: (n,) or scalar, V; the specification's, else the paper's by default.
    Returns (k, N) float32, V, amplifier polarity applied, offset and noise not.
    """
    default_v = DEFAULT_AMPLITUDE_V if spec.amplitude_v is None else spec.amplitude_v
    level_v = np.broadcast_to(default_v if amplitude_v is None else amplitude_v, spec.nodes)
    speaking = np.ones(spec.nodes, bool) if active is None else np.asarray(active, bool)
    level_v = np.where(speaking, level_v, 0.0)
    bits = word_bits(codes, spec.bits)
    if spec.parity:
        bits = with_parity(bits)
    symbols = np.zeros((spec.line_bits, spec.row_count), dtype=np.float32)
    symbols[:, spec.rows] = (2.0 * bits.T - 1.0) * (spec.signs * level_v)
    chips = chips_of(symbols, spec)
    if spec.drive == UNIPOLAR:
        chips = (chips + level_v.sum()) / 2
    return np.asarray(spec.polarity * chips, dtype=np.float32)


def frame_levels(chips: Floats32, spec: FrameSpec) -> Floats32:
    """Coded chips (k, N) in the order of the line, with silent guards: (span_chips,)."""
    levels = np.zeros(spec.span_chips, dtype=np.float32)
    levels[spec.places] = chips.ravel()
    return levels
