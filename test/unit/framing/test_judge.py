# SPDX-License-Identifier: Apache-2.0

"""What is likely before looking, and which of some frames the samples decide for."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_cdma.framing.fit import Fit, Line
from tactile_cdma.framing.judge import Judgement, choose
from tactile_cdma.framing.raster import LEAST_KNOWN, Expected, Raster
from test.support.synthetic_line import PAPER, Wire

CHIP, PERIOD = 8.0, 2048.0
TIE = {0: 500, 1: 500}
"""Silent in one chip of every bit: another pair says the same a chip later."""


def taught(jitter: float, slips: float, frames: int, seed: int = 0) -> Expected:
    """What is expected of the frame after many that the waveform alone has placed."""
    rng, raster, late = np.random.default_rng(seed), Raster(PERIOD), 0.0
    for number in range(frames):
        late += (rng.random() < slips) * rng.choice([-1.0, 1.0])
        start = number * PERIOD + CHIP * (late + rng.uniform(-jitter, jitter))
        raster.learn(Fit(start, CHIP), unaided=True)
    expected = raster.expect(frames * PERIOD)
    assert expected is not None
    return expected


def odds(expected: Expected, chips: float) -> float:
    """How much likelier the raster makes a start on it than one some chips off."""
    on, off = expected.log_prior(expected.start + np.array([0.0, chips * expected.chip]))
    return float(np.exp(on - off))


def test_nothing_is_expected_before_a_frame() -> None:
    raster = Raster(PERIOD)
    assert raster.expect(0.0) is None
    raster.learn(Fit(5.0, CHIP), unaided=True)
    assert raster.expect(3 * PERIOD) is not None
    raster.forget_place()
    assert raster.expect(3 * PERIOD) is None


def test_a_raster_decides_little_until_it_is_known() -> None:
    assert odds(taught(0.02, 0.0, LEAST_KNOWN), 3.0) < 3
    assert odds(taught(0.02, 0.0, LEAST_KNOWN + 2), 3.0) > 100


@pytest.mark.parametrize("jitter", [0.05, 0.2])
def test_the_width_is_that_of_the_frames(jitter: float) -> None:
    expected = taught(jitter, 0.0, 2000)
    apart = jitter * np.sqrt(2 / 3)  # of two uniform ones
    assert expected.scatter / CHIP == pytest.approx(np.hypot(apart, 0.05), rel=0.1)


def test_frames_that_slip_leave_room_for_the_next_one() -> None:
    assert taught(0.02, 0.05, 2000).slips == pytest.approx(0.05, rel=0.3)
    assert odds(taught(0.02, 0.05, 2000), 1.0) < 1e4 < 1e5 < odds(taught(0.02, 0.0, 5000), 1.0)


def test_frames_placed_by_the_raster_do_not_teach_it() -> None:
    raster = Raster(PERIOD)
    for number in range(200):
        raster.learn(Fit(number * PERIOD, CHIP), unaided=False)
    expected = raster.expect(200 * PERIOD)
    assert expected is not None and expected.slips == 1.0


def test_periods_passed_in_silence_widen_it() -> None:
    raster = Raster(PERIOD)
    for number in range(100):
        raster.learn(Fit(number * PERIOD, CHIP), unaided=True)
    soon, late = raster.expect(100 * PERIOD), raster.expect(9000 * PERIOD)
    assert soon is not None and late is not None
    assert late.scatter > 50 * soon.scatter


def judged(volts: np.ndarray, wire: Wire, expected: Expected | None = None) -> Judgement:
    sent = wire.sent[0]
    noise = (0.01 * 0.3) ** 2 / wire.chip
    shifts = np.arange(-3, 4)
    return choose(
        Line(volts.astype(np.float64)),
        sent.start + sent.chip * shifts,
        np.full(7, sent.chip),
        PAPER,
        noise,
        np.log1p(np.square(2.0 * shifts)),
        expected,
    )


def sent(words: dict[int, int]) -> tuple[Wire, np.ndarray]:
    wire = Wire(PAPER, CHIP)
    wire.send(500.4, words, stretch=0.0)
    return wire, wire.volts()


def test_a_tie_concerns_the_nodes_that_it_exchanges() -> None:
    wire, volts = sent(TIE)
    judgement = judged(volts, wire)
    assert not judgement.decided and judgement.doubtful is not None
    assert judgement.doubtful[[0, 1]].any() and not judgement.doubtful[5:].any()


def test_a_raster_long_known_tells_a_tie_apart_and_a_young_one_does_not() -> None:
    wire, volts = sent(TIE)
    for frames, decided in ((100, False), (20_000, True)):
        expected = taught(0.02, 0.0, frames)
        place = replace(expected, start=wire.sent[0].start)
        judgement = judged(volts, wire, place)
        assert judgement.decided == decided
        assert not judgement.unaided
        assert judgement.fit.start == pytest.approx(wire.sent[0].start, abs=0.1)


def test_words_that_differ_need_no_raster() -> None:
    wire, volts = sent({0: 500, 1: 77, 9: 1000})
    judgement = judged(volts, wire)
    assert judgement.decided and judgement.unaided and judgement.doubtful is None


@pytest.mark.parametrize("disturbed", range(-2, 162, 9))
def test_no_single_chip_outvotes_the_others(disturbed: int) -> None:
    wire, volts = sent({0: 500, 1: 77, 9: 1000})
    begin = round(wire.sent[0].start + disturbed * CHIP)
    volts[begin : begin + round(CHIP)] += 3.0
    assert judged(volts, wire).fit.start == pytest.approx(wire.sent[0].start, abs=0.1)


@pytest.mark.parametrize("stretch", [0.0, 0.03, 0.11])
@pytest.mark.parametrize("words", [{0: 1023}, {0: 500, 1: 77, 9: 1000}])
def test_chips_of_other_durations_lose(stretch: float, words: dict[int, int]) -> None:
    """Also against the silence that shorter frames predict: word 1023 of row 0 is constant."""
    wire = Wire(PAPER, CHIP)
    wire.send(500.4, words, stretch)
    frame, line = wire.sent[0], Line(wire.volts().astype(np.float64))
    chip = CHIP * (1 + np.array([0.0, 0.005, 0.03, 0.06, 0.11]))
    found = choose(line, np.full(5, frame.start), chip, PAPER, (0.01 * 0.3) ** 2 / CHIP)
    assert found.fit.chip == pytest.approx(CHIP * (1 + stretch))
    assert found.doubtful is None or not found.doubtful.any()
