# SPDX-License-Identifier: Apache-2.0

"""Correlation and decoding of chips: identities, noise, activity."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import DEFAULT_AMPLITUDE_V, FrameSpec
from tactile_cdma.words.decode import decode, silent
from test.support.correlations import read_chips, separate
from test.support.examples import examples

SPECS = {
    "default": FrameSpec(),
    "paper": FrameSpec(order=16, first_row=0, sign_seed=None, polarity=-1),
    "unipolar": FrameSpec(drive="unipolar", polarity=-1),
    "learnt amplitude": FrameSpec(amplitude_v=None),
    "12 bits, 35 nodes": FrameSpec(nodes=35, bits=12, chip_s=20e-6),
    "256 nodes": FrameSpec(nodes=256, bits=16, chip_s=2e-6),
}


@examples(60)
@given(st.sampled_from(sorted(SPECS)), st.integers(0, 2**32 - 1), st.floats(0, 1))
def test_decoding_undoes_encoding_for_every_word_and_activity(
    name: str, seed: int, share: float
) -> None:
    spec, rng = SPECS[name], np.random.default_rng(seed)
    codes = rng.integers(0, 1 << spec.bits, spec.nodes)
    active = rng.random(spec.nodes) < share
    words = read_chips(line_chips(spec, codes, active), spec)
    assert np.array_equal(words.active, active)
    assert np.array_equal(words.codes[active], codes[active])
    assert not words.doubtful.any()
    level = (spec.amplitude_v or DEFAULT_AMPLITUDE_V) / (2 if spec.drive == "unipolar" else 1)
    assert np.allclose(words.amplitude_v[active], level, rtol=1e-3)


@pytest.mark.parametrize("name", sorted(SPECS.keys() - {"learnt amplitude"}))
def test_noise_is_measured_and_errors_follow_the_matched_filter(name: str) -> None:
    """Bit errors at ρ = 3 lie within five standard deviations of Q(ρ)."""
    spec, rng, rho = SPECS[name], np.random.default_rng(3), 3.0
    frames = 200 if spec.nodes < 100 else 20
    swing = spec.node_swing_v
    sigma = swing * math.sqrt(spec.order) / rho
    wrong = total = 0
    noise = []
    for _ in range(frames):
        codes = rng.integers(0, 1 << spec.bits, spec.nodes)
        chips = line_chips(spec, codes)
        words = read_chips(chips + rng.normal(0, sigma, chips.shape), spec)
        heard = words.active
        differing = (words.codes ^ codes)[heard]
        wrong += sum(int(word).bit_count() for word in differing)
        total += int(heard.sum()) * spec.bits
        noise.append(words.noise_rms_v / sigma)
    expected = 0.5 * math.erfc(rho / math.sqrt(2)) * total
    assert abs(wrong - expected) < 5 * math.sqrt(expected)
    # Without spare rows the noise comes from the words' own scatter, biased at such a low ρ.
    assert np.mean(noise) == pytest.approx(1.0, abs=0.05 if spec.order > spec.nodes + 1 else 0.25)


def test_noise_alone_is_silence_even_with_unknown_amplitude() -> None:
    rng = np.random.default_rng(4)
    for spec in (SPECS["learnt amplitude"], FrameSpec(order=16, first_row=0, amplitude_v=None)):
        for _ in range(200):
            chips = rng.normal(0, 0.05, (spec.bits, spec.order)).astype(np.float32)
            assert not read_chips(chips, spec).active.any()


def test_close_decisions_are_flagged() -> None:
    spec, rng = FrameSpec(), np.random.default_rng(5)
    chips = line_chips(spec, np.full(16, 682))
    chips[3] *= 0.2  # one bit nearly lost, as a dropout of the line would do
    words = read_chips(chips, spec)
    assert words.doubtful.all()
    noisy = line_chips(spec, np.full(16, 682)) + rng.normal(0, 0.4, chips.shape)
    assert read_chips(noisy, spec).doubtful.any()


@pytest.mark.slow
@pytest.mark.parametrize("nodes", [16, 256, 1024])
def test_a_discharge_within_one_bit_passes_no_wrong_word_for_a_good_one(nodes: int) -> None:
    """It fades over many chips, turns a few nodes' levels, and leaves most others nearly as is."""
    spec, rng = FrameSpec(nodes=nodes, chip_s=1e-6), np.random.default_rng(nodes)
    turned = 0
    for _ in range(2000 * 16 // nodes):
        codes = rng.integers(0, 1 << spec.bits, nodes)
        since = np.arange(spec.order) - rng.integers(0, spec.order)
        height, chips = 0.3 * 10 ** rng.uniform(0.7, 2.7), 10 ** rng.uniform(0, 2.5)
        line = line_chips(spec, codes) + rng.normal(0, 0.005, (spec.bits, spec.order))
        line[rng.integers(spec.bits)] += np.where(
            since < 0, 0, height * np.exp(-abs(since) / chips)
        )
        words = read_chips(line, spec)
        wrong = words.codes != codes
        turned += wrong.any()
        assert not (wrong & ~words.doubtful).any()
    assert turned > 50 * 16 / nodes, "it had something to find"


@pytest.mark.parametrize("name", ["default", "paper", "256 nodes"])
def test_noise_that_differs_from_bit_to_bit_makes_no_doubt(name: str) -> None:
    """As edges that jitter do: those between sums that differ much move levels the most."""
    spec, rng = SPECS[name], np.random.default_rng(6)
    rms = 0.1 * DEFAULT_AMPLITUDE_V
    for _ in range(300):
        codes = rng.integers(0, 1 << spec.bits, spec.nodes)
        levels = separate(line_chips(spec, codes), spec)
        noise = np.clip(rng.standard_normal(levels.values.shape), -3, 3)
        noise *= rms * rng.uniform(0.3, 1.0, (spec.bits, 1))
        levels.values[:] += noise.astype(np.float32)
        words = decode(replace(levels, noise_v=rms), spec)
        assert np.array_equal(words.codes, codes)
        assert not words.doubtful.any()


def test_one_node_that_fails_in_one_bit_is_the_only_one_in_doubt() -> None:
    spec = FrameSpec()
    for share in (0.0, 0.1, -2.5, 3.0):
        levels = separate(line_chips(spec, np.arange(16) * 60), spec)
        levels.values[4, 7] *= share
        assert np.flatnonzero(decode(levels, spec).doubtful).tolist() == [7]


def test_offset_does_not_reach_nodes_while_row_zero_is_free() -> None:
    spec = FrameSpec()
    codes = np.arange(16) * 60
    words = read_chips(line_chips(spec, codes) + np.float32(5.0), spec)
    assert np.array_equal(words.codes, codes)


def test_silent_words_have_the_shape_of_decoded_ones() -> None:
    spec = FrameSpec()
    nothing = silent(spec.nodes, 0.0)
    decoded = read_chips(np.zeros((10, 20), np.float32), spec)
    for field in ("active", "codes", "amplitude_v", "rho", "margin", "doubtful", "doubled"):
        a, b = getattr(nothing, field), getattr(decoded, field)
        assert (a.shape, a.dtype) == (b.shape, b.dtype)
        assert np.array_equal(a, b)
