# SPDX-License-Identifier: Apache-2.0

"""sim:// as pyserial sees it."""

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
import serial

from tactile_cdma.base.errors import SpecError
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.packets import stream
from tactile_cdma.wire import port as port_module
from tactile_cdma.wire.messages import Info, Samples, Start
from tactile_cdma.wire.packets import PacketParser, PacketWriter
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


def collect(port: serial.SerialBase, count: int) -> list[Samples]:
    parser, packets = PacketParser(), []
    while len(packets) < count:
        data = port.read(1) + port.read(port.in_waiting)
        packets += [packet for packet in parser.feed(data) if isinstance(packet, Samples)]
    assert parser.counters.lost_packets == parser.counters.crc_errors == 0
    return packets[:count]


def test_packets_flow_in_real_time(port: serial.SerialBase) -> None:
    start(port)
    began, busy = time.monotonic(), time.thread_time()
    packets = collect(port, 50)
    elapsed = time.monotonic() - began
    assert elapsed > 25 * 12.8e-3 - 0.01
    assert time.thread_time() - busy < 0.5 * elapsed, "it sleeps in between"
    options = SimOptions.from_url(port.port)
    for packet, block in zip(packets, stream(options, options.setup()), strict=False):
        assert (packet.first_index, packet.sync) == (block.first_index, block.sync)
        assert np.array_equal(packet.counts, block.counts)


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
