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
from .transform import CompiledTransform, chips_of, rows_of

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
REMEMBERED = (0.5, 1.5)
"""Share of its amplitude that a node is expected to have for how it spoke before. Chosen: a sound
one's is within; of others a frame tells more."""


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


class Before(NamedTuple):
    """What the last frame that settled tells of the next one; changed by each of these.

    spoke: (n,) bool. amplitude_v: (n,) float32, V, of every node, when it last spoke.
    """

    spoke: Bools
    amplitude_v: Floats32


class Detector:
    """Takes the words of frames of one specification apart: in the kernel, where there is one.

    kernel: what does it there.
    """

    def __init__(self, spec: FrameSpec, certificate: Mapping[str, float]) -> None:
        """certificate: what the kernel certifies frames by; see framing/sparse_timing.py."""
        assert spec.flips is not None, "sparse codes are scrambled"
        self._spec = spec
        self.kernel: kernel.Held | None = None
        swing = spec.node_swing_v or 0.0
        self._before = Before(
            np.zeros(spec.nodes, np.bool_), np.full(spec.nodes, swing, np.float32)
        )
        if kernel.compiled is not None:
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
            self.kernel = _compiled(spec, rules)

    def detect(self, chips: Floats32, damping: float = 0.0) -> Detected:
        """The words in chips (k, N) float32, V.

        damping: share of the words before that soft ones keep: slower, and more often right.
        """
        spec = self._spec
        if self.kernel is None:
            return numpy_detect(chips, spec, damping, self._before)
        rows = np.empty((spec.line_bits, spec.row_count), np.float32)
        left = np.empty((spec.line_bits, spec.order), np.float32)
        heard, power = np.empty(spec.nodes, np.bool_), np.empty(spec.line_bits)
        found = kernel.struct(
            "detected", rows=rows, heard=heard, left=left, power=power, level=0.0, settled=False
        )
        detector = kernel.compiled.sparse_detector(self.kernel.at)
        kernel.compiled.detector_detect(
            detector, kernel.pointer(chips, *left.shape), damping, found.at
        )
        return Detected(rows, heard, found.at.level, left, power, found.at.settled)

    def detect_from(self, words: Floats32, chips: Floats32) -> Detected:
        """The words in chips (k, N) float32, V, beginning with others, (k, 2^m) V."""
        return numpy_detect(chips, self._spec, 0.0, self._before, words)

    def loudness(self, chips: Floats32, lateness: int) -> Floats32:
        """Mean |r| of every node, (n,) V, in chips (k, N) that are read so much later in bits."""
        if self.kernel is None:
            return numpy_loudness(chips, lateness, self._spec)
        spec = self._spec
        if abs(lateness) >= spec.order:
            raise ValueError(f"{lateness} chips late: all of a bit's {spec.order}")
        loudness = np.empty(spec.nodes, np.float32)
        detector, order = kernel.compiled.sparse_detector(self.kernel.at), spec.order
        of_chips = kernel.pointer(chips, spec.line_bits, order)
        of_nodes = kernel.pointer(loudness, spec.nodes)
        kernel.compiled.detector_loudness(detector, of_chips, lateness, of_nodes)
        return loudness

    def learn(self, noise: float, found: float) -> float:
        """Return the noise, V², after a frame of so much."""
        assert self.kernel is not None
        return float(kernel.compiled.sparse_learn(self.kernel.at, noise, found))


def _compiled(spec: FrameSpec, rules: kernel.Held) -> kernel.Held:
    """Make the kernel's struct sparse."""
    assert spec.flips is not None
    bits, order, pointer = spec.line_bits, spec.order, kernel.pointer
    walsh = CompiledTransform(spec.book.plan, spreading=True)
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
    made = kernel.compiled.sparse_new(book.at, rules.at)
    return kernel.Held(made, kernel.compiled.sparse_free, walsh, book)


def numpy_loudness(chips: Floats32, lateness: int, spec: FrameSpec) -> Floats32:
    """As Detector.loudness."""
    read = np.zeros_like(chips)
    if lateness > 0:
        read[:, :-lateness] = chips[:, lateness:]
    else:
        read[:, -lateness:] = chips[:, :lateness]
    own = np.abs(rows_of(read, spec)[:, spec.node_slice])
    loudness: Floats32 = own.mean(axis=0, dtype=np.float32)
    return loudness


def numpy_detect(
    chips: Floats32,
    spec: FrameSpec,
    damping: float,
    before: Before,
    start: Floats32 | None = None,
) -> Detected:
    """As Detector.detect. With damping, nothing is expected for what was before.

    start: words to begin with, (k, 2^m) V, which are hard.
    """
    swing, bits = np.float32(spec.node_swing_v or 0.0), spec.line_bits
    words = np.zeros((bits, spec.row_count), np.float32) if start is None else start
    left = chips if start is None else chips - chips_of(words, spec)
    level = float(left.mean(dtype=np.float64))
    left = left - np.float32(level)
    nodes, noise_before, soft, were_hard = spec.node_slice, np.inf, start is None, True
    are_whole = True  # the words before: then what is left is of them alone
    expected_v = before.amplitude_v if damping == 0 else np.full(spec.nodes, swing)
    spoke = before.spoke if damping == 0 else np.zeros(spec.nodes, np.bool_)
    rows, power, settled = words, np.zeros(bits), False
    heard = np.zeros(spec.nodes, np.bool_)
    odds = _prior(float(np.square(left).mean()), spec)
    for turn in range(MOST_TURNS):
        rows = words + rows_of(left, spec)
        power = np.square(left, dtype=np.float64).mean(axis=1)
        noise = max(float(power.mean()) / spec.order, 1e-12 * float(swing) ** 2)
        if soft and (noise < (SOFT_NOISE * swing) ** 2 or noise > STALLED**2 * noise_before):
            soft = False
        noise_before, own = noise, rows[:, nodes]
        amplitude = np.abs(own).mean(axis=0, dtype=np.float32)
        newer, onsager = np.zeros_like(words), 0.0
        if soft:
            belief = np.maximum(
                _belief(amplitude, bits, float(swing), noise, odds),
                spoke * _belief(amplitude, bits, float(swing), noise, 0.0),
            )
            bit, onsager = _soft_bits(own, belief, float(swing), noise)
            newer[:, nodes] = expected_v * belief * bit
            newer += np.float32(damping) * (words - newer)
        else:
            least = max(LEAST_SHARE * float(swing), HARD_SHARE * noise**0.5)
            heard = amplitude > np.float32(least)
            newer[:, nodes] = np.copysign(amplitude * heard, own)
            change = float(np.square(newer - words).sum()) / bits
            is_near = were_hard or change < NEAR * float(power.mean())
            if are_whole and is_near and np.array_equal(np.sign(newer), np.sign(words)):
                after = change * np.count_nonzero(heard) / spec.chips
                most = max(SETTLED * float(power.mean()), NEGLIGIBLE * float(swing) ** 2)
                settled = bool(after < most)
                power -= min(change, float(power.min())) if settled else 0.0
        were_hard, are_whole = not soft, onsager == 0 and (damping == 0 or not soft)
        if settled or turn + 1 == MOST_TURNS:
            break
        words = newer
        told = chips - chips_of(words, spec)
        if not soft:
            level = float(told.mean(dtype=np.float64))
        left = told - np.float32(level) + np.float32(onsager / spec.order) * left
    if settled:
        before.spoke[:] = heard
        least_v, most_v = (np.float32(share) * swing for share in REMEMBERED)
        spoken_v = np.abs(rows[:, nodes]).mean(axis=0, dtype=np.float32)
        before.amplitude_v[heard] = np.clip(spoken_v, least_v, most_v)[heard]
    return Detected(rows, heard, level, left, power, settled)


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


def _prior(power: float, spec: FrameSpec) -> float:
    """Logarithm of the odds that a node speaks, from the power of the chips, V²."""
    swing = spec.node_swing_v or 0.0
    share = min(max(power / swing**2 / spec.nodes, 1 / spec.nodes), 0.5) if swing else 0.5
    return float(np.log(share / (1 - share)))


def _belief(amplitude: Floats32, bits: int, swing: float, noise: float, odds: float) -> Floats32:
    """The share of each node's word that is believed, (n,), from its mean |r|, (n,) V.

    noise: variance of a level, V². odds: logarithm of those that it speaks.
    """
    per = swing / noise
    u = np.float32(per) * amplitude
    # log cosh u is u²/2 for small ones and u − log 2 for large ones: a parabola up to the line.
    turn = 2 * np.float32(np.log(2))
    log_cosh = np.where(u < turn, u * u / (2 * turn), u - turn / 2)
    ratio = bits * (log_cosh - np.float32(swing * per / 2)) + np.float32(odds)
    belief: Floats32 = np.clip(np.float32(0.5) + ratio / np.float32(LOG_ODDS), 0, 1)
    return belief


def _soft_bits(
    rows: Floats32, belief: Floats32, swing: float, noise: float
) -> tuple[Floats32, float]:
    """The bits of the nodes, (k, n), −1…1; and how words follow from the rows, (k, n) V.

    The latter is the mean sum of the derivatives of a bit's words by their levels.
    """
    bits, per = len(rows), swing / noise
    rising = (belief > 0) & (belief < 1)
    bit = np.clip(np.float32(SLOPE * per) * rows, -1, 1)
    slopes = np.count_nonzero(np.abs(bit) < 1, axis=0) @ belief * SLOPE
    slopes += np.square(bit).sum(axis=0) @ rising / LOG_ODDS
    return bit, float(slopes) * swing * per / bits
