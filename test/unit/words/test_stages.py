# SPDX-License-Identifier: Apache-2.0

"""The kernel reads words as numpy does: decisions equal, floats within 1e-6 of the line's RMS."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_cdma.base import kernel
from tactile_cdma.code.frame import BIPOLAR, UNIPOLAR, FrameSpec
from tactile_cdma.code.separate import NodeLevels, frame_settings, node_levels
from tactile_cdma.code.transform import correlate, spread
from tactile_cdma.framing.fit import compiled_fit_words, numpy_fit_words
from tactile_cdma.words import lateness, stages
from tactile_cdma.words.decode import Words, decode_at_once, decode_in_stages

pytestmark = pytest.mark.skipif(kernel.compiled is None, reason=kernel.why_numpy)

SPECS = st.builds(
    lambda row_and_drive, **rest: FrameSpec(
        first_row=row_and_drive[0], drive=row_and_drive[1], **rest
    ),
    st.sampled_from([(0, BIPOLAR), (1, BIPOLAR), (2, BIPOLAR), (1, UNIPOLAR)]),
    nodes=st.sampled_from([1, 2, 3, 7, 16, 19, 128, 129, 300]),
    bits=st.sampled_from([8, 10, 16]),
    chip_s=st.just(1e-7),
    frame_period_s=st.just(1.0),
    polarity=st.sampled_from([1, -1]),
    sign_seed=st.sampled_from([None, 1]),
    amplitude_v=st.sampled_from([None, 0.3]),
    parity=st.booleans(),
)


@st.composite
def lines(draw: st.DrawFn) -> tuple[FrameSpec, np.ndarray]:
    """A skin and the correlations of three frames of it: silent, weak, doubled and broken words."""
    spec = draw(SPECS)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    shape = (3, spec.line_bits, spec.order)
    of_nodes = [[0.3], [0.3, 0.0], [0.3, 0.29, 0.05], [0.0], [0.3, 0.7, 0.11, 0.0], [30.0]]
    amplitudes = draw(st.sampled_from(of_nodes))
    rows = np.zeros(shape)
    signs = rng.choice([-1.0, 1.0], (3, spec.line_bits, spec.nodes))
    rows[..., spec.node_slice] = signs * rng.choice(amplitudes, spec.nodes)
    hit = rng.random(shape) < draw(st.sampled_from([0.0, 0.0, 0.02]))
    rows[hit] *= rng.choice([-0.5, 0.0, 2.0], np.count_nonzero(hit))
    rows += rng.normal(0, draw(st.sampled_from([0.0, 1e-3, 0.03, 0.2])), shape)
    return spec, rows.astype(np.float32)


def same(some: Any, others: Any, rms: float) -> None:
    """Floats nearly, all else exactly."""
    for a, b in zip(some, others, strict=True):
        if np.asarray(a).dtype.kind == "f":
            np.testing.assert_allclose(a, b, rtol=2e-6, atol=1e-6 * rms)
        else:
            np.testing.assert_array_equal(a, b)


@settings(max_examples=200, deadline=None)
@given(lines())
def test_words_of_candidates_are_those_of_numpy(line: tuple[FrameSpec, np.ndarray]) -> None:
    spec, rows = line
    rms = float(np.sqrt(np.mean(np.square(rows))))
    found, expected = compiled_fit_words(rows, spec), numpy_fit_words(rows, spec)
    assert np.array_equal(found.amplitude > 0, expected.amplitude > 0)
    for name, scale in (("amplitude", rms), ("pedestal", rms), ("uneven", rms**2), ("power", rms)):
        a, b = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-6 * scale, err_msg=name)
    spoken = expected.power > 1e-9
    for name in ("spread", "misfit"):
        a, b = getattr(found, name)[spoken], getattr(expected, name)[spoken]
        # numpy adds thousands of squares in float32, one after the other.
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4, err_msg=name)


@settings(max_examples=300, deadline=None)
@given(lines(), st.sampled_from([None, 0.3]), st.sampled_from([0.3, 0.5, 0.9]))
def test_decoded_words_are_those_of_numpy(
    line: tuple[FrameSpec, np.ndarray], swing_v: float | None, threshold: float
) -> None:
    spec, rows = line
    rms = float(np.sqrt(np.mean(np.square(rows))))
    levels = node_levels(rows[0], spec)
    ways = [way(levels, spec, threshold, swing_v) for way in (decode_at_once, decode_in_stages)]
    fields = [field for field in Words.__slots__ if field != "noise_rms_v"]
    same(*([getattr(words, field) for field in fields] for words in ways), rms)


@pytest.mark.parametrize("noise_v", [0.0, 2e-3])
@pytest.mark.parametrize("nodes", [16, 256])
def test_sound_words_are_read_at_once(nodes: int, noise_v: float) -> None:
    """Else the comparison above would not compare."""
    spec, rng = FrameSpec(nodes=nodes, chip_s=1e-7, frame_period_s=1.0), np.random.default_rng(1)
    rows = rng.normal(0, noise_v, (spec.line_bits, spec.order)).astype(np.float32)
    rows[:, spec.node_slice] += rng.choice([-0.3, 0.3], (spec.line_bits, nodes))
    swing_v = np.full(nodes, 0.3, np.float32)
    settings = frame_settings(spec), stages.reading_settings(spec, 0.5, 1.0, 3, 0.5)
    found = stages.read(settings, rows, swing_v, spec.sign_mask, noise_v, np.nan)
    assert found is not None
    words, leave_energy = found
    assert words.active.all() and leave_energy == (nodes * noise_v > 0.1), "noise of many rows"


@settings(max_examples=200, deadline=None)
@given(lines(), st.integers(0, 5))
def test_late_words_are_those_of_numpy(line: tuple[FrameSpec, np.ndarray], delay: int) -> None:
    """Of frames in which some nodes are late by chips, too."""
    spec, rows = line
    if spec.order <= 2 * lateness.EDGE:
        return
    delayed = rows[1].copy()
    delayed[:, spec.node_slice][:, ::2] = 0
    chips = np.roll(spread(rows[1] - delayed, spec.book), delay)
    rows = rows[0] + delayed + correlate(chips, spec.book)
    levels = node_levels(rows, spec)
    amplitude = stages.measure(levels.values).amplitude
    active = amplitude > 0.1
    found = lateness.compiled_late(levels, amplitude, active, spec)
    assert np.array_equal(found, lateness.numpy_late(levels, amplitude, active, spec))


def test_levels_that_are_no_numbers_are_no_words() -> None:
    """Of a frame that holds samples that were not received."""
    spec = FrameSpec(nodes=16, amplitude_v=0.3)
    rows = np.full((1, spec.line_bits, spec.order), 0.3, np.float32)
    rows[0, 3, 5] = np.nan
    found, expected = compiled_fit_words(rows, spec), numpy_fit_words(rows, spec)
    np.testing.assert_array_equal(found.amplitude, expected.amplitude)
    levels = NodeLevels(rows[0, :, spec.node_slice], 1e-3, rows=rows[0])
    words = decode_at_once(levels, spec)
    assert np.array_equal(words.active, decode_in_stages(levels, spec).active)


def test_misuse_is_refused_and_says_of_which_argument() -> None:
    assert kernel.compiled is not None
    spec = FrameSpec(nodes=5, order=8)
    settings = frame_settings(spec), stages.reading_settings(spec, 0.5, 1.0, 3, 0.5)
    rows, mask, expected = np.zeros((10, 8), np.float32), np.zeros(5, np.int32), np.ones(5)
    out = np.zeros((6, 5), np.float32), np.zeros((3, 5), np.int32), np.zeros((5, 5), np.bool_)
    sound = [*settings, 100.0, np.nan, rows, mask, expected.astype(np.float32), *out]
    kernel.compiled.read_words(*sound)
    for place, wrong, error in (
        (0, settings[1], "words_frame: 56 bytes of settings expected, not 64"),
        (2, "much", "per_noise: must be real number"),
        (4, rows[:9], r"rows: \(10, 8\) with 5 nodes from row 1 on expected, not \(9, 8\)"),
        (4, rows[:, ::2], "rows: ndarray is not C-contiguous"),
        (4, rows[0], r"rows: 2 axes \(kN\) expected, not 1"),
        (5, mask[:4], "expected: 4 values expected, not 5"),
        (6, expected, "expected: values of type 'f' expected, not 'd'"),
        (6, None, "expected: a bytes-like object"),
        (7, out[0][:5], r"floats: 6 of \(6n\) is 6, not 5"),
        (8, out[1][:, :4], "ints: ndarray is not C-contiguous"),
        (9, b"flags", "flags: "),
    ):
        with pytest.raises((TypeError, ValueError, BufferError), match=f"read_words: {error}"):
            kernel.compiled.read_words(*sound[:place], wrong, *sound[place + 1 :])
    with pytest.raises(TypeError, match="read_words: 10 arguments expected, not 9"):
        kernel.compiled.read_words(*sound[:-1])


def test_settings_have_the_members_of_their_struct() -> None:
    assert kernel.compiled is not None
    for name, (size, members) in kernel.compiled.STRUCTS.items():
        end = 0
        for _, offset, kind in members:
            width = np.dtype(kind).itemsize
            assert end <= offset < end + width + 8 and offset % width == 0, "no member is left out"
            end = offset + width
        assert end <= size < end + 8
        for wrong in ({}, {**dict.fromkeys((m[0] for m in members), 1), "more": 1}):
            with pytest.raises(TypeError, match=name):
                kernel.settings(name, **wrong)
    one = kernel.settings("words_lateness", late_share=0.25, leaked=0.5, by_chance=4.0)
    assert one.tolist() == (0.25, 0.5, 4.0)
