# SPDX-License-Identifier: Apache-2.0

"""Limits by which words are told from noise, from each other, and from what is no word."""

SOUND_SHARE = 0.8
"""Share of the loudest word's amplitude below which a word may be what leaks from louder ones.
Chosen: spreads of sound nodes are a few percent."""
LOW_RHO = 5.0
"""ρ below which words are flagged: more than 3e-6 hold a wrong bit, k·Q(ρ) for k = 10."""
DOUBLE_SHARE = 1.6
"""Share of a node's amplitude above which a level is that of two nodes. Chosen: nodes with equal
bits give 2, one 60 % too strong is out of tolerance anyway."""
SHARED_SHARE = 1.25
"""Share of a node's amplitude above which a word may be that of more than one: two nodes with
random bits give 1 on average, three give 1.5. Chosen between these."""
CLEAR_RHO = 8.0
"""ρ above which noise gives no word levels of two nodes: 0.6 amplitudes are 4.8 deviations."""
UNLIKE = 0.2
"""Share of a word's amplitude by which a level may be off. Chosen on bad lines (make torture)."""

LOWER_SHARE = 0.5
"""Share of a word's strongest level below which its weakest is that of fewer nodes. Chosen: three
nodes give 3 and 1."""


def most_square(bits: int) -> float:
    """Sum of squares over the squared amplitude, of a word with one level that is off by UNLIKE.

    Such a level adds 1/k − 1/k² of its square to the mean square of the word's k levels.
    """
    return bits + UNLIKE**2 * (bits - 1) / bits
