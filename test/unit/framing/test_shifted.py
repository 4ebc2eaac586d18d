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


ORDERS = (4, 8, 12, 16, 32)
SPEC = {n: FrameSpec(nodes=n - 1, order=n, first_row=1, chip_s=2e-5) for n in ORDERS}


@examples(400)
@given(
    st.sampled_from(ORDERS),
    st.sets(st.integers(0, 30), min_size=1, max_size=3),
    st.integers(0, 2**30 - 1),
    st.sampled_from(["whole", "bit"]),
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
    elif len(nodes) % 2:
        assert told or np.array_equal(spoken, codes) or not found.believable(spec)
