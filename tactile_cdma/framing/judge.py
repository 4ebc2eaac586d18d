# SPDX-License-Identifier: Apache-2.0

"""Picks the most likely frame among candidates for a stretch of samples; says how sure that is."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.arrays import Bools, Floats, Floats32
from ..base.stage import stage
from ..base.sums import in_order
from ..code.frame import FrameSpec
from .fit import Fit, Line, WordFit, integrate, read_words, refine
from .limits import LIMITS
from .raster import Expected

RULED_OUT = 2 * LIMITS.close
"""Cost beyond that of the likeliest frame at which another one is ruled out, whatever was likely
before looking: the burst makes up for 10 at most, the raster for 20."""


@stage
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


class Votes(NamedTuple):
    """How chips vote. distortion: δ, V. variance: σ², V²."""

    distortion: float
    variance: float

    def most(self, chips: int) -> float:
        """The highest cost of the true frame of so many chips: noise, and few that are disturbed.

        A vote of normal noise is (1 + d²)·Q(d) − d·φ(d) in the mean, for a distortion of d
        deviations, and its variance is about the same; five deviations of their sum are allowed.
        """
        d = self.distortion / math.sqrt(self.variance)
        density = math.exp(-0.5 * d**2) / math.sqrt(2 * math.pi)
        usual = chips * ((1 + d**2) * 0.5 * math.erfc(d / math.sqrt(2)) - d * density)
        return usual + 5 * math.sqrt(usual) + LIMITS.disturbed * chips * LIMITS.vote


class Weighed(NamedTuple):
    """What c candidates' whole chips say: words; cost: (c,) negative log-likelihood.

    votes: how the chips voted. chips: of the longest view.
    """

    words: WordFit
    cost: Floats
    votes: Votes
    chips: int


def weigh(
    line: Line,
    start: Floats,
    chip: Floats,
    view: tuple[float, float],
    spec: FrameSpec,
    noise: float,
    votes: Votes | None = None,
) -> Weighed:
    """Weigh candidates by the chips from view[0] to view[1], samples; each in chips of its own.

    start, chip: (c,) float64, samples. noise: variance of a chip's level in the gap, V². votes: by
    which to vote; None for what the line gives.
    """
    end = start + spec.span_chips * chip
    lead = np.rint((start - view[0]) / chip).astype(np.intp)
    count = lead + spec.span_chips + np.rint((view[1] - end) / chip).astype(np.intp)
    place = np.arange(count.max() + 1) - lead[:, None]
    levels = line.means(start[:, None] + chip[:, None] * place)
    own = np.arange(start.size)[:, None], lead[:, None] + spec.places
    words = read_words(levels[own].reshape(-1, spec.line_bits, spec.order), spec)
    model = np.zeros_like(levels)
    model[own] = words.chips(spec).reshape(start.size, -1) + words.pedestal[:, None]
    seen = np.arange(levels.shape[1]) < count[:, None]
    # A chip counts by its duration, relative to the others'; beyond its view not at all.
    weight = seen * (chip / chip.mean())[:, None]
    off = np.abs(levels - model)
    if votes is None:
        best = int(np.argmin((np.square(off) * weight).sum(axis=1)))
        votes = _votes_of(levels[best, : count[best]], off[best, : count[best]], noise)
    beyond = np.maximum(off - np.float32(votes.distortion), 0)
    each = np.minimum(np.square(beyond) * np.float32(0.5 / votes.variance), LIMITS.vote)
    cost: Floats = (each * weight).sum(axis=1)
    return Weighed(words, cost, votes, levels.shape[1])


def _votes_of(levels: Floats32, off: Floats32, noise: float) -> Votes:
    """Those of a line on which even the best candidate leaves so much over, V.

    That is the line's noise if most chips have it, not only those at level changes (low-pass).
    """
    rank = int(LIMITS.most * (off.size - 1))
    left = float(np.partition(off, rank)[rank]) / LIMITS.most_deviations
    steps = np.square(np.diff(levels))  # as wide as the code's, whatever their mean
    distortion = LIMITS.distortion * float(np.sqrt(0.5 * steps.mean()))
    return Votes(distortion, max(noise, left**2, (0.5 * distortion) ** 2, 1e-30))


def choose(
    line: Line,
    start: Floats,
    chip: Floats,
    spec: FrameSpec,
    noise: float,
    unlikely: Floats | float = 0.0,
    expected: Expected | None = None,
) -> Judgement:
    """The most likely frame of candidates.

    Each is a hypothesis: a start, a chip duration, and the words that follow from them. Its cost is
    its negative log-likelihood,

        Σ over chips of min(max(|level − model| − δ, 0)² / 2σ², κ),

    with δ for distortion, over all chips of the view, which reaches from the first start to the
    last end: a shorter frame predicts silence in what is left. No chip votes with more than κ, so
    that no single disturbed chip decides. With what is likely before looking, costs give each
    frame's probability, and for every node that of all frames that give it another word or silence.

    start, chip: (c,) float64, samples. noise: variance of a chip's level in the gap, V².
    unlikely: (c,) negative log-probability of each before looking, which the waveform itself gives;
    expected: and where frames are expected.
    """
    if start.size == 1:
        words = read_words(integrate(line, start, chip, spec), spec)
        return Judgement(Fit(start.item(), chip.item()), words, None, True, True)
    view = float(start.min()), float((start + spec.span_chips * chip).max())
    seen = weigh(line, start, chip, view, spec, noise)
    cost = unaided = _refined_close(line, start, chip, view, spec, seen) + unlikely
    if expected is not None:
        cost = unaided - expected.log_prior(start)
    chosen, limit = int(cost.argmin()), LIMITS.doubt
    understood = bool(unaided[chosen] < seen.votes.most(seen.chips))
    decided = understood and _other(cost, chosen) < limit
    sure = understood and _other(unaided, chosen) < limit
    doubtful = None
    if not decided:
        level, spoken = seen.words.amplitude, seen.words.signs(spec)
        unlike = np.abs(level - level[chosen]) > LIMITS.alike * np.maximum(level, level[chosen])
        unlike |= (spoken != spoken[chosen]).any(axis=1)
        odds = np.exp(cost[chosen] - cost)
        doubtful = ((odds / odds.sum()) @ unlike >= limit) | (not understood)
    best = Fit(float(start[chosen]), float(chip[chosen]))
    return Judgement(best, seen.words.of(chosen), doubtful, decided, sure)


def _refined_close(
    line: Line,
    start: Floats,
    chip: Floats,
    view: tuple[float, float],
    spec: FrameSpec,
    seen: Weighed,
) -> Floats:
    """The costs; of candidates nearly ruled out, those that their own best timing has.

    The chips' edges were fitted to one frame's words; behind a low-pass others suit others.
    """
    cost = seen.cost
    least = float(cost.min())
    for number in np.flatnonzero((cost < least + LIMITS.close) & (cost != least)).tolist():
        there = Fit(float(start[number]), float(chip[number]))
        own = refine(line, there, spec)
        end_moved = abs(own.end(spec) - there.end(spec))
        if max(abs(own.start - there.start), end_moved) < LIMITS.in_place * there.chip:
            one = np.array([own.start]), np.array([own.chip])
            alone = weigh(line, *one, view, spec, 0.0, votes=seen.votes)
            cost[number] = min(cost[number], alone.cost.item())
    return cost


def _other(cost: Floats, chosen: int) -> float:
    """Probability that it is another frame than the chosen one."""
    costs = cost.tolist()
    odds = in_order(math.exp(min(costs[chosen] - each, 700.0)) for each in costs)  # of one, itself
    return 1 - 1 / odds
