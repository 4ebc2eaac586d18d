# SPDX-License-Identifier: Apache-2.0

"""The virtual digitizer: the same packets at any pace, handshake, truth, back-pressure."""

from itertools import islice, pairwise
from typing import Any

import numpy as np
import pytest

from tactile_cdma.code.encode import line_chips
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.code.transform import correlate
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.packets import Block, stream
from tactile_cdma.wire._protocol import Result, SyncMode
from tactile_cdma.wire.messages import (
    Ack,
    Ask,
    Command,
    Configure,
    FrameLayout,
    GetInfo,
    Groups,
    Info,
    Pack,
    Quiet,
    Received,
    Samples,
    Start,
    Status,
    Stop,
)
from tactile_cdma.wire.packets import PacketParser, PacketWriter, wrap
from test.support.simulated import Truth

TELLING_SILENCE = Configure(FrameLayout.of(FrameSpec(), 4), quiet_uv=100_000)


class Bench:
    """A digitizer, a clock that the test turns, and a host, which sends commands at once."""

    def __init__(self, query: str = "", *commands: Command) -> None:
        self.now_s = 100.0
        self.digitizer = VirtualDigitizer(
            SimOptions.from_url(f"sim://?{query}"), clock=lambda: self.now_s
        )
        self.parser, self._writer = PacketParser(), PacketWriter()
        self.send(*commands)

    def send(self, *commands: Command) -> None:
        for command in commands:
            self.digitizer.receive(self._writer.encode(command))

    def read(self, wanted: int = 1) -> list[Received]:
        self.digitizer.advance(wanted)
        return self.parser.feed(self.digitizer.take(1 << 30))

    def run(self, seconds: float, step_s: float) -> list[Received]:
        packets = []
        for _ in range(round(seconds / step_s)):
            self.now_s += step_s
            packets += self.read()
        return packets


def blocks(query: str, count: int) -> list[Block]:
    options = SimOptions.from_url(f"sim://?{query}")
    return list(islice(stream(options, options.setup()), count))


def of_kind(packets: list[Received], *kinds: type) -> list[Any]:
    return [packet for packet in packets if isinstance(packet, kinds)]


def samples(packets: list[Received]) -> list[Samples]:
    return of_kind(packets, Samples)


@pytest.mark.parametrize(
    "query",
    [
        "stretch=0.1",
        "timing=gap&jitter=0.1&samples_per_chip=7",
        "integrated=1",
        "scene=presses&sensor=paper&mismatch=0.05&warming=20&sensor_noise=0.002",
    ],
)
def test_samples_depend_on_options_only(query: str) -> None:
    once, again, other = (blocks(f"{query}&seed={seed}", 60) for seed in (1, 1, 2))
    for a, b in zip(once, again, strict=True):
        assert (a.first_index, a.sync, a.begin_s) == (b.first_index, b.sync, b.begin_s)
        assert np.array_equal(a.counts, b.counts)
    assert any(not np.array_equal(a.counts, b.counts) for a, b in zip(once, other, strict=False))


def test_samples_are_the_same_at_any_pace() -> None:
    runs = []
    for query, step_s in (("", 1.7e-3), ("", 0.11), ("speed=3", 0.01)):
        bench = Bench(f"seed=5&stretch=0.1&{query}")
        bench.now_s += 0.3  # START comes at another moment
        bench.send(Start())
        runs.append(samples(bench.run(0.5, step_s)))
    hurried = Bench("seed=5&stretch=0.1&speed=0", Start())
    runs.append(samples(hurried.read(100_000)))
    shortest = min(len(run) for run in runs)
    assert shortest > 70
    for run in runs[1:]:
        for a, b in zip(runs[0], run, strict=False):
            assert (a.first_index, a.sync) == (b.first_index, b.sync)
            assert np.array_equal(a.counts, b.counts)


def test_packets_come_when_their_last_sample_was_taken() -> None:
    """That is: when frame and tail are over, and right before the next mark."""
    bench = Bench("", Start())
    bench.read()
    start_s, begin_s = bench.now_s, 0.0
    for number in range(10):
        for end_s in (number * 12.8e-3 + 203 * 50e-6, (number + 1) * 12.8e-3):
            bench.now_s = start_s + end_s - 1e-6
            assert not samples(bench.read())
            assert bench.digitizer.advance() == pytest.approx(1e-6, abs=1e-9)
            bench.now_s = start_s + end_s + 1e-6
            (packet,) = samples(bench.read())
            # µs: the middle of a sample
            assert packet.device_time_us == pytest.approx(begin_s * 1e6 + 6.25, abs=0.5)
            begin_s = end_s


def test_after_silence_a_gap_comes_with_the_packet_after_it() -> None:
    bench = Bench("scene=idle&heartbeat=100", TELLING_SILENCE, Start())
    bench.read()
    start_s, frame_s, period_s = bench.now_s, 203 * 50e-6, 12.8e-3
    silences = []
    for number in range(30):
        bench.now_s = start_s + number * period_s + frame_s - 1e-6
        early = of_kind(bench.read(), Samples, Quiet)
        bench.now_s += 2e-6
        *gap, frame = of_kind(bench.read(), Samples, Quiet)
        assert (frame.first_index, frame.sync) == (1024 * number, True)
        if number:
            (quiet,) = gap or early[-1:]
            assert (type(quiet), quiet.first_index) == (Quiet, 1024 * number - 212)
            assert len(gap) == silences[-1]
        silences.append(isinstance(frame, Quiet))
    assert {True, False} == set(silences)


@pytest.mark.parametrize("stretch", [0.005, 0.1])
def test_frames_that_last_longer_are_sent_to_their_end_at_once(stretch: float) -> None:
    bench = Bench(f"scene=all&threshold=0&stretch={stretch}", TELLING_SILENCE, Start())
    bench.read()
    start_s = bench.now_s
    for number in range(1, 60):
        bench.now_s = start_s + number * 12.8e-3 + 1e-6
        last = of_kind(bench.read(), Samples, Quiet)[-1]
        size = last.count if isinstance(last, Quiet) else len(last.counts)
        assert last.first_index + size == 1024 * number


def test_integrated_packets_end_with_the_last_chip_of_a_frame() -> None:
    bench = Bench("integrated=1&nodes=64&chip_us=10", Start())
    packets = samples(bench.run(1.0, 0.05))
    spec = bench.digitizer.setup.spec
    assert [p.first_index for p in packets if p.sync] == [i * spec.chips for i in range(78)]
    for packet in packets:
        frame, chip = divmod(packet.first_index, spec.chips)
        assert chip + len(packet.counts) <= spec.chips
        begin_s = frame * spec.frame_period_s + chip * spec.chip_s
        assert packet.device_time_us == pytest.approx(begin_s * 1e6, abs=1)


@pytest.mark.parametrize(
    "query",
    [
        "",
        "samples_per_chip=9&polarity=-1&drive=unipolar",
        "integrated=1",
        "nodes=100&chip_us=5&offset=1.65",
        "order=16&first_row=0&sign_seed=natural",
        "stretch=0.1&samples_per_chip=16",
    ],
)
def test_truth_is_what_the_samples_say(query: str) -> None:
    bench = Bench(f"scene=moving&noise=0&seed=3&{query}")
    digitizer, options = bench.digitizer, bench.digitizer.options
    setup, spec, info = digitizer.setup, digitizer.setup.spec, digitizer.info()
    bench.send(Start())
    packets = samples(bench.run(0.3, 0.01))
    volts = info.volts(np.concatenate([p.counts for p in packets])) - options.offset
    per_chip, truths = 1 if setup.integrated else setup.samples_per_chip, Truth(digitizer)
    for number, start in enumerate([p.first_index for p in packets if p.sync][:-1]):
        truth = truths[number]
        assert truth.number == number
        stretch = options.stretch * np.random.default_rng([3, number]).random()
        middles = start + np.floor((np.arange(spec.chips) + 0.5) * per_chip * (1 + stretch))
        chips = volts[middles.astype(int)].reshape(spec.bits, spec.order)
        sent = line_chips(spec, truth.codes, truth.active)
        assert np.abs(chips - sent).max() <= 1.01 * info.volts_per_count
        rows = correlate(chips, spec.book)[:, spec.rows] * spec.signs * spec.polarity
        active = np.abs(rows).mean(axis=0) > spec.node_swing_v / 2
        codes = (1 << np.arange(spec.bits)[::-1]) @ (rows > 0)
        assert np.array_equal(active, truth.active)
        assert np.array_equal(codes[active], truth.codes[active])


def test_start_may_fall_into_a_frame() -> None:
    late = blocks("start_phase=0.25&noise=0&threshold=0", 40)
    whole = blocks("noise=0&threshold=0&scene=idle", 40)
    first_mark = next(block for block in late if block.sync)
    assert first_mark.first_index == pytest.approx(0.75 * 1024, abs=1)
    tail = np.concatenate([block.counts for block in late])[: first_mark.first_index]
    assert len(tail) == 768
    assert tail.any()
    assert whole[0].sync
    assert blocks("start_phase=0.25&integrated=1", 1)[0].begin_s == pytest.approx(0.75 * 12.8e-3)


def test_handshake() -> None:
    bench = Bench("noise=0.001")
    first = bench.read()
    assert [type(packet) for packet in first] == [Info, Status]
    assert first[0].frame == FrameLayout.of(FrameSpec(), 4)
    wanted = FrameLayout.of(FrameSpec(nodes=64, chip_s=10e-6), 8)
    bench.send(Configure(wanted, SyncMode.NONE), GetInfo(), Start())
    packets = of_kind(bench.read(), Ack, Info)
    assert [type(packet) for packet in packets] == [Ack, Info, Ack, Info, Ack]
    acks = of_kind(packets, Ack)
    assert [(a.command_sequence, a.result) for a in acks] == [(i, Result.OK) for i in range(3)]
    info = packets[3]
    assert (info.frame, info.sync_mode, info.integrated) == (wanted, SyncMode.NONE, False)
    assert info.sample_rate_hz == 800e3
    bench.now_s += 0.01
    assert samples(bench.read())
    bench.send(Stop())
    assert of_kind(bench.read(), Ack)
    bench.now_s += 0.5
    assert not bench.read()
    bench.send(Start())
    bench.now_s += 0.01
    assert samples(bench.read())[0].first_index == 0


def test_impossible_requests_are_refused_and_change_nothing() -> None:
    bench = Bench("rows=4&columns=4&stretch=0.1")
    before = bench.digitizer.info()
    full = FrameSpec(frame_period_s=FrameSpec().frame_s)
    good = FrameLayout.of(FrameSpec(), 4)
    bench.send(
        Configure(FrameLayout.of(FrameSpec(nodes=9), 4)),  # the grid has 16 places
        Configure(FrameLayout.of(full, 4)),  # no room to stretch
        Configure(good, SyncMode.NONE, integrated=True),
    )
    bench.digitizer.receive(wrap(bytes([0x8F, 9, 0])))
    packets = bench.read()
    told = [ack.result for ack in of_kind(packets, Ack)]
    assert told == [Result.UNSUPPORTED] * 3 + [Result.UNKNOWN_COMMAND]
    assert bench.digitizer.info() == before
    assert bench.run(1.1, 0.1)[-1].commands_refused == 4


BROKEN = PacketWriter().encode(Start())[:-3]


@pytest.mark.parametrize(
    "data",
    [
        b"\x05\x11\0" + BROKEN + b"\0" + bytes(range(1, 100)) * 200 + b"\0",
        # Its own packets coming back, as the firmware counts them.
        PacketWriter().encode(Status(0)) + wrap(b"\x82") + wrap(b"\x7f\0\0"),
    ],
    ids=["broken", "echo"],
)
def test_what_is_no_command_is_counted_and_not_answered(data: bytes) -> None:
    bench = Bench()
    bench.digitizer.receive(data)
    assert of_kind(bench.read(), Ack) == []
    assert bench.run(1.1, 0.1)[-1].command_errors == 3


def test_reports_come_every_second() -> None:
    bench = Bench()
    packets = bench.run(5.05, 0.05)
    assert [type(packet) for packet in packets] == [Info, Status] * 6
    uptimes_us = [status.uptime_us for status in of_kind(packets, Status)]
    assert uptimes_us == [i * 1_000_000 for i in range(6)]


def test_a_slow_host_loses_whole_packets_and_is_told() -> None:
    bench = Bench("", Start())
    before = samples(bench.run(0.5, 0.01))
    bench.now_s += 5.0  # the host sleeps
    bench.digitizer.advance()
    assert bench.digitizer.pending < 100_000
    after = bench.run(1.2, 0.01)
    counters = bench.parser.counters
    dropped = of_kind(after, Status)[-1].packets_dropped
    assert dropped == bench.digitizer.packets_dropped == counters.lost_packets > 500
    assert counters.crc_errors == counters.framing_errors == 0
    received = sum(len(packet.counts) for packet in before + samples(after))
    last = samples(after)[-1]
    assert last.first_index + len(last.counts) - received == pytest.approx(512 * dropped, abs=600)


@pytest.mark.parametrize("query", ["", "chip_us=51.3&frame_period_ms=13.37", "integrated=1"])
def test_a_machine_too_slow_for_the_pace_loses_frames_and_is_never_held_up(query: str) -> None:
    bench = Bench(f"speed=40&threshold=0&{query}")

    def hurrying_clock() -> float:  # 20 ms pass whenever it is looked at
        bench.now_s += 0.02
        return bench.now_s

    bench.digitizer = VirtualDigitizer(bench.digitizer.options, clock=hurrying_clock)
    bench.send(Start())
    packets, lost_then = list[Received](), set[int]()
    for _ in range(300):
        before_s = bench.now_s
        packets += bench.read()
        lost_then.add(bench.digitizer.samples_lost)
        assert bench.now_s - before_s < 0.2
    received, status = samples(packets), of_kind(packets, Status)[-1]
    gaps = {
        later.first_index: later.first_index - earlier.first_index - len(earlier.counts)
        for earlier, later in pairwise(received)
    }
    assert [p.first_index for p in received if p.overrun] == [i for i, gap in gaps.items() if gap]
    assert {sum(gaps.values()), status.samples_lost} < lost_then
    assert status.samples_lost > 100_000
    assert bench.parser.counters.lost_packets == 0
    if "integrated" not in query:
        rate_hz = bench.digitizer.setup.rate_hz
        indices = [packet.first_index for packet in received]
        times_s = np.array([packet.device_time_us for packet in received]) * 1e-6
        assert np.ptp(times_s - np.array(indices) / rate_hz) < 2 / rate_hz
    assert status.uptime_us * 1e-6 == pytest.approx(40 * (bench.now_s - 100), abs=3 * 40)


def test_at_speed_0_nothing_is_dropped_and_only_what_is_read_is_made() -> None:
    bench = Bench("speed=0")
    bench.now_s += 0.25
    bench.send(Start())
    bench.now_s += 3600.0
    bench.digitizer.advance(1)
    assert bench.digitizer.pending < 2000
    assert len(samples(bench.read(1_000_000))) > 900
    assert bench.parser.counters.lost_packets == 0
    bench.send(Stop())
    bench.read()
    bench.now_s += 2.0
    assert [type(packet) for packet in bench.read()] == [Info, Status] * 2


@pytest.mark.parametrize("query", ["samples_per_chip=8", "integrated=1&samples_per_chip=8"])
def test_nodes_with_clocks_of_their_own_are_late_as_told(query: str) -> None:
    """Against each node's levels, read where its own clock says that its chips are."""
    bench = Bench(
        f"{query}&nodes=3&order=20&clock_spread=0.02&delay_spread=0.5&noise=0&threshold=0&seed=4"
    )
    bench.send(Start())
    packets = samples(bench.run(0.1, 0.01))
    digitizer, spec = bench.digitizer, bench.digitizer.setup.spec
    info = digitizer.info()
    volts, marks = info.volts(np.concatenate([p.counts for p in packets])), []
    marks = [p.first_index for p in packets if p.sync]
    per_chip = 1 if info.integrated else 8
    clocks = digitizer.options.clocks(3)
    assert clocks is not None
    assert np.ptp(clocks.displacement(np.array([spec.chips]))) > 1
    truth, fine = Truth(digitizer)[3], 64
    instants = (np.arange(spec.chips * fine) + 0.5) / fine
    line = np.zeros(instants.size)
    for node in range(3):
        alone = np.arange(3) == node
        levels = line_chips(spec, truth.codes, alone).ravel()
        late = (instants - clocks.delay_chips[node]) / (1 + clocks.rate_error[node])
        inside = (late >= 0) & (late < spec.chips)
        line[inside] += levels[late[inside].astype(int)]
    if info.integrated:
        expected = line.reshape(-1, fine).mean(axis=1)
    else:
        expected = line[np.arange(spec.chips * 8) * 8 + 4]  # instant s + ½
    seen = volts[marks[3] : marks[3] + per_chip * spec.chips]
    wrong = np.abs(seen - expected) > 2 * info.volts_per_count + 0.3 * 4 / fine * info.integrated
    assert np.mean(wrong) < 0.03  # instants within 1/128 chip of an edge


def test_restarts_keep_clocks_together() -> None:
    """With a restart every 10 chips no node is later than 10 chips of drift make it."""
    query = "noise=0&threshold=0&nodes=15&samples_per_chip=4&clock_spread=0.01"
    errors = []
    for more in ("", "&resync_chips=10&guard_chips=1"):
        bench = Bench(query + more, Start())
        packets = samples(bench.run(0.05, 0.01))
        spec, info = bench.digitizer.setup.spec, bench.digitizer.info()
        first = next(p.first_index for p in packets if p.sync and p.first_index)
        volts = info.volts(np.concatenate([p.counts for p in packets]))[first:]
        chips = volts[(4 * spec.places[:, None] + np.arange(4))].mean(axis=1).reshape(spec.bits, -1)
        sent = line_chips(spec, Truth(bench.digitizer)[1].codes)
        errors.append(np.abs(chips - sent).mean())
    assert errors[1] < 0.25 * errors[0]


@pytest.mark.parametrize(("query", "packs"), [("", True), ("adc_bits=14", False)])
def test_samples_are_packed_on_request(query: str, packs: bool) -> None:
    """Until the next configuration, and where a converter has no more than 12 bits."""
    plain, packed = Bench(f"scene=all&threshold=0&{query}"), Bench(f"scene=all&threshold=0&{query}")
    layout = plain.digitizer.info().frame
    sizes, received = [], []
    for bench, commands in ((plain, []), (packed, [Pack()])):
        bench.send(Configure(layout), *commands, Start())
        received.append(samples(bench.run(0.5, 0.01)))
        sizes.append(bench.parser.counters.bytes)
    assert received[0] == received[1]
    assert (sizes[1] < 0.8 * sizes[0]) == packs
    packed.send(Configure(layout), Start())
    before = packed.parser.counters.bytes
    packed.run(0.5, 0.01)
    assert packed.parser.counters.bytes - before > 0.95 * sizes[0]


def test_all_are_asked_to_speak() -> None:
    """In the next frame, or by turns, in the groups there are if these are more; then as before."""
    bench = Bench("scene=idle&nodes=8&heartbeat=0", Start())
    truth, told, said = Truth(bench.digitizer), [], []
    for command in (Ask(), Ask(2), Groups(1), Ask(0), Groups(0)):
        bench.run(0.0128 * 3, 0.0016)  # START's frame, or the last round, is over
        bench.send(command)
        marks = of_kind(bench.run(0.0128 * 6, 0.0016), Samples, Quiet)
        told += [(mark.turn, mark.asked) for mark in marks if mark.sync]
    rounds = [told[i] for i in range(len(told)) if told[i][1]]
    assert rounds == [(0, True), *((turn, True) for turn in (4, 5, 6, 7, 2, 3))]
    for number in range(24):
        frame = truth[number]
        if frame.asked:
            groups = 4 if frame.turn >= 4 else 2 if frame.turn >= 2 else 1
            said.append(np.flatnonzero(frame.active) + 1)
            wanted = [node for node in range(1, 9) if node % groups == frame.turn % groups]
            assert said[-1].tolist() == wanted
        else:
            assert not frame.active.any()
    assert len(said) >= 5


def test_nobody_is_asked_where_nodes_could_not_hear_it() -> None:
    bench = Bench("chip_us=50&order=20&nodes=16&frame_period_ms=10.95", Ask(), Start(), Ask(4))
    answers = [ack.result for ack in of_kind(bench.read(), Ack)]
    assert answers == [Result.UNSUPPORTED, Result.OK, Result.UNSUPPORTED]
    bench = Bench("chip_us=50&order=20&nodes=16&frame_period_ms=10.97", Start(), Ask(4))
    assert [ack.result for ack in of_kind(bench.read(), Ack)] == [Result.OK, Result.OK]
