# SPDX-License-Identifier: Apache-2.0

"""Tells words from tones: hum and other interference whose period is not far from that of a bit.

Such a tone lands on the rows of about its own frequency, and may do so in every bit alike. But it
is a sine and a row is not: silent and spare rows, and row 0, hold the rest of it. What they hold
says what the tone is, and so what it is on the rows of those who spoke.
"""

import math
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools, Floats, Floats32
from ..code.codes import CodeBook
from ..code.frame import FrameSpec
from ..code.separate import NodeLevels
from ..code.transform import correlate

Complexes: TypeAlias = NDArray[np.complexfloating]

TONE_SHARE, MOST_HELD = 0.7, 0.87
"""Of a tone a row holds a share u, 0.87 at most of one that is not the chips' own turn; so a word
that is one leaves over 1/u − 1 of its energy per bit. Tones are looked for from TONE_SHARE of that
on. Chosen: the rest for noise."""
MOST_PERIODS, STEP, MOST_LEVELS = 8.0, 0.02, 4096
"""Periods per bit up to which tones are looked for, their steps, and the levels of rows that each
may cost. Chosen: half a step turns a tone of ten bits by 0.1 period; few rows have more."""
TONES = 3
"""Tones that are looked for, the strongest first. Chosen: mains and two harmonics."""
PROVEN = 15.0
"""A tone is one where noise alone would explain as much once in e¹⁵ times. Chosen: noise reaches
log(400) = 6 with the best of so many tones."""
HALF = 0.5
"""Share of a word's level that tones may explain, RMS. Chosen: as for a word that was spoken."""
RIDGE = 1e-3
"""Added to the energy of a tone of 1 V on the rows where nobody spoke, of 0.5 on all. Chosen: a
fiftieth of a tone is seen whole there but for a tenth."""


class _Tones(NamedTuple):
    """Tones of 1 V on the rows of a code book; its real part is a cosine that begins with the bit.

    periods: (f,) per bit. waves: (2, f, N) float32, levels of all rows, both parts. products:
    (3, f, N) float32, |wave|², and both parts of wave². holds: (N,) most of a tone on a row.
    """

    periods: Floats
    waves: Floats32
    products: Floats32
    holds: Floats32


@lru_cache(maxsize=8)
def least_left(spec: FrameSpec) -> float:
    """Energy per bit left over, of the weakest word's, from which on tones are looked for."""
    if spec.scramble:  # there a tone is noise
        return math.inf
    holds = float(_tones(spec.book).holds[spec.node_slice].max())
    return TONE_SHARE * (1 / min(holds, MOST_HELD) - 1)


def toned(levels: NodeLevels, amplitude: Floats32, active: Bools, spec: FrameSpec) -> Bools | None:
    """Words that tones explain, (n,) bool; None where there are none.

    amplitude: (n,) V, of every node's word. active: (n,) bool, at least one. Tones are steady for a
    frame, and explain what is on rows where nobody spoke.
    """
    rows = levels.rows
    if rows is None or spec.scramble:
        return None
    spoken = amplitude[active]
    left = float(np.einsum("kr,kr->", rows, rows)) / spec.line_bits
    left -= float(np.square(spoken).sum())
    offset_v = float(rows[:, 0].mean()) if spec.first_row > 0 else 0.0
    if left - offset_v**2 < least_left(spec) * float(spoken.min()) ** 2:
        return None
    words = active
    while words.any():  # those that are none show the tones, too
        told = _told(rows, offset_v, words, spec)
        explained = words & (np.square(told).mean(axis=0) > np.square(HALF * amplitude))
        if not explained.any():
            break
        words = words & ~explained
    return None if words is active else active & ~words


def _told(rows: Floats32, offset_v: float, words: Bools, spec: FrameSpec) -> Floats32:
    """What the tones are on the nodes' rows, (k, n) V; rows: (k, N) V. words: (n,)."""
    free = np.ones(spec.order, np.float32)
    free[spec.node_slice] = ~words
    seen = rows * free
    if spec.first_row > 0:
        seen[:, 0] -= offset_v
    tones = _tones(spec.book)
    turns = np.exp(2j * np.pi * tones.periods[:, None] * np.arange(spec.line_bits))
    told = np.zeros((spec.line_bits, spec.nodes), np.float32)
    for _ in range(TONES):
        found = _strongest(seen, free, tones, turns)
        if found is None:
            break
        best, height = found
        turned = height * turns[best]
        tone = np.outer(turned.real, tones.waves[0, best])
        tone -= np.outer(turned.imag, tones.waves[1, best])
        seen -= (tone * free).astype(np.float32)
        told += tone[:, spec.node_slice].astype(np.float32)
    return told


def _strongest(
    seen: Floats32, free: Floats32, tones: _Tones, turns: Complexes
) -> tuple[int, complex] | None:
    """The tone that explains the most of some rows, and its height, V; None where none is proven.

    seen: (k, N) V, 0 where free (N,) is 0. turns: (f, k) phases in which bits begin. A tone h is
    the real part of h·turn·wave in every bit: least squares for the two parts of h.
    """
    bits = len(seen)
    on_real, on_imaginary = tones.waves @ seen.T
    moment = (turns * (on_real + 1j * on_imaginary)).sum(axis=1)
    power, *skews = 0.5 * (tones.products @ free).astype(np.float64)
    skew = np.square(turns).sum(axis=1) * (skews[0] + 1j * skews[1])
    ridge = RIDGE * bits
    real, imaginary = bits * power + skew.real + ridge, bits * power - skew.real + ridge
    cross, x, y = skew.imag, moment.real, -moment.imag
    # The normal equations: [real, −cross; −cross, imaginary]·h = (x, y).
    determinant = real * imaginary - cross * cross
    height = ((imaginary * x + cross * y) + 1j * (cross * x + real * y)) / determinant
    explained = height.real * x + height.imag * y
    best = int(np.argmax(explained))
    total, others = float(np.square(seen).sum()), bits * float(free.sum()) - 2
    # Two parameters leave of white noise less than a share s with probability s^(others/2).
    if total - float(explained[best]) > total * math.exp(-2 * PROVEN / max(others, 1.0)):
        return None
    return best, complex(height[best])


@lru_cache(maxsize=8)
def _tones(book: CodeBook) -> _Tones:
    most = min(MOST_PERIODS, book.order / 4, MOST_LEVELS / book.order)
    periods = np.arange(STEP, most + STEP, STEP)
    phase = 2 * np.pi * periods[:, None] * (np.arange(book.order) + 0.5) / book.order
    waves = correlate(np.stack((np.cos(phase), np.sin(phase))).astype(np.float32), book)
    real, imaginary = waves
    power = np.square(real) + np.square(imaginary)
    products = np.stack((power, np.square(real) - np.square(imaginary), 2 * real * imaginary))
    holds = np.zeros(book.order, np.float32)
    for turn in np.exp(1j * np.pi * np.arange(8) / 8).astype(np.complex64):
        seen = np.square(turn.real * real - turn.imag * imaginary)
        holds = np.maximum(holds, (seen / seen.sum(axis=1, keepdims=True)).max(axis=0))
    return _Tones(periods, waves, products, holds)
