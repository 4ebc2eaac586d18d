# SPDX-License-Identifier: Apache-2.0

"""Numbers at their limits: nothing overflows, nothing non-finite gets out unflagged."""

import math
import warnings
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.parameters import GAP
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.clock import DeviceClock
from tactile_cdma.driver.pipeline import Pipeline
from tactile_cdma.framing.frames import LineFrame
from tactile_cdma.readings.status import Status
from tactile_cdma.wire.messages import FrameLayout, Info, Samples
from tactile_cdma.wire.packets import PacketWriter
from test.support.chip_line import read_chips
from test.support.examples import examples
from test.support.single_frames import SingleReader

SPEC = FrameSpec()
A = 0.3


@pytest.fixture(autouse=True)
def no_silent_overflow() -> Iterator[None]:
    with np.errstate(over="raise", invalid="raise", divide="raise"), warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def spec_of(nodes: int, **fields: object) -> FrameSpec:
    return FrameSpec(nodes=nodes, chip_s=1e-8, frame_period_s=0.1, **fields)  # type: ignore[arg-type]


@pytest.mark.parametrize("nodes", [1, 2, 1000, 4096, 16_383, 65_535])
def test_every_word_survives_at_any_number_of_nodes(nodes: int) -> None:
    """Of most nodes scrambled ones: to find which rows a delay makes alike would take minutes."""
    scramble = nodes > 16_383
    spec, rng = spec_of(nodes, scramble=scramble), np.random.default_rng(nodes)
    codes, active = rng.integers(0, 1024, nodes), rng.random(nodes) < 0.7
    words = read_chips(line_chips(spec, codes, active), spec)
    assert np.array_equal(words.active, active)
    assert np.array_equal(words.codes, codes * active)


@pytest.mark.parametrize("nodes", [16, 1000])
@pytest.mark.parametrize("share", [0.3, 0.15])
def test_a_node_of_a_third_of_the_amplitude_is_read_once_it_is_known(
    nodes: int, share: float
) -> None:
    """And one of less is not silent."""
    spec, rng = spec_of(nodes), np.random.default_rng(2)
    codes, weak = rng.integers(0, 1024, nodes), nodes // 2
    amplitude_v = np.full(nodes, A)
    amplitude_v[weak] *= share
    reader = SingleReader(spec, 2 / spec.chip_s)
    reader.learn_rest(0.0, 0.0)
    reader.expected_v[weak] = amplitude_v[weak]
    volts = np.repeat(line_chips(spec, codes, amplitude_v=amplitude_v).ravel(), 2)
    frame = reader.read(np.concatenate((volts, np.zeros(8, np.float32))))
    assert frame is not None and frame.words is not None
    read = frame.words.codes == codes
    assert np.delete(read, weak).all()
    assert read[weak] if share == 0.3 else frame.words.doubtful[weak]


def line_frames(volts: np.ndarray, spec: FrameSpec = SPEC, per_chip: int = 4) -> list[LineFrame]:
    """Three equal frames, each with its gap before it."""
    reader, frames = SingleReader(spec, per_chip / spec.chip_s), []
    gap = round((spec.frame_period_s / spec.chip_s - spec.span_chips) * per_chip)
    level_v = float(np.mean(volts[:gap], dtype=np.float64))
    noise_v2 = float(np.var(volts[:gap], dtype=np.float64)) / per_chip
    for _ in range(3):
        if math.isfinite(noise_v2):
            reader.learn_rest(level_v, noise_v2)
        frames.append(reader.read(volts[gap:]))
    return [frame for frame in frames if frame is not None]


def samples(codes: np.ndarray, spec: FrameSpec = SPEC, per_chip: int = 4) -> np.ndarray:
    gap = round((spec.frame_period_s / spec.chip_s - spec.span_chips) * per_chip)
    chips = np.repeat(frame_levels(line_chips(spec, codes), spec), per_chip)
    return np.concatenate((np.zeros(gap, np.float32), chips, np.zeros(4 * per_chip, np.float32)))


@pytest.mark.parametrize("offset_v", [A * 1000, -A * 1000])
@pytest.mark.parametrize("first_row", [0, 1])
def test_offsets_of_a_thousand_amplitudes(offset_v: float, first_row: int) -> None:
    spec = FrameSpec(first_row=first_row)
    codes = np.arange(16) * 64 + 7
    frames = line_frames(samples(codes, spec) + np.float32(offset_v), spec)
    assert len(frames) == 3
    for frame in frames:
        assert frame.words is not None
        assert np.array_equal(frame.words.codes, codes)


@pytest.mark.parametrize("share", [2.0, 1.0])
def test_hitting_the_rails_costs_margin_but_not_words(share: float) -> None:
    rng, wrong = np.random.default_rng(3), 0
    for _ in range(20):
        codes = rng.integers(0, 1024, 16)
        rail = share * math.sqrt(16) * A
        [*_, frame] = line_frames(np.clip(samples(codes), -rail, rail))
        words = frame.words
        assert words is not None
        wrong += int((words.codes != codes)[words.active & ~words.doubtful].sum())
    assert wrong == 0


def test_signals_of_one_count() -> None:
    """Two nodes of one count each: the line has five levels."""
    count = 0.01
    spec = FrameSpec(nodes=2, order=4, amplitude_v=count)
    codes = np.array([682, 819])
    counts = np.rint(samples(codes, spec) / count).astype(np.int16)
    for frame in line_frames(counts.astype(np.float32) * np.float32(count), spec):
        assert frame.words is not None
        assert np.array_equal(frame.words.codes, codes)


@pytest.mark.parametrize("scale", [1e-44, 1e-38, 1e-30, 1e5])
def test_denormal_and_huge_volts(scale: float) -> None:
    spec = FrameSpec(amplitude_v=None)
    codes = np.arange(16) * 60 + 3
    with np.errstate(under="ignore"):
        frames = line_frames(samples(codes) * np.float32(scale), spec)
    for frame in frames:
        if frame.words is not None:
            assert np.isfinite(frame.words.amplitude_v).all() and np.isfinite(frame.words.rho).all()
    if scale > 1:
        assert [f.words is not None for f in frames] == [True] * 3


def info_of(config: SkinConfig, volts_per_count: float) -> Info:
    return Info(
        frame=FrameLayout.of(config.spec, config.samples_per_chip),
        sample_rate_uhz=round(1e6 * config.samples_per_chip / config.spec.chip_s),
        volts_per_count=volts_per_count,
        sync_mode=0 if config.timing == GAP else 1,  # type: ignore[arg-type]
        integrated=config.samples_per_chip == 1,
    )


def counts_of(kind: str, size: int, rng: np.random.Generator) -> np.ndarray:
    """What a broken digitizer may send."""
    if kind == "extremes":
        return rng.choice(np.array([-32768, 32767], np.int16), size)
    if kind == "stuck":
        return np.full(size, rng.integers(-32768, 32768), np.int16)
    if kind == "spikes":
        return np.where(rng.random(size) < 0.01, rng.integers(-32768, 32768, size), 0)
    return rng.integers(-32768, 32768, size)


@examples(60)
@given(
    st.sampled_from(["noise", "extremes", "stuck", "spikes"]),
    st.sampled_from([1, 4]),
    st.sampled_from(["line", GAP]),
    st.sampled_from([1e-30, 1e-4, 1e5]),
    st.sampled_from([300.0, 0.0]),
    st.integers(0, 2**32 - 1),
)
def test_whatever_samples_come_every_reading_is_in_range_or_flagged(
    kind: str, per_chip: int, timing: str, volts_per_count: float, amplitude: float, seed: int
) -> None:
    if timing == GAP:
        per_chip = 4
    values = {"samples_per_chip": per_chip, "timing": timing, "amplitude_mv": amplitude}
    config, rng = SkinConfig.of(values), np.random.default_rng(seed)
    pipeline, writer = Pipeline(config), PacketWriter()
    pipeline.feed(b"\0" + writer.encode(info_of(config, volts_per_count)), 0.0)
    assert pipeline.problem is None
    at, frames = 0, []
    for _ in range(30):
        counts = counts_of(kind, int(rng.integers(1, 400)), rng).astype(np.int16)
        time_us = round(at * 1e6 * config.spec.chip_s / per_chip)
        packet = Samples(time_us, at, counts, sync=bool(timing != GAP and rng.random() < 0.3))
        frames += pipeline.feed(writer.encode(packet), time_us * 1e-6)
        at += counts.size
    for frame in [*frames, *pipeline.flush()]:
        pressure_pa, status = frame.readings.pressure_pa, frame.readings.status
        unread = np.isnan(pressure_pa)
        assert ((pressure_pa[~unread] >= 0) & (pressure_pa[~unread] <= 140e3)).all()
        assert (status[unread] & (Status.STALE | Status.FAULTY)).all()
        assert math.isfinite(frame.t_host) and math.isfinite(frame.chip_s)


def test_nan_and_infinity_from_a_broken_capture_reach_no_word() -> None:
    codes, rng = np.arange(16) * 60 + 3, np.random.default_rng(5)
    volts = samples(codes)
    for bad in (np.nan, np.inf, -np.inf, np.float32(3e38)):
        spoilt = volts + rng.normal(0, 0.003, volts.size).astype(np.float32)
        gap = spoilt.size - (SPEC.chips + 4) * 4
        spoilt[gap + rng.integers(0, SPEC.chips * 4)] = bad
        with np.errstate(invalid="ignore", over="ignore"):
            frames = line_frames(spoilt)
        assert not any((f.words is None) or (~f.words.doubtful).any() for f in frames)
    assert len(line_frames(volts)) == 3


@pytest.mark.parametrize("week", [0, 1, 8])
def test_the_clock_holds_for_weeks(week: int) -> None:
    """A crystal 40 ppm off, swung by 3 ppm over the day; packets 1 ms late."""
    clock, rng, day = DeviceClock(), np.random.default_rng(6), 86_400.0
    device = host = week * 7 * day
    worst = 0.0
    for step in range(9000):
        device += 0.0128
        host += 0.0128 * (1 + 40e-6 + 3e-6 * math.sin(2 * math.pi * device / day))
        clock.observe(device, host + rng.exponential(1e-3))
        if step > 2000:
            worst = max(worst, abs(clock.to_host(device) - host))
    assert worst < 0.5e-3
