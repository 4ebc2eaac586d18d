# SPDX-License-Identifier: Apache-2.0

"""Decides which of the frames that a stretch of line could be it is, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..base.arrays import Bools, Floats, Floats32
from ..code.chips import chips_of
from ..code.frame import FrameSpec
from .fit import Fit, Line, WordFit, integrate, read_words, refine
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

    levels: (c, j) V. words, spoken: what they say, spoken (c, k, n) as ±1, 0 where silent.
    off: (c, j) V, |levels − model|. weight: (c, j), what a chip's vote counts: its duration,
    relative to the others', or 0 beyond the view.
    """

    levels: Floats32
    words: WordFit
    spoken: Floats32
    off: Floats32
    weight: Floats


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
        off = seen.off
        best = int(np.argmin((np.square(off) * seen.weight).sum(axis=1)))
        rank = int(LIMITS.most * (off.shape[1] - 1))
        left = float(np.partition(off[best], rank)[rank]) / LIMITS.most_deviations
        steps = np.square(np.diff(seen.levels[best]))  # as wide as the code's, whatever their mean
        distortion = LIMITS.distortion * float(np.sqrt(0.5 * steps.mean()))
        return cls(distortion, max(noise, left**2, (0.5 * distortion) ** 2, 1e-30))

    def cost(self, seen: _Compared) -> Floats:
        """Negative log-likelihood of each frame, (c,)."""
        beyond = np.maximum(seen.off - np.float32(self.distortion), 0)
        votes = np.minimum(np.square(beyond) * np.float32(0.5 / self.variance), LIMITS.vote)
        cost: Floats = (votes * seen.weight).sum(axis=1)
        return cost

    def most(self, chips: int) -> float:
        """The highest cost of the true frame: noise, and few disturbed chips.

        A vote of normal noise is (1 + d²)·Q(d) − d·φ(d) in the mean, for a distortion of d
        deviations, and its variance is about the same; five deviations of their sum are allowed.
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
        if start.size == 1:
            words = read_words(integrate(line, start, chip, self._spec), self._spec)
            return Judgement(Fit(start.item(), chip.item()), words, None, True, True)
        view = float(start.min()), float((start + self._spec.span_chips * chip).max())
        seen = self._compare(line, start, chip, view)
        votes = _Votes.of(seen, noise)
        cost = votes.cost(seen)
        self._refine_close(line, start, chip, view, votes, cost)
        cost += unlikely
        unaided = doubt = self._probability(cost)
        if expected is not None:
            doubt = self._probability(cost - expected.log_prior(start))
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
        best = Fit(float(start[chosen]), float(chip[chosen]))
        return Judgement(best, seen.words.of(chosen), doubtful, decided, sure)

    def _refine_close(
        self,
        line: Line,
        start: Floats,
        chip: Floats,
        view: tuple[float, float],
        votes: _Votes,
        cost: Floats,
    ) -> None:
        """Lower the costs of those nearly ruled out to what they have with their own best timing.

        The chips' edges were fitted to one frame's words; behind a low-pass others suit others.
        """
        above = cost - cost.min()
        for number in np.flatnonzero((above > 0) & (above < LIMITS.close)):
            there = Fit(float(start[number]), float(chip[number]))
            own = refine(line, there, self._spec)
            end_moved = abs(own.end(self._spec) - there.end(self._spec))
            if max(abs(own.start - there.start), end_moved) < LIMITS.in_place * there.chip:
                alone = self._compare(line, np.array([own.start]), np.array([own.chip]), view)
                cost[number] = min(cost[number], votes.cost(alone).item())

    def _compare(
        self, line: Line, start: Floats, chip: Floats, view: tuple[float, float]
    ) -> _Compared:
        """Frames with the line from view[0] to view[1], samples; each in chips of its own."""
        spec, end = self._spec, start + self._spec.span_chips * chip
        lead = np.rint((start - view[0]) / chip).astype(np.intp)
        count = lead + spec.span_chips + np.rint((view[1] - end) / chip).astype(np.intp)
        place = np.arange(count.max() + 1) - lead[:, None]
        levels = line.means(start[:, None] + chip[:, None] * place)
        own = np.arange(start.size)[:, None], lead[:, None] + spec.places
        words = read_words(levels[own].reshape(-1, spec.line_bits, spec.order), spec)
        spoken = np.sign(words.rows[..., spec.node_slice]) * (words.amplitude > 0)[:, None]
        symbols = np.zeros_like(words.rows)
        symbols[..., spec.node_slice] = spoken * words.amplitude[:, None]
        model = np.zeros_like(levels)
        model[own] = chips_of(symbols, spec).reshape(start.size, -1) + words.pedestal[:, None]
        seen = np.arange(levels.shape[1]) < count[:, None]
        share = seen * (chip / chip.mean())[:, None]
        return _Compared(levels, words, spoken, np.abs(levels - model), share)

    @staticmethod
    def _probability(cost: Floats) -> Floats:
        """Probability of each frame, (c,)."""
        odds = np.exp(np.maximum(cost.min() - cost, -700.0))
        probability: Floats = odds / odds.sum()
        return probability
