# SPDX-License-Identifier: Apache-2.0

"""Tells whether a marked frame, or a part of it, is some whole chips beside its place."""

import math
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from ..base.arrays import Floats32, Indices
from ..code.frame import BIPOLAR, FrameSpec
from ..code.transform import chips_of, rows_of
from .fit import WordFit, fit_words
from .limits import LIMITS

SHIFTS = (-2, -1, 1, 2)
"""Whole chips after the mark at which a frame may begin. Chosen: a digitizer that is late by more
loses sync edges, and counts them."""

BETTER, AS_WELL = 0.25, 3.0
"""Chips of the weakest word that a rival must leave less, where there is no noise; log-likelihood
by which noise may make it worse. Chosen: one chip that is missing is 1, one that is the opposite 4;
and marks that are late are few.
"""


def may_be_shifted(chips: Floats32, words: WordFit, spec: FrameSpec) -> bool:
    """Whether few nodes, an odd number or faint, leave a bit's first or last chip at rest.

    There even clear words may be the opposite ones, as those of Sylvester's rows 1 to 3 that are
    the same in all bits, or be several of part of the amplitude: all that tells is the chip that is
    missing. Nor do others show it where noise leaves as much as chips that are the opposite; of
    many nodes the frame's first or last chip may be at rest then. Scrambled frames that are shifted
    look like noise. See is_shifted.
    """
    spoken = words.amplitude[0][words.amplitude[0] > 0]
    if not spoken.size or spec.scramble:
        return False
    weakest, swing_v = float(spoken.min()), spec.node_swing_v or 0.0
    left = words.misfit.item() * words.power.item()
    is_hidden, are_few = left > LIMITS.hiding * weakest**2, spoken.size <= LIMITS.few
    if is_hidden and not are_few:
        return float(np.abs(chips.flat[[0, -1]]).min()) < LIMITS.at_rest * math.sqrt(left)
    if is_hidden or not are_few:
        return is_hidden
    if spec.drive != BIPOLAR or (spoken.size % 2 == 0 and weakest >= LIMITS.whole * swing_v):
        return False
    return float(np.abs(chips[:, [0, -1]]).min()) < LIMITS.rest * weakest


def is_shifted(chips: Floats32, words: WordFit, spec: FrameSpec) -> bool:
    """Whether chips that are moved leave less of them unexplained, and are other words.

    A row of a code book that is moved by a chip may be another row, or the opposite one, or nearly.
    The rivals are whole frames that begin some chips earlier or later, and, where few nodes speak:
    frames within which a sample was taken twice, or dropped at a bit's end; and frames of which one
    bit begins a chip off, after a wrong sync pulse. The line is at rest beside a frame; a chip out
    of view is taken to be like others. chips: (k, N) V, from the mark on. words: what they say.
    """
    if spec.scramble:
        return False
    weakest = float(words.amplitude[words.amplitude > 0].min(initial=np.inf))
    noise = words.misfit.item() * words.power.item()  # variance of a chip
    least = noise * (chips.size + 2 * AS_WELL) - BETTER * weakest**2
    signs = words.signs(spec)
    for rows, besides in _rivals(chips, words, spec):
        rival = fit_words(np.ascontiguousarray(rows), spec)
        left = rival.power * rival.misfit * chips.size + besides(rival)
        better = (left < least) & (rival.power > 0)
        if better.any() and (rival.signs(spec)[better] != signs).any():
            return True
    return False


def _rivals(
    chips: Floats32, words: WordFit, spec: FrameSpec
) -> Iterator[tuple[Floats32, Callable[[WordFit], Floats32]]]:
    """Which rows take the place of a frame's own, (c, k, N), and V² that their words leave besides.

    That is less than nothing where chips are out of view, and so at rest for these words.
    """
    (bits, order), flat = chips.shape, chips.ravel()
    power = np.square(chips)
    whole = np.zeros((len(SHIFTS), bits, order), np.float32)
    for moved, shift in zip(whole.reshape(-1, flat.size), SHIFTS, strict=True):
        _move(flat, shift, moved)
    cut = np.array([power.flat[s:].sum() if s < 0 else power.flat[:s].sum() for s in SHIFTS])
    hidden = [slice(-s, None) if s > 0 else slice(0, -s) for s in SHIFTS]
    ends = np.where(np.array(SHIFTS) > 0, bits - 1, 0)

    def beside_shifted(rival: WordFit) -> Floats32:
        unseen = np.square(_meant(rival, ends, spec))
        out_of_view = [one[chip].sum() for one, chip in zip(unseen, hidden, strict=True)]
        beside: Floats32 = cut - np.array(out_of_view)
        return beside

    rows = rows_of(whole, spec)
    yield rows, beside_shifted
    if np.count_nonzero(words.amplitude) > LIMITS.few:
        return
    own, bit = words.rows[0], np.arange(bits)
    later, alone = (bit >= bit[:, None])[..., None], (bit == bit[:, None])[..., None]
    earlier, after = (rows[SHIFTS.index(shift)] for shift in (-1, 1))
    yield np.where(later[1:], earlier, own), lambda _: power[-1, -1]
    yield np.where(later, after, own), lambda rival: _beside_double(chips, rival, spec)
    within = np.zeros((2, bits, order), np.float32)
    for moved, shift in zip(within, (-1, 1), strict=True):
        _move(chips, shift, moved)
    for rows_within, cut_off, unseen in zip(rows_of(within, spec), (-1, 0), (0, -1), strict=True):
        rival_rows = np.where(alone, rows_within, own)
        yield rival_rows, partial(_beside_bit, power[:, cut_off], unseen, spec)


def _beside_bit(cut: Floats32, unseen: int, spec: FrameSpec, rival: WordFit) -> Floats32:
    """What is left beside a bit that is a chip off, (k,) V²; unseen: its chip out of view."""
    meant = _meant(rival, np.arange(len(cut)), spec)[:, unseen]
    return cut - np.square(meant)


def _beside_double(chips: Floats32, rival: WordFit, spec: FrameSpec) -> Floats32:
    """What the second of two equal samples leaves over, of the likeliest ones in each bit, (k,) V².

    rival: of frames whose chips are a chip later from the begin of each bit on. If the sample is
    doubled within that bit, what its first chips leave is what they leave where they are.
    """
    flat, bit = chips.ravel(), np.arange(len(chips))
    meant = _meant(rival, bit, spec)
    in_place = np.square(chips - meant)
    later = np.square(np.append(flat[1:], 0).reshape(chips.shape) - meant)
    gained = np.zeros_like(chips)
    np.cumsum((in_place - later)[:, :-1], axis=1, out=gained[:, 1:])
    twice = np.square(np.diff(flat, prepend=0)).reshape(chips.shape)
    unseen = np.square(_meant(rival, np.full_like(bit, len(chips) - 1), spec)[:, -1])
    least: Floats32 = (twice + gained).min(axis=1) - unseen
    return least


def _meant(words: WordFit, bit: Indices, spec: FrameSpec) -> Floats32:
    """Chips that the words of each candidate mean in one of its bits, (c,): (c, N) V."""
    rows = np.zeros((len(bit), spec.order), np.float32)
    candidate = np.arange(len(bit))
    rows[:, spec.node_slice] = np.sign(words.rows[candidate, bit, spec.node_slice])
    rows[:, spec.node_slice] *= words.amplitude
    return chips_of(rows, spec) + words.pedestal[:, None]


def _move(chips: Floats32, shift: int, moved: Floats32) -> None:
    """Write chips to where they are by a shift, along the last axis; others stay."""
    if shift > 0:
        moved[..., :-shift] = chips[..., shift:]
    else:
        moved[..., -shift:] = chips[..., :shift]
