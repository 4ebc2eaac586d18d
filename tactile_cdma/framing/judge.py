# SPDX-License-Identifier: Apache-2.0

"""Decides which of the frames that a stretch of line could be it is, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..base.arrays import Bools, Floats, Floats32
from ..code.frame import FrameSpec
from ..code.transform import spread
from .fit import Fit, Line, WordFit, read_words
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

        start, chip: (c,) samples. noise: variance of a chip's level in the gap, V². unlikely: (c,)
        added to the costs. expected: where the frames before make one likely.
        """
        spec, end = self._spec, start + self._spec.span_chips * chip
        # Each frame's view is cut into chips as its own are.
        lead = np.rint((start - start.min()) / chip).astype(np.intp)
        count = lead + spec.span_chips + np.rint((end.max() - end) / chip).astype(np.intp)
        place = np.arange(count.max() + 1) - lead[:, None]
        levels = line.means(start[:, None] + chip[:, None] * place)
        own = np.arange(start.size)[:, None], lead[:, None] + spec.places
        words = read_words(levels[own].reshape(-1, spec.line_bits, spec.order), spec)
        if start.size == 1:
            return Judgement(Fit(float(start[0]), float(chip[0])), words, None, True, True)
        spoken = np.sign(words.rows[..., spec.node_slice]) * (words.amplitude > 0)[:, None]
        symbols = np.zeros_like(words.rows)
        symbols[..., spec.node_slice] = spoken * words.amplitude[:, None]
        model = np.zeros_like(levels)
        model[own] = spread(symbols, spec.book).reshape(start.size, -1) + words.pedestal[:, None]
        seen = np.arange(levels.shape[1]) < count[:, None]
        cost = self._costs(levels, model, noise, seen * (chip / chip.mean())[:, None]) + unlikely
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
    def _costs(levels: Floats32, model: Floats32, noise: float, weight: Floats) -> Floats:
        """Negative log-likelihoods of models (c, j) of the levels (c, j), with bounded votes."""
        off = np.abs(levels - model)
        # What even the best model leaves over is noise of this line, if not few chips have it:
        # behind a low-pass only those next to a level change do.
        best = int(np.argmin((np.square(off) * weight).sum(axis=1)))
        rank = int(LIMITS.most * (off.shape[1] - 1))
        left = float(np.partition(off[best], rank)[rank]) / LIMITS.most_deviations
        steps = np.square(np.diff(levels[best]))  # as wide as the code's, whatever their mean
        distortion = LIMITS.distortion * float(np.sqrt(0.5 * steps.mean()))
        variance = max(noise, left**2, (0.5 * distortion) ** 2, 1e-30)
        off = np.maximum(off - np.float32(distortion), 0)
        votes = np.minimum(np.square(off) * np.float32(0.5 / variance), np.float32(LIMITS.vote))
        cost: Floats = (votes * weight).sum(axis=1)
        return cost

    @staticmethod
    def _probability(cost: Floats) -> Floats:
        """Probability of each frame, (c,)."""
        odds = np.exp(np.maximum(cost.min() - cost, -700.0))
        probability: Floats = odds / odds.sum()
        return probability
