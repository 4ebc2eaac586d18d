# SPDX-License-Identifier: Apache-2.0

"""Multiuser detection: which nodes of a sparse book spoke in a frame, and what.

Codes are not orthogonal, so that every row holds a part of what every other one has, as noise. It
is taken off in turns (approximate message passing: Donoho, Maleki, Montanari 2009): the levels of
all rows give the likeliest words, these the chips, and what is left of the frame's chips better
levels. A node's k bits decide together whether it spoke, which they do with more noise than any
bit could be read in. While much is left, words are soft, and what is left is corrected for having
been made of these levels (Onsager's term); then they are hard, with the amplitude that they show.
Who spoke in the frame before, and how loud, is where the next one begins: it saves a turn or two,
and decides nothing, because words that do not fit leave more than noise.

The line's level is one unknown more. The result is a claim: what is left says how good it is.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..base import kernel
from ..base.arrays import Bools, Floats, Floats32
from .amplitude import LEAST_SHARE
from .frame import FrameSpec
from .sparse import code_places
from .transform import Transform, chips_of, rows_of

SOFT_NOISE = 0.1
"""Noise of a level, of a node's amplitude, up to which words are hard. Chosen: it is then of the
size of what amplitudes differ by, which hard words find."""
SLOPE, LOG_ODDS = 0.75, 8.0
"""Soft bits rise by SLOPE of what tanh does, to ±1; the share of a word that is believed rises from
0 to 1 over so much of the logarithm of its odds. Chosen: straight lines for the optimal curves,
with which as many nodes are found."""
HARD_SHARE = 2.2
"""Mean |r| of a hard word, in deviations of noise. Chosen: noise has 0.8 ± 0.6/√k, and exceeds it
at k = 10 once in a million."""
SETTLED, NEGLIGIBLE = 0.01, 1e-4
"""Power by which the amplitudes of words may change in the turn after, of what is left; and in any
case, in amplitudes of a node squared. Of m words they change by m/kN of what they do in this turn.
Chosen: a percent of noise, and of an amplitude."""
NEAR = 0.1
"""Power by which hard words may differ from the soft ones before, of what is left, to be final.
Chosen: what nodes leave then hides in the noise of the frame."""
STALLED = 0.97
"""Ratio of noise to that of the turn before beyond which soft words get no better. Chosen."""
MOST_TURNS = 24
"""Turns after which a frame is given up. Chosen: those that are found take up to 12."""
MOST_PAIRS = 16
"""Pairs of bits that are turned in one bit of the words. Chosen: one or two are."""


class Detected(NamedTuple):
    """What is found in the chips of a frame.

    rows: (k, 2^m) float32, V, of every row: what is left on it, and its word, if it has one.
    heard: (n,) bool, nodes of which words were taken off. level_v: level of the line.
    chips: (k, N) float32, V, what is left over of the chips. left: (k,) mean squares of that, V².
    settled: whether the words stayed the same in the end.
    """

    rows: Floats32
    heard: Bools
    level_v: float
    chips: Floats32
    left: Floats
    settled: bool


class Detector:
    """Takes the words of frames of one specification apart.

    kernel: the kernel's struct sparse, which does it.
    """

    def __init__(self, spec: FrameSpec, certificate: Mapping[str, float]) -> None:
        """certificate: what the kernel certifies frames by; see framing/sparse_timing.py."""
        assert spec.flips is not None, "sparse codes are scrambled"
        self._spec = spec
        swing = spec.node_swing_v or 0.0
        rules = kernel.struct(
            "sparse_rules",
            swing=swing,
            least=LEAST_SHARE * swing,
            soft_noise=SOFT_NOISE,
            slope=SLOPE,
            log_odds=LOG_ODDS,
            hard_share=HARD_SHARE,
            settled=SETTLED,
            near=NEAR,
            negligible=NEGLIGIBLE * swing**2,
            stalled=STALLED,
            turns=MOST_TURNS,
            **certificate,
        )
        self.kernel = _made(spec, rules)

    def detect(self, chips: Floats32, damping: float = 0.0) -> Detected:
        """The words in chips (k, N) float32, V.

        damping: share of the words before that soft ones keep: slower, and more often right.
        """
        spec = self._spec
        rows = np.empty((spec.line_bits, spec.row_count), np.float32)
        left = np.empty((spec.line_bits, spec.order), np.float32)
        heard, power = np.empty(spec.nodes, np.bool_), np.empty(spec.line_bits)
        found = kernel.struct(
            "detected", rows=rows, heard=heard, left=left, power=power, level=0.0, settled=False
        )
        detector = kernel.lib.sparse_detector(self.kernel.at)
        kernel.lib.detector_detect(detector, kernel.pointer(chips, *left.shape), damping, found.at)
        return Detected(rows, heard, found.at.level, left, power, found.at.settled)

    def detect_from(self, words: Floats32, chips: Floats32) -> Detected:
        """The words in chips (k, N) float32, V, beginning with others, (k, 2^m) V."""
        spec = self._spec
        swing, bits, nodes = np.float32(spec.node_swing_v or 0.0), spec.line_bits, spec.node_slice
        settled = False
        for turn in range(MOST_TURNS):
            told = chips - chips_of(words, spec)
            level = float(told.mean(dtype=np.float64))
            left = told - np.float32(level)
            rows = words + rows_of(left, spec)
            power = np.square(left, dtype=np.float64).mean(axis=1)
            noise = max(float(power.mean()) / spec.order, 1e-12 * float(swing) ** 2)
            own, newer = rows[:, nodes], np.zeros_like(words)
            amplitude = np.abs(own).mean(axis=0, dtype=np.float32)
            heard = amplitude > np.float32(max(LEAST_SHARE * float(swing), HARD_SHARE * noise**0.5))
            newer[:, nodes] = np.copysign(amplitude * heard, own)
            change = float(np.square(newer - words).sum()) / bits
            if np.array_equal(np.sign(newer), np.sign(words)):
                after = change * np.count_nonzero(heard) / spec.chips
                most = max(SETTLED * float(power.mean()), NEGLIGIBLE * float(swing) ** 2)
                settled = bool(after < most)
                power -= min(change, float(power.min())) if settled else 0.0
            if settled or turn + 1 == MOST_TURNS:
                break
            words = newer
        return Detected(rows, heard, level, left, power, settled)

    def loudness(self, chips: Floats32, lateness: int) -> Floats32:
        """Mean |r| of every node, (n,) V, in chips (k, N) that are read so much later in bits."""
        spec = self._spec
        if abs(lateness) >= spec.order:
            raise ValueError(f"{lateness} chips late: all of a bit's {spec.order}")
        loudness = np.empty(spec.nodes, np.float32)
        detector, order = kernel.lib.sparse_detector(self.kernel.at), spec.order
        of_chips = kernel.pointer(chips, spec.line_bits, order)
        of_nodes = kernel.pointer(loudness, spec.nodes)
        kernel.lib.detector_loudness(detector, of_chips, lateness, of_nodes)
        return loudness

    def learn(self, noise: float, found: float) -> float:
        """Return the noise, V², after a frame of so much."""
        return float(kernel.lib.sparse_learn(self.kernel.at, noise, found))


def _made(spec: FrameSpec, rules: kernel.Held) -> kernel.Held:
    """Make the kernel's struct sparse."""
    assert spec.flips is not None
    bits, order, pointer = spec.line_bits, spec.order, kernel.pointer
    walsh = Transform(spec.book.plan, spreading=True)
    book = kernel.struct(
        "sparse_book",
        bits=bits,
        order=order,
        rows=spec.row_count,
        nodes=spec.nodes,
        walsh=walsh.at,
        places=pointer(code_places(spec.nodes, bits, order).astype(np.int32), bits, order),
        codes=pointer(spec.code_numbers.astype(np.int32), spec.row_count),
        flips=pointer(np.ascontiguousarray(spec.flips, np.float32), bits, order),
    )
    made = kernel.lib.sparse_new(book.at, rules.at)
    return kernel.Held(made, kernel.lib.sparse_free, walsh, book)


def turn_pairs(found: Detected, products: Floats32, spec: FrameSpec) -> Floats32:
    """The words found, (k, 2^m) V, with bits turned, two at a time, as long as that leaves less.

    Turns of all words stop where no single bit that is turned leaves less; of few chips two may.
    products: (k, 2^m), of codes i and j at i XOR j, over the chips per bit.
    """
    own = found.rows[:, spec.node_slice][:, found.heard]
    codes = spec.code_numbers[spec.rows[found.heard]]
    products = products[:, codes[:, None] ^ codes]
    words = np.copysign(np.abs(own).mean(axis=0, dtype=np.float32), own)
    off = own - words  # what is left on every row
    for bit, alike in enumerate(products):
        word, rest = words[bit], off[bit]
        for _ in range(MOST_PAIRS):
            one = 4 * word * (word + rest)  # power that turning it adds, per chip
            both = one[:, None] + one + 8 * word[:, None] * word * alike
            np.fill_diagonal(both, one)
            pair = list(set(divmod(int(both.argmin()), word.size)))
            if both.min() >= 0:
                break
            rest += 2 * alike[:, pair] @ word[pair]
            word[pair] *= -1
    turned = np.zeros_like(found.rows)
    turned[:, spec.rows[found.heard]] = words
    return turned
