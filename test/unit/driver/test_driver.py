# SPDX-License-Identifier: Apache-2.0

"""The driver thread on real ports, what can go wrong there, and its measurements of itself."""

import math
import os
import select
import socket
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base.errors import PortError, SpecError
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver import checkup
from tactile_cdma.driver.checkup import (
    CLEAR_REPORTS,
    RAISE_REPORTS,
    Finding,
    Level,
    Settling,
    worst,
)
from tactile_cdma.driver.clock import SLOW_S, StreamCounters
from tactile_cdma.driver.driver import CATCH_UP_S, CONNECTING, LATE_PERIODS, LATE_S, Backlog, Driver
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.driver.vitals import Counts, Vitals, Window
from tactile_cdma.readings.stuck import LOOK_S
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.identity import SIMULATED_ID
from tactile_cdma.wire.messages import Samples, Status
from tactile_cdma.wire.packets import Counters, PacketParser, PacketWriter
from tactile_cdma.wire.port import Port
from tactile_cdma.words.health import NodeState
from test.support.boards import board, chattering, plugged
from test.support.hosts import CONFIG, Watch
from test.support.mute_host import mute_host
from test.support.waiting import PATIENCE_S, wait_for


@contextmanager
def raw_pty() -> Iterator[tuple[int, str]]:
    """A pty whose other end the test drives by hand."""
    host, device = os.openpty()
    tty.setraw(device)
    try:
        yield host, os.ttyname(device)
    finally:
        os.close(host)
        os.close(device)


def test_frames_arrive_at_the_frame_rate_with_host_times() -> None:
    watch = Watch()
    with watch.driver("sim://?seed=1"):
        wait_for(lambda: len(watch.frames) >= 80)
    now = time.monotonic()
    times = np.array([frame.t_host for frame in watch.frames])
    assert np.median(np.diff(times)) == pytest.approx(12.8e-3, rel=0.01)
    assert 0 < now - times[-1] < PATIENCE_S
    periods = [(f.t_start - watch.frames[0].t_start) / 12.8e-3 for f in watch.frames]
    assert periods == pytest.approx([frame.sequence for frame in watch.frames], abs=0.01)
    assert [p for p in watch.problems if p] == []


def test_a_port_that_takes_no_bytes_is_named() -> None:
    with raw_pty() as (_, name):
        full = os.open(name, os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY)
        for _ in range(3):  # the kernel makes some room a little later
            with suppress(BlockingIOError):
                while True:
                    os.write(full, bytes(4096))
            time.sleep(0.05)
        watch = Watch()
        with watch.driver(name):
            wait_for(lambda: watch.problems)
        os.close(full)
    assert "takes no bytes" in (watch.problems[0] or "")


def test_a_clock_that_contradicts_the_count_of_samples_is_named() -> None:
    options = SimOptions(scene="moving", speed=0)
    digitizer, config = VirtualDigitizer(options), SkinConfig.of({})
    session, pipeline, writer = Session(config), Pipeline(config), PacketWriter()
    digitizer.receive(session.open())
    digitizer.advance(100_000)
    for number, packet in enumerate(PacketParser().feed(digitizer.take(100_000))):
        if isinstance(packet, Samples):
            packet = replace(packet, device_time_us=packet.device_time_us + number * 10**7)
        pipeline.feed(writer.encode(packet), 0.0)
        if number == 20:
            session.watch(pipeline, 0.0)
    assert session.watch(pipeline, 10.0)
    assert "clock and its count of samples contradict each other" in (session.problem or "")


@pytest.mark.parametrize(
    ("made_by", "who"), [(SIMULATED_ID, "simulator"), (b"\xe6\x60\x58\x38", "digitizer")]
)
def test_silence_is_told_when_patience_ends_however_long_a_read_may_wait(
    monkeypatch: pytest.MonkeyPatch, made_by: bytes, who: str
) -> None:
    """A simulator has no power that may be off."""
    monkeypatch.setattr("tactile_cdma.sim.digitizer.SIMULATED_ID", made_by)
    monkeypatch.setattr("tactile_cdma.driver.driver.READ_TIMEOUT_MS", round(2e3 * PATIENCE_S))
    watch = Watch()
    with raw_pty() as (host, name), watch.driver(name):
        serve(host, VirtualDigitizer(SimOptions()), watch, 20)
        wait_for(lambda: f"the {who} has fallen silent" in (watch.problems[-1] or ""))
        assert ("powered" in watch.problems[-1]) == (who == "digitizer")


def serve(host: int, digitizer: VirtualDigitizer, watch: Watch, count: int) -> None:
    """Be a digitizer on a pty until so many frames were seen."""
    os.set_blocking(host, False)

    def are_seen() -> bool:
        digitizer.advance(4096)
        with suppress(BlockingIOError):
            digitizer.receive(os.read(host, 4096))
        with suppress(BlockingIOError):
            os.write(host, digitizer.take(1024))
        return len(watch.frames) >= count

    wait_for(are_seen)


def test_simulated_nodes_that_do_not_repeat_are_refused_where_the_driver_counts_on_that() -> None:
    config = SkinConfig.of({"nodes_repeat": True})
    for speaks, frames in (("change", 0), ("rest", 20)):
        watch = Watch()
        with watch.driver(f"sim://?speaks={speaks}", config):
            wait_for(lambda watch=watch: any(watch.problems) or len(watch.frames) >= 20)
        assert len(watch.frames) >= frames and any(watch.problems) == (frames == 0)
        assert frames or "set nodes_repeat to false, or speaks=rest" in (watch.problems[0] or "")


def test_a_port_without_permission_names_the_group() -> None:
    with raw_pty() as (_, name):
        os.chmod(name, 0)
        child = os.fork()
        if child == 0:  # root may open everything, so the child is somebody else
            verdict = 1
            with suppress(BaseException):
                if os.geteuid() == 0:
                    os.setuid(65_534)
                with pytest.raises(PortError, match=r"no permission.*dialout"):
                    Port(name, 115_200)
                verdict = 0
            os._exit(verdict)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_unplugging_and_plugging_in_again_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who comes back ends the pause between attempts, however long it is."""
    monkeypatch.setattr("tactile_cdma.driver.driver.RETRY_S", (3600.0,))
    path, watch = tmp_path / "skin", Watch()
    with watch.driver(str(path)):
        wait_for(lambda: watch.problems)
        assert "no such port" in (watch.problems[0] or "")
        for _ in range(2):
            with plugged(board(5), path):
                seen = len(watch.frames)
                wait_for(lambda seen=seen: len(watch.frames) > seen + 20)
                assert watch.problems[-1] is None
                problems = len(watch.problems)
            wait_for(lambda problems=problems: len(watch.problems) > problems)
            assert str(path) in (watch.problems[-1] or "")


def test_a_digitizer_that_restarts_is_started_again() -> None:
    watch = Watch()
    with raw_pty() as (host, name), watch.driver(name):
        for _ in range(2):  # the second one was just powered up: nobody told it to start
            serve(host, VirtualDigitizer(SimOptions()), watch, len(watch.frames) + 20)
    sequence = [frame.sequence for frame in watch.frames]
    assert sequence == sorted(set(sequence))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"hello, this is a 3D printer\r\n" * 20, "text received instead of packets"),
        (bytes(np.random.default_rng(0).integers(0, 256, 2000, dtype=np.uint8)), "wrong baud rate"),
        (b"", "is the digitizer powered and started"),
    ],
)
def test_ports_with_something_else_are_diagnosed(content: bytes, message: str) -> None:
    watch = Watch()
    with chattering(content, 0.2) as name, watch.driver(name):
        wait_for(lambda: watch.problems)
    assert watch.frames == []
    assert message in (watch.problems[0] or "")


def test_stopping_stops_the_digitizer_and_frees_the_port() -> None:
    with raw_pty() as (host, name):
        watch, parser = Watch(), PacketParser()
        with watch.driver(name):
            assert select.select([host], [], [], PATIENCE_S)[0]
        sent: list[str] = []
        while "Stop" not in sent and select.select([host], [], [], PATIENCE_S)[0]:
            sent += [type(packet).__name__ for packet in parser.feed(os.read(host, 4096))]
        assert sent[:3] == ["Configure", "GetInfo", "Start"]
        assert sent[-1] == "Stop"
        with Port(name, 115_200):
            pass


def test_a_fault_in_a_consumer_is_reported_and_the_skin_comes_back() -> None:
    watch, faults = Watch(), iter([True])

    def consume(frame: TactileFrame) -> None:
        if len(watch.frames) == 5 and next(faults, False):
            raise ZeroDivisionError("of the test")
        watch.frames.append(frame)

    def note(problem: str | None) -> None:
        watch.note(problem)
        raise ZeroDivisionError("of whoever is told")

    with Driver(CONFIG, "sim://", 2_000_000, consume, note) as driver:
        wait_for(lambda: len(watch.frames) > 20)
        assert driver.connections == 2
    assert any("ZeroDivisionError: of the test" in problem for problem in watch.problems if problem)


@contextmanager
def network_port() -> Iterator[str]:
    """The URL of a digitizer behind a socket, whose kernel keeps seconds of what it sends."""
    server = socket.create_server(("127.0.0.1", 0))
    stop = threading.Event()

    def serve_digitizer() -> None:
        connection, _ = server.accept()
        digitizer = VirtualDigitizer(SimOptions())
        with connection:
            connection.settimeout(0.001)
            while not stop.is_set():
                with suppress(TimeoutError):
                    digitizer.receive(connection.recv(4096))
                digitizer.advance()
                with suppress(OSError):
                    connection.sendall(digitizer.take(65_536))

    thread = threading.Thread(target=serve_digitizer)
    thread.start()
    try:
        yield f"socket://127.0.0.1:{server.getsockname()[1]}"
    finally:
        stop.set()
        thread.join()
        server.close()


def test_a_driver_that_is_left_behind_skips_what_waits_and_counts_it() -> None:
    """Handing on takes two frame periods: every other frame is one too many."""
    ages_s: list[float] = []
    sequences: list[int] = []

    def slow(frame: TactileFrame) -> None:
        ages_s.append(time.monotonic() - frame.t_host)
        sequences.append(frame.sequence)
        time.sleep(2 * 12.8e-3)

    with network_port() as url, Driver(CONFIG, url, 0, slow, lambda problem: None) as driver:
        counters = driver.pipeline.counters
        wait_for(lambda: counters.skipped_bytes and counters.lost_frames)
        packets = driver.pipeline.packet_counts
    assert np.diff(ages_s).min() < -0.05, "newest data wins: they grew older by 13 ms a frame"
    assert sequences[-1] + 1 - len(sequences) == pytest.approx(counters.lost_frames, abs=5)
    assert packets.lost_packets > 0
    broken = packets.crc_errors, packets.framing_errors, packets.resyncs
    unexpected = packets.jumps, packets.malformed
    assert {*broken, *unexpected} == {0}, "a packet that was cut is not a broken one"


def test_stuck_nodes_are_looked_for_ten_times_a_second_of_the_skins_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driver = Watch().driver("sim://?seed=1&speed=0")
    look = Mock(wraps=driver.stuck.look)
    monkeypatch.setattr(driver.stuck, "look", look)
    with driver:
        wait_for(lambda: look.call_count >= 20)
    apart_s = np.diff([t_s for _, t_s, _ in (call.args for call in look.call_args_list)])
    assert apart_s.min() >= LOOK_S - 1e-9
    assert np.median(apart_s) < LOOK_S + 1.5 * CONFIG.spec.frame_period_s


def test_what_the_wire_cannot_say_is_refused() -> None:
    with pytest.raises(SpecError, match="whole nanoseconds"):
        Session(SkinConfig.of({"chip_us": 33.33333}))


@pytest.mark.slow
def test_calls_between_frames_cost_none() -> None:
    """Tares, and calibrations read anew, from another thread, as fast as they get in."""
    watch, calls = Watch(), 0
    with watch.driver("sim://?scene=all&seed=2&speed=0") as driver:
        while len(watch.frames) < 800 or calls < 20:
            with driver.between_frames() as pipeline:
                pipeline.adjust(CONFIG)
                if pipeline.taxels.baseline.seen:
                    pipeline.taxels.tare(1000.0, force=True)
            calls += 1
            time.sleep(1e-3)
        counters = driver.pipeline.counters
        assert (counters.lost_frames, counters.lost_samples, counters.restarts) == (0, 0, 0)
    assert [frame.sequence for frame in watch.frames] == list(range(len(watch.frames)))
    assert all(frame.words.active.all() for frame in watch.frames[1:])


def connecting(url: str) -> bool:
    return any(thread.name == f"skin {url}" for thread in threading.enumerate())


def test_stopping_does_not_wait_for_a_host_that_does_not_answer() -> None:
    watch = Watch()
    with mute_host() as url:
        driver = watch.driver(url)
        driver.start()
        time.sleep(0.1)
        driver.stop()
        assert connecting(url)  # pyserial tries for 5 s
    wait_for(lambda: not connecting(url))
    assert watch.problems == [CONNECTING]


def driven(options: str, count: int, each_s: float = 0.0) -> tuple[Window, list[TactileFrame]]:
    """What was measured while so many frames arrived, which are taken for a while each."""
    frames: list[TactileFrame] = []

    def take(frame: TactileFrame) -> None:
        frames.append(frame)
        time.sleep(each_s)

    url = f"sim://?scene=all&threshold=0&{options}"
    with Driver(CONFIG, url, 2_000_000, take, lambda problem: None) as driver:
        wait_for(lambda: len(frames) >= count)
    return driver.vitals.take(driver.pipeline), frames


def test_frames_are_counted_and_their_way_is_timed() -> None:
    window, frames = driven("rail=1.0", 60, each_s=0.004)
    assert window.frames == window.totals.stream.frames == len(frames)
    assert window.publish_s >= 0.004
    assert window.line_s >= CONFIG.spec.frame_s / 2 - 1e-3
    assert window.slowest_s >= window.latency_s > 0
    assert window.latency_s == window.line_s + window.decode_s + window.publish_s
    assert window.clipped == pytest.approx(np.mean([frame.clipped for frame in frames]))
    power = np.mean([frame.words.noise_rms_v**2 for frame in frames])
    assert window.noise_rms_v == pytest.approx(math.sqrt(power))


def test_a_driver_that_is_never_idle_takes_cpu_time() -> None:
    window, _ = driven("speed=0", 500)
    assert 0.05 < window.thread_share <= 1.05  # other programs may take most of the core
    assert window.process_share >= 0.9 * window.thread_share


def test_cpu_shares_are_cpu_time_by_time_that_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    passed_s = {"monotonic": 100.0, "process_time": 7.0, "thread_time": 3.0}
    for name in passed_s:
        monkeypatch.setattr(time, name, lambda name=name: passed_s[name])
    vitals, pipeline = Vitals(), Pipeline(CONFIG)
    vitals.note_read(0)
    vitals.take(pipeline)
    passed_s |= {"monotonic": 102.0, "process_time": 7.5, "thread_time": 3.1}
    vitals.note_read(0)
    window = vitals.take(pipeline)
    assert window.seconds == pytest.approx(2.0)
    assert window.process_share == pytest.approx(0.25)
    assert window.thread_share == pytest.approx(0.05)


def test_rises_are_since_the_last_report_and_nothing_is_made_up() -> None:
    pipeline, vitals = Pipeline(CONFIG), Vitals()
    pipeline.counters.lost_frames = 5
    first = vitals.take(pipeline)
    assert set(first.rises.named().values()) == {0} and first.totals.stream.lost_frames == 5
    pipeline.counters.lost_frames = 12
    second = vitals.take(pipeline)
    assert second.rises.stream.lost_frames == 7
    assert first.totals.stream.lost_frames == 5, "a snapshot, whatever comes later"
    pipeline.counters.lost_frames = 2  # began anew
    assert vitals.take(pipeline).rises.stream.lost_frames == 2
    assert second.frames == 0 and math.isnan(second.latency_s) and math.isnan(second.noise_rms_v)
    assert second.thread_share == 0


def test_the_digitizers_counts_rise_once_two_statuses_came() -> None:
    pipeline, vitals, writer = Pipeline(CONFIG), Vitals(), PacketWriter()
    windows = [vitals.take(pipeline)]
    for lost in (4, 9):
        pipeline.feed(writer.encode(Status(uptime_us=lost, samples_lost=lost)), 0.0)
        windows.append(vitals.take(pipeline))
    assert windows[0].totals.digitizer is None
    assert "digitizer samples lost" not in windows[0].totals.named()
    assert windows[1].rises.digitizer is None
    assert windows[2].totals.named()["digitizer samples lost"] == 9
    assert windows[2].rises.digitizer == Status(uptime_us=5, samples_lost=5)


def window_with(**values: object) -> Window:
    """What a second of an idle process would be, but for these values."""
    idle = {"seconds": 1.0, "process_share": 0.0, "thread_share": 0.0}
    return replace(Vitals().take(Pipeline(CONFIG)), **idle | values)  # type: ignore[arg-type]


def levels(findings: list[Finding]) -> dict[str, Level]:
    return {finding.key: finding.level for finding in findings}


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        (78, {}),
        (72, {}),
        (69, {"slow": Level.WARN}),
        (38, {"very slow": Level.ERROR}),
        (87, {"fast": Level.WARN}),
    ],
)
def test_the_rate_has_limits(frames: int, expected: dict[str, Level]) -> None:
    window = window_with(frames=frames)
    assert levels(list(checkup.stream(Pipeline(CONFIG), window, None))) == expected


NO_RISE = Counts(StreamCounters(), Counters(), None, 0)


@pytest.mark.parametrize(
    ("risen", "text"),
    [
        (StreamCounters(skipped_bytes=1), "does not keep up"),
        (StreamCounters(restarts=1), "the digitizer restarted"),
        (StreamCounters(clock_steps=1), "clock stood still, stepped"),
        (StreamCounters(implausible_packets=1), "impossible contents"),
        (Counters(lost_packets=1), "packets are missing"),
        (Counters(jumps=1), "restarts packet numbering"),
        (Counters(repeated_packets=1), "packets come twice"),
        (Counters(resyncs=1), "bytes arrive that are no packets"),
        (Counters(malformed=1), "do not fit the protocol"),
        (Status(0, sync_faults=1), "sync edges came late"),
        (Status(0, samples_lost=1), "the digitizer loses samples"),
        (Status(0, packets_dropped=1), "too slow for the digitizer's packets"),
        (Status(0, command_errors=1), "commands reach the digitizer broken"),
    ],
    ids=str,
)
def test_losses_are_told_as_they_rise(risen: StreamCounters | Counters | Status, text: str) -> None:
    part = {StreamCounters: "stream", Counters: "packets", Status: "digitizer"}[type(risen)]
    rises = replace(NO_RISE, **{part: risen})  # type: ignore[arg-type]
    [finding] = checkup.link(Pipeline(CONFIG), window_with(rises=rises))
    assert text in finding.text and (finding.level, finding.event) == (Level.WARN, True)


def test_counts_that_may_rise_are_no_losses() -> None:
    rises = Counts(
        StreamCounters(frames=78, samples=10**5, lost_samples=1, unannounced_samples=1),
        Counters(bytes=10**5, packets=500, unknown=1, text_bytes=1),
        Status(10**6, commands_refused=1, streaming=True),
        0,
    )
    for quiet in (rises, NO_RISE):
        assert list(checkup.link(Pipeline(CONFIG), window_with(rises=quiet))) == []


@pytest.mark.parametrize(("errors", "level"), [(1, Level.WARN), (12, Level.ERROR)])
def test_broken_packets_are_told_by_their_share(errors: int, level: Level) -> None:
    rises = replace(NO_RISE, packets=Counters(packets=98, crc_errors=errors, framing_errors=1))
    [finding] = checkup.link(Pipeline(CONFIG), window_with(rises=rises))
    share = (errors + 1) / (errors + 99)
    assert (finding.level, finding.event) == (level, True)
    assert f"{share:.1%} of the packets arrive broken" in finding.text


def test_a_thread_without_reserve_is_told() -> None:
    assert list(checkup.host(window_with(thread_share=0.79), 1)) == []
    [finding] = checkup.host(window_with(thread_share=0.85), 1)
    assert finding.level == Level.WARN and "85% of a core" in finding.text
    [finding] = checkup.host(window_with(thread_share=0.3, process_share=0.95), 1)
    assert "its process takes 95% of a core" in finding.text and "fewer patches" in finding.text
    assert list(checkup.host(window_with(thread_share=0.3, process_share=0.85), 1)) == []


def found_of_nodes(stated_mv: float, options: str = "", weak: int = 0) -> list[Finding]:
    """What is found of nodes that all speak. weak: so many are taken to be."""
    config, watch = SkinConfig.of({"amplitude_mv": stated_mv}), Watch()
    with watch.driver(f"sim://?scene=all&threshold=0&speed=0{options}", config) as driver:
        wait_for(lambda: len(watch.frames) >= 100)
        with driver.between_frames() as pipeline:
            pipeline.health.state[:weak] = NodeState.WEAK
            return [*checkup.nodes(pipeline, [], driver.vitals.take(pipeline))]


@pytest.mark.parametrize(
    ("stated_mv", "options", "key", "said"),
    [
        (97.5, "", "amplitude", "which is 97.5: set it"),  # not twenty pairs of nodes on one row
        (300.0, "&amplitude_mv=97.5", "weak", "instead of 300. Are these the parameters"),
    ],
)
def test_an_amplitude_far_off_is_told(stated_mv: float, options: str, key: str, said: str) -> None:
    [finding] = found_of_nodes(stated_mv, options)
    assert finding.key == key and said in finding.text


@pytest.mark.parametrize(("weak", "level"), [(0, None), (1, Level.WARN), (16, Level.ERROR)])
def test_of_nearly_all_weak_the_amplitude_is_suspected(weak: int, level: Level | None) -> None:
    found = found_of_nodes(300.0, weak=weak)
    assert [finding.level for finding in found] == ([] if level is None else [level])
    assert all(("amplitude_mv" in f.text) == (level == Level.ERROR) for f in found)


STATE = Finding("slow", key="slow")
EVENT = Finding("broken", Level.ERROR, event=True)


def test_states_stand_in_a_row_events_at_once_and_the_worst_is_told_first() -> None:
    settling = Settling()
    for _ in range(RAISE_REPORTS - 1):
        assert settling.settle([STATE]) == []
    assert settling.settle([STATE]) == [STATE]
    for _ in range(CLEAR_REPORTS - 1):
        assert settling.settle([]) == [STATE]
    assert settling.settle([]) == []
    assert settling.settle([STATE]) == []  # and must prove itself again
    settling = Settling()
    standing = [settling.settle([EVENT])] + [settling.settle([]) for _ in range(CLEAR_REPORTS)]
    assert standing == [[EVENT]] * CLEAR_REPORTS + [[]]
    settling = Settling()
    settling.settle([STATE])
    newer = Finding("slower", key="slow")
    assert settling.settle([newer, EVENT]) == [EVENT, newer]


@given(st.lists(st.booleans(), min_size=1, max_size=200))
def test_a_level_changes_no_faster_than_it_may(course: list[bool]) -> None:
    settling = Settling()
    levels = [worst(settling.settle([STATE] if there else []))[0] for there in course]
    ups = [i for i in range(1, len(levels)) if levels[i] > levels[i - 1]]
    downs = [i for i in range(1, len(levels)) if levels[i] < levels[i - 1]]
    for down in downs:
        assert not any(course[down - CLEAR_REPORTS + 1 : down + 1])
        since = [up for up in ups if up < down]
        assert down - max(since, default=0) >= CLEAR_REPORTS
    for up in ups:
        assert all(course[up - RAISE_REPORTS + 1 : up + 1])


def test_texts_of_the_worst_level_are_told_together() -> None:
    assert worst([]) == (Level.OK, "")
    other = Finding("other")
    assert worst([STATE, other]) == (Level.WARN, "slow; other")
    assert worst([STATE, EVENT, other]) == (Level.ERROR, "broken")


PERIOD_S = 12.8e-3
LATE = LATE_S + LATE_PERIODS * PERIOD_S + 0.01
STEP_S = 0.05


def looks(waiting: list[int], ages_s: list[float]) -> list[bool]:
    """The verdicts at looks every STEP_S."""
    backlog = Backlog(PERIOD_S)
    pairs = enumerate(zip(waiting, ages_s, strict=True))
    return [backlog.observe(count, age_s, i * STEP_S) for i, (count, age_s) in pairs]


def test_who_stays_behind_skips_again_and_again() -> None:
    count = round(3 * CATCH_UP_S / STEP_S) + 3
    said = looks(count * [1], count * [LATE])
    assert sum(said) == 3
    assert said.index(True) == pytest.approx(CATCH_UP_S / STEP_S, abs=1)


@pytest.mark.parametrize(("waiting", "age_s"), [(4095, LATE_S), (0, 10.0)])
def test_bytes_that_wait_and_late_frames_are_each_harmless(waiting: int, age_s: float) -> None:
    """A fast link always has more; a slow device is always late."""
    assert not any(looks(200 * [waiting], 200 * [age_s]))


def test_who_was_held_up_and_makes_up_for_it_skips_nothing() -> None:
    once = round(0.8 * CATCH_UP_S / STEP_S)
    assert not any(looks((once * [1] + [0]) * 5, (once * [5.0] + [5.0]) * 5))
    assert LATE_S < SLOW_S
