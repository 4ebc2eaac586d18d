# SPDX-License-Identifier: Apache-2.0

"""The decoding chain on the virtual digitizer's bytes, whole, cut, corrupted and restarted."""

import re
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.readings.status import Status
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.line import truth
from tactile_cdma.sim.options import Setup, SimOptions
from tactile_cdma.wire._protocol import VERSION
from tactile_cdma.wire.messages import FrameLayout, Info, Quiet, Samples
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.simulated import configuration, run, stream


def assert_true(frames: list[TactileFrame], config: SkinConfig, url: str) -> None:
    """Every decoded frame is one that the simulated nodes sent, word by word."""
    options = SimOptions.from_url(url)
    asked = configuration(config)
    setup = Setup(
        asked.frame.spec(), asked.frame.samples_per_chip, asked.sync_mode, asked.integrated
    )
    sent = list(islice(truth(options, setup), len(frames) + 10))
    for frame in frames:
        node_frame = sent[round(frame.t_start / config.spec.frame_period_s)]
        assert np.array_equal(frame.words.active, node_frame.active)
        said = node_frame.active
        assert np.array_equal(frame.words.codes[said], node_frame.codes[said])


CONFIGS = {
    "line, 4 samples per chip": {},
    "line, integrated": {"samples_per_chip": 1},
    "line, 8 samples, inverted": {"samples_per_chip": 8, "polarity": -1},
    "line, stretched": {"samples_per_chip": 8},
    "line, unipolar": {"drive": "unipolar"},
    "line, the paper's book": {"order": 16, "first_row": 0, "sign_seed": -1, "polarity": -1},
    "line, 64 nodes": {"nodes": 64, "chip_us": 10.0, "rows": 8, "columns": 8},
    "gap": {"timing": "gap", "samples_per_chip": 8},
    "gap, the paper's book": {
        "timing": "gap",
        "samples_per_chip": 6,
        "order": 16,
        "first_row": 0,
        "sign_seed": -1,
        "polarity": -1,
    },
    "gap, unipolar": {"timing": "gap", "drive": "unipolar"},
}


@pytest.mark.parametrize("name", CONFIGS)
def test_every_word_that_is_sent_is_read(name: str) -> None:
    config = SkinConfig.of(CONFIGS[name])
    stretch = 0.11 if config.timing == "gap" or "stretched" in name else 0.0
    url = f"sim://?scene=presses&seed=3&threshold=0&stretch={stretch}"
    frames = run(config, stream(config, url, 40))
    assert len(frames) >= 38
    assert_true(frames, config, url)
    assert [f.sequence for f in frames] == list(range(len(frames)))
    assert (max(f.chip_s for f in frames) > 1.08 * config.spec.chip_s) == (stretch > 0)


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
    config = SkinConfig.of({})
    pipeline = Pipeline(config)
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
    packets = PacketParser().feed(stream(config, "sim://?scene=all&seed=1", 20))
    writer, pipeline = PacketWriter(), Pipeline(config)
    *_, held = pipeline.feed(b"".join(map(writer.encode, packets)), 1.0)
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


def in_the_middle(change: dict[str, int]) -> tuple[Pipeline, list[TactileFrame]]:
    """Decodes a stream in which the 21st frame claims another place."""
    config = SkinConfig.of({"samples_per_chip": 1})
    packets = PacketParser().feed(stream(config, "sim://?scene=all&heartbeat=40", 60))
    marks = [i for i, p in enumerate(packets) if isinstance(p, Samples) and p.sync]
    packets[marks[20]] = replace(packets[marks[20]], **change)
    writer, pipeline = PacketWriter(), Pipeline(config)
    return pipeline, pipeline.feed(b"".join(map(writer.encode, packets)), 1.0)


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
def test_an_intact_packet_with_impossible_contents_costs_itself_and_nothing_else(
    change: dict[str, int],
) -> None:
    pipeline, frames = in_the_middle(change)
    counters = pipeline.counters
    assert (counters.implausible_packets, counters.restarts) == (1, 0)
    assert (counters.lost_samples, counters.lost_frames) == (200, 1)
    assert [f.sequence for f in frames] == [n for n in range(len(frames) + 1) if n != 20]
    period_s = pipeline.config.spec.frame_period_s
    assert all(f.t_start == pytest.approx(f.sequence * period_s, abs=2e-6) for f in frames)
    assert not any((f.readings.status & Status.STALE).any() for f in frames[-15:])


@pytest.mark.parametrize("params", [{}, {"samples_per_chip": 1}], ids=str)
def test_a_frame_without_its_mark_costs_itself_and_nothing_else(params: dict) -> None:
    """Its chips are no gap, from which to learn what noise is."""
    config, url = SkinConfig.of(params), "sim://?scene=all&threshold=0"
    packets = PacketParser().feed(stream(config, url, 40))
    marks = [i for i, p in enumerate(packets) if isinstance(p, Samples) and p.sync]
    packets[marks[20]] = replace(packets[marks[20]], sync=False)
    writer = PacketWriter()
    frames = run(config, b"".join(map(writer.encode, packets)))
    assert_true(frames, config, url)
    assert [f.sequence for f in frames] == [n for n in range(len(frames) + 1) if n != 20]


def test_a_long_loss_is_believed_when_it_is_confirmed() -> None:
    config = SkinConfig.of({"samples_per_chip": 1})
    packets = PacketParser().feed(stream(config, "sim://?scene=all", 20))
    later: list[object] = [
        replace(p, first_index=p.first_index + 10**6, device_time_us=p.device_time_us + 64 * 10**6)
        if isinstance(p, Samples)
        else p
        for p in packets
    ]
    writer, pipeline = PacketWriter(), Pipeline(config)
    half = next(i for i, p in enumerate(packets) if isinstance(p, Samples) and p.first_index > 1999)
    sent = [*packets[:half], *later[half:]]
    frames = pipeline.feed(b"".join(map(writer.encode, sent)), 1.0)
    counters = pipeline.counters
    assert (counters.lost_samples, counters.lost_frames) == (10**6, 5000)
    assert (counters.restarts, counters.implausible_packets) == (0, 0)
    assert frames[-1].sequence == len(frames) - 1 + 5000


@pytest.mark.parametrize("params", [{}, {"timing": "gap"}, {"samples_per_chip": 1}], ids=str)
@pytest.mark.parametrize("begin", [2**32 - 3000, 2**53 - 3000, 2**63 - 3000, 2**64 - 2**20])
def test_indices_of_any_size_give_the_same_frames(params: dict, begin: int) -> None:
    config = SkinConfig.of(params)
    packets = PacketParser().feed(stream(config, "sim://?scene=all&seed=1", 8))
    writer = PacketWriter()
    moved = [
        replace(p, first_index=p.first_index + begin) if isinstance(p, Samples) else p
        for p in packets
    ]
    frames = run(config, b"".join(map(writer.encode, packets)))
    late = run(config, b"".join(map(writer.encode, moved)))
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
def test_a_digitizer_set_otherwise_is_reported_and_not_decoded(
    theirs: str, ours: dict, message: str
) -> None:
    config = SkinConfig.of(ours)
    pipeline = Pipeline(config)
    assert pipeline.feed(stream(config, f"sim://?{theirs}", 5), 0.0) == []
    assert re.search(message, pipeline.problem or "")


def info_of(config: SkinConfig) -> Info:
    packets = PacketParser().feed(stream(config, "sim://?", 1))
    return next(packet for packet in packets if isinstance(packet, Info))


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
    pipeline = Pipeline(SkinConfig.of({}))
    info = replace(info_of(pipeline.config), **changes)
    samples = Samples(0, 0, np.zeros(100, np.int16), sync=True)
    writer = PacketWriter()
    assert pipeline.feed(writer.encode(info) + writer.encode(samples), 0.0) == []
    assert re.search(message, pipeline.problem or "")


def test_frames_of_too_many_samples_are_refused_in_one_sentence() -> None:
    period_s = 17 * 65_536 * 50e-6
    spec = FrameSpec(nodes=9, bits=16, order=65_536, parity=True, frame_period_s=period_s)
    config = replace(SkinConfig.of({"nodes": 9}), spec=spec)
    info = replace(
        info_of(SkinConfig.of({})),
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
    packets = PacketParser().feed(stream(config, "sim://?scene=all&seed=1", 40))
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
    packets = PacketParser().feed(stream(config, "sim://?scene=all", 10))
    pipeline.feed(writer.encode(replace(info_of(config), version=9)), 0.0)
    samples = [packet for packet in packets if isinstance(packet, Samples)]
    assert pipeline.feed(b"".join(map(writer.encode, samples)), 0.0) == []
    assert f"protocol version 9, this driver speaks {VERSION}" in (pipeline.problem or "")
    assert len(pipeline.feed(b"".join(map(writer.encode, packets)), 0.0)) >= 9
    assert pipeline.problem is None


@given(st.binary(max_size=3000))
def test_garbage_gives_nothing(data: bytes) -> None:
    assert Pipeline(SkinConfig.of({})).feed(data, 0.0) == []


def test_another_start_leaves_the_devices_clock_and_the_sequence_as_they_were() -> None:
    """A host that was too busy asks again; the first frames after that come late, too."""
    config, now_s, frames = SkinConfig.of({}), 0.0, list[TactileFrame]()

    def clock() -> float:
        return now_s

    digitizer, pipeline = VirtualDigitizer(SimOptions(scene="all"), clock), Pipeline(config)
    for late_s in (0.0, 0.3):
        digitizer.receive(Session(config).open())
        for _ in range(150):
            now_s += 0.01
            digitizer.advance()
            frames += pipeline.feed(digitizer.take(digitizer.pending), now_s + late_s, late_s > 0)
        now_s += 5.2 * config.spec.frame_period_s
        digitizer.advance()
        digitizer.take(digitizer.pending)  # nobody reads that
    assert pipeline.counters.restarts == 1
    starts_s = np.array([frame.t_start for frame in frames])
    sequence = np.array([frame.sequence for frame in frames])
    steps = np.rint(np.diff(starts_s) / config.spec.frame_period_s)
    assert steps.max() >= 5
    assert np.array_equal(np.diff(sequence), steps)
    assert max(frame.t_host - frame.t_middle for frame in frames) < 0.05


def test_the_first_frame_after_a_reset_has_its_time_though_it_waits_for_the_next() -> None:
    """One mean per chip, so one packet per frame: the first is believed when the second comes."""
    config, now_s = SkinConfig.of({"samples_per_chip": 1}), 0.0
    pipeline, frames = Pipeline(config), list[TactileFrame]()

    def clock() -> float:
        return now_s

    for seed, began_s in enumerate((0.0, 1.0)):
        now_s = began_s
        options = SimOptions(scene="all", threshold=0, seed=seed)
        digitizer = VirtualDigitizer(options, clock)
        digitizer.receive(Session(config).open())
        before = len(frames)
        while now_s < began_s + 0.2:
            now_s += 1e-3
            digitizer.advance()
            frames += pipeline.feed(digitizer.take(1 << 16), now_s)
        true_s = [frame.t_middle + began_s for frame in frames[before:]]
        assert len(true_s) > 12
        assert [frame.t_host for frame in frames[before:]] == pytest.approx(true_s, abs=2e-3)


@pytest.mark.parametrize("heard", [True, False])
def test_a_digitizer_that_was_reset_soon_has_another_clock(heard: bool) -> None:
    """Though its time may be what the old clock's would have been, but for 0.6 s.

    heard: else the packets that it sent before its samples are lost.
    """
    config, now_s = SkinConfig.of({}), 0.0
    pipeline, frames = Pipeline(config), list[TactileFrame]()

    def clock() -> float:
        return now_s

    for seed, uptime_s in ((1, 0.2), (2, 0.4)):
        digitizer = VirtualDigitizer(SimOptions(scene="all", seed=seed), clock)
        began_s, now_s = now_s, now_s + 2 * uptime_s
        digitizer.advance()
        digitizer.receive(Session(config).open())
        if seed == 2 and not heard:
            digitizer.take(digitizer.pending)
        while now_s < began_s + 3 * uptime_s:
            now_s += 1e-3
            digitizer.advance()
            frames += pipeline.feed(digitizer.take(1 << 16), now_s)
    true_s = [frame.t_middle + began_s for frame in frames if frame.t_middle > 0.8]
    assert [frame.t_host for frame in frames[-len(true_s) :]] == pytest.approx(true_s, abs=5e-3)


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
    config = SkinConfig.of(CONFIGS["line, integrated"])
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
