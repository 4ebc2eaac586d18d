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
from tactile_cdma.code.separate import node_levels
from tactile_cdma.code.transform import correlate, spread
from tactile_cdma.framing.fit import compiled_fit_words, numpy_fit_words
from tactile_cdma.words import decode as decode_module
from tactile_cdma.words import lateness, stages
from tactile_cdma.words.decode import decode_at_once, decode_in_stages

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


@settings(max_examples=300, deadline=None)
@given(lines(), st.sampled_from([0.3, 0.5, 0.9]))
def test_each_stage_gives_what_numpy_gives(
    line: tuple[FrameSpec, np.ndarray], threshold: float
) -> None:
    spec, rows = line
    rms = float(np.sqrt(np.mean(np.square(rows))))
    values = rows[0, :, spec.node_slice]
    expected = np.full(spec.nodes, 0.3, np.float32)
    measures = stages.numpy_measure(values)
    same(stages.compiled_measure(values), measures, rms)
    amplitude = measures.amplitude
    found = stages.numpy_find_active(amplitude, expected, threshold)
    same(stages.compiled_find_active(amplitude, expected, threshold), found, rms)
    noise = node_levels(rows[0], spec).noise_v
    arguments = (measures, found[0], expected, spec.sign_mask, noise, spec.line_bits, spec.parity)
    same(stages.compiled_decide(*arguments), stages.numpy_decide(*arguments), rms)


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
@given(lines(), st.sampled_from([None, 0.3]), st.sampled_from([0.3, 0.5]))
def test_decoded_words_are_those_of_numpy(
    line: tuple[FrameSpec, np.ndarray], swing_v: float | None, threshold: float
) -> None:
    """At once, in compiled stages, and in numpy's."""
    spec, rows = line
    rms = float(np.sqrt(np.mean(np.square(rows))))
    levels = node_levels(rows[0], spec)
    compiled = [way(levels, spec, threshold, swing_v) for way in (decode_at_once, decode_in_stages)]
    with pytest.MonkeyPatch.context() as patch:
        for name in ("measure", "find_active", "decide"):
            patch.setattr(decode_module, name, getattr(stages, f"numpy_{name}"))
        interpreted = decode_in_stages(levels, spec, threshold, swing_v)
    fields = [field for field in interpreted.__slots__ if field != "noise_rms_v"]
    for words in compiled:
        same([getattr(words, f) for f in fields], [getattr(interpreted, f) for f in fields], rms)


@pytest.mark.parametrize("noise_v", [0.0, 2e-3])
@pytest.mark.parametrize("nodes", [16, 256])
def test_sound_words_are_read_at_once(nodes: int, noise_v: float) -> None:
    """Else the comparison above would not compare."""
    spec, rng = FrameSpec(nodes=nodes, chip_s=1e-7, frame_period_s=1.0), np.random.default_rng(1)
    rows = rng.normal(0, noise_v, (spec.line_bits, spec.order)).astype(np.float32)
    rows[:, spec.node_slice] += rng.choice([-0.3, 0.3], (spec.line_bits, nodes))
    swing_v = np.full(nodes, 0.3, np.float32)
    found = stages.compiled_read(
        rows, swing_v, spec.sign_mask, noise_v, 10, False, spec.first_row, 0.5, np.nan, 1.0, 3
    )
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
    amplitude = stages.numpy_measure(levels.values).amplitude
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
    values = rows[0, :, spec.node_slice]
    measures = stages.compiled_measure(values)
    np.testing.assert_array_equal(measures.amplitude, stages.numpy_measure(values).amplitude)
    level = np.full(spec.nodes, 0.3, np.float32)
    for ours, theirs in zip(
        stages.compiled_find_active(measures.amplitude, level, 0.5),
        stages.numpy_find_active(measures.amplitude, level, 0.5),
        strict=True,
    ):
        np.testing.assert_array_equal(ours, theirs)


def test_levels_that_do_not_lie_in_rows_are_measured_too() -> None:
    values = np.random.default_rng(1).normal(size=(30, 10)).astype(np.float32).T
    same(stages.compiled_measure(values), stages.numpy_measure(values), 1.0)


def test_misuse_is_refused() -> None:
    assert kernel.compiled is not None
    floats, ints = np.zeros((4, 5), np.float32), np.zeros((2, 5), np.int32)
    flags, levels = np.zeros((4, 5), np.bool_), np.zeros((10, 5), np.float32)
    for values, arrays in (
        (levels, (*floats, *ints[:1])),
        (levels, (*floats, *floats[:2])),
        (levels, (*np.zeros((4, 4), np.float32), *ints)),
        (levels[:0], (*floats, *ints)),
        (np.zeros((32, 5), np.float32), (*floats, *ints)),
        (levels.astype(np.float64), (*floats, *ints)),
        (levels[0], (*floats, *ints)),
        (levels.T.copy().T, (*floats, *ints)),
    ):
        with pytest.raises((TypeError, ValueError)):
            kernel.compiled.measure(values, *arrays)
    with pytest.raises(ValueError, match="an array of 5 values, not 6"):
        kernel.compiled.find_active(0.5, 0.5, 0.5, 6, floats[0], floats[1], flags[0], flags[1])
    with pytest.raises(TypeError, match="arguments"):
        kernel.compiled.decide()
    rows, out = np.zeros((1, 10, 8), np.float32), np.zeros((4, 1), np.float32)
    with pytest.raises(ValueError, match="with those of the nodes in N"):
        kernel.compiled.fit_words(4, 5, False, 0.3, 0.1, 0.5, rows, floats[:1], floats[1:2], *out)
