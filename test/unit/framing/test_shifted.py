# SPDX-License-Identifier: Apache-2.0

"""Marks, bits and samples some whole chips beside their places, where few nodes speak."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.doubt.words import compare, decode
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.framing.fit import read_words
from tactile_cdma.framing.shifted import is_shifted, may_be_shifted
from test.support.examples import examples
from test.support.independent_line import Digitizer, Line, Skin, Talk, render, row_sign

RAW, MEANS = Digitizer(), Digitizer(integrated=True, samples_per_chip=8)
MOVED = [{"mark_shifts": (1.0, 2.0)}, {"mark_shifts": (-1.0, -2.0)}, {"slip_share": 0.3}]


@pytest.mark.parametrize("digitizer", [RAW, MEANS], ids=["raw", "means"])
@pytest.mark.parametrize("moved", MOVED, ids=str)
@pytest.mark.parametrize(
    ("order", "speak", "words"), [(8, 2, "random"), (24, 3, "random"), (64, 1, "extreme")]
)
def test_no_word_is_wrong_without_a_flag(
    digitizer: Digitizer, moved: dict, order: int, speak: int, words: str
) -> None:
    skin = Skin(nodes=order - 1, order=order, period_chips=13 * order)
    talk = Talk(speakers=tuple(range(6)), together=speak, words=words)
    recording = render(skin, talk, Line(), replace(digitizer, **moved), 100, seed=order)
    tally, complaints = compare(recording, decode(recording), Line())
    assert tally.unflagged == 0, complaints
    assert tally.flagged + tally.wrong_flagged + tally.lost > 0, "there was something to flag"


@pytest.mark.parametrize("by", [-1.5, -0.5, 0.5, 1.5])
def test_a_mark_that_is_half_a_chip_off_hides_no_lone_node(by: float) -> None:
    """Chips of row 1 of this book turn with each: their means over two are 0 within a bit."""
    skin = Skin(nodes=15, order=16, period_chips=208)
    moved = replace(MEANS, mark_shifts=(by,))
    recording = render(skin, Talk(speakers=(0,)), Line(), moved, 100, seed=3)
    tally, complaints = compare(recording, decode(recording), Line())
    assert tally.unflagged == 0, complaints
    assert tally.wrong_flagged + tally.lost > 10, "it hides words"
    assert tally.right > 50


@pytest.mark.parametrize(
    ("skin", "by"),
    [
        (Skin(nodes=96, order=96, bits=8, first_row=0, period_chips=1363, amplitude_v=0.12), -2.0),
        (Skin(nodes=39, order=40, period_chips=500, amplitude_v=0.2), 2.0),
    ],
    ids=["96", "40"],
)
def test_many_words_beside_their_mark_are_told(skin: Skin, by: float) -> None:
    moved = replace(MEANS, mark_shifts=(by,))
    recording = render(skin, Talk(share=0.3, stay=8, words="equal"), Line(), moved, 40, seed=2)
    tally, complaints = compare(recording, decode(recording), Line())
    assert tally.unflagged == 0, complaints
    assert tally.flagged + tally.wrong_flagged + tally.lost > 20, "there was something to flag"
    assert tally.right > 0.6 * tally.words


def test_a_value_too_many_tells_of_one_that_was_taken_twice() -> None:
    """At a bit's begin it turns all of the last bit, and no chip within the frame shows it."""
    skin, talk = Skin(nodes=15, order=16, period_chips=208), Talk(speakers=(0,), words="extreme")
    recording = render(skin, talk, Line(), MEANS, 20, seed=4)
    number = next(i for i, truth in enumerate(recording.frames) if truth.codes[0] in (0, 1023))
    runs = [run for run in recording.runs if run.marked]
    counts = np.insert(runs[number].counts, 144, runs[number].counts[143])
    runs[number] = replace(runs[number], counts=counts)
    after = number + 1
    runs[after:] = [replace(run, first_index=run.first_index + 1) for run in runs[after:]]
    decoded = decode(replace(recording, runs=tuple(runs)))
    for i, (frame, truth) in enumerate(zip(decoded, recording.frames, strict=True)):
        assert frame.words.doubtful.all() == (i == number)
        assert (frame.words.codes[0] != truth.codes[0]) == (i == number), "it turned a bit"


ORDERS = (4, 8, 12, 16, 32)
SPEC = {n: FrameSpec(nodes=n - 1, order=n, first_row=1, chip_s=2e-5) for n in ORDERS}


@examples(400)
@given(
    st.sampled_from(ORDERS),
    st.sets(st.integers(0, 30), min_size=1, max_size=3),
    st.integers(0, 2**30 - 1),
    st.sampled_from(["whole", "bit", "double"]),
    st.sampled_from([-2, -1, 0, 1, 2]),
    st.integers(0, 9),
)
def test_frames_and_single_bits_that_are_moved(
    order: int, rows: set[int], words: int, kind: str, by: int, bit: int
) -> None:
    """By the page's book: words of an odd number of nodes are right, or the frame is told."""
    spec = SPEC[order]
    skin = Skin(nodes=order - 1, order=order, sign_seed=spec.sign_seed)
    codes = np.full(order - 1, -1)
    nodes = sorted({row % (order - 1) for row in rows})
    codes[nodes] = [words >> 10 * i & 1023 for i in range(len(nodes))]
    sent = skin.waveforms(codes).sum(axis=0).reshape(10, order)
    padded = np.pad(sent.ravel() if kind == "whole" else sent[bit], 2)
    chips = sent.copy()
    if kind == "whole":
        chips = padded[2 - by : padded.size - 2 - by].reshape(chips.shape)
    elif kind == "double":
        place = bit * order + abs(by) % order
        by = 0 if abs(by) % order == 0 else by
        chips = np.insert(sent.ravel(), place, sent.flat[place - 1])[:-1].reshape(chips.shape)
        chips = chips if by else sent
    else:
        by = int(np.sign(by))
        chips[bit] = padded[2 - by : padded.size - 2 - by]
    chips = chips.astype(np.float32)
    found = read_words(chips[None], spec)
    looked_at = not found.is_clear(spec) or may_be_shifted(chips, found, spec)
    told = looked_at and is_shifted(chips, found, spec)
    signs = [row_sign(row, spec.sign_seed) for row in range(1, order)]
    bits = found.rows[0, :, spec.node_slice] * signs > 0
    spoken = np.where(found.amplitude[0] > 0, bits.T @ (1 << np.arange(9, -1, -1)), -1)
    if by == 0:
        assert np.array_equal(spoken, codes)
        assert not told
    elif kind == "double" and found.misfit.item() < 1e-6:
        pass  # exactly other words': only the sample after the frame tells
    elif len(nodes) % 2:
        assert told or np.array_equal(spoken, codes) or not found.believable(spec)
