# SPDX-License-Identifier: Apache-2.0

"""The limits by which frames are accepted, in one place, each with its derivation."""

from dataclasses import dataclass

from ..code.frame import MAX_STRETCH


@dataclass(frozen=True, slots=True)
class Limits:
    """What a frame must be to be one.

    chip_error: share by which chips may be shorter than nominal, or longer than the longest
        stretch. Chosen: a third of a chip at the end of a frame of 32.
    loud: deviations of a correlation that a word's mean |r| exceeds where somebody spoke. Noise
        alone gives 0.8 ± 0.6/√k, so at k = 10 that is six deviations off.
    spread: relative variance of |r| within a word (WordFit.spread) beyond which a fit is not
        believed. White noise alone gives 1/ρ², so ρ > 2.9; chips that have nothing to do with the
        code book give π/2 − 1 = 0.57.
    clear_spread: the same of few words that are clear, with carried_noise and carried_misfit, so
        that no shifted frame is looked for. Chosen: ρ of 22.
    chips: of a word in a bit, that words which are clear may leave over. Chosen: half of what many
        words that are a chip off leave, and of the least that a wrong bit or a missing chip does.
    few: words up to which a frame may be another one that is some chips off (shifted.py). Chosen:
        frames of three nodes, beside their mark, look like up to ten words (make bench-doubt).
    whole: share of a node's amplitude below which it may be a part of that of another one, whose
        frame is shifted. Chosen: parts are halves and less.
    misfit: power left over by the words, relative to theirs, that jitter of edges and clipping may
        account for. Chosen; edges that jitter by ±0.1 chip leave 0.007, so most of it is for
        clipping.
    left: factor on the noise of the gap within which what words leave over is noise. Chosen: the
        variance of the 16 samples of a short gap is right to a third, and a frame's scatters, too.
    carried_misfit: misfit that reused timing may leave: edges 0.04 chip off (each of them changes
        one chip by 2a·0.04, and half of all edges are level changes), which costs 0.01 dB.
    carried_noise: factor on the noise of the gap that reused timing may leave. Chosen: the variance
        of the chips of a frame of order 20 is right to a tenth (√(2/200)), that of the gap to
        less.
    kept: share of the samples' power, without noise, that chips have. Chosen: of nodes all half a
        chip late it is a half, and at order 4 three nodes look like one with a third of theirs.
    odd_share: share of at least three words that may be uneven and still say nothing about the
        frame. Chosen: broken nodes are few, while wrong timing makes all words uneven.
    stricter: factor by which the other words must then be cleaner than they would have to be with
        these. Chosen: frames of wrong timing do not get there.
    lone_chip: median deviations beyond which a chip is none of noise. Chosen: 5 deviations.
    faint_scatter: deviations by which the power of a frame's chips must exceed the gap's noise for
        a stretch to be searched for. Chosen: noise does not get there.
    hiding: power of a chip that few words leave over, in squares of the weakest one's amplitude,
        beyond which it hides the chips that tell a frame that is beside its mark. Chosen: those of
        five bits that change, twice in each, are then 11 deviations.
    rest: share of the weakest word's amplitude below which a line is at rest. Chosen: below half,
        so that a lone node's chips exceed it even where their edges leave out part of them.
    at_rest: deviations of what many words leave of a chip up to which a line that such noise hides
        is at rest there. Chosen: a chip at rest is louder once in 80.
    tail_noise, tail_scatter: what follows a frame is noise where its power is below tail_noise +
        tail_scatter/√m of that of the gap, of m samples. Chosen; the fewer, the more by chance.
    tail_level: deviations of their mean from the level at rest up to which the same holds. Chosen.
    least_tail: chips after a frame with fewer samples than which nothing is said of them. Chosen.
    beside_level, beside: mean level, relative to the RMS of the frame, and power, relative to the
        frame's, that a gap beside a frame may have beyond its noise in timing by gaps. Chosen: hum
        of a fifth of the words; two of a bit's 20 chips.
    rise: largest ratio of a gap's variance to the estimate that is believed: a burst within one gap
        must not excuse the next frame. Chosen; with a weight of a quarter (marked_timing) the
        estimate grows by 1.75 per gap at most.
    proven_ends: frames in a row that end in silence, after which their length is taken as right.
        Chosen: less than half a second at 78 Hz.
    vote: κ, the most that one chip contributes to a log-likelihood. Beyond √(2κ) = 3.5 deviations,
        which noise exceeds once in 2,000 chips, a chip is disturbed, and how far says nothing.
    disturbed: share of the chips that may be disturbed, beside noise, in a frame that is
        understood; beyond it the true one need not be among those that were weighed. Chosen: 4 of
        200.
    close: log-likelihood below the best frame's beyond which another one's is final; up to there
        its timing is refined. Chosen: behind a low-pass of 0.2 chip refinement gains up to 25.
    in_place: chips by which refined timing may move before it is another frame's. Chosen; a
        low-pass moves edges by its time constant.
    known_place: uncertainty of an expected frame's edges, chips, up to which it is not searched
        for. Chosen: from twice the least width of a raster on, frames of two nodes with equal words
        were taken half a chip off (make bench-doubt).
    rare_slips: share of frames off the raster up to which the same holds. Chosen; what may be the
        case after 30 frames without one is less.
    distortion: deviation of a chip's level, relative to the code's RMS, that says nothing: edges
        0.1 chip off and low-passes of 0.3 chip leave as much next to each level change, on all
        chips of a kind alike. Half of it is the least deviation of chips beyond that. Found with
        `make bench-doubt`: with 0.2, 1 of 120 words of nodes that tie was not flagged; with
        0.25, 1 of 20,000 behind a low-pass of 0.2 chip.
    most: share of the chips that shows a line's own noise. Chosen: half of them are next to a level
        change; a fifth may be disturbed.
    most_deviations: what a normal variable of variance 1 exceeds, in size, in the other chips.
    clipped: share of a frame's samples at a rail beyond which words are not believed at all: a line
        that rests at the rail clips half of its chips.
    deafened: the same beyond which nobody can tell who was silent. At half, a lone node has half of
        its amplitude, which is where silence begins; half of that. A sound frame that clips at
        3·√n·A has 0.3 % there (Gaussian).
    blind_rho: ρ below which words are not found reliably, so that their absence says nothing.
        Chosen; at ρ = 3 one frame in 5,000 is missed at order 20 (make bench-error).
    lone: factor by which a lone node's power must exceed what a burst needs that is no noise, for a
        slot without one to be silent in timing by gaps. Chosen: the noise of a gap comes out up to
        a third too low.
    doubt: probability of another word beyond which a word is doubtful: e⁻²ᵏ, so that the votes of
        two disturbed chips do not make it certain.
    alike: largest relative difference of two amplitudes that are one word's. Chosen; whether a
        node spoke is decided at half of its amplitude.
    """

    chip_error: float = 0.01
    loud: float = 2.0
    spread: float = 0.12
    clear_spread: float = 0.002
    chips: float = 1.0
    few: int = 12
    whole: float = 0.75
    misfit: float = 0.15
    left: float = 3.0
    carried_misfit: float = 3e-3
    carried_noise: float = 1.5
    kept: float = 0.6
    odd_share: float = 0.25
    stricter: float = 3.0
    lone_chip: float = 7.4
    faint_scatter: float = 6.0
    hiding: float = 0.3
    rest: float = 0.4
    at_rest: float = 2.5
    tail_noise: float = 2.0
    tail_scatter: float = 8.0
    tail_level: float = 4.0
    least_tail: float = 0.5
    beside_level: float = 0.2
    beside: float = 0.1
    rise: float = 4.0
    proven_ends: int = 30
    vote: float = 6.0
    disturbed: float = 0.02
    close: float = 30.0
    in_place: float = 0.3
    known_place: float = 0.1
    rare_slips: float = 0.05
    distortion: float = 0.3
    most: float = 0.8
    most_deviations: float = 1.28
    clipped: float = 0.5
    deafened: float = 0.25
    blind_rho: float = 2.5
    lone: float = 1.5
    doubt: float = 6e-6
    alike: float = 0.25

    def possible(self, stretch: float) -> bool:
        """Whether chips may last so many nominal ones."""
        return 1 - self.chip_error <= stretch <= (1 + self.chip_error) * (1 + MAX_STRETCH)


LIMITS = Limits()
