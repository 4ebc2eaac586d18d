# SPDX-License-Identifier: Apache-2.0

"""The analog line: levels, edges, noise, rails and quantisation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.sim.channel import Channel, chip_means, first_sample, point_samples

SPEC = FrameSpec()
QUIET = Channel(noise_rms_v=0.0)


def words(spec: FrameSpec, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.integers(0, 1 << spec.bits, spec.nodes), rng.random(spec.nodes) < 0.7


@given(start=st.integers(0, 10**9), samples_per_chip=st.integers(1, 9))
def test_aligned_chips_give_whole_runs_of_samples(start: int, samples_per_chip: int) -> None:
    levels = np.arange(1, 6, dtype=np.float32)
    rate_hz = samples_per_chip / 50e-6
    edges_s = start / rate_hz + np.arange(6) * 50e-6
    stop = start + 7 * samples_per_chip
    samples = point_samples(levels, edges_s, rate_hz, start, stop)
    assert np.array_equal(samples, np.repeat([1, 2, 3, 4, 5, 0, 0], samples_per_chip))


def test_a_sample_shows_the_chip_in_the_middle_of_its_period() -> None:
    rng = np.random.default_rng(1)
    edges_s = np.sort(rng.uniform(1.0, 2.0, 50))
    levels = rng.normal(size=49).astype(np.float32)
    first, stop = 90, 230
    middles_s = (np.arange(first, stop) + 0.5) / 100.0
    chip = np.searchsorted(edges_s, middles_s, side="right") - 1
    expected = np.where((chip >= 0) & (chip < 49), levels[np.clip(chip, 0, 48)], 0)
    assert np.array_equal(point_samples(levels, edges_s, 100.0, first, stop), expected)
    assert first_sample(edges_s, 100.0).min() >= 100


def test_integrating_nominal_chips_is_exact_and_smears_stretched_ones() -> None:
    levels = line_chips(SPEC, *words(SPEC)).ravel()
    rng = np.random.default_rng(0)
    means = chip_means(levels, QUIET.edges(SPEC, rng), SPEC.chip_s)
    assert np.allclose(means, levels, atol=1e-6)
    edges_s = 1.01 * np.arange(SPEC.chips + 1) * SPEC.chip_s
    smeared = chip_means(levels, edges_s, SPEC.chip_s)
    late = 10 * 0.01 / 1.0  # chip 10 begins a tenth of a chip late
    assert smeared[10] == pytest.approx((1 - late) * levels[10] + late * levels[9], abs=1e-5)


def test_stretch_is_uniform_and_common_to_a_frame() -> None:
    channel = Channel(stretch=0.1)
    frames = np.array([channel.edges(SPEC, np.random.default_rng([0, i])) for i in range(2000)])
    stretch = frames[:, -1] / SPEC.frame_s - 1
    assert np.all((stretch >= 0) & (stretch <= 0.1))
    assert np.mean(stretch) == pytest.approx(0.05, abs=4 * 0.1 / np.sqrt(12 * 2000))
    assert np.std(stretch) == pytest.approx(0.1 / np.sqrt(12), rel=0.05)
    durations = np.diff(frames, axis=1)
    assert np.allclose(durations, durations[:, :1], rtol=1e-9)


def test_jitter_moves_edges_without_accumulating() -> None:
    edges = Channel(jitter=0.1).edges(SPEC, np.random.default_rng(0)) / SPEC.chip_s
    error = edges - np.arange(SPEC.chips + 1)
    assert np.abs(error).max() <= 0.1
    assert np.std(error) == pytest.approx(0.1 / np.sqrt(3), rel=0.15)
    assert abs(np.corrcoef(error[1:-1], error[2:])[0, 1]) < 0.25


def test_noise_has_the_stated_deviation() -> None:
    silent = np.zeros(200_000, dtype=np.float32)
    channel = Channel(noise_rms_v=0.05, adc_bits=16)
    for averaged in (1, 4):
        counts = channel.digitize(silent, SPEC, np.random.default_rng(1), averaged)
        rms = np.std(channel.volts(counts, SPEC))
        assert rms == pytest.approx(0.05 / np.sqrt(averaged), rel=0.01)


@pytest.mark.parametrize("offset", [0.0, 1.65, -7.3])
@pytest.mark.parametrize("adc_bits", [8, 12, 16])
def test_quantisation_is_within_half_a_count(adc_bits: int, offset: float) -> None:
    channel = Channel(offset_v=offset, noise_rms_v=0.0, adc_bits=adc_bits)
    lsb_v = channel.volts_per_count(SPEC)
    rail_v = channel.rail_of(SPEC)
    # the top half count below the rail is the converter's end, and zero_count is a whole number
    volts = np.linspace(-rail_v + lsb_v, rail_v - 2 * lsb_v, 1001).astype(np.float32)
    counts = channel.digitize(volts, SPEC, np.random.default_rng(0))
    assert np.abs(channel.volts(counts, SPEC) - (volts + offset)).max() <= 0.51 * lsb_v
    assert counts.min() >= channel.min_count
    assert counts.max() <= channel.max_count


def test_rails_clip() -> None:
    channel = Channel(offset_v=1.0, noise_rms_v=0.0, rail_v=0.5)
    volts = np.array([-9, -0.5, -0.4, 0.4, 0.5, 9], dtype=np.float32)
    line_v = channel.volts(channel.digitize(volts, SPEC, np.random.default_rng(0)), SPEC)
    assert np.allclose(line_v, [0.5, 0.5, 0.6, 1.4, 1.5, 1.5], atol=channel.volts_per_count(SPEC))


@pytest.mark.parametrize("nodes", [1, 16, 256, 1024])
def test_default_rails_are_out_of_reach(nodes: int) -> None:
    spec = FrameSpec(nodes=nodes, chip_s=1e-7)
    worst = [np.abs(line_chips(spec, np.full(nodes, code))).max() for code in (0, 341, 1023)]
    assert max(worst) < QUIET.rail_of(spec)
