# SPDX-License-Identifier: Apache-2.0

"""Hum and impulses cost timing by gaps few frames, and their removal takes no word away."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.doubt.tally import Tally
from benchmarks.doubt.words import compare, decode
from tactile_cdma.framing.gaps.gap_timing import GapTiming
from tactile_cdma.framing.gaps.hum import Hum, without_impulses
from test.support.independent_line import Digitizer, Line, Skin, Talk, render
from test.support.synthetic_line import DEFAULT, PAPER, Wire, check, run, same, words_of

RATE_HZ = 80_000.0
TWO = Talk(together=2)
CHURN = Talk(share=0.3, stay=8)
OLD = Skin(order=16, first_row=0, sign_seed=None, polarity=-1, period_chips=208)


def tally(line: Line, talk: Talk, skin: Skin, frames: int = 60, seed: int = 3) -> Tally:
    recording = render(skin, talk, line, Digitizer(marked=False), frames, seed)
    counts, complaints = compare(recording, decode(recording), line)
    assert not counts.unflagged, complaints
    assert not counts.phantom
    return counts


@pytest.mark.parametrize(
    ("skin", "hum_hz"),
    [(Skin(), 50.0), (OLD, 59.9), (Skin(period_chips=400), 50.0)],
    ids=["78 per s", "row 0", "50 per s"],
)
@pytest.mark.parametrize("talk", [Talk(), TWO, CHURN], ids=["all", "two", "some"])
def test_hum_costs_few_frames(skin: Skin, hum_hz: float, talk: Talk) -> None:
    """Of a third of an amplitude; at 50 frames per second each one is at the same place in it."""
    counts = tally(Line(hum_v=0.1, hum_hz=hum_hz), talk, skin)
    assert counts.lost < 0.05 * counts.words
    assert counts.right + counts.tied > 0.95 * counts.words


@pytest.mark.parametrize("talk", [Talk(), TWO], ids=["all", "two"])
def test_a_thousand_impulses_per_second_cost_few_frames(talk: Talk) -> None:
    counts = tally(Line(impulses_hz=1000), talk, Skin())
    assert counts.lost < 0.3 * counts.words


def test_slots_in_which_a_node_spoke_are_not_silent_while_hum_is_being_learnt() -> None:
    """It begins in silence, and what was learnt of the line before is wrong then."""
    wire = Wire(DEFAULT, 4.0, seed=21)
    wire.amplitude_v = 0.3
    for slot in range(7, 40, 3):
        wire.send((slot + 0.3) * wire.period, {4: 37 * slot % 1024})
    volts, index = wire.volts(rho=60, length=42 * wire.period), np.arange(round(42 * wire.period))
    grows = np.clip(index / wire.period - 6, 0, 1)
    volts += (0.1 * grows * np.sin(2 * np.pi * 50 / wire.rate_hz * index)).astype("f4")
    timing, heard = GapTiming(replace(DEFAULT, amplitude_v=0.3), wire.rate_hz), 0
    for frame in run(timing, volts):
        near = [sent for sent in wire.sent if abs(sent.start - frame.start) < 0.3 * wire.period]
        said = None if frame.levels is None else words_of(frame, wire.spec)
        assert said == (near[0].words if near else None)
        heard += bool(near)
    assert timing.rejections.total > 0
    assert heard >= 7


@pytest.mark.parametrize("seed", range(3))
def test_chunking_is_invisible_in_hum_and_impulses(seed: int) -> None:
    wire = Wire(PAPER, 5.1, seed=seed)
    wire.send_random(12)
    volts, rng = wire.volts(rho=30), wire.rng
    volts += (0.1 * np.sin(2 * np.pi * 50 / wire.rate_hz * np.arange(volts.size))).astype("f4")
    at = rng.integers(0, volts.size, volts.size // 100)
    volts[at] += rng.choice([-1.0, 1.0], at.size).astype("f4")
    whole = run(GapTiming(PAPER, wire.rate_hz), volts)
    cuts = np.sort(rng.integers(0, volts.size, 200)).tolist()
    same(run(GapTiming(PAPER, wire.rate_hz), volts, cuts), whole)
    assert sum(frame.levels is not None for frame in whole) >= 8


def test_a_node_that_holds_the_line_is_no_hum() -> None:
    """On row 0, half a frame up and half a frame down, as slowly as 60 Hz."""
    wire = Wire(replace(PAPER, amplitude_v=0.3), 8.0, seed=22)
    for slot in range(25):
        wire.send((slot + 0.25) * wire.period, {0: 0b1111100000})
    timing = GapTiming(wire.spec, wire.rate_hz)
    check(wire, run(timing, wire.volts(rho=60)), start_chips=0.25)
    assert timing.rejections.total == 0


@pytest.mark.parametrize("hum_hz", [49.7, 60.2, 100.0, 250.3])
def test_hum_is_removed_between_the_windows_that_showed_it(hum_hz: float) -> None:
    rng, period, window = np.random.default_rng(23), 1024, 132
    index = np.arange(20 * period)
    wave = 0.1 * np.sin(2 * np.pi * hum_hz / RATE_HZ * index + 1)
    volts = 0.7 + wave + rng.normal(0, 0.01, index.size)
    hum = Hum(RATE_HZ)
    for begin in range(0, 18 * period, period):
        hum.learn(begin, volts[begin : begin + window], 1e-4)
    left = hum.removed(volts, 0)[-3 * period :] - volts[-3 * period :] + wave[-3 * period :]
    assert hum.heard
    assert np.abs(left).max() < 0.01


@pytest.mark.parametrize("kind", ["noise", "drift", "jumps", "30 Hz", "400 Hz"])
def test_what_is_no_hum_is_left_alone(kind: str) -> None:
    rng, period, window = np.random.default_rng(24), 1024, 132
    index = np.arange(40 * period)
    other = {
        "noise": np.zeros(index.size),
        "drift": 1e-5 * index,
        "jumps": np.repeat(rng.choice([-0.2, 0.2], 40), period),
        "30 Hz": 0.1 * np.sin(2 * np.pi * 30 / RATE_HZ * index),
        "400 Hz": 0.1 * np.sin(2 * np.pi * 400 / RATE_HZ * index),
    }[kind]
    volts = other + rng.normal(0, 0.01, index.size)
    hum = Hum(RATE_HZ)
    for begin in range(0, index.size, period):
        hum.learn(begin, volts[begin : begin + window], 1e-4)
    assert hum.removed(volts, 0) is volts


def test_impulses_are_removed_and_chips_are_not() -> None:
    rng = np.random.default_rng(25)
    chips = np.repeat(rng.choice([-0.6, 0.0, 0.6], 400), rng.choice([2, 3], 400))
    clean = chips + rng.normal(0, 0.02, chips.size)
    assert without_impulses(clean) is clean
    at = np.arange(10, chips.size - 10, 90)
    struck = clean.copy()
    struck[at] += rng.choice([-2.0, 2.0], at.size)
    left, near = without_impulses(struck), np.concatenate((at - 1, at, at + 1))
    assert np.array_equal(np.delete(left, near), np.delete(clean, near))
    between = np.minimum(clean[at - 1], clean[at + 1]), np.maximum(clean[at - 1], clean[at + 1])
    assert ((left[at] >= between[0]) & (left[at] <= between[1])).all()


def test_ringing_is_no_impulse() -> None:
    """Where many samples stand off their neighbours, they are the line's own."""
    chips = np.repeat(np.random.default_rng(26).choice([-0.6, 0.6], 300), 4)
    chips += np.tile([0.2, -0.1, 0.05, 0.0], 300) * chips
    assert without_impulses(chips) is chips
