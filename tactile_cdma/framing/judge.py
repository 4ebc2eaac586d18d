# SPDX-License-Identifier: Apache-2.0

"""Decides which of the frames that a stretch of line could be it is, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..base.arrays import Bools, Floats, Floats32
from ..code.frame import FrameSpec
from ..code.transform import spread
from .fit import Fit, Line, WordFit, read_words, refine
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


@dataclass(frozen=True, slots=True)
class _Compared:
    """Frames of c candidates, and the line over j chips.

    starts: (c,) samples. levels: (j,) V. words, spoken: what they say, spoken (c, k, n) as ±1, 0
    where silent. off: (c, j) V, |levels − model|.
    """

    starts: Floats
    levels: Floats32
    words: WordFit
    spoken: Floats32
    off: Floats32


@dataclass(frozen=True, slots=True)
class _Votes:
    """How chips vote. distortion: δ, V. variance: σ², V²."""

    distortion: float
    variance: float

    @classmethod
    def of(cls, seen: _Compared, noise: float) -> _Votes:
        """Those of a line with this noise of a chip's level in the gap, V²."""
        # What even the best model leaves over is noise of this line, if not few chips have it:
        # behind a low-pass only those next to a level change do.
        best = seen.off[np.argmin(np.square(seen.off).sum(axis=1))]
        rank = int(LIMITS.most * (best.size - 1))
        left = float(np.partition(best, rank)[rank]) / LIMITS.most_deviations
        steps = np.square(np.diff(seen.levels))  # as wide as the code's levels, whatever their mean
        distortion = LIMITS.distortion * float(np.sqrt(0.5 * steps.mean()))
        return cls(distortion, max(noise, left**2, (0.5 * distortion) ** 2, 1e-30))

    def cost(self, off: Floats32) -> Floats:
        """Negative log-likelihoods of models that are off by (c, j) V, (c,)."""
        beyond = np.maximum(off - np.float32(self.distortion), 0)
        votes = np.square(beyond) * np.float32(0.5 / self.variance)
        cost: Floats = np.minimum(votes, np.float32(LIMITS.vote)).sum(axis=1, dtype=np.float64)
        return cost

    def most(self, chips: int) -> float:
        """The highest cost of the true frame: noise, and few disturbed chips.

        A vote of normal noise is (1 + d²)·Q(d) − d·φ(d) in the mean, for a distortion of d
        deviations, and its variance is about the same.
        """
        d = self.distortion / math.sqrt(self.variance)
        density = math.exp(-0.5 * d**2) / math.sqrt(2 * math.pi)
        usual = chips * ((1 + d**2) * 0.5 * math.erfc(d / math.sqrt(2)) - d * density)
        return usual + 5 * math.sqrt(usual) + LIMITS.disturbed * chips * LIMITS.vote


class Judge:
    """Weighs frames of one specification against each other.

    Each is a hypothesis: a start, a chip duration, and the words that follow from them. Its cost is
    its negative log-likelihood,

        Σ over chips of min(max(|level − model| − δ, 0)² / 2σ², κ),

    with δ for distortion, over all chips of the line, for which a frame that ends earlier predicts
    silence. No chip votes with more than κ, so that no single disturbed chip decides. With what is
    likely before looking (Expected) the costs give each frame's probability, and for every node the
    probability of all frames that give it another word or silence.
    """

    def __init__(self, spec: FrameSpec) -> None:
        self._spec = spec

    def choose(
        self,
        line: Line,
        fit: Fit,
        shifts: tuple[int, int],
        loud: float,
        noise: float,
        expected: Expected | None,
    ) -> Judgement:
        """Choose among a frame and those that start whole chips earlier and later.

        shifts: the earliest and the latest, chips. loud: first instant that is. noise: variance of
        a chip's level in the gap, V². expected: where frames are likely.
        """
        seen = self._compare(line, fit, shifts, shifts)
        votes = _Votes.of(seen, noise)
        cost = votes.cost(seen.off)
        self._refine_close(line, fit, shifts, votes, cost)
        # Two nodes that cancel at the start of every bit are possible, but not likely.
        cost += np.log1p(np.square((seen.starts - loud) / (0.5 * fit.chip)))
        unaided = doubt = self._probability(cost)
        if expected is not None:
            doubt = self._probability(cost - expected.log_prior(seen.starts))
        chosen, limit = int(np.argmax(doubt)), LIMITS.doubt
        understood = bool(cost[chosen] < votes.most(seen.off.shape[1]))
        decided = understood and bool(1 - doubt[chosen] < limit)
        doubtful = None
        if not decided:
            level, spoken = seen.words.amplitude, seen.spoken
            unlike = np.abs(level - level[chosen]) > LIMITS.alike * np.maximum(level, level[chosen])
            unlike |= (spoken != spoken[chosen]).any(axis=1)
            doubtful = (doubt @ unlike >= limit) | (not understood)
        sure = understood and bool(1 - unaided[chosen] < limit)
        best = Fit(float(seen.starts[chosen]), fit.chip)
        return Judgement(best, seen.words.of(chosen), doubtful, decided, sure)

    def _refine_close(
        self, line: Line, fit: Fit, view: tuple[int, int], votes: _Votes, cost: Floats
    ) -> None:
        """Lower the costs of those nearly ruled out to what they have with their own best timing.

        The chips' edges were fitted to one frame's words; behind a low-pass others suit others.
        """
        above = cost - cost.min()
        for number in np.flatnonzero((above > 0) & (above < LIMITS.close)):
            shift = view[0] + int(number)
            there = Fit(fit.start + shift * fit.chip, fit.chip)
            own = refine(line, there, self._spec)
            moved = max(
                abs(own.start - there.start), abs(own.end(self._spec) - there.end(self._spec))
            )
            if moved < LIMITS.in_place * fit.chip:
                alone = self._compare(line, own, (0, 0), (view[0] - shift, view[1] - shift))
                cost[number] = min(cost[number], votes.cost(alone.off).item())

    def _compare(
        self, line: Line, fit: Fit, shifts: tuple[int, int], view: tuple[int, int]
    ) -> _Compared:
        """Frames of these shifts with the line from view[0] chips before to view[1] after fit."""
        spec = self._spec
        shift = np.arange(shifts[0], shifts[1] + 1)
        edges = np.arange(view[0], spec.span_chips + view[1] + 1.0)
        levels = line.means(fit.start + fit.chip * edges)
        first = (shift - view[0])[:, None]
        windows = np.lib.stride_tricks.sliding_window_view(levels, spec.span_chips)
        chips = windows[first, spec.places].reshape(-1, spec.line_bits, spec.order)
        words = read_words(chips, spec)
        spoken = np.sign(words.rows[..., spec.node_slice]) * (words.amplitude > 0)[:, None]
        symbols = np.zeros_like(words.rows)
        symbols[..., spec.node_slice] = spoken * words.amplitude[:, None]
        code = spread(symbols, spec.book).reshape(shift.size, -1) + words.pedestal[:, None]
        model = np.zeros((shift.size, levels.size), np.float32)
        model[np.arange(shift.size)[:, None], first + spec.places] = code
        off = np.abs(levels - model)
        starts: Floats = fit.start + fit.chip * shift.astype(np.float64)
        return _Compared(starts, levels, words, spoken, off)

    @staticmethod
    def _probability(cost: Floats) -> Floats:
        """Probability of each frame, (c,)."""
        odds = np.exp(np.maximum(cost.min() - cost, -700.0))
        probability: Floats = odds / odds.sum()
        return probability
