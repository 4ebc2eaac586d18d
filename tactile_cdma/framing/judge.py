# SPDX-License-Identifier: Apache-2.0

"""Decides which of the frames that a stretch of line could be it is, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..base.arrays import Bools, Floats, Floats32
from ..code.frame import FrameSpec
from ..code.transform import spread
from .fit import Fit, Line, WordFit, integrate, read_words
from .limits import LIMITS
from .raster import Expected


@dataclass(frozen=True, slots=True)
class Judgement:
    """The most likely frame of some.

    fit: its timing. words: what its whole chips say, of this one candidate.
    doubtful: (n,) bool, nodes of which others that are not ruled out say something else; of a
        silent node this means that it may have spoken. None where no other is likely.
    decided: no other frame is likely.
    unaided: nor would it be if frames were equally likely everywhere.
    """

    fit: Fit
    words: WordFit
    doubtful: Bools | None
    decided: bool
    unaided: bool


class Judge:
    """Weighs frames of one specification against each other.

    Each is a hypothesis: a start, a chip duration, and the words that follow from them. Its cost is
    its negative log-likelihood,

        Σ over chips of min(max(|level − model| − δ, 0)² / 2σ², κ),

    with δ for distortion, over all chips of the view, which reaches from the first start to the
    last end: a shorter frame predicts silence in what is left. No chip votes with more than κ, so
    that no single disturbed chip decides. With what is likely before looking the costs give each
    frame's probability, and for every node the probability of all frames that give it another word
    or silence.
    """

    def __init__(self, spec: FrameSpec) -> None:
        self._spec = spec

    def choose(
        self,
        line: Line,
        start: Floats,
        chip: Floats,
        noise: float,
        unlikely: Floats | float = 0.0,
        expected: Expected | None = None,
    ) -> Judgement:
        """Choose among frames.

        start, chip: (c,) samples; the view is cut into chips as the first one's are. noise:
        variance of a chip's level in the gap, V². unlikely: (c,) what is to be added to the costs,
        whatever is expected: where frames are likely by those before.
        """
        spec = self._spec
        words = read_words(integrate(line, start, chip, spec), spec)
        if start.size == 1:
            return Judgement(Fit(float(start[0]), float(chip[0])), words, None, True, True)
        spoken = np.sign(words.rows[..., spec.node_slice]) * (words.amplitude > 0)[:, None]
        symbols = np.zeros_like(words.rows)
        symbols[..., spec.node_slice] = spoken * words.amplitude[:, None]
        model = np.zeros((start.size, spec.span_chips))
        code = spread(symbols, spec.book).reshape(start.size, -1)
        model[:, spec.places] = code + words.pedestal[:, None]
        instants = start[:, None] + chip[:, None] * np.arange(spec.span_chips + 1)
        begin, width = instants.min(), chip[0]
        edges = begin + width * np.arange(math.ceil((instants.max() - begin) / width - 1e-6) + 1)
        area = np.zeros(instants.shape)
        np.cumsum(model * chip[:, None], axis=1, out=area[:, 1:])
        until = [np.interp(edges, *one) for one in zip(instants, area, strict=True)]
        cost = self._costs(line.means(edges), np.diff(until) / width, noise) + unlikely
        unaided = doubt = self._probability(cost)
        if expected is not None:
            doubt = self._probability(cost - expected.log_prior(start))
        chosen = int(np.argmax(doubt))
        limit = LIMITS.doubt
        decided = bool(1 - doubt[chosen] < limit)
        doubtful = None
        if not decided:
            level = words.amplitude
            unlike = np.abs(level - level[chosen]) > LIMITS.alike * np.maximum(level, level[chosen])
            unlike |= (spoken != spoken[chosen]).any(axis=1)
            doubtful = doubt @ unlike >= limit
        sure = bool(1 - unaided[chosen] < limit)
        best = Fit(float(start[chosen]), float(chip[chosen]))
        return Judgement(best, words.of(chosen), doubtful, decided, sure)

    @staticmethod
    def _costs(levels: Floats32, model: Floats, noise: float) -> Floats:
        """Negative log-likelihoods of models (c, j) of the levels (j,), with bounded votes."""
        off = np.abs(levels - model)
        # What even the best model leaves over is noise of this line, if not few chips have it:
        # behind a low-pass only those next to a level change do.
        best = off[np.argmin(np.square(off).sum(axis=1))]
        rank = int(LIMITS.most * (best.size - 1))
        left = float(np.partition(best, rank)[rank]) / LIMITS.most_deviations
        steps = np.square(np.diff(levels))  # as wide as the code's levels, whatever their mean
        distortion = LIMITS.distortion * float(np.sqrt(0.5 * steps.mean()))
        variance = max(noise, left**2, (0.5 * distortion) ** 2, 1e-30)
        off = np.maximum(off - np.float32(distortion), 0)
        votes = np.minimum(np.square(off) * np.float32(0.5 / variance), np.float32(LIMITS.vote))
        cost: Floats = votes.sum(axis=1, dtype=np.float64)
        return cost

    @staticmethod
    def _probability(cost: Floats) -> Floats:
        """Probability of each frame, (c,)."""
        odds = np.exp(np.maximum(cost.min() - cost, -700.0))
        probability: Floats = odds / odds.sum()
        return probability
