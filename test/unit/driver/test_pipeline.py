# SPDX-License-Identifier: Apache-2.0

"""The decoding chain on bytes: whole, restarted, impossible, and of numbers at their limits."""

import math
import re
import warnings
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.code.encode import frame_levels, line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.parameters import GAP
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.framing.frames import LineFrame
from tactile_cdma.readings.status import Status
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire._protocol import VERSION
from tactile_cdma.wire.messages import FrameLayout, Info, Quiet, Samples
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.chip_line import read_chips
from test.support.examples import examples
from test.support.hosts import Talk
from test.support.simulated import decoded, introduction, packets_of, run, stream
from test.support.single_frames import SingleReader

CHIPS = SkinConfig.of({"samples_per_chip": 1})


def test_silent_frames_hold_values_and_keep_the_frame_rate() -> None:
    for timing in ("line", "gap"):
        config = SkinConfig.of({"timing": timing})
        frames = run(config, stream(config, "sim://?scene=idle&seed=1&heartbeat=16", 60))
        assert len(frames) >= 57
        last = frames[-1].readings
        assert not np.isnan(last.pressure_pa).any()
        assert np.count_nonzero(last.status & Status.SILENT) == 15  # one heartbeat a frame
        assert [f.sequence for f in frames] == list(range(len(frames)))


def test_the_share_above_which_words_count_may_change_while_it_runs() -> None:
    config = SkinConfig.of({})
    data = stream(config, "sim://?scene=all&threshold=0&amplitude_mv=240", 20)
    pipeline = Pipeline(config)
    half = len(data) // 2
    before = pipeline.feed(data[:half], 0.0)
    pipeline.adjust(replace(config, active_share=0.95))
    after = pipeline.feed(data[half:], 1.0)
    assert before[-1].words.active.all()
    assert not any(frame.words.active.any() for frame in after)


def test_a_restarted_digitizer_is_followed() -> None:
    """Even if it takes as long to start as before: its clock, sequence and index are the same."""
    config, pipeline = SkinConfig.of({}), Pipeline(SkinConfig.of({}))
    first = pipeline.feed(stream(config, "sim://?scene=all&seed=1&threshold=0", 10), 0.0)
    again = stream(config, "sim://?scene=all&seed=2&threshold=0", 10)
    second = pipeline.feed(again, 1.28)  # a hundred frame periods later
    assert pipeline.counters.restarts == 1
    assert len(second) >= len(first) - 1
    assert second[0].sequence - first[0].sequence == pytest.approx(100, abs=12)
    assert (np.diff([f.sequence for f in second]) == 1).all()


@pytest.mark.parametrize("other", [True, False])
def test_what_another_board_said_is_forgotten(other: bool) -> None:
    """One that introduces itself in mid-stream, and whose packets happen to continue the stream."""
    config = SkinConfig.of({"sign_seed": 1, "order": 20})
    packets, writer = packets_of(config, "sim://?scene=all&seed=1", 20), PacketWriter()
    pipeline, (*_, held) = decoded(config, packets, 1.0)
    assert np.isfinite(held.readings.pressure_pa).all()
    info = next(packet for packet in packets if isinstance(packet, Info))
    last = [packet for packet in packets if isinstance(packet, Samples)][-1]
    index = last.first_index + len(last.counts)
    time_us = last.device_time_us + round(1e6 * len(last.counts) / info.sample_rate_hz)
    if other:
        info = replace(info, digitizer_id=b"board..2")
    data = writer.encode(info) + writer.encode(Quiet(time_us, index, 815, 0, 815, sync=True))
    *_, frame = pipeline.feed(data, 1.01)
    assert not frame.words.active.any()
    assert np.isnan(frame.readings.pressure_pa).all() == other
    assert pipeline.timeline.times.last is not None


@pytest.mark.parametrize(
    "change",
    [
        {"first_index": 2**60},
        {"first_index": 2**64 - 1},
        {"first_index": 0},
        {"device_time_us": 2**45},
        {"device_time_us": 2**64 - 1},
        {"device_time_us": 0},
        {"first_index": 2**53, "device_time_us": 2**52},
    ],
)
def test_an_intact_packet_of_impossible_contents_costs_only_itself(change: dict[str, int]) -> None:
    """The 21st frame claims another place."""
    packets = packets_of(CHIPS, "sim://?scene=all&heartbeat=40", 60)
    marks = [i for i, p in enumerate(packets) if isinstance(p, Samples) and p.sync]
    packets[marks[20]] = replace(packets[marks[20]], **change)
    pipeline, frames = decoded(CHIPS, packets, 1.0)
    counters = pipeline.counters
    assert (counters.implausible_packets, counters.restarts) == (1, 0)
    assert (counters.lost_samples, counters.lost_frames) == (200, 1)
    assert [f.sequence for f in frames] == [n for n in range(len(frames) + 1) if n != 20]
    period_s = pipeline.config.spec.frame_period_s
    assert all(f.t_start == pytest.approx(f.sequence * period_s, abs=2e-6) for f in frames)
    assert not any((f.readings.status & Status.STALE).any() for f in frames[-15:])


def test_a_long_loss_is_believed_when_it_is_confirmed() -> None:
    sent = [
        replace(p, first_index=p.first_index + 10**6, device_time_us=p.device_time_us + 64 * 10**6)
        if isinstance(p, Samples) and p.first_index > 1999
        else p
        for p in packets_of(CHIPS, "sim://?scene=all", 20)
    ]
    pipeline, frames = decoded(CHIPS, sent, 1.0)
    counters = pipeline.counters
    assert (counters.lost_samples, counters.lost_frames) == (10**6, 5000)
    assert (counters.restarts, counters.implausible_packets) == (0, 0)
    assert frames[-1].sequence == len(frames) - 1 + 5000


@pytest.mark.parametrize("params", [{}, {"timing": "gap"}, {"samples_per_chip": 1}], ids=str)
@pytest.mark.parametrize("begin", [2**32 - 3000, 2**53 - 3000, 2**63 - 3000, 2**64 - 2**20])
def test_indices_of_any_size_give_the_same_frames(params: dict, begin: int) -> None:
    config = SkinConfig.of(params)
    packets = packets_of(config, "sim://?scene=all&seed=1", 8)
    moved = [
        replace(p, first_index=p.first_index + begin) if isinstance(p, Samples) else p
        for p in packets
    ]
    frames, late = decoded(config, packets)[1], decoded(config, moved)[1]
    assert [f.t_start for f in late] == [f.t_start for f in frames]
    for a, b in zip(late, frames, strict=True):
        assert np.array_equal(a.words.codes, b.words.codes)


@pytest.mark.parametrize(
    ("theirs", "ours", "message"),
    [
        ("order=24", {}, r"order 24 \(parameters: 20\)"),
        ("chip_us=40", {}, r"chip_ns 40000 \(parameters: 50000\)"),
        ("timing=gap", {}, "timing is 'line': set timing to 'gap', or connect the sync wire"),
        (
            "timing=gap&samples_per_chip=4",
            {"codes": "sparse", "order": 32, "samples_per_chip": 1, "frame_period_ms": 20.0},
            "timing is 'line': connect the sync wire",
        ),
        ("drive=unipolar&bits=8", {}, r"bits 8 .*drive unipolar \(parameters: bipolar\)"),
        ("scramble=true", {}, r"scramble true \(parameters: scramble false\)"),
    ],
)
def test_a_digitizer_set_otherwise_is_told_of_only(theirs: str, ours: dict, message: str) -> None:
    config = SkinConfig.of(ours)
    pipeline = Pipeline(config)
    assert pipeline.feed(stream(config, f"sim://?{theirs}", 5), 0.0) == []
    assert re.search(message, pipeline.problem or "")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"volts_per_count": 0.0}, "describes no voltages"),
        ({"volts_per_count": -1.0}, "describes no voltages"),
        ({"min_count": 5, "max_count": 5}, "describes no voltages"),
        ({"sample_rate_uhz": 1}, "says it sends raw samples, but|or at least two samples"),
        ({"sample_rate_uhz": 2**62}, "1000 at most"),
        ({"sample_rate_uhz": 24_000 * 10**6}, "does not fit.*1.2 samples per chip"),
        ({"integrated": True}, "says it sends chip means, but 4 per chip"),
    ],
)
def test_impossible_descriptions_are_reported(changes: dict, message: str) -> None:
    info = replace(introduction(SkinConfig.of({})), **changes)
    samples = Samples(0, 0, np.zeros(100, np.int16), sync=True)
    pipeline, frames = decoded(SkinConfig.of({}), [info, samples])
    assert frames == []
    assert re.search(message, pipeline.problem or "")


def test_frames_of_too_many_samples_are_refused_in_one_sentence() -> None:
    period_s = 17 * 65_536 * 50e-6
    spec = FrameSpec(nodes=9, bits=16, order=65_536, parity=True, frame_period_s=period_s)
    config = replace(SkinConfig.of({"nodes": 9}), spec=spec)
    info = replace(
        introduction(SkinConfig.of({})),
        frame=FrameLayout.of(spec, 128),
        sample_rate_uhz=round(128 / 50e-6) * 10**6,
    )
    pipeline = Pipeline(config)
    assert pipeline.feed(PacketWriter().encode(info), 0.0) == []
    assert re.search("a frame has 1.43e\\+08 samples", pipeline.problem or ""), pipeline.problem


@pytest.mark.parametrize("jump_us", [-5_000_000, 5_000_000, 2**40, 2**63])
def test_a_clock_that_parts_from_the_count_of_samples_starts_anew(jump_us: int) -> None:
    """Stamps go on rising, the sequence goes on, and nothing old passes for new."""
    config = SkinConfig.of({})
    packets = packets_of(config, "sim://?scene=all&seed=1", 40)
    writer, pipeline, frames = PacketWriter(), Pipeline(config), []
    for number, packet in enumerate(packets):
        if isinstance(packet, Samples) and number > len(packets) // 2:
            later = max(0, packet.device_time_us + jump_us)
            packet = replace(packet, device_time_us=later)
        frames += pipeline.feed(writer.encode(packet), 10.0 + number * 1.6e-3)
    assert (np.diff([f.t_host for f in frames]) > 0).all()
    assert (np.diff([f.sequence for f in frames]) >= 1).all()
    assert frames[-1].sequence < 50
    assert frames[-1].t_host < 10.0 + len(packets) * 1.6e-3
    assert pipeline.counters.clock_steps + pipeline.counters.implausible_packets


def test_values_from_before_a_reconnection_are_not_shown_as_current() -> None:
    config = SkinConfig.of({})
    pipeline = Pipeline(config)
    pipeline.feed(stream(config, "sim://?scene=all&threshold=0", 5), 0.0)
    pipeline.reconnected()
    [frame, *_] = pipeline.feed(stream(config, "sim://?scene=idle&heartbeat=0", 5), 1e4)
    assert np.isnan(frame.readings.pressure_pa).all()
    assert (frame.readings.status & Status.STALE).all()


def test_another_protocol_version_is_reported_and_ends_decoding() -> None:
    config = SkinConfig.of({})
    writer, pipeline = PacketWriter(), Pipeline(config)
    packets = packets_of(config, "sim://?scene=all", 10)
    pipeline.feed(writer.encode(replace(introduction(config), version=9)), 0.0)
    samples = [packet for packet in packets if isinstance(packet, Samples)]
    assert pipeline.feed(b"".join(map(writer.encode, samples)), 0.0) == []
    assert f"protocol version 9, this driver speaks {VERSION}" in (pipeline.problem or "")
    assert len(pipeline.feed(b"".join(map(writer.encode, packets)), 0.0)) >= 9
    assert pipeline.problem is None


def test_another_start_leaves_the_devices_clock_and_the_sequence_as_they_were() -> None:
    """A host that was too busy asks again; the first frames after that come late, too."""
    talk, frames = Talk(""), list[TactileFrame]()
    talk.power_up(SimOptions(scene="all"))
    period_s = talk.config.spec.frame_period_s
    for late_s in (0.0, 0.3):
        talk.open()
        frames += talk.go_on(1.5, late_s=late_s)
        talk.now_s += 5.2 * period_s
        talk.skip()
    assert talk.pipeline.counters.restarts == 1
    steps = np.rint(np.diff([frame.t_start for frame in frames]) / period_s)
    assert steps.max() >= 5
    assert np.array_equal(np.diff([frame.sequence for frame in frames]), steps)
    assert max(frame.t_host - frame.t_middle for frame in frames) < 0.05


def test_the_first_frame_after_a_reset_has_its_time_though_it_waits_for_the_next() -> None:
    """One mean per chip, so one packet per frame: the first is believed when the second comes."""
    talk = Talk("", CHIPS)
    for seed in range(2):
        talk.now_s = float(seed)
        talk.power_up(SimOptions(scene="all", threshold=0, seed=seed))
        talk.open()
        frames = talk.go_on(0.2, 1e-3)
        assert len(frames) > 12
        true_s = [frame.t_middle + seed for frame in frames]
        assert [frame.t_host for frame in frames] == pytest.approx(true_s, abs=2e-3)


@pytest.mark.parametrize("heard", [True, False])
def test_a_digitizer_that_was_reset_soon_has_another_clock(heard: bool) -> None:
    """Though its time may be what the old clock's would have been, but for 0.6 s.

    heard: else the packets that it sent before its samples are lost.
    """
    talk = Talk("")
    for seed, uptime_s in ((1, 0.2), (2, 0.4)):
        began_s = talk.now_s
        talk.power_up(SimOptions(scene="all", seed=seed))
        talk.now_s += 2 * uptime_s
        talk.digitizer.advance()
        talk.open()
        if seed == 2 and not heard:
            talk.skip()
        frames = talk.go_on(uptime_s, 1e-3)
    assert len(frames) > 20
    true_s = [frame.t_middle + began_s for frame in frames]
    assert [frame.t_host for frame in frames] == pytest.approx(true_s, abs=5e-3)


def test_a_digitizer_that_was_reset_after_one_packet_is_not_the_one_before() -> None:
    """Its second packet would go on from the first of the old one."""
    config, pipeline = SkinConfig.of({}), Pipeline(SkinConfig.of({}))
    frames, began_s = list[TactileFrame](), (10.0, 20.0)
    for seed, host_s in enumerate(began_s):
        digitizer = VirtualDigitizer(SimOptions(scene="all", seed=seed, speed=0))
        digitizer.receive(Session(config).open())
        digitizer.advance(9000 if seed else 2000)
        frames += pipeline.feed(digitizer.take(9000 if seed else 2000), host_s)
    assert pipeline.counters.restarts == 1
    assert pipeline.counters.implausible_packets == 0
    assert [round(frame.t_host, -1) for frame in frames] == [10.0] + (len(frames) - 1) * [20.0]


def test_old_packets_are_no_news_until_the_stream_begins_anew() -> None:
    """An INFO of another sampling, of before the stream, changes nothing when it is repeated.

    A digitizer that was reset says the same, but goes on with other samples.
    """
    config = CHIPS
    data = stream(config, "sim://?scene=all&seed=4&threshold=0", 30)
    packets = [run + b"\0" for run in data.split(b"\0") if run]
    greeting = packets[:6]
    said = PacketParser().feed(b"".join(greeting))
    infos = [packet for packet in said if isinstance(packet, Info)]
    assert infos[0] != infos[-1]
    plain, pipeline = Pipeline(config), Pipeline(config)
    expected = plain.feed(data, 0.0)
    frames = pipeline.feed(b"".join([*packets[:15], *greeting, *packets[15:]]), 0.0)
    assert [frame.t_start for frame in frames] == [frame.t_start for frame in expected]
    assert pipeline.counters == plain.counters
    assert pipeline.packet_counts.repeated_packets == len(greeting)
    assert pipeline.digitizer.info == infos[-1]
    first = Samples(10**9, 0, np.zeros(200, np.int16), sync=True)
    pipeline.feed(b"\0" + greeting[0] + greeting[1], 0.0)
    assert pipeline.digitizer.info == infos[-1]
    pipeline.feed(PacketWriter(2).encode(first), 0.0)
    assert pipeline.digitizer.info == infos[0]


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
    pipeline.feed(b"\0" + writer.encode(introduction(config, volts_per_count)), 0.0)
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
