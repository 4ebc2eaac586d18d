# SPDX-License-Identifier: Apache-2.0

"""Frames of sparse codes: what is certified, and that nothing false is.

The chips are those of the document (test/support/sparse_codes.py), added up here.
"""

from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_cdma.base.arrays import Bools, Floats
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.framing.load import capacity
from tactile_cdma.words.health import NodeState
from tactile_cdma.words.words import Words, nobody, silent
from test.support.chip_line import ChipLine
from test.support.single_frames import SingleReader
from test.support.sparse_codes import code_number, node_chips

SPEC = FrameSpec(
    nodes=300, order=96, codes="sparse", amplitude_v=1.0, chip_s=1e-6, frame_period_s=1.0
)
SMALL = replace(SPEC, nodes=60, order=16)
RHO = 60.0
LEARNT, RELEARNT = 8, 16
"""Frames until noise is known, and until more of it is: see kernel/frame_reader.c."""


@cache
def chips_of_node(node: int, spec: FrameSpec = SPEC) -> NDArray[np.float32]:
    return node_chips(node, spec.nodes, spec.order, spec.bits)


class Rig:
    """A line of nodes, and its reader, which knows the noise already.

    speakers: how many spoke in the frame that was read last.
    """

    def __init__(self, spec: FrameSpec = SPEC, rho: float = RHO, known: bool = True) -> None:
        self.spec, self.rho = spec, rho
        self.rng = np.random.default_rng(5)
        self.reader = SingleReader(spec, 1 / spec.chip_s)
        if known:
            for _ in range(RELEARNT):
                self.read(self.sent({1: 5, 2: 9}))

    def sent(self, words: dict[int, int]) -> Floats:
        """The chips of these words, in the order of the line."""
        weights = 1 << np.arange(self.spec.bits - 1, -1, -1)
        line = np.zeros((self.spec.bits, self.spec.order))
        for node, word in words.items():
            bits = np.where(word & weights, 1.0, -1.0)
            line += self.rng.uniform(0.97, 1.03) * bits[:, None] * chips_of_node(node, self.spec)
        return line.ravel()

    def words(self, nodes: Iterable[int]) -> dict[int, int]:
        return {int(node): int(self.rng.integers(1 << self.spec.bits)) for node in nodes}

    def some(self, count: int) -> dict[int, int]:
        return self.words(self.rng.choice(self.spec.nodes, count, replace=False) + 1)

    def read(self, line: Floats) -> Words:
        """The words of a frame; where it is rejected, all are in doubt."""
        noise = self.rng.normal(0, np.sqrt(self.spec.order) / self.rho, line.size)
        frame = self.reader.read((0.2 + line + noise).astype(np.float32))
        if frame is None:
            return replace(silent(self.spec.nodes, 0.0), doubtful=~nobody(self.spec.nodes))
        self.speakers = frame.speakers
        return silent(self.spec.nodes, 0.0) if frame.words is None else frame.words


def told(words: Words) -> dict[int, int]:
    """What is claimed, by number of the node."""
    return {int(i) + 1: int(words.codes[i]) for i in np.flatnonzero(words.active)}


def certain(words: Words) -> Bools:
    return ~words.doubtful


def assert_right_where_certain(read: Words, sent: dict[int, int], but: int = 0) -> None:
    """Of all nodes but one."""
    sure = set((np.flatnonzero(certain(read)) + 1).tolist()) - {but}
    assert all(told(read).get(node) == sent.get(node) for node in sure)


def silences(read: Words) -> Bools:
    """Of whom it is claimed that they did not speak."""
    return certain(read) & ~read.active


def stranger(spec: FrameSpec = SPEC) -> Floats:
    """The chips of a node that flips them by another seed."""
    return node_chips(9, spec.nodes, spec.order, spec.bits, seed=4).ravel().astype(np.float64)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 1.0])
def test_frames_are_certain_and_right_up_to_their_capacity(share: float) -> None:
    rig, speakers = Rig(), round(share * capacity(SPEC))
    for _ in range(30):
        words = rig.some(speakers)
        read = rig.read(rig.sent(words))
        assert certain(read).all() and (not speakers or rig.speakers == speakers)
        assert told(read) == words


@pytest.mark.parametrize(("speakers", "frames"), [(1, 300), (20, 30)])
def test_noise_makes_no_word_uncertain_beside_empty_rows(speakers: int, frames: int) -> None:
    rig = Rig(rho=15.0)
    for _ in range(frames):
        words = rig.some(speakers)
        read = rig.read(rig.sent(words))
        assert certain(read)[read.active].all() and told(read) == words


def test_bits_that_are_mistaken_in_pairs_are_turned() -> None:
    """Of 29 equal words on 64 chips turns of all words end in such, once in 20 frames."""
    rig, found = Rig(replace(SPEC, nodes=256, order=64, bits=8), rho=15.0), 0
    for _ in range(200):
        words = dict.fromkeys(rig.some(29), int(rig.rng.integers(256)))
        read = rig.read(rig.sent(words))
        found += bool(certain(read)[read.active].all()) and told(read) == words
    assert found >= 198


def test_frames_of_the_shortest_codes_are_right_or_flagged() -> None:
    rig, found = Rig(replace(SPEC, nodes=20, order=8), known=False), 0
    for _ in range(LEARNT):
        rig.read(rig.sent({5: 3}))
    for count in (0, 1, 1, 3, 20):
        words = rig.some(count)
        read = rig.read(rig.sent(words))
        found += bool(certain(read).all()) and told(read) == words
        assert certain(read).all() == (count <= 1)
    assert found == 3


def test_equal_words_and_neighbours_are_told_apart() -> None:
    """As when everybody at rest speaks, or a hand is laid on."""
    rig = Rig()
    for first in range(1, 250, 12):
        words = dict.fromkeys(range(first, first + 40), 1023)
        read = rig.read(rig.sent(words))
        assert certain(read).all()
        assert told(read) == words


@pytest.mark.parametrize("count", [capacity(SPEC) + 1, 100, 200, 300])
def test_more_than_its_capacity_is_flagged_as_a_whole(count: int) -> None:
    rig = Rig()
    for _ in range(5):
        assert not certain(rig.read(rig.sent(rig.some(count)))).any()
        assert rig.speakers == pytest.approx(count, rel=0.2)


def test_many_nodes_are_not_taken_for_noise_of_the_line() -> None:
    """What they add up to is as Gaussian; but in as much noise nobody would be heard."""
    for known in (True, False):
        rig = Rig(SMALL, known=known)
        for _ in range(2 * RELEARNT):
            assert not certain(rig.read(rig.sent(rig.some(60)))).any()
        if known:
            words = rig.some(2)
            read = rig.read(rig.sent(words))
            assert certain(read).all() and told(read) == words


@pytest.mark.parametrize("speakers", [1, 5, 40])
@pytest.mark.parametrize("late", [*range(-8, 0), *range(1, 9)])
def test_a_frame_that_is_chips_off_is_flagged(late: int, speakers: int) -> None:
    rig = Rig()
    line = np.roll(rig.sent(rig.some(speakers)), late)
    assert not certain(rig.read(line)).any()


@pytest.mark.parametrize("others", [0, 4, 40])
@pytest.mark.parametrize("late", [*range(-8, 0), *range(1, 9)])
def test_a_frame_with_a_node_that_is_late_is_flagged(late: int, others: int) -> None:
    rig = Rig()
    line = rig.sent(rig.words(range(2, 2 + others))) + np.roll(rig.sent({1: 77}), late)
    assert not certain(rig.read(line)).any()


@pytest.mark.parametrize("times", [0, 2], ids=["lost", "doubled"])
@pytest.mark.parametrize("speakers", [1, 3, 40])
def test_a_sample_lost_or_doubled_anywhere_leaves_nothing_false(times: int, speakers: int) -> None:
    """Near the end it leaves the words as they are; there they may be certain, and right."""
    rig = Rig()
    for end in range(3, SPEC.chips + 3, 3 * 37):
        words = rig.some(speakers)
        line = rig.sent(words)
        each = np.where(np.arange(end) == end // 3, times, 1)
        line[-end:] = np.resize(np.repeat(line[-end:], each), end)
        read = rig.read(line)
        assert_right_where_certain(read, words)
        assert end <= SPEC.order or not certain(read).any()


def test_what_breaks_off_in_the_last_of_many_bits_is_seen() -> None:
    """In the mean of all bits it is less than chance may be."""
    rig = Rig(replace(SPEC, bits=16))
    line = rig.sent({7: 54321})
    assert certain(rig.read(line)).all()
    at = line.size - 58
    line[at:-1] = line[at + 1 :]
    assert not certain(rig.read(line)).any()


def test_silence_is_not_claimed_of_a_node_that_cannot_be_understood() -> None:
    """It spoke, and flips its chips by another seed: there is nothing to see but noise."""
    rig = Rig()
    for others in (0, 20):
        assert not certain(rig.read(rig.sent(rig.some(others)) + stranger())).any()


@pytest.mark.parametrize("other", ["none", "clipped", "spikes"])
@pytest.mark.parametrize("rho", [20.0, RHO])
def test_a_node_that_is_never_understood_is_not_taken_for_noise(rho: float, other: str) -> None:
    """It speaks from the first frame on. What others leave sticks out, of more power or of its.

    Its power may be learnt as noise: the words of others are certain then, but no silence.
    """
    for known in (True, False):
        rig = Rig(rho=rho, known=known)
        for frame in range(4 * RELEARNT):
            if frame % 2 == 0 and other == "clipped":
                line = rig.sent(rig.some(40))
                rig.read(np.clip(line, -1.2 * np.std(line), 1.2 * np.std(line)))
            if frame % 2 == 0 and other == "spikes":
                line = rig.sent(rig.some(3))
                line[rig.rng.choice(line.size, 20)] += np.sqrt(line.size / 20)
                rig.read(line)
            words = rig.some(3)
            read = rig.read(rig.sent(words) + stranger())
            assert_right_where_certain(read, words)
            assert not silences(read).any()


def test_a_node_among_frames_of_more_noise_is_not_taken_for_noise() -> None:
    """They are as Gaussian as noise is, and seven times as many."""
    rig = Rig(rho=20.0, known=False)
    for frame in range(10 * LEARNT):
        line = rig.sent(rig.some(3))
        if frame % 8:
            rig.read(line + rig.rng.normal(0, 1.8, line.size))
        else:
            assert not silences(rig.read(line + stranger())).any()


@pytest.mark.parametrize(("spec", "rho"), [(SPEC, 4.0), (SMALL, 5.5)])
def test_silence_is_not_claimed_where_noise_may_hide_a_node(spec: FrameSpec, rho: float) -> None:
    rig = Rig(spec, rho)
    words = {3: 700, 8: 12}
    read = rig.read(rig.sent(words))
    assert not silences(read).any()


def test_silence_is_not_claimed_where_what_words_leave_may_hide_a_node() -> None:
    """3 % of 1,100 words on 2,048 chips are an amplitude squared."""
    rig = Rig(replace(SPEC, nodes=4000, order=2048), rho=100.0)
    for speakers in (20, 1100):
        words = rig.some(speakers)
        assert told(rig.read(rig.sent(words))) == words
        read = rig.read(rig.sent(words) + stranger(rig.spec))
        assert_right_where_certain(read, words)
        assert not silences(read).any()


def test_nothing_is_claimed_where_the_noise_of_a_bit_may_hide_a_word() -> None:
    """A lost sample makes noise of a bit, and nothing is left to tell it by."""
    rig = Rig(replace(SPEC, nodes=256, order=64), rho=5.0)
    for _ in range(10):
        line = rig.sent(rig.some(1))
        assert not certain(rig.read(line)).any()
        assert not certain(rig.read(np.append(np.delete(line, 590), 0.0))).any()


def test_words_are_claimed_where_their_own_levels_show_what_disturbs_a_bit() -> None:
    """Noise of one bit of 2,048 chips would hide a word, but not turn what is lost of one."""
    rig = Rig(replace(SPEC, nodes=4000, order=2048), rho=15.0)
    for speakers in (1, 5):
        words = rig.some(speakers)
        line = rig.sent(words)
        read = rig.read(line)
        assert certain(read)[read.active].all() and told(read) == words
        line[-2048:] = 0
        assert not certain(rig.read(line)).any()


def test_noise_that_creeps_up_hides_no_node_that_speaks_afterwards() -> None:
    """A tone grows: it leaves more, time by time, but no more than words and chance may."""
    rig = Rig(replace(SPEC, nodes=4000, order=912), rho=15.0)
    strange = stranger(rig.spec)
    nodes = range(101, 251)
    for power in np.concatenate([np.linspace(0, 0.8, 32), np.repeat([0.9, 1.2], 8)]):
        tone = np.sqrt(2 * power) * np.sin(0.7 * np.arange(strange.size))
        rig.read(rig.sent(rig.words(nodes)) + tone)
    assert not silences(rig.read(rig.sent(rig.words(nodes)) + strange)).any()
    assert not silences(rig.read(rig.sent(rig.words(range(101, 104))) + strange)).any()


def test_a_node_that_begins_as_noise_ends_is_not_taken_for_it() -> None:
    """Its power is less than that of the noise before."""
    rig = Rig(rho=8.6)
    rig.rho = RHO
    words = rig.some(1)
    assert told(rig.read(rig.sent(words))) == words


def test_silence_is_not_claimed_where_no_row_shows_a_node_that_noise_hides() -> None:
    """Half of a node, which flips its chips otherwise, beside the noise of 9,120 chips."""
    spec = replace(SPEC, nodes=1000, order=912)
    for rho, may_hide in ((12.0, True), (30.0, False)):
        rig = Rig(spec, rho)
        assert (certain(rig.read(rig.sent({3: 700}))) != may_hide)[3:].all()
        disturbed = rig.read(rig.sent({3: 700}) + 0.5 * stranger(spec))
        assert not silences(disturbed).any()


def test_noise_that_is_new_or_rises_is_believed_after_a_while() -> None:
    for rho, unsure in ((15.0, LEARNT), (RHO, 0)):
        rig = Rig(rho=rho, known=False)
        flagged = [not certain(rig.read(rig.sent({5: 3}))).any() for _ in range(LEARNT + 1)]
        assert flagged == [True] * unsure + [False] * (LEARNT + 1 - unsure)
    rig = Rig()
    rig.rho = RHO / 4
    flagged = [not certain(rig.read(rig.sent({5: 3}))).any() for _ in range(2 * RELEARNT)]
    assert flagged == [True] * RELEARNT + [False] * RELEARNT


def _one(rig: Rig, level: Floats, twice: bool = False) -> Floats:
    """A word of node 7, or two that differ, of this level, (k,), in each bit."""
    bits = rig.rng.choice([-1.0, 1.0], (1 + twice, SPEC.bits)).sum(axis=0)
    chips: Floats = ((level * bits)[:, None] * chips_of_node(7)).ravel()
    return chips


@pytest.mark.parametrize(
    ("level", "twice", "state"),
    [
        (np.full(10, 0.35), False, NodeState.WEAK),
        (np.full(10, 0.6), False, NodeState.WEAK),
        (np.full(10, 2.0), False, NodeState.DOUBLED),
        (np.ones(10), True, NodeState.DOUBLED),
        ((np.arange(10) != 4).astype(float), False, NodeState.FAULTY),
    ],
    ids=["a third", "weak", "equal words", "two words", "a bit is missing"],
)
def test_a_node_at_fault_is_named_and_claims_nothing(
    level: Floats, twice: bool, state: NodeState
) -> None:
    rig, line = Rig(), ChipLine(SPEC, codes="sparse", nodes=SPEC.nodes, order=SPEC.order)
    for _ in range(150):
        words = rig.words(rig.rng.choice(range(8, 301), 20, replace=False))
        noise = rig.rng.normal(0, np.sqrt(SPEC.order) / RHO, SPEC.chips)
        sent = rig.sent(words) + _one(rig, level, twice) + noise
        read = line.frame(sent.reshape(SPEC.bits, SPEC.order)).words
        assert_right_where_certain(read, words, but=7)
        assert state == NodeState.WEAK or not certain(read)[6]
    assert line.pipeline.health.nodes(state) == [7]


def test_words_that_clipping_makes_of_three_others_are_flagged() -> None:
    """Of three chips, clipped at ±1, half their product is left, and half of each."""
    rig, m = Rig(), SPEC.nodes.bit_length()
    node_of = {code_number(node, m): node for node in range(1, SPEC.nodes + 1)}
    found = 0
    for three in rig.rng.choice(SPEC.nodes, (30, 3), replace=False) + 1:
        fourth = np.bitwise_xor.reduce([code_number(int(node), m) for node in three])
        if int(fourth) in node_of:
            found += 1
            line = np.clip(1.05 * rig.sent(rig.words(three)), -1.05, 1.05)
            assert not certain(rig.read(line)).any()
    assert found > 5


def test_words_whose_chips_add_up_to_nothing_are_flagged() -> None:
    """Four codes of a small book cancel in a bit; all their bits turned give the same chips."""
    rig = Rig(SMALL, rho=100.0)
    book = {node: chips_of_node(node, SMALL) for node in range(1, SMALL.nodes + 1)}
    rng, found = np.random.default_rng(2), 0
    while found < 3:
        nodes = [int(node) + 1 for node in rng.choice(SMALL.nodes, 4, replace=False)]
        for bit in range(SMALL.bits):
            for signs in ((1, 1, 1, 1), (1, 1, -1, -1), (1, -1, 1, -1), (1, -1, -1, 1)):
                own = [sign * book[node][bit] for sign, node in zip(signs, nodes, strict=True)]
                if not np.any(np.sum(own, axis=0)):
                    words = rig.words(nodes)
                    weight = 1 << SMALL.bits - 1 - bit
                    for sign, node in zip(signs, nodes, strict=True):
                        words[node] = words[node] & ~weight | (weight if sign > 0 else 0)
                    assert not certain(rig.read(rig.sent(words))).any()
                    found += 1
