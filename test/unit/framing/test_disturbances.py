# SPDX-License-Identifier: Apache-2.0

"""Hum and impulses cost timing by gaps few frames, and their removal takes no word away."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.doubt.tally import Tally
from benchmarks.doubt.words import compare, decode
from test.support.independent_line import Digitizer, Line, Skin, Talk, render
from test.support.synthetic_line import DEFAULT, PAPER, Wire, check, gap_timing, run, same, words_of

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
    """Of a third of an amplitude; at 50 frames per second each one is at the same place in it.

    Where row 0 is a node's, hum is on it: its words are right, but most of the frames are doubtful.
    """
    counts = tally(Line(hum_v=0.1, hum_hz=hum_hz), talk, skin)
    assert counts.lost < 0.05 * counts.words
    known = counts.right + counts.tied + (counts.flagged if skin.first_row == 0 else 0)
    assert known > 0.95 * counts.words


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
    timing, heard = gap_timing(replace(DEFAULT, amplitude_v=0.3), wire.rate_hz), 0
    for frame in run(timing, volts):
        near = [sent for sent in wire.sent if abs(sent.start - frame.start) < 0.3 * wire.period]
        assert words_of(frame) == (near[0].words if near else {})
        heard += bool(near)
    assert heard >= 7


@pytest.mark.parametrize("seed", range(3))
def test_chunking_is_invisible_in_hum_and_impulses(seed: int) -> None:
    wire = Wire(PAPER, 5.1, seed=seed)
    wire.send_random(12)
    volts, rng = wire.volts(rho=30), wire.rng
    volts += (0.1 * np.sin(2 * np.pi * 50 / wire.rate_hz * np.arange(volts.size))).astype("f4")
    at = rng.integers(0, volts.size, volts.size // 100)
    volts[at] += rng.choice([-1.0, 1.0], at.size).astype("f4")
    whole = run(gap_timing(PAPER, wire.rate_hz), volts)
    cuts = np.sort(rng.integers(0, volts.size, 200)).tolist()
    same(run(gap_timing(PAPER, wire.rate_hz), volts, cuts), whole)
    assert sum(bool(frame.speakers) for frame in whole) >= 8


def test_a_node_that_holds_the_line_is_no_hum() -> None:
    """On row 0, half a frame up and half a frame down, as slowly as 60 Hz."""
    wire = Wire(replace(PAPER, amplitude_v=0.3), 8.0, seed=22)
    for slot in range(25):
        wire.send((slot + 0.25) * wire.period, {0: 0b1111100000})
    timing = gap_timing(wire.spec, wire.rate_hz)
    check(wire, run(timing, wire.volts(rho=60)), start_chips=0.25)
    assert timing.rejections.total == 0
