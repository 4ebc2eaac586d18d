# SPDX-License-Identifier: Apache-2.0

"""Chips of a frame ↔ levels of its rows: the code book's transform, and the scrambler's flips."""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats32
from .frame import FrameSpec
from .transform import correlate, spread


def rows_of(chips: Floats32, spec: FrameSpec) -> Floats32:
    """Correlation of every row with every bit's chips: (…, k, N) float32, V, of such chips."""
    if spec.flips is not None:
        chips = np.multiply(chips, spec.flips, dtype=np.float32)
    return correlate(chips, spec.book)


def chips_of(rows: Floats32, spec: FrameSpec) -> Floats32:
    """The inverse: the chips in which every row has this level."""
    chips = spread(rows, spec.book)
    return chips if spec.flips is None else chips * spec.flips
