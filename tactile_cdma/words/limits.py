# SPDX-License-Identifier: Apache-2.0

"""The limits of the certificate (kernel/certificate.h), in one place, each with its origin.

A share is of a node's amplitude A on the line unless it is said. What a limit costs and prevents is
measured by `python -m benchmarks.doubt --ablate`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

FALSE_ALARM = 3e-5
"""α, the probability with which noise fails one comparison by chance: four times in half an hour at
78 frames a second; clauses make some that are alike."""
LEAST_REST = 16
"""Samples of the line at rest that an estimate of its level and noise takes: their variance is
right to a third (√(2/15))."""
GAP_WEIGHT = 0.25
"""Weight of the newest gap in the running estimate of noise, which averages about seven gaps."""
MOST_RISE = 1 / GAP_WEIGHT
"""Times the noise known so far that a gap may show, lest one gap more than double it: a burst must
not excuse the next frame."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What a frame must be, so that its words are certain.

    deviations, log_odds: normal deviations that noise exceeds with probability α; what a rival must
        be less likely by, nats: −ln α, and two more, as some seven
        rivals of a frame are compared (ln 7 = 1.9).
    left, left_of_word: mean square that may be left beside noise, A², and the root of what each
        word may add. Edges 0.1 chip off leave 0.09 of a word (two thirds of its chips change).
    bit, chip: times what edges leave of the frame that they may leave of one bit; share of A by
        which one chip may be off, beside five deviations of what is left; more with the words. An
        impulse of a tenth of a chip, or a clipped peak, leaves 0.7 A in one chip and turns no bit.
    leak: most share of a chip that the next one holds: a low-pass of 0.6 chip leaves 0.35.
    atom, row: share with which a node shows on another row early or late, and on its own row. A
        node that is half a chip late leaves 0.5 on two readings.
    faint, faint_bit, faint_deviations: share of a silent row, and of its loudest bit, above which
        the silence is doubtful; the row has to exceed so many deviations of noise, too (its loudest
        bit `deviations`). A doubtful silence costs a taxel, and the frame only beside a weak word.
    better: squares of the weakest word by which a rival must be worse: a quarter of one chip that
        is missing.
    edges: share of the words' RMS by which edges may put a chip off, so that it tells no rivals
        apart: edges 0.1 chip off and low-passes of 0.3 chip.
    few: words up to which shifted frames are compared. More do not look like other words: what
        they leave over shows in `left`.
    beside, moves: share of a chip beside the frame; deviation of the offset from bit to bit,
        beyond which it is no line at rest: hum of an amplitude `beside`.
    silent_rho: ρ below which noise may hide a node at half its amplitude.
    hidden: mean square in which a node may hide, A², if its chips look like noise, or noise is not
        known: a node whose row holds `row`.
    weak: share below which a word may be a part of one, if a silent row holds more than noise: the
        other part, as large as `row`.
    loud_share: share of the loudest word below which a level is no word: the loudest may be that of
        three nodes on one row, and a lone node has a third of it.
    unknown_noise: deviations of noise beyond which a level is none of noise (2e-9): below, nothing
        is a word where A is not known.
    uneven: share of the words that may be uneven in a frame that says what is wrong with their
        nodes: broken nodes are few, while wrong timing makes all words uneven.
    low_rho, low_margin: ρ below which a tenth of α of the words hold a wrong bit, k·Q(ρ) for
        k = 10; share of a word's amplitude below which its weakest bit is uncertain.
    clear_margin, even_rho: the same where ρ is so high that noise makes no word so uneven: what
        inverts a bit leaves another level than the word's, mostly.
    two, shared: share above which a level is that of two nodes (equal bits give 2); above which a
        word may be that of more than one (random bits of three give 1.5).
    clear_rho, lower: ρ above which noise gives no word levels of two nodes; share of a word's
        strongest level below which its weakest is of fewer nodes.
    """

    deviations: float = NormalDist().inv_cdf(1 - FALSE_ALARM)
    log_odds: float = 2 - math.log(FALSE_ALARM)
    left: float = 0.1
    left_of_word: float = 0.09
    bit: float = 2.5
    chip: float = 0.7
    leak: float = 0.35
    atom: float = 0.33
    row: float = 0.2
    faint: float = 0.1
    faint_bit: float = 0.25
    faint_deviations: float = 3.3
    better: float = 0.25
    edges: float = 0.3
    few: int = 12
    beside: float = 0.4
    moves: float = beside / math.sqrt(2)
    silent_rho: float = 10.0
    hidden: float = row**2
    weak: float = 1 - row
    loud_share: float = 0.25
    unknown_noise: float = 6.0
    uneven: float = 0.25
    low_rho: float = NormalDist().inv_cdf(1 - FALSE_ALARM / 100)
    low_margin: float = 0.4
    clear_margin: float = 0.65
    even_rho: float = unknown_noise / (1 - clear_margin)
    two: float = 1.6
    shared: float = 1.25
    clear_rho: float = deviations / (two - 1)
    lower: float = 0.5


LIMITS = Limits()
