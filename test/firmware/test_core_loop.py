# SPDX-License-Identifier: Apache-2.0

"""The digitizer's main loop (core/loop.c) on a board in memory: links, samples, missed pulses."""

import ctypes
from ctypes import POINTER, byref, c_size_t, c_uint8, c_uint64
from itertools import pairwise

import pytest

from tactile_cdma.wire.messages import Ack, Command, GetInfo, Info, Packet, Samples, Start, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.core_digitizer import of_kind

FIRST, LAST = 0, 1
"""Links: the preferred one, and the one that is always ready."""


class Loop:
    """Passes of the loop; links carry everything that they are given unless told otherwise."""

    def __init__(self, core: ctypes.CDLL) -> None:
        self._core = core
        core.loop_sent.restype = c_size_t
        self._writer = PacketWriter()
        self._parsed = [0, 0]
        self.parsers = [PacketParser(), PacketParser()]
        self.stuck: set[int] = set()
        self.now_us = 0
        core.loop_new()
        self.run()  # the reports of power-up, over the link that is always ready
        assert kinds(self.packets(LAST)) == [Info, Status]

    def run(self, passes: int = 8, step_us: int = 0) -> None:
        for _ in range(passes):
            self.now_us += step_us
            self._core.loop_pass(c_uint64(self.now_us))
            for link in {FIRST, LAST} - self.stuck:
                self._core.loop_carry(link, c_size_t(1 << 16))

    def ready(self, link: int, ready: bool = True) -> None:
        self._core.loop_ready(link, ready)

    def command(self, link: int, *commands: Command) -> None:
        self.write(link, b"".join(map(self._writer.encode, commands)))

    def write(self, link: int, data: bytes) -> None:
        self._core.loop_write(link, data, c_size_t(len(data)))

    def sample(self, size: int, lost: int = 0) -> None:
        self._core.loop_sample(c_size_t(size), c_size_t(lost))

    def packets(self, link: int) -> list[Packet]:
        """What has come over a link since the last call."""
        pointer = POINTER(c_uint8)()
        size = self._core.loop_sent(link, byref(pointer))
        new = ctypes.string_at(pointer, size)[self._parsed[link] :]
        self._parsed[link] = size
        return list(self.parsers[link].feed(new))

    def errors(self, link: int) -> int:
        """Runs of bytes that were no packet, as the link's host counts them."""
        counters = self.parsers[link].counters
        return counters.framing_errors + counters.crc_errors

    def carry(self, link: int, size: int) -> None:
        self._core.loop_carry(link, c_size_t(size))

    def fail_pulses(self) -> None:
        self._core.loop_fail_pulses()

    @property
    def sleeps(self) -> int:
        return int(self._core.loop_sleeps())

    @property
    def starts(self) -> int:
        return int(self._core.loop_starts())


@pytest.fixture
def loop(core: ctypes.CDLL) -> Loop:
    return Loop(core)


def kinds(packets: list[Packet]) -> list[type]:
    return [type(packet) for packet in packets]


def test_reports_go_to_the_first_ready_link(loop: Loop) -> None:
    loop.run(step_us=200_000)
    assert set(kinds(loop.packets(LAST))) == {Info, Status} and not loop.packets(FIRST)
    loop.ready(FIRST)
    loop.run(step_us=200_000)
    assert set(kinds(loop.packets(FIRST))) == {Info, Status}


def test_answers_go_to_the_link_that_asked(loop: Loop) -> None:
    loop.ready(FIRST)
    for link, other in ((LAST, FIRST), (FIRST, LAST)):
        loop.command(link, GetInfo())
        loop.run()
        assert kinds(loop.packets(link)) == [Ack, Info]
        assert not loop.packets(other)


def test_a_host_that_does_not_read_gets_what_is_new(loop: Loop) -> None:
    """Half a second later at the latest; what it gets is whole, and what it does not is counted."""
    loop.command(LAST, Start())
    loop.run(100, step_us=1000)
    loop.stuck = {LAST}
    for tenth in range(12):
        loop.sample(2048)
        loop.run(10, step_us=10_000)
        if tenth == 2:
            loop.carry(LAST, 1 << 16)  # what follows is cut within a packet
    loop.stuck = set()
    loop.sample(2048)
    loop.run(40)
    samples = of_kind(loop.packets(LAST), Samples)
    firsts = [packet.first_index for packet in samples]
    assert firsts[-1] >= 12 * 2048
    old = [p.counts.size for p in samples if p.first_index < 12 * 2048]
    assert 0 < 2 * sum(old) <= 4096 + 2 * max(old)
    loop.run(11, step_us=100_000)
    status = of_kind(loop.packets(LAST), Status)[-1]
    assert status.packets_dropped == loop.parsers[LAST].counters.lost_packets > 10
    assert loop.errors(LAST) == 0


def test_a_host_that_left_ends_its_stream(loop: Loop) -> None:
    """The next one gets nothing of it, not even the rest of a packet."""
    loop.ready(FIRST)
    loop.command(FIRST, Start())
    loop.run()
    loop.sample(2048)
    loop.stuck = {FIRST}
    loop.run()
    loop.carry(FIRST, 5)
    loop.ready(FIRST, False)
    starts = loop.starts
    loop.run(20, step_us=100_000)
    assert loop.starts == starts + 1
    loop.stuck = set()
    loop.ready(FIRST)
    loop.packets(FIRST)
    loop.run(12, step_us=100_000)
    packets = loop.packets(FIRST)
    assert kinds(packets) == [Info, Status] and loop.errors(FIRST) == 1
    assert isinstance(packets[1], Status) and not packets[1].streaming


def test_bytes_of_two_links_are_never_one_packet(loop: Loop) -> None:
    command = PacketWriter().encode(GetInfo())
    loop.write(FIRST, command[:4])
    loop.run()
    loop.write(LAST, command[4:])
    loop.run()
    loop.command(LAST, GetInfo())
    loop.run(step_us=200_000)
    answers = loop.packets(LAST)
    assert kinds(answers).count(Ack) == 1
    assert of_kind(answers, Status)[-1].command_errors == 2


def test_a_packet_cut_by_a_change_of_links_spoils_no_other(loop: Loop) -> None:
    """The preferred link's host stops reading within a packet; another host takes over."""
    loop.ready(FIRST)
    loop.run(3)
    loop.command(FIRST, Start())
    loop.stuck = {FIRST}
    loop.run(1)
    loop.carry(FIRST, 5)
    loop.command(LAST, GetInfo())
    loop.run()
    assert kinds(loop.packets(LAST))[-2:] == [Ack, Info]
    loop.stuck = set()
    loop.command(FIRST, GetInfo())
    loop.run()
    assert kinds(loop.packets(FIRST)) == [Ack, Info]
    assert loop.errors(FIRST) == 1 and loop.errors(LAST) == 1  # its begin here, its end there


def test_samples_pass_until_fewer_than_a_chunk_come(loop: Loop) -> None:
    loop.command(LAST, Start())
    loop.run()
    loop.packets(LAST)
    sleeps = loop.sleeps
    loop.sample(3 * 256 + 44, lost=7)
    loop.run(3)
    assert loop.sleeps == sleeps  # more samples wait
    loop.run(8)
    assert loop.sleeps == sleeps + 8
    samples = of_kind(loop.packets(LAST), Samples)
    assert samples[0].first_index == 7 and samples[0].overrun
    assert all(a.first_index + a.counts.size == b.first_index for a, b in pairwise(samples))


def test_after_a_missed_pulse_what_was_sampled_is_sent_and_a_new_stream_begins(loop: Loop) -> None:
    loop.command(LAST, Start())
    loop.run()
    loop.packets(LAST)
    starts = loop.starts
    for faults in (1, 2):
        loop.sample(600)
        loop.fail_pulses()
        loop.run(12, step_us=100_000)
        packets = loop.packets(LAST)
        assert sum(packet.counts.size for packet in of_kind(packets, Samples)) == 600
        assert loop.starts == starts + faults
        status = of_kind(packets, Status)[-1]
        assert status.sync_faults == faults and status.streaming
