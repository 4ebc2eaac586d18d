# SPDX-License-Identifier: Apache-2.0

"""Decodes marked frames of sparse codes, and certifies them.

Detection always finds words; what it leaves over says whether these are all that was sent. So a
frame is certain only if it settled, no more nodes spoke than the book tells apart, and what is left
is less than a node that is late, or flips its chips otherwise, would leave. Else all of it is in
doubt: it is never guessed which part.
"""

import math
from typing import NamedTuple

import numpy as np

from ..base.arrays import Bools, Floats, Floats32, Indices
from ..base.sums import in_order
from ..code.amplitude import LEAST_SHARE, LOW_MARGIN, SILENT_RHO, most_noise_power, rises
from ..code.detect import Detected, Detector, turn_pairs
from ..code.frame import FrameSpec
from ..code.separate import NodeLevels
from ..code.transform import rows_of
from ..wire._protocol import TURN_MOST_LOG2
from .marked_timing import MarkedFrame, MarkedLine, MarkedTiming, Recogniser, Verdict
from .timing import Rails, blinding_noise_v

DAMPINGS = (0.0, 0.6, 0.8)
"""How a frame is tried, in turn, until it is certain; see detect. Chosen: of frames of 32 words on
64 chips one in 300 fails without damping, none of 2,500 with 0.6."""
CAPACITY, LOST = 0.65, 2.0
"""Nodes that may speak in a frame, of the chips per bit but LOST times their square root: beyond,
some frames do not settle. Found with `make bench-sparse`."""
TOLERANCE = 0.03
"""Share of a word that may be left over, RMS: chips have edges. Chosen: of 300 words a quarter of
what a node leaves that is not understood."""
FAINTEST = 0.56
"""Share of an amplitude that a word of a frame has. Derived: of three words that clip at an
amplitude, half is left, and as much of the product of their codes, which may be that of a node."""
MORE, BY_CHANCE = 0.1, 4.0
"""Power by which what is left may exceed the noise of the frames before, in amplitudes of a node
squared; and deviations of that noise that are chance. Chosen: a node leaves 1, a wrong bit 0.4."""
MOST_TURNED = 128
"""Words of which pairs of bits are turned. Chosen: 5 ms; no frame in 10,000 of more needed it."""
ALIKE_BELOW = 128
"""Chips per bit below which codes of those who speak may add up to nothing. Derived: of four whose
numbers XOR to 0 they do in a bit once in 0.75^-N times, in 10¹⁶ at 128 chips."""
HIDDEN = 0.36
"""Power of chips below which no node is hidden in them, in amplitudes squared. Chosen: at 0.6 A."""
LEARNT, RELEARNT = 8, 64
"""Frames of which the least noise is that of the line: the first ones, and as many in doubt for
their noise alone; more of them if a node might hide in it. Chosen: the kurtosis of so many tells it
from a node."""
WEIGHT = 0.25
"""Weight of the newest frame in the noise. Chosen: averages about seven frames."""
MOST_LATE, LATE_SHARE = 8, 0.5
"""Chips by which a node that is late or early is found; its share of an amplitude there. Chosen."""
LATENESSES = (*range(1, MOST_LATE + 1), *range(-MOST_LATE, 0))


class Load(NamedTuple):
    """Nodes that speak at once.

    capacity: most that are told apart. now, peak: in the newest frame, and in any so far; of those
    that are not told apart, as many as have the line's power. overloads: frames of more than the
    capacity, or of nodes whose codes are not told apart; crowded: the newest one is of these.
    """

    capacity: int
    now: int = 0
    peak: int = 0
    overloads: int = 0
    crowded: bool = False

    def after(self, now: int, crowded: bool = False) -> "Load":
        """With a frame more, in which so many spoke."""
        overloads = self.overloads + (crowded or now > self.capacity)
        return Load(self.capacity, now, max(self.peak, now), overloads, crowded)


class SparseTiming(MarkedTiming):
    """Line timing of nodes with sparse codes."""

    def __init__(self, spec: FrameSpec, rate_hz: float, rails_v: Rails = None) -> None:
        """See MarkedLine."""
        line = MarkedLine(spec, rate_hz, rails_v)
        self._own = SparseRecogniser(line)
        self.detector = self._own.detector
        self.load = Load(capacity(spec))
        super().__init__(line, self._own)

    def _noted(self, verdict: Verdict) -> Verdict:
        frame = verdict.frame
        if frame is not None:
            spoke = (self._own.speakers, self._own.crowded) if frame.levels else (0,)
            self.load = self.load.after(*spoke)
            if frame.levels is None:  # all of it was noise
                self._own.learn(frame.noise_rms_v**2)
        return super()._noted(verdict)


def capacity(spec: FrameSpec) -> int:
    """Nodes that may speak in one frame."""
    if not spec.sparse:
        return spec.nodes
    return min(spec.nodes, told_apart(spec.order))


def told_apart(order: int) -> int:
    """Nodes that may speak in one frame of so many chips per bit."""
    return max(1, int(CAPACITY * (order - LOST * math.sqrt(order))))


def groups_for_all(spec: FrameSpec) -> int:
    """In how many groups all nodes may speak by turns, and are told apart; 0: in none."""
    codes = spec.code_numbers[spec.rows]
    products = _products(spec) if spec.order < ALIKE_BELOW else None
    for log2 in range(TURN_MOST_LOG2 + 1):
        groups = [codes[first :: 1 << log2] for first in range(1 << log2)]
        most = max(each.size for each in groups)
        if most <= capacity(spec) and (
            products is None or all(_told_apart(each, products, MORE) for each in groups)
        ):
            return len(groups)
    return 0


def certificate(spec: FrameSpec) -> dict[str, float]:
    """What frames of a specification have to satisfy: members of the kernel's sparse_rules."""
    swing2, power = (spec.node_swing_v or 0.0) ** 2, most_noise_power(spec.line_bits)
    return {
        "capacity": capacity(spec),
        "most_noise": blinding_noise_v(spec) ** 2,
        "more": MORE,
        "tolerance": TOLERANCE,
        "faintest": FAINTEST * (spec.node_swing_v or 0.0),
        "chance": _by_chance(spec.chips),
        "chance_of_bit": _by_chance(spec.order),
        "hiding": swing2 * min(_most_noise_of_words(spec), spec.order / SILENT_RHO**2),
        "weight": WEIGHT,
        "silent_square": spec.line_bits * LEAST_SHARE**2 * swing2,
        "silent_power": spec.line_bits * power,
        "alike": spec.order < ALIKE_BELOW,
    }


class SparseRecogniser(Recogniser):
    """Reads frames of means of chips.

    The kernel reads those that leave nothing to decide, by the same rules: `sparse_read` in
    kernel/sparse.c. The line's noise is what frames leave over, as there is no gap.

    speakers, crowded: of the last frame that was not silent; see Load. detector: finds the words.
    """

    def __init__(self, line: MarkedLine) -> None:
        super().__init__(line)
        self.speakers, self.crowded = 0, False
        self._swing2 = (line.spec.node_swing_v or 0.0) ** 2
        self._rules = certificate(line.spec)
        self._unlearnt = _Unlearnt(line.spec)
        self.detector = Detector(line.spec, self._rules)
        line.noise_share, line.most_noise = 1 - self._rules["chance"], HIDDEN * self._swing2
        self._products = _products(line.spec)

    def recognise(self, frame: MarkedFrame) -> Verdict:
        """See Recogniser.

        Uncertain frames are tried harder, a bounded number of times; then late nodes are sought.
        """
        if verdict := self._line.gate(frame):
            return verdict
        spec, line = self._spec, self._line
        chips = frame.volts[: spec.chips].astype(np.float32).reshape(spec.line_bits, spec.order)
        found = self.detector.detect(chips)
        explained = self._words_explain(found)
        for damping in DAMPINGS[1:]:
            if explained or not line.noise:
                break
            other = self.detector.detect(chips, damping)
            if other.left.mean() < found.left.mean():
                found, explained = other, self._words_explain(other)
        are_few = 1 < np.count_nonzero(found.heard) <= MOST_TURNED
        if not explained and are_few and line.noise > 0 and self._is_understood(found):
            words = turn_pairs(found, self._products, spec)
            other = self.detector.detect_from(words, chips)
            if other.left.mean() < found.left.mean():
                found, explained = other, self._words_explain(other)
        late = () if explained else self._late(found)
        doubtful: Bools | None = None
        # The noise of a bit may hide that a word is disturbed, and what it says.
        hides_words = line.noise > _most_noise_of_words(spec) * self._swing2
        if late or not explained or hides_words:
            doubtful = np.ones(spec.nodes, np.bool_)
        elif _hides_nodes(spec, line.noise, int(np.count_nonzero(found.heard))):
            doubtful = ~found.heard
        noise = in_order(self._noise_of(found).tolist()) / spec.line_bits  # as the kernel
        rows: Floats32 | None = found.rows
        values, spoke = found.rows[:, spec.node_slice], None
        noise_v = math.sqrt(noise / spec.order)
        is_understood = self._is_understood(found)
        may_crowd = not explained and is_understood and line.noise > 0
        self.crowded = may_crowd and not self._are_told_apart(found)
        if self._settled(found):
            self.speakers = int(np.count_nonzero(found.heard))
        else:
            power = float(chips.var(dtype=np.float64)) - line.noise
            self.speakers = max(0, round(power / self._swing2))
        if explained:
            self.learn(noise)
        elif is_understood and not late:
            frames = RELEARNT if line.noise else LEARNT
            shown = self._unlearnt.learn(noise, _kurtosis(found.chips), frames)
            line.noise = line.noise if shown is None else shown
        line.level_v = found.level_v
        if doubtful is None and not self._silence_rises(found, noise_v):
            # There is nothing to ask about the silence.
            spoke = np.flatnonzero(found.heard).astype(np.int32)
            values, rows = np.ascontiguousarray(values[:, spoke]), None
        levels = NodeLevels(
            values, noise_v, rows=rows, late=late, spoke=spoke, understood=is_understood
        )
        return line.heard(frame, line.nominal, levels, doubtful)

    def learn(self, newest: float) -> None:
        """Learn the noise of a frame that left no more than words and noise do, V².

        It follows such frames, but no further than chance does: what is more may be what words or a
        tone leave. If that was learnt, the next frame might leave as much again, up to a node.
        """
        self._line.noise = self.detector.learn(self._line.noise, newest)

    def _silence_rises(self, found: Detected, noise_v: float) -> bool:
        """Whether the row of anyone who did not speak holds more than noise, V RMS of a level."""
        values = found.rows[:, self._spec.node_slice][:, ~found.heard]
        squares = np.einsum("kn,kn->n", values, values)
        swing_v = np.float32(self._spec.node_swing_v or 0.0)
        return bool(rises(squares, swing_v, noise_v, self._spec.line_bits).any())

    def _is_understood(self, found: Detected) -> bool:
        """Whether words were found that stay, of no more nodes than the book tells apart."""
        return (
            self._settled(found) and int(np.count_nonzero(found.heard)) <= self._rules["capacity"]
        )

    def _settled(self, found: Detected) -> bool:
        """Whether words were found that stay, or none, and leave no noise that hides words."""
        return found.settled and float(found.left.mean()) < self._rules["most_noise"]

    def _words_explain(self, found: Detected) -> bool:
        """Whether words were found that leave no more than the line's noise, in any bit."""
        noise, more = self._line.noise, MORE + TOLERANCE**2 * np.count_nonzero(found.heard)
        left = self._noise_of(found)
        own = found.rows[:, self._spec.node_slice][:, found.heard]
        amplitude = np.abs(own).mean(axis=0, dtype=np.float32)
        if amplitude.size and amplitude.max() < np.float32(self._rules["faintest"]):
            return False
        for power, chips in ((left.mean(), self._spec.chips), (left.max(), self._spec.order)):
            if not power < noise * (1 + _by_chance(chips)) + more * self._swing2:
                return False
        return noise > 0 and self._is_understood(found) and self._are_told_apart(found)

    def _are_told_apart(self, found: Detected) -> bool:
        """Whether no other bits of those who spoke would give nearly the same chips.

        To turn two bits or more changes the power of a bit's chips by 8 λ amplitudes squared, or
        more, where λ is the least eigenvalue of the codes' products.
        """
        if self._spec.order >= ALIKE_BELOW:
            return True
        codes = self._spec.code_numbers[self._spec.rows[found.heard]]
        least = MORE + _by_chance(self._spec.order) * self._line.noise / self._swing2
        return _told_apart(codes, self._products, least)

    def _noise_of(self, found: Detected) -> Floats:
        """Mean square of the noise of chips, (k,) V²; words have taken their share of it."""
        free = self._spec.chips - int(np.count_nonzero(found.heard)) - 1
        return found.left * (self._spec.chips / max(free, 1))

    def _late(self, found: Detected) -> tuple[int, ...]:
        """Nodes, counted from 0, whose words show in chips that are read that much later."""
        spec, late = self._spec, np.zeros(self._spec.nodes, np.bool_)
        # Of noise |r| has a mean of 0.8, and that of a word scatters by 0.6/√k.
        by_chance = math.sqrt(float(found.left.mean()) / spec.order)
        by_chance *= 0.8 + 0.6 * BY_CHANCE / math.sqrt(spec.line_bits)
        least = np.float32(max(LATE_SHARE * (spec.node_swing_v or 0.0), by_chance))
        for lateness in (each for each in LATENESSES if abs(each) < spec.order):
            late |= self.detector.loudness(found.chips, lateness) > least
        return tuple(np.flatnonzero(late).tolist())


def _products(spec: FrameSpec) -> Floats32:
    """Of codes i and j, over the chips per bit, at i XOR j, (k, 2^m)."""
    assert spec.flips is not None, "sparse codes are scrambled"
    products = np.empty((spec.line_bits, spec.row_count), np.float32)
    # Those of code 0, whose chips are the flips, with all.
    products[:, spec.code_numbers] = rows_of(spec.flips, spec)
    return products


def _told_apart(codes: Indices, products: Floats32, least: float) -> bool:
    """Whether all other bits of these codes change a bit's power by so much, amplitudes squared."""
    gram = products[:, codes[:, None] ^ codes].astype(np.float64)
    diagonal = np.arange(codes.size)
    gram[:, diagonal, diagonal] -= least / 8
    try:
        np.linalg.cholesky(gram)
    except np.linalg.LinAlgError:
        return False
    return True


def _most_noise_of_words(spec: FrameSpec) -> float:
    """Noise of chips up to which words are certain, in amplitudes squared.

    What is lost of a word in a bit, or turned, leaves more than an amplitude squared there; what it
    says then is noise, of which little reaches the margin of a word that is claimed.
    """
    return max(1 / _by_chance(spec.order), spec.order * (LOW_MARGIN / BY_CHANCE) ** 2)


def _hides_nodes(spec: FrameSpec, noise: float, words: int) -> bool:
    """Whether the noise of chips, V², and what so many words leave may hold a node that is unheard.

    What is known of the noise may be too much by chance; as much less, or more, is in the frame.
    """
    swing2 = (spec.node_swing_v or 0.0) ** 2
    if noise * SILENT_RHO**2 > spec.order * swing2:
        return True
    return 3 * _by_chance(spec.chips) * noise + (MORE + TOLERANCE**2 * words) * swing2 > swing2


def _by_chance(chips: int) -> float:
    """Share by which the mean square of so many chips' noise may be off."""
    return BY_CHANCE * math.sqrt(2 / chips)


def _kurtosis(chips: Floats32) -> float:
    """3 for noise; the chips of one node have 1, those of a tone 1.5."""
    squares = np.square(chips, dtype=np.float64)
    return float(np.square(squares).mean() / max(squares.mean() ** 2, 1e-300))


class _Unlearnt:
    """Frames that leave more than the noise that is known, but are understood.

    They are believed if what they leave is less than a node would, or as Gaussian as noise: the
    chips of few nodes, or a tone, are not. Frames that leave more than others do not count, nor
    those of which few chips stick out (clipping): they would outweigh what a node shows.
    """

    def __init__(self, spec: FrameSpec) -> None:
        self._spec, self._swing2 = spec, (spec.node_swing_v or 0.0) ** 2
        self._start()

    def _start(self) -> None:
        self._count, self._least, self._kurtoses = 0, math.inf, 0.0

    def learn(self, power: float, kurtosis: float, frames: int) -> float | None:
        """The noise, V², if this is the last of so many that show it, or of more if need be."""
        hidden, by_chance = HIDDEN * self._swing2, BY_CHANCE * math.sqrt(24 / self._spec.chips)
        alike = 1 + 2 * _by_chance(self._spec.chips)
        if max(power, hidden) * alike < self._least:
            self._start()
        is_more = power > alike * max(self._least, hidden)
        if is_more or (power > hidden and kurtosis > 3 + by_chance):
            return None
        self._count, self._kurtoses = self._count + 1, self._kurtoses + kurtosis
        self._least = least = min(self._least, power)
        if self._count < frames:
            return None
        by_chance /= math.sqrt(self._count)
        # A node lowers the kurtosis of what is left by twice this.
        of_node = (self._swing2 / max(least, self._swing2)) ** 2
        if least > hidden and by_chance > of_node and not _hides_nodes(self._spec, least, 0):
            return None
        is_gaussian = self._kurtoses / self._count > 3 - by_chance
        self._start()
        return least if is_gaussian or least < hidden else None
