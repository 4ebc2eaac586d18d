# SPDX-License-Identifier: Apache-2.0

"""The digitizer leaves out only frames that the decoder would have found silent."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.transform import correlate
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.digitizer import quiet_uv
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.framing.frame_reader import FrameReader
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.messages import Configure, FrameLayout, GetInfo, Info, Quiet, Samples, Start
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.examples import examples

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
    reader = FrameReader(spec, samples_per_chip / spec.chip_s)
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
