# SPDX-License-Identifier: Apache-2.0

"""The virtual digitizer behind a real tty."""

import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import serial

from tactile_cdma.base.errors import PortError
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.sim.packets import stream
from tactile_cdma.sim.pty import serve
from tactile_cdma.wire.messages import Info, Samples, Start, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.boards import plugged
from test.support.waiting import PATIENCE_S


def collect(port: serial.Serial, parser: PacketParser, count: int) -> list[Samples]:
    packets: list[Samples] = []
    while len(packets) < count:
        data = port.read(1) + port.read(port.in_waiting)
        assert data
        packets += [packet for packet in parser.feed(data) if isinstance(packet, Samples)]
    return packets


def test_a_tty_carries_the_same_samples(tmp_path: Path) -> None:
    options = SimOptions(seed=4, stretch=0.1, speed=0)
    with (
        plugged(lambda: VirtualDigitizer(options), tmp_path / "skin") as path,
        serial.Serial(path, 2_000_000, timeout=PATIENCE_S) as port,
    ):
        assert path == str(tmp_path / "skin")
        port.write(PacketWriter().encode(Start()))
        parser = PacketParser()
        packets = collect(port, parser, 150)
    assert not parser.counters.crc_errors and not parser.counters.lost_packets
    for packet, block in zip(packets, stream(options, options.setup()), strict=False):
        assert (packet.first_index, packet.sync) == (block.first_index, block.sync)
        assert np.array_equal(packet.counts, block.counts)
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
            port.write(PacketWriter().encode(Start()))
            collect(port, PacketParser(), 20)
        time.sleep(1.0)  # nobody reads: more than the buffer holds
        with serial.Serial(path, timeout=PATIENCE_S) as port:
            parser = PacketParser()
            packets = collect(port, parser, 20)
            assert packets[-1].first_index > 20 * 512
            port.write(PacketWriter().encode(Start()))
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
