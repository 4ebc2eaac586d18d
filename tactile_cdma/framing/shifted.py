# SPDX-License-Identifier: Apache-2.0

"""Tells whether a marked frame, or a part of it, is some whole chips beside its place."""

from __future__ import annotations

import numpy as np

from ..base.arrays import Floats32
from ..code.frame import BIPOLAR, FrameSpec
from ..code.transform import rows_of
from .fit import WordFit, fit_words
from .limits import LIMITS

SHIFTS = (-2, -1, 1, 2)
"""Whole chips after the mark at which a frame may begin. Chosen: a digitizer that is late by more
loses sync edges, and counts them."""


def may_be_shifted(chips: Floats32, words: WordFit, spec: FrameSpec) -> bool:
    """Whether few nodes, an odd number or faint, leave a bit's first or last chip at rest.

    There even clear words may be the opposite ones, as those of Sylvester's rows 1 to 3 that are
    the same in all bits, or be several of part of the amplitude: all that tells is the chip that is
    missing. Scrambled frames that are shifted look like noise. See is_shifted.
    """
    spoken = words.amplitude[0][words.amplitude[0] > 0]
    if not 0 < spoken.size <= LIMITS.few or spec.drive != BIPOLAR or spec.scramble:
        return False
    weakest, swing_v = float(spoken.min()), spec.node_swing_v or 0.0
    if spoken.size % 2 == 0 and weakest >= LIMITS.whole * swing_v:
        return False
    return float(np.abs(chips[:, [0, -1]]).min()) < LIMITS.rest * weakest


def is_shifted(chips: Floats32, words: WordFit, spec: FrameSpec) -> bool:
    """Whether chips that are moved leave less of them unexplained than where they are.

    Where few nodes speak, a frame beside its mark may hold words of other nodes, or the opposite
    ones: a row of a code book that is moved by a chip may be another row, or nearly. The rivals are
    whole frames that begin some chips earlier or later; frames within which a sample was dropped,
    or taken twice, at a bit's end; and frames of which one bit begins a chip off, after a wrong
    sync pulse. The line is at rest beside a frame; a chip out of view is taken to be like others.
    chips: (k, N) V, from the mark on. words: what they say.
    """
    if np.count_nonzero(words.amplitude) > LIMITS.few or spec.scramble:
        return False
    (bits, order), flat = chips.shape, chips.ravel()
    power = np.square(flat)
    moved = np.zeros((len(SHIFTS) + 2, bits, order), np.float32)
    for whole, shift in zip(moved.reshape(-1, flat.size), SHIFTS, strict=False):
        _move(flat, shift, whole)
    for within, shift in zip(moved[-2:], (-1, 1), strict=True):
        _move(chips, shift, within)
    rows, own = rows_of(moved, spec), words.rows[0]
    bit = np.arange(bits)
    later, alone = (bit >= bit[1:, None])[..., None], (bit == bit[:, None])[..., None]
    cut = [power[s:].sum() if s < 0 else power[:s].sum() for s in SHIFTS]
    doubled = np.square(chips[1:, 0] - chips[:-1, -1])
    # Which rows take the place of a frame's own; V² that are left over besides; chips out of view.
    rivals = [
        (rows[: len(SHIFTS)], np.array(cut), np.abs(SHIFTS)),
        (np.where(later, rows[SHIFTS.index(-1)], own), power[-1], np.array(0)),
        (np.where(later, rows[SHIFTS.index(1)], own), doubled, np.array(1)),
        (np.where(alone, rows[-2], own), np.square(chips[:, -1]), np.array(1)),
        (np.where(alone, rows[-1], own), np.square(chips[:, 0]), np.array(1)),
    ]
    least = words.misfit.item() * words.power.item() * flat.size
    for candidates, beside, unseen in rivals:
        found = fit_words(np.ascontiguousarray(candidates), spec)
        left = found.power * (found.misfit * flat.size - unseen) + beside
        if (left[found.power > 0] < least).any():
            return True
    return False


def _move(chips: Floats32, shift: int, moved: Floats32) -> None:
    """Write chips to where they are by a shift, along the last axis; others stay."""
    if shift > 0:
        moved[..., :-shift] = chips[..., shift:]
    else:
        moved[..., -shift:] = chips[..., :shift]
