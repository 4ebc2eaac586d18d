# SPDX-License-Identifier: Apache-2.0

"""The words of one frame: who spoke, which code, and how sure that is."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Bools, Floats32
from ..base.stage import stage


@stage
class Words:
    """The words of n nodes in one frame.

    active: (n,) bool, False for a silent node (its code and margin then mean nothing).
    codes: (n,) int32 ADC words.
    amplitude_v: (n,) float32, V, mean |r| over the word's bits.
    rho: (n,) float32, amplitude over what the frame's words leave on a row, RMS.
    margin: (n,) float32, |r| of the word's weakest bit over its amplitude.
    doubtful: (n,) bool, words of a frame in doubt, or doubtful by themselves (words_decide and
        doubt_parts in kernel/words.c, or on row 0); and nodes whose silence is uncertain.
    doubled: (n,) bool, words in which some bits have the level of two nodes or more and others a
        much lower one: more than one node speaks on their row.
    odd: (n,) bool, active words whose parity had to be mended.
    faint: (n,) bool, nodes that did not speak loudly enough, but on whose rows there is more than
        noise and leakage explain.
    noise_rms_v: σ, what the words leave of a chip, V; NaN if unknown.

    Treat the arrays as read-only: frames share those in which no node is True or heard.
    """

    active: Bools
    codes: NDArray[np.int32]
    amplitude_v: Floats32
    rho: Floats32
    margin: Floats32
    doubtful: Bools
    doubled: Bools
    odd: Bools
    faint: Bools
    noise_rms_v: float

    @property
    def confidence(self) -> Floats32:
        """Probability that each word's weakest bit is right, (n,) float32, 0.5…1.

        In white noise the log-likelihood ratio of a bit is 2·a·|r|/σᵣ² = 2·ρ²·margin.
        """
        ratio = np.minimum(np.float32(2) * np.square(self.rho) * self.margin, np.float32(80))
        confidence: Floats32 = np.float32(1) / (np.float32(1) + np.exp(-ratio))
        return confidence


def silent(nodes: int, noise_rms_v: float) -> Words:
    """The words of a frame in which no node spoke; these share their arrays."""
    no, codes, nothing = _zeros(nodes)
    return Words(no, codes, nothing, nothing, nothing, no, no, no, no, noise_rms_v)


def nobody(nodes: int) -> Bools:
    """(n,) bool, False for all nodes: an array that frames share, and nobody can write to."""
    return _zeros(nodes)[0]


@lru_cache(maxsize=4)
def _zeros(nodes: int) -> tuple[Bools, NDArray[np.int32], Floats32]:
    zeros = np.zeros(nodes, np.bool_), np.zeros(nodes, np.int32), np.zeros(nodes, np.float32)
    for array in zeros:
        array.flags.writeable = False
    return zeros
