# SPDX-License-Identifier: Apache-2.0

"""Samples of one frame → its timing and words, or why nothing is said of it; silence left out."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.doubt.words import RAW, play
from tactile_cdma.base.errors import SpecError
from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.transform import correlate
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.digitizer import quiet_uv
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.framing.frames import LineFrame, Rejections
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.messages import Configure, FrameLayout, GetInfo, Info, Quiet, Samples, Start
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.examples import examples
from test.support.independent_line import Line, Skin, Talk, render
from test.support.single_frames import SingleReader

SPEC = FrameSpec()
A = 0.3
RAILS = -2.0, 2.0
OTHERS = FrameSpec(nodes=3, order=20, first_row=17)
"""Nodes of another skin on the same wire."""
PER_CHIP = 4


def reader_of(spec: FrameSpec = SPEC, per_chip: float = PER_CHIP) -> SingleReader:
    reader = SingleReader(spec, per_chip / spec.chip_s, RAILS)
    reader.learn_rest(0.0, 1e-4)
    return reader


def samples_of(
    codes: np.ndarray, start: float = -0.5, chip: float = PER_CHIP, spec: FrameSpec = SPEC
) -> np.ndarray:
    """The line at whole instants; start and chip in samples; six chips of rest after the frame."""
    levels = np.concatenate((line_chips(spec, codes).ravel(), np.zeros(8)))
    edges = start + chip * np.arange(levels.size + 1)
    instants = np.arange(int(edges[-2]))
    return levels[np.searchsorted(edges, instants, side="right") - 1].astype(np.float32)


def words_of(frame: LineFrame | None) -> np.ndarray:
    assert frame is not None and frame.words is not None
    assert frame.words.active.all() and not frame.words.doubtful.any()
    return frame.words.codes


@pytest.mark.parametrize("stretch", [0.0, 0.033, 0.1])
def test_the_silence_after_a_frame_tells_how_long_its_chips_last(stretch: float) -> None:
    rng, reader, close = np.random.default_rng(11), reader_of(), 0
    for _ in range(40):
        chip = PER_CHIP * (1 + stretch)
        volts = samples_of(rng.integers(0, 1024, 16), chip=chip)
        volts += rng.normal(0, 0.02, volts.size).astype(np.float32)
        volts[-5] = 1.0  # an impulse is no end
        close += abs(reader.duration(volts, -0.5) - chip) * SPEC.chips <= 0.5 * PER_CHIP
    assert close >= 30  # of the others the last chips cancel
    assert reader.duration(np.zeros(900, np.float32), -0.5) == 0


@pytest.mark.parametrize("per_chip", [2.0, 4.0, 7.3, 40.0])
def test_timing_is_recovered_within_a_twentieth_of_a_chip(per_chip: float) -> None:
    """Or half a sample where these are few and in step: all edges lie at one place between two."""
    rng = np.random.default_rng(1)
    for _ in range(30):
        codes, start = rng.integers(0, 1024, 16), rng.uniform(-1.0, 0.0)
        chip = per_chip * (1 + (per_chip > 5) * rng.uniform(1e-3, 3e-3))
        volts = samples_of(codes, start, chip)
        volts += rng.normal(0, 0.01, volts.size).astype(np.float32)
        frame = reader_of(per_chip=per_chip).read(volts, first_index=5000)
        np.testing.assert_array_equal(words_of(frame), codes)
        assert frame is not None
        off, most = frame.start - 5000 - start, max(0.05 * chip, 0.5)
        assert abs(off) < most
        assert abs(off + SPEC.chips * (frame.chip_samples - chip)) < most


def test_a_timing_is_carried_to_the_next_frame() -> None:
    """Chips 0.3 % long end 0.6 chip late: each frame begins where its words are found already."""
    reader, rng = reader_of(), np.random.default_rng(2)
    for _ in range(5):
        codes = rng.integers(0, 1024, 16)
        frame = reader.read(samples_of(codes, chip=PER_CHIP * 1.003))
        np.testing.assert_array_equal(words_of(frame), codes)
        assert frame is not None
        assert frame.chip_samples == pytest.approx(PER_CHIP * 1.003, rel=2e-4)


def test_chips_that_last_much_longer_are_not_found_unless_they_are_proposed() -> None:
    codes, chip = np.arange(16) * 64 + 7, PER_CHIP * 1.08
    volts = samples_of(codes, chip=chip)
    frame = reader_of().read(volts)
    assert frame is None or (frame.words is not None and frame.words.doubtful.all())
    reader = reader_of()
    reader.propose(-0.5, chip)
    np.testing.assert_array_equal(words_of(reader.read(volts)), codes)


@pytest.mark.parametrize("stretch", [0.02, 0.06, 0.1])
def test_stretched_chips_are_searched_for_and_found(stretch: float) -> None:
    """By the independent line: the nodes' board is slower than it should be."""
    recording = render(Skin(), Talk(share=0.8), Line(stretch=stretch), RAW, 30, seed=3)
    true = {round(truth.start_chips): truth for truth in recording.frames}
    found = searches = 0
    for frame, pipeline in play(recording):
        searches = pipeline.decisions.searches
        near = min(true, key=lambda start: abs(start - frame.t_start / 50e-6))
        assert abs(frame.t_start / 50e-6 - true[near].start_chips) < 0.5
        if frame.words.active.any():
            assert frame.chip_s == pytest.approx(50e-6 * true[near].chip, rel=1e-3)
            found += 1
    assert found > 20 and searches >= 1


def test_a_scrambled_frame_with_a_node_on_row_0_is_read_before_its_level_is_known() -> None:
    spec = FrameSpec(order=16, first_row=0, scramble=True)
    reader = SingleReader(spec, PER_CHIP / spec.chip_s, RAILS)
    codes = np.arange(16) * 60 + 11
    volts = samples_of(codes, spec=spec)
    volts += np.random.default_rng(6).normal(0, 0.01, volts.size).astype(np.float32)
    np.testing.assert_array_equal(words_of(reader.read(volts)), codes)


def test_words_count_from_another_share_on_while_it_runs() -> None:
    reader, volts = reader_of(), 0.7 * samples_of(np.arange(16) * 60 + 11)
    heard = reader.read(volts)
    assert heard is not None and heard.speakers == 16
    reader.count_above(0.9)
    heard = reader.read(volts)
    assert heard is None or heard.speakers == 0


def test_nobody_speaks() -> None:
    reader, rng = reader_of(), np.random.default_rng(4)
    for noise_v in (0.0, 0.01, 0.02):
        frame = reader.read(rng.normal(0, noise_v, 840).astype(np.float32))
        assert frame is not None and frame.words is None and frame.speakers == 0
        assert frame.noise_rms_v == pytest.approx(noise_v / PER_CHIP**0.5, rel=0.1, abs=1e-6)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda volts: volts[:790], "incomplete"),
        (lambda volts: volts[:0], "incomplete"),
        (lambda volts: np.where(np.arange(volts.size) == 400, np.nan, volts), "absurd"),
        (lambda volts: np.full_like(volts, np.nan), "absurd"),
        (lambda volts: np.full_like(volts, 2.0), "at_rail"),
        (lambda volts: np.where(np.arange(volts.size) % 8 < 5, -2.0, volts), "at_rail"),
        (lambda volts: 2 * samples_of(np.array([1, 700, 400]), spec=OTHERS), "misfit"),
    ],
)
def test_what_cannot_be_read_is_rejected_for_its_reason(spoil: object, reason: str) -> None:
    reader = reader_of()
    volts = samples_of(np.arange(16) * 60 + 11)
    assert reader.read(np.asarray(spoil(volts), np.float32)) is None  # type: ignore[operator]
    assert reader.rejections == replace(Rejections(), **{reason: 1})


def test_an_absurd_sample_at_the_end_of_a_long_frame_is_found() -> None:
    """Chips 8 % long: the frame has 864 samples, of which a nominal one has 800."""
    reader, chip = reader_of(), PER_CHIP * 1.08
    volts = samples_of(np.arange(16) * 60 + 11, chip=chip)
    volts[840] = np.nan
    reader.propose(-0.5, chip)
    assert reader.read(volts) is None
    assert reader.rejections == Rejections(absurd=1)


def test_noise_that_would_hide_words_is_no_silence() -> None:
    reader, rng = reader_of(), np.random.default_rng(5)
    for _ in range(20):
        frame = reader.read(rng.normal(0, 2.5, 840).clip(-1.9, 1.9).astype(np.float32))
        assert frame is None or (frame.words is not None and frame.words.doubtful.all())
    assert reader.rejections.total > 5


def test_a_quarter_at_the_rail_makes_all_doubtful() -> None:
    reader, volts = reader_of(), samples_of(np.arange(16) * 60 + 11)
    volts[:800][np.argsort(-np.abs(volts[:800]))[:250]] = 2.0
    frame = reader.read(volts)
    assert frame is None or (frame.words is not None and frame.words.doubtful.all())


@pytest.mark.parametrize("per_chip", [0.5, 1.1, 1.8])
def test_too_few_samples_for_a_chip_are_refused(per_chip: float) -> None:
    with pytest.raises(SpecError, match="samples per chip: line timing takes one integrated"):
        reader_of(per_chip=per_chip)


CONFIGS = {
    "raw": {},
    "raw, unipolar": {"drive": "unipolar"},
    "raw, 2 samples, inverted, long gap": {
        "samples_per_chip": 2,
        "polarity": -1,
        "frame_period_ms": 20.0,
    },
    "integrated": {"samples_per_chip": 1},
    "integrated, 64 nodes": {"samples_per_chip": 1, "nodes": 64, "chip_us": 10.0},
}


def packets(config: SkinConfig, query: str, seconds: float, quiet: int) -> list[object]:
    """What a virtual digitizer sends in so many seconds."""
    now = [0.0]
    digitizer = VirtualDigitizer(SimOptions.from_url(f"sim://?{query}"), clock=lambda: now[0])
    writer, parser = PacketWriter(), PacketParser()
    layout = FrameLayout.of(config.spec, config.samples_per_chip)
    configure = Configure(layout, integrated=config.samples_per_chip == 1, quiet_uv=quiet)
    for command in (configure, GetInfo(), Start()):
        digitizer.receive(writer.encode(command))
    received: list[object] = []
    while now[0] < seconds:
        now[0] += 0.05
        digitizer.advance()
        received += parser.feed(digitizer.take(1 << 30))
    assert digitizer.packets_dropped == parser.counters.lost_packets == 0
    return received


def decoded(config: SkinConfig, received: list[object]) -> tuple[Pipeline, list[TactileFrame]]:
    pipeline, writer = Pipeline(config), PacketWriter()
    return pipeline, [f for p in received for f in pipeline.feed(writer.encode(p), 0.0)]


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["press", "idle"])
@pytest.mark.parametrize("name", CONFIGS)
def test_the_host_reads_the_same_with_and_without_the_silence(name: str, scene: str) -> None:
    config = SkinConfig.of(CONFIGS[name])
    query = f"scene={scene}&seed=2&noise=0.004&offset=0.3&heartbeat=150"
    everything = packets(config, query, 3.0, 0)
    audible = packets(config, query, 3.0, quiet_uv(config.spec))
    assert not any(isinstance(packet, Quiet) for packet in everything)
    suppressed = sum(isinstance(packet, Quiet) for packet in audible)
    assert suppressed > 30
    (full, expected), (lean, frames) = decoded(config, everything), decoded(config, audible)
    assert len(frames) == len(expected) > 100
    assert any(f.words.active.any() for f in frames)
    assert not all(f.words.active.any() for f in frames)
    for a, b in zip(frames, expected, strict=True):
        assert a.sequence == b.sequence
        assert a.t_start == pytest.approx(b.t_start, abs=2e-6)  # device times are whole µs
        assert np.array_equal(a.words.active, b.words.active)
        assert np.array_equal(a.words.codes, b.words.codes)
        assert np.array_equal(a.readings.pressure_pa, b.readings.pressure_pa, equal_nan=True)
        assert np.array_equal(a.readings.status, b.readings.status)
        assert a.words.noise_rms_v == pytest.approx(b.words.noise_rms_v, rel=0.5)
    waiting = full.counters.samples - lean.counters.samples  # a gap that nothing followed yet
    assert 0 <= waiting < config.spec.frame_period_s * config.samples_per_chip / config.spec.chip_s
    assert replace(lean.counters, samples=full.counters.samples) == full.counters
    assert lean.rejections == full.rejections


def test_lost_silence_is_counted_as_lost_samples() -> None:
    config = SkinConfig.of({})
    received = packets(config, "scene=idle&heartbeat=0", 1.0, quiet_uv(config.spec))
    marks = [i for i, p in enumerate(received) if isinstance(p, Quiet) and p.sync]
    lost = received[marks[10]]
    assert isinstance(lost, Quiet)
    pipeline, frames = decoded(config, received[: marks[10]] + received[marks[10] + 1 :])
    assert pipeline.counters.lost_samples == lost.count
    assert pipeline.counters.lost_frames == 1
    assert np.diff([f.sequence for f in frames]).max() == 2


def test_absurd_counts_are_implausible_and_cost_nothing() -> None:
    config = SkinConfig.of({})
    received = packets(config, "scene=idle&heartbeat=0", 0.5, quiet_uv(config.spec))
    index = next(p for p in reversed(received) if isinstance(p, Quiet)).first_index + 1000
    pipeline, _ = decoded(config, [*received, Quiet(600_000, index, 2**32 - 1, 0, 0, sync=True)])
    assert pipeline.counters.implausible_packets == 1


def test_a_digitizer_that_leaves_out_too_much_is_reported() -> None:
    config = SkinConfig.of({})
    received = packets(config, "scene=idle", 0.2, 2 * quiet_uv(config.spec))
    pipeline, frames = decoded(config, received)
    assert frames == []
    assert "leaves out frames" in (pipeline.problem or "")


@pytest.mark.parametrize(
    "spec", [FrameSpec(amplitude_v=None), FrameSpec(order=16, first_row=0)], ids=["auto", "row 0"]
)
def test_where_nothing_is_certain_nothing_is_left_out(spec: FrameSpec) -> None:
    assert quiet_uv(spec) == 0


@examples(60)
@given(
    st.sampled_from(["bipolar", "unipolar"]),
    st.sampled_from([1, 4]),
    st.floats(-1.0, 1.0),
    st.integers(0, 2**32 - 1),
)
def test_the_limit_keeps_every_node_below_the_least_that_is_heard(
    drive: str, samples_per_chip: int, offset_v: float, seed: int
) -> None:
    """Even for samples at the ends of the allowed range, arranged as a node's own row."""
    spec = FrameSpec(drive=drive)
    half_v = quiet_uv(spec) * 0.5e-6
    rng = np.random.default_rng(seed)
    row = spec.book.rows([rng.integers(1, spec.order)])[0]
    bits = rng.choice([-1, 1], spec.line_bits)
    chips = (offset_v + half_v * np.outer(bits, row)).astype(np.float32)
    assert np.abs(correlate(chips, spec.book)[:, spec.rows]).max() < 0.15 * spec.node_swing_v
    samples = np.repeat(chips.ravel(), samples_per_chip)
    reader = SingleReader(spec, samples_per_chip / spec.chip_s)
    reader.learn_rest(offset_v, 0.0)
    tail = np.full(3 * samples_per_chip, offset_v, np.float32)
    frame = reader.read(np.concatenate((samples, tail)))
    assert frame is not None
    assert frame.words is None or not frame.words.active.any()


def test_timing_by_gaps_takes_silence_in_recordings() -> None:
    """What was recorded with marks and silence can be decoded without the marks."""
    config = SkinConfig.of({"timing": "gap"})
    received = packets(SkinConfig.of({}), "scene=press&seed=1", 1.5, quiet_uv(config.spec))
    received = [replace(p, quiet_uv=0) if isinstance(p, Info) else p for p in received]
    _, frames = decoded(config, received)
    marks = [p for p in received if isinstance(p, Quiet | Samples) and p.sync]
    assert len(frames) > 0.9 * len(marks)
