# SPDX-License-Identifier: Apache-2.0

"""How loud a node is on the line, from the words of a frame; and what is too faint for one."""

import math

import numpy as np

from ..base.arrays import Bools, Floats32

ACTIVE_SHARE = 0.5
"""A node spoke where its word's mean |r| exceeds this share of its amplitude: midway to silence."""
FAINT_SHARE = 0.25
"""Share of a node's amplitude below which nothing is taken for one: half of it may be. Chosen."""
LEAST_SHARE = 0.1
"""Share of a node's amplitude below which nothing is asked of what is on its row. Chosen: what
sound lines leave there (edges, hum of a third of an amplitude, droop) stays below."""
LOW_MARGIN = 0.4
"""A word is flagged where one bit has less than this share of the word's mean amplitude. Chosen."""
MOVED_SHARE = 0.3
"""Deviation of the bits' means, of a node's amplitude, with which a line moves so much that a frame
may be somewhere else, and its words in all rows' noise. Chosen: hum of 0.42 amplitudes."""
SILENT_RHO = 6.0
"""ρ of a node below which noise may be a faint word, and nobody's silence is certain. Chosen: words
are flagged below 5, and those of weak nodes are half as loud."""
HIDDEN = 0.65
"""Share of a node's level that, as noise of a chip, may be a node that is out of its place. Chosen:
such a node leaves 1, less what is taken for words of others."""
BY_CHANCE = 3.3
"""Normal deviations that make more than noise of a row's power. Chosen: 5e-4 of all silent words
exceed them; a word at 0.15 A and ρ = 20 stays below once in 10⁵."""
LEAST_POOL, MOST_POOLED = 4, 1.25
"""Silent nodes whose rows say something of the noise; by how much they may raise it. Chosen: of
three spare rows' ten levels it is right to 13 % (√(2/30)/2)."""
LEAST_NOISE = 1e-12
"""V; less is taken for this, so that ρ stays finite."""
LOUDEST_FLOOR = 0.25
"""Share of the loudest word's amplitude that others have, too, if it is that of a sound node: the
loudest may be that of three nodes on one row, and a lone node then still has a third of it."""


def most_noise_power(bits: int) -> float:
    """Mean r² of a word's levels, over the noise's variance, that noise alone hardly exceeds.

    A χ² variable of so many degrees of freedom, by the cube root (Wilson and Hilferty 1931).
    """
    spread = 2 / (9 * bits)
    return (1 - spread + BY_CHANCE * math.sqrt(spread)) ** 3


def rises(squares: Floats32, expected: Floats32 | np.float32, noise: float, bits: int) -> Bools:
    """Whether the levels of a row are more than noise and what no node is taken for, (n,).

    squares: (n,) V², sums of the squares of so many bits' levels.
    expected: (n,) or scalar, V, amplitude of a node. noise: RMS of a level, V.
    """
    per_noise = np.float32(1 / max(noise, LEAST_NOISE))
    least, loud = bits * LEAST_SHARE**2, bits * most_noise_power(bits)
    above: Bools = squares > np.float32(least) * expected * expected
    return above & (squares * per_noise * per_noise > np.float32(loud))


def hiding_rho(bits: int, order: int) -> float:
    """ρ of a node below which noise hides a word of LEAST_SHARE, or may be a node itself."""
    return max(math.sqrt(most_noise_power(bits)) / LEAST_SHARE, math.sqrt(order) / HIDDEN)


def pooled_noise(noise: float, silent: Floats32, bits: int) -> float:
    """RMS of a level, V, where few spare rows show it, and silent nodes' rows, too.

    silent: (m,) V², sums of squares of so many bits' levels; of most of them, unless all are faint.
    """
    if silent.size < LEAST_POOL:
        return noise
    usual = math.sqrt(float(np.median(silent)) / bits)
    return min(max(noise, usual), MOST_POOLED * noise)


def usual_amplitude(mean: Floats32) -> Floats32:
    """Amplitude of a sound node, V, from mean |r| of all nodes: (…, n) to (…, 1).

    The loudest word may be that of two or three on one row: the second of three loud ones counts.
    """
    loudest: Floats32 = mean.max(axis=-1, keepdims=True)
    if mean.shape[-1] < 3:
        return loudest
    third, second = np.split(np.partition(mean, (-3, -2), axis=-1)[..., -3:-1], 2, axis=-1)
    return np.where(third > np.float32(LOUDEST_FLOOR) * loudest, second, loudest)
