# SPDX-License-Identifier: Apache-2.0

"""Each clause of the certificate fails in presence of what it is for, and hardly ever by chance."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_cdma.base.arrays import Floats
from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.twins import twins
from tactile_cdma.framing.frame_reader import FrameReader
from tactile_cdma.framing.frames import Certificate, Clause
from tactile_cdma.words.limits import FALSE_ALARM
from test.support.chip_line import hear, read_frame

SPEC = FrameSpec()
SWING = 0.3
RNG = np.random.default_rng(1)
CODES = RNG.integers(0, 1024, 16)
ALL = np.ones(16, bool)
SIDE = 2


def some(*nodes: int) -> NDArray[np.bool_]:
    return np.isin(np.arange(16), nodes)


def certificate(chips: Floats, noise_v: float = 0.01, spec: FrameSpec = SPEC) -> Certificate:
    noisy = chips + np.random.default_rng(2).normal(0, noise_v, chips.shape)
    found = read_frame(noisy, spec, noise_v).certificate
    assert found is not None
    return found


def moved(chips: Floats, by: int) -> Floats:
    """Chips that come later; what is beyond the frame is lost."""
    padded = np.pad(chips.ravel(), SIDE)
    return padded[SIDE - by : SIDE - by + chips.size].reshape(chips.shape)


@pytest.mark.parametrize("active", [ALL, some(3), some(1, 2, 9)], ids=["all", "one", "three"])
@pytest.mark.parametrize("scramble", [False, True])
def test_a_sound_frame_holds(active: NDArray[np.bool_], scramble: bool) -> None:
    spec = FrameSpec(scramble=scramble)
    assert certificate(line_chips(spec, CODES, active), spec=spec).holds


def late_node(chips: Floats) -> Floats:
    late = line_chips(SPEC, CODES, some(5))
    return chips - late + moved(late, 1)


def loud_chip(chips: Floats) -> Floats:
    chips = chips.copy()
    chips[4, 7] += 12 * SWING
    return chips


def jump(chips: Floats) -> Floats:
    return chips + 3 * SWING * (np.arange(10) >= 5)[:, None]


def hum(chips: Floats) -> Floats:
    """Of a period of four bits."""
    return chips + SWING * np.sin(2 * np.pi * np.arange(200) / 80).reshape(10, 20)


@pytest.mark.parametrize(
    ("disturbed", "clauses"),
    [
        (late_node, {Clause.ATOMS, Clause.ENERGY}),
        (loud_chip, {Clause.ENERGY}),
        (jump, {Clause.REST}),
        (hum, {Clause.REST, Clause.ENERGY}),
    ],
)
def test_what_a_clause_is_for_fails_it(
    disturbed: Callable[[Floats], Floats], clauses: set[Clause]
) -> None:
    chips = line_chips(SPEC, CODES, ALL)
    assert certificate(chips).holds
    values = certificate(disturbed(chips)).values
    assert clauses & {clause for clause in Clause if values[clause] > 1}


@pytest.mark.parametrize("by", [-1, 1])
def test_of_few_words_some_chips_beside_others_may_be_meant(by: int) -> None:
    """Two nodes with one word, shifted, hold no loud chip that the frame does not: a rival."""
    chips = line_chips(SPEC, np.full(16, 341), some(3, 8))
    frame = hear(moved(chips, by), SPEC, 0.01)
    if frame is not None and frame.words is not None:
        assert frame.words.doubtful.all()


def test_a_node_that_another_ones_delay_makes_is_in_doubt() -> None:
    """By the pairs of rows that a delay makes alike; of every pair that a small book has."""
    spec = FrameSpec(nodes=15, order=16, frame_period_s=0.02)
    pairs = twins(spec.order, spec.first_row, spec.nodes)
    pairs = pairs[(pairs["sent"] != pairs["alike"]) & (np.abs(pairs["share"]) > 0.85)]
    assert pairs.size
    for pair in pairs:
        own = np.arange(15) == pair["alike"]
        sent = moved(line_chips(spec, np.full(15, 0), own), int(pair["shift"]))
        frame = hear(sent + RNG.normal(0, 0.01, sent.shape), spec, 0.01)
        if frame is not None and frame.words is not None:
            right = own & (frame.words.codes == 0)
            assert not (frame.words.active & ~frame.words.doubtful & ~right).any(), pair


def test_something_beside_the_frame_fails_rest() -> None:
    reader = FrameReader(SPEC, 4 / SPEC.chip_s)
    reader.learn_rest(0.0, 1e-4)
    chips = np.append(line_chips(SPEC, CODES, ALL).ravel(), np.zeros(4))
    certificates = []
    for beside in (0.0, SWING):
        chips[200:202] = beside
        frame = reader.read(np.repeat(chips, 4).astype(np.float32))
        assert frame is not None and frame.certificate is not None
        certificates.append(frame.certificate)
    assert certificates[0].holds
    assert certificates[1].rest > 1


def test_half_a_word_and_its_rest_on_a_silent_row_are_in_doubt() -> None:
    half = line_chips(SPEC, CODES, ALL & ~some(4, 9))
    half = half + 0.6 * line_chips(SPEC, CODES, some(4)) + 0.35 * line_chips(SPEC, CODES, some(9))
    frame = read_frame(half, SPEC, 0.01)
    assert frame.certificate is not None and frame.certificate.words > 1
    assert frame.words is not None and frame.words.doubtful.all()


def test_noise_is_learnt_from_frames_where_there_is_no_gap() -> None:
    """Noise of 0.15 V is more than nothing explains, until frames have shown it."""
    reader, rng = FrameReader(SPEC, 1 / SPEC.chip_s), np.random.default_rng(3)
    holds = []
    for _ in range(40):
        chips = line_chips(SPEC, rng.integers(0, 1024, 16), ALL).ravel()
        frame = reader.read((chips + rng.normal(0, 0.15, chips.size)).astype(np.float32))
        assert frame is not None and frame.certificate is not None
        holds.append(frame.certificate.energy < 1)
    assert all(holds[10:])


@pytest.mark.parametrize("scramble", [False, True])
def test_gaussian_noise_fails_no_more_clauses_than_it_may(scramble: bool) -> None:
    """Most that 2000 frames may have, by chance, of all statistics of the five clauses."""
    spec, rng, frames = FrameSpec(scramble=scramble), np.random.default_rng(4), 2000
    statistics = spec.chips + spec.line_bits + 6 * spec.order + 5
    failed = 0
    for _ in range(frames):
        chips = line_chips(spec, rng.integers(0, 1024, 16), ALL)
        found = read_frame(chips + rng.normal(0, 0.05, chips.shape), spec, 0.05).certificate
        assert found is not None
        failed += not found.holds
    expected = FALSE_ALARM * statistics * frames
    assert failed <= expected + 4 * np.sqrt(expected)
