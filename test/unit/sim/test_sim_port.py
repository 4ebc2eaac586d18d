# SPDX-License-Identifier: Apache-2.0

"""The virtual digitizer as a port: sim:// as pyserial sees it, and behind a real tty."""

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import serial

from tactile_cdma.base.errors import PortError, SpecError
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.packets import stream
from tactile_cdma.sim.pty import serve
from tactile_cdma.wire import port as port_module
from tactile_cdma.wire.messages import Info, Samples, Start, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.boards import plugged
from test.support.waiting import PATIENCE_S

assert set(port_module.HANDLERS) <= set(serial.protocol_handler_packages)


@pytest.fixture
def port() -> Iterator[serial.SerialBase]:
    with serial.serial_for_url(
        "sim://?seed=4&stretch=0.1", baudrate=2_000_000, timeout=PATIENCE_S
    ) as port:
        yield port


def start(port: serial.SerialBase) -> None:
    port.write(PacketWriter().encode(Start()))


def collect(port: serial.SerialBase, parser: PacketParser, count: int) -> list[Samples]:
    packets: list[Samples] = []
    while len(packets) < count:
        data = port.read(1) + port.read(port.in_waiting)
        assert data
        packets += [packet for packet in parser.feed(data) if isinstance(packet, Samples)]
    return packets


def assert_made_by(options: SimOptions, packets: list[Samples]) -> None:
    for packet, block in zip(packets, stream(options, options.setup()), strict=False):
        assert (packet.first_index, packet.sync) == (block.first_index, block.sync)
        assert np.array_equal(packet.counts, block.counts)


def test_packets_flow_in_real_time(
    port: serial.SerialBase, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks = mock.Mock(side_effect=VirtualDigitizer.advance)
    monkeypatch.setattr(VirtualDigitizer, "advance", lambda *about: looks(*about))
    start(port)
    began = time.monotonic()
    packets = collect(port, parser := PacketParser(), 50)
    elapsed = time.monotonic() - began
    assert parser.counters.lost_packets == parser.counters.crc_errors == 0
    assert elapsed > 25 * 12.8e-3 - 0.01
    assert looks.call_count < 20 * len(packets), "it sleeps in between"
    assert_made_by(SimOptions.from_url(port.port), packets)


def test_a_packet_wakes_the_reader_at_once(port: serial.SerialBase) -> None:
    start(port)
    parser, delays = PacketParser(), []

    def at_once() -> int:
        return int(np.count_nonzero(np.array(delays) < min(delays) + 1e-3))

    # Of a busy machine the quick ones only: polling would spread all of them.
    while len(delays) < 120 or (at_once() < 12 and len(delays) < 3000):
        data = port.read(1)
        read_s = time.monotonic()
        for packet in parser.feed(data + port.read(port.in_waiting)):
            if isinstance(packet, Samples):
                end_s = packet.device_time_us * 1e-6 + len(packet.counts) / 80e3
                delays.append(read_s - end_s)
    assert at_once() >= 12


def test_read_waits_no_longer_than_the_timeout(port: serial.SerialBase) -> None:
    greeting = port.read(port.in_waiting)
    assert isinstance(PacketParser().feed(greeting)[0], Info)
    port.timeout = 0.05
    began = time.monotonic()
    assert port.read(10) == b""
    assert time.monotonic() - began >= 0.05
    port.timeout = 0
    assert port.read(10) == b""
    start(port)
    time.sleep(0.01)
    assert len(port.read(10)) == 10
    port.timeout = 0.1
    assert len(port.read(8192)) == 8192  # several packets' worth of waiting


def test_more_than_the_buffer_holds_can_be_read_at_once() -> None:
    with serial.serial_for_url("sim://?speed=10", timeout=PATIENCE_S) as port:
        start(port)
        data = port.read(300_000)
        parser = PacketParser()
        parser.feed(data)
        assert len(data) == 300_000
        assert parser.counters.lost_packets == 0


@pytest.mark.parametrize("end", ["close", "write"])
def test_a_blocked_read_can_be_ended(end: str) -> None:
    port = serial.serial_for_url("sim://", timeout=None)
    port.read(port.in_waiting)
    result: list[bytes | Exception] = []

    def read() -> None:
        try:
            result.append(port.read(1))
        except serial.SerialException as error:
            result.append(error)

    reader = threading.Thread(target=read)
    reader.start()
    time.sleep(0.02)
    if end == "write":
        start(port)
    else:
        port.close()
    reader.join(PATIENCE_S)
    assert not reader.is_alive()
    (outcome,) = result
    if end == "close":
        assert isinstance(outcome, serial.SerialException)
    else:
        assert len(outcome) == 1
    port.close()


def test_open_and_close_are_those_of_a_port() -> None:
    port = serial.serial_for_url("sim://", do_not_open=True)
    with pytest.raises(serial.SerialException):
        port.read()
    port.baudrate = 115_200
    port.open()
    with pytest.raises(serial.SerialException):
        port.open()
    assert port.in_waiting > 0
    port.reset_input_buffer()
    assert port.in_waiting == 0
    port.reset_output_buffer()
    port.flush()
    port.dtr = port.rts = True
    port.close()
    port.close()
    with pytest.raises(serial.SerialException):
        port.write(b"x")
    with pytest.raises(SpecError, match="noise"):
        serial.serial_for_url("sim://?noize=1")


def test_a_tty_carries_the_same_samples(tmp_path: Path) -> None:
    options = SimOptions(seed=4, stretch=0.1, speed=0)
    with (
        plugged(lambda: VirtualDigitizer(options), tmp_path / "skin") as path,
        serial.Serial(path, 2_000_000, timeout=PATIENCE_S) as port,
    ):
        assert path == str(tmp_path / "skin")
        start(port)
        parser = PacketParser()
        assert_made_by(options, collect(port, parser, 150))
    assert not parser.counters.crc_errors and not parser.counters.lost_packets
    assert not (tmp_path / "skin").is_symlink()


def test_it_is_raw_before_anyone_configures_it() -> None:
    with plugged(VirtualDigitizer) as path:
        host = os.open(path, os.O_RDWR | os.O_NOCTTY)
        try:
            packets = PacketParser().feed(os.read(host, 4096))
        finally:
            os.close(host)
    assert isinstance(packets[0], Info)


def test_clients_come_and_go() -> None:
    with plugged(VirtualDigitizer) as path:
        with serial.Serial(path, timeout=PATIENCE_S) as port:
            start(port)
            collect(port, PacketParser(), 20)
        time.sleep(1.0)  # nobody reads: more than the buffer holds
        with serial.Serial(path, timeout=PATIENCE_S) as port:
            parser = PacketParser()
            packets = collect(port, parser, 20)
            assert packets[-1].first_index > 20 * 512
            start(port)
            statuses: list[Status] = []
            while not statuses:
                received = parser.feed(port.read(4096))
                statuses = [p for p in received if isinstance(p, Status) and p.packets_dropped]
    assert statuses[0].packets_dropped > 0
    assert statuses[0].streaming


def test_links_replace_links_only(tmp_path: Path) -> None:
    link = tmp_path / "skin"
    link.symlink_to("/dev/pts/4000000")  # of a run that was killed
    with plugged(VirtualDigitizer, link):
        assert Path(os.readlink(link)).exists()
    for target in (tmp_path / "precious", Path("/dev/ttyACM0"), None):
        link.unlink(missing_ok=True)
        link.symlink_to(target) if target else link.write_text("precious")
        before = link.lstat()
        with pytest.raises(PortError, match="no link to a pseudo-terminal; it is left alone"):
            serve(VirtualDigitizer, link, threading.Event(), lambda path: None)
        assert link.lstat() == before
    with pytest.raises(PortError, match="cannot create the link"):
        serve(VirtualDigitizer, tmp_path / "no" / "skin", threading.Event(), lambda path: None)
