# SPDX-License-Identifier: Apache-2.0

"""The limits by which frames are accepted, in one place, each with its derivation."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Limits:
    """What a frame must be to be one.

    vote: κ, the most that one chip contributes to a log-likelihood. Beyond √(2κ) = 3.5 deviations,
        which noise exceeds once in 2,000 chips, a chip is disturbed, and how far says nothing.
    distortion: deviation of a chip's level, relative to the code's RMS, that says nothing: edges
        0.1 chip off and low-passes of 0.3 chip leave as much next to each level change, on all
        chips of a kind alike. Half of it is the least deviation of chips beyond that. Found with
        `make bench-doubt`: with 0.2, 1 of 120 words of nodes that tie was not flagged.
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
    doubt: probability of another word beyond which a word is doubtful: e⁻²ᵏ, so that the votes of
        two disturbed chips do not make it certain.
    alike: largest relative difference of two amplitudes that are one word's. Chosen; whether a
        node spoke is decided at half of its amplitude.
    """

    vote: float = 6.0
    distortion: float = 0.25
    most: float = 0.8
    most_deviations: float = 1.28
    clipped: float = 0.5
    deafened: float = 0.25
    blind_rho: float = 2.5
    doubt: float = 6e-6
    alike: float = 0.25


LIMITS = Limits()
