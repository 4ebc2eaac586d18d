# SPDX-License-Identifier: Apache-2.0

"""The driver thread on real pyserial ports: sim://, a pty, and what can go wrong there."""

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

import numpy as np
import pytest

from tactile_cdma.base.errors import PortError, SpecError
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.driver import CONNECTING, Driver
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.readings.stuck import LOOK_S, StuckNodes
from tactile_cdma.readings.taxels import Readings
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire.identity import SIMULATED_ID
from tactile_cdma.wire.messages import Samples
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from tactile_cdma.wire.port import Port
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


def test_unplugging_and_plugging_in_again_resumes(tmp_path: Path) -> None:
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


def test_a_device_that_comes_back_ends_the_pause(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tactile_cdma.driver.driver.RETRY_S", (3600.0,))
    path, watch = tmp_path / "skin", Watch()
    with watch.driver(str(path)):
        wait_for(lambda: watch.problems)
        with plugged(board(5), path):
            wait_for(lambda: len(watch.frames) > 2)


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


def test_a_digitizer_that_restarts_is_started_again() -> None:
    with raw_pty() as (host, name):
        os.set_blocking(host, False)
        watch = Watch()
        with watch.driver(name):
            for _ in range(2):  # the second one was just powered up: nobody told it to start
                serve(host, VirtualDigitizer(SimOptions()), watch, len(watch.frames) + 20)
        sequence = [frame.sequence for frame in watch.frames]
        assert sequence == sorted(set(sequence))


@pytest.mark.parametrize(
    ("made_by", "who"), [(SIMULATED_ID, "simulator"), (b"\xe6\x60\x58\x38", "digitizer")]
)
def test_silence_is_told_when_patience_ends_however_long_a_read_may_wait(
    monkeypatch: pytest.MonkeyPatch, made_by: bytes, who: str
) -> None:
    """A simulator has no power that may be off."""
    monkeypatch.setattr("tactile_cdma.sim.digitizer.SIMULATED_ID", made_by)
    monkeypatch.setattr("tactile_cdma.driver.driver.READ_TIMEOUT_MS", round(2e3 * PATIENCE_S))
    with raw_pty() as (host, name):
        os.set_blocking(host, False)
        watch = Watch()
        with watch.driver(name):
            serve(host, VirtualDigitizer(SimOptions()), watch, 20)
            wait_for(lambda: f"the {who} has fallen silent" in (watch.problems[-1] or ""))
            assert ("powered" in watch.problems[-1]) == (who == "digitizer")


def serve(host: int, digitizer: VirtualDigitizer, watch: Watch, count: int) -> None:
    """Be a digitizer on a pty until so many frames were seen."""

    def are_seen() -> bool:
        digitizer.advance(4096)
        with suppress(BlockingIOError):
            digitizer.receive(os.read(host, 4096))
        with suppress(BlockingIOError):
            os.write(host, digitizer.take(1024))
        return len(watch.frames) >= count

    wait_for(are_seen)


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


class Looks(StuckNodes):
    """Notes when it is called, device time, s."""

    def __init__(self) -> None:
        super().__init__(CONFIG.layout)
        self.times_s: list[float] = []

    def look(self, readings: Readings, t_s: float, contact_pa: float) -> None:
        self.times_s.append(t_s)
        super().look(readings, t_s, contact_pa)


def test_stuck_nodes_are_looked_for_ten_times_a_second_of_the_skins_time() -> None:
    watch, looks = Watch(), Looks()
    driver = watch.driver("sim://?seed=1&speed=0")
    driver.stuck = looks
    with driver:
        wait_for(lambda: len(looks.times_s) >= 20)
    apart_s = np.diff(looks.times_s)
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
