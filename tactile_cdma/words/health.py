# SPDX-License-Identifier: Apache-2.0

"""Judges each node by its words of many frames: sound, weak, doubled, faulty, or not heard yet."""

import math
from enum import IntEnum

import numpy as np

from ..base.arrays import Floats32
from ..code.frame import FrameSpec
from .limits import LIMITS

JUDGE_FRAMES = 32
"""Frames with words in them between two verdicts. Chosen: 0.4 s at 78 Hz."""
LEAST_WORDS = 4
"""Words needed for a verdict on a node; each verdict halves the weight of older words. Chosen."""
WEAK_SHARE = 0.6
"""Share of the expected amplitude below which a node is weak. Chosen: just above
the default of active_share, so that a weak node is reported before its words are lost."""
MOST_UNEVEN, MOST_ODD = 0.5, 0.25
"""Shares of a node's words beyond which the node is faulty: of uneven words, and of odd ones (odd
parity though every bit is clear; levels of two nodes, which make it doubled). Chosen; words that
are no words have odd parity in half of all cases."""
MOST_FAINT, FAINT_FADES = 8.0, 0.98
"""Frames with a faint word on a silent node's row, more than it spoke in, from which on it is weak;
and what each verdict leaves of their number. Chosen: one that speaks faintly once in 78 frames gets
to 20, noise (Limits.faint_deviations) to 1."""
DOUBLE_SHARE, FAINT_SHARE = LIMITS.two, LIMITS.faint_bit
"""Shares of the expected amplitude above which a node's words are those of two, as Limits.two; and
below which nothing on its row is a word of a node that is too weak."""
WEAK_RHO = LIMITS.even_rho / 2
"""ρ above which words too faint to count show a weak node: that of half a node."""


class NodeState(IntEnum):
    """The verdict on a node; the later ones outrank the earlier ones."""

    UNHEARD = 0
    OK = 1
    WEAK = 2
    FAULTY = 3
    DOUBLED = 4


class NodeHealth:
    """Follows every node's amplitude and how even its words are.

    nominal_v: amplitude of a node's row, V; None: unknown.
    swing_v: (n,) float32, V, the amplitude to expect of each node; None while the specification
        leaves it to be learnt from each frame.
    state: (n,) uint8 of NodeState.
    invalid: (n,) bool, nodes whose words cannot be trusted: doubled or faulty.
    sums: (6, n) float32, fading, of each node's words: their number and amplitudes, V; uneven,
        doubled and odd ones; and frames with a faint one. The kernel adds to them (readout.c).
    weak_v: least amplitude of a word that is too weak to count as spoken, V; NaN where unknown.
    """

    def __init__(self, spec: FrameSpec) -> None:
        self.nominal_v = spec.node_swing_v
        self.swing_v: Floats32 | None = None
        if self.nominal_v is not None:
            self.swing_v = np.full(spec.nodes, self.nominal_v, dtype=np.float32)
        self.state = np.full(spec.nodes, NodeState.UNHEARD, dtype=np.uint8)
        self.invalid = np.zeros(spec.nodes, dtype=bool)
        self.sums = np.zeros((6, spec.nodes), dtype=np.float32)
        self._words, self._amplitude_v, self._uneven, self._doubled, self._odd, self._faint = (
            self.sums
        )
        self.weak_v = FAINT_SHARE * (self.nominal_v or math.nan)

    def nodes(self, state: NodeState) -> list[int]:
        """Numbers, from 1 on, of the nodes in a state."""
        return (np.flatnonzero(self.state == state) + 1).tolist()

    @property
    def amplitude_v(self) -> Floats32:
        """Mean amplitude of each node's last words, (n,) float32, V; NaN for one never heard."""
        amplitude_v = np.full_like(self._amplitude_v, np.nan)
        np.divide(self._amplitude_v, self._words, out=amplitude_v, where=self._words > 0)
        return amplitude_v

    def judge(self, least_words: int = LEAST_WORDS) -> bool:
        """Update the verdict on every node with at least this many words, once in JUDGE_FRAMES.

        Returns whether one has changed, or the amplitude to expect of a node.
        """
        before = self.state, self.swing_v
        spoke, due = self._words > 0, self._words >= least_words
        amplitude_v = self._amplitude_v / np.maximum(self._words, 1e-6)
        expected_v = self.nominal_v or (float(np.median(amplitude_v[spoke])) if spoke.any() else 0)
        verdict = np.full(due.shape, NodeState.OK, dtype=np.uint8)
        verdict[amplitude_v < WEAK_SHARE * expected_v] = NodeState.WEAK
        uneven = self._uneven > MOST_UNEVEN * self._words
        verdict[uneven | (self._odd > MOST_ODD * self._words)] = NodeState.FAULTY
        twice = amplitude_v > DOUBLE_SHARE * expected_v
        verdict[twice | (self._doubled > MOST_ODD * self._words)] = NodeState.DOUBLED
        unknown = spoke & (self.state == NodeState.UNHEARD)
        state = np.where(due, verdict, np.where(unknown, NodeState.OK, self.state))
        is_faint = self._faint > np.maximum(MOST_FAINT, self._words)
        state[is_faint & (state < NodeState.WEAK)] = NodeState.WEAK
        self._faint *= np.float32(FAINT_FADES)
        if not np.array_equal(state, self.state):  # others keep what follows from these
            self.state, self.invalid = state, state >= NodeState.FAULTY
        if self.nominal_v is not None and self.swing_v is not None:
            weak = due & (verdict == NodeState.WEAK)
            if np.count_nonzero(weak) > weak.size // 2 + 1:
                weak[:] = False  # the stated amplitude is wrong: words stay in doubt by it
            swing_v = np.where(weak, amplitude_v, np.float32(self.nominal_v))
            swing_v = np.where(due, swing_v, self.swing_v).astype(np.float32)
            if not np.array_equal(swing_v, self.swing_v):
                self.swing_v = swing_v
        # Each node's words fade by its own: one that speaks seldom is judged as well as others.
        self.sums[:5, due] *= 0.5
        return self.state is not before[0] or self.swing_v is not before[1]
