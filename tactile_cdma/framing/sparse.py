# SPDX-License-Identifier: Apache-2.0

"""What frames of sparse codes are read by (kernel/sparse.h, detect.h), each with its origin.

What orthogonal codes are read by, too, is in `limits`.
"""

from __future__ import annotations

from dataclasses import replace

from ..base import kernel
from ..code.frame import FrameSpec
from ..code.sparse import code_places
from ..code.transform import Transform
from ..words.limits import LIMITS
from .load import ALIKE_BELOW, capacity

SLOPE, SPAN = 0.75, 8.0
"""Soft bits rise by SLOPE of what tanh does, to ±1; the share of a word that is believed rises from
0 to 1 over SPAN of the logarithm of its odds: straight lines for the optimal curves, with which as
many nodes are found."""
HARD_SHARE = 2.2
"""Least mean |r| of a hard word, in deviations of noise, which has 0.8 ± 0.6/√k and exceeds it at
k = 10 once in a million."""
NEAR, SETTLED = 0.1, 0.01
"""Power by which hard words may differ from the soft ones before, of what is left, to be final:
what nodes leave then hides in the noise; soft words that leave no less than that less in the next
turn get no better. Power by which amplitudes may change in the turn after: a percent of noise, or
of an amplitude."""
MOST_TURNS = 24
"""Turns after which a frame is given up: those that are found take up to 12."""
DAMPING = 0.6
"""Share of the words before that soft ones keep where a frame is tried again: of frames of 32 words
on 64 chips one in 300 fails without, none of 2,500 with it."""
TOLERANCE = 0.03
"""Share of a word that may be left over, RMS: chips are means, of which edges take little."""
FAINTEST = 0.5 + 2 * TOLERANCE
"""Share of an amplitude that a word of a frame has: of three words that clip at an amplitude half
is left, and as much of the product of their codes, which may be that of a node."""
HIDDEN = 0.5
"""Power left beside noise, in amplitudes squared, in which a node may hide: half of its own. At
ρ = 15 on 912 chips per bit it is exceeded by chance once in a hundred frames, and no silence is
claimed then; a quarter would be in nine frames of ten."""

SPARSE_LIMITS = replace(LIMITS, left_of_word=TOLERANCE, bit=1.0)
"""A bit that is wrong, or missing, leaves an amplitude squared there, among that of all nodes."""


def sparse_code(spec: FrameSpec, spreads: Transform) -> kernel.Held:
    """Return the kernel's struct sparse_code; spreads: the transform of the book, unscaled."""
    return kernel.struct(
        "sparse_code",
        rows=spec.row_count,
        walsh=spreads.at,
        places=code_places(spec.nodes, spec.line_bits, spec.order).astype("int32"),
        numbers=spec.code_numbers.astype("int32"),
        least=LIMITS.faint,
        slope=SLOPE,
        span=SPAN,
        hard=HARD_SHARE,
        near=NEAR,
        settled=SETTLED,
        turns=MOST_TURNS,
        capacity=capacity(spec),
        hidden=HIDDEN,
        damping=DAMPING,
        faintest=FAINTEST,
        may_cancel=spec.order < ALIKE_BELOW,
    )
