# SPDX-License-Identifier: Apache-2.0

"""The digitizer's core on its virtual board, with emulated nodes on its lines.

The nodes here copy the sync line to the analog one, 201 of their cycles of 125 ns later.
"""

from dataclasses import replace

import numpy as np
import pytest

from emulated import Amplifier, EmulatedSkin
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.wire.messages import (
    Configure,
    FrameLayout,
    Info,
    Packet,
    Samples,
    Start,
    Status,
    Stop,
)
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.core_digitizer import of_kind
from test.support.firmware import Specimen

MS = 1_000_000
SPEC = FrameSpec(nodes=2, order=4, frame_period_s=5e-3)
LAYOUT = FrameLayout.of(SPEC, samples_per_chip=4)
COUNT_V = 3.3 / 4096
LEAD_NS, ECHO_NS = 64_000, 201 * 125
HALF_US = 6  # half a sample's period of 12.5 µs, in whole µs


class Host:
    """Sends commands to a skin's digitizer and keeps its packets."""

    def __init__(self, skin: EmulatedSkin) -> None:
        self.skin = skin
        self.writer, self.parser = PacketWriter(), PacketParser()
        self.heard: list[object] = []

    def say(self, *packets: Packet) -> None:
        self.skin.write(b"".join(self.writer.encode(packet) for packet in packets))

    def run(self, t_ns: int) -> None:
        self.skin.run(t_ns)
        self.heard += self.parser.feed(self.skin.read())

    def all(self, kind: type[Packet]) -> list:
        return of_kind(self.heard, kind)

    def stream(self, t_ns: int, **options: object) -> list[Samples]:
        """Samples from a Start now until a time."""
        self.say(Configure(LAYOUT, **options), Start())
        self.run(t_ns)
        return self.all(Samples)


@pytest.mark.parametrize("clock_error", [0.0, 0.01, -0.003])
def test_samples_are_the_line_at_their_instants(specimen: Specimen, clock_error: float) -> None:
    echo, shows = specimen("capture"), specimen("convert")
    nodes = [
        replace(echo, gain=0.1),
        replace(shows, gain=0.13, clock_hz=7.6e6),
        replace(shows, gain=0.07, clock_hz=8.3e6),
    ]
    with EmulatedSkin(nodes, clock_error=clock_error) as skin:
        skin.press([0, 1.1, 2.2])
        skin.run(3 * MS + 123_456)
        samples = Host(skin).stream(60 * MS)
        counts = np.concatenate([packet.counts for packet in samples])
        indices = np.concatenate([[0], np.cumsum([packet.counts.size for packet in samples])[:-1]])
        assert [packet.first_index for packet in samples] == indices.tolist()
        ticks = 600  # of 48 MHz; each is taken in the middle of its period
        first_ticks = (samples[0].device_time_us - HALF_US) * 48
        tick_ns = 1e3 / 48 / (1 + clock_error)
        at_ns = (first_ticks + ticks / 2) * tick_ns
        line = skin.volts(at_ns, ticks * tick_ns, counts.size)
        assert (counts == np.floor(line / COUNT_V)).all()
        assert len(np.unique(counts)) == 4  # low; one node, the other, both
        times = [packet.device_time_us - samples[0].device_time_us for packet in samples]
        assert times == [packet.first_index * 25 // 2 for packet in samples]


@pytest.mark.parametrize("clock_error", [0.0, 0.01])
def test_frames_are_announced_at_their_time(specimen: Specimen, clock_error: float) -> None:
    with EmulatedSkin([specimen("capture")], clock_error=clock_error) as skin:
        host = Host(skin)
        host.stream(12 * MS)
        host.run(50 * MS)
        marks = [packet for packet in host.all(Samples) if packet.sync]
        assert np.diff([mark.device_time_us for mark in marks]).tolist() == [5000] * (
            len(marks) - 1
        )
        edges = skin.edges(0)
        rises = edges["t_ns"][edges["level"] == 1]
        falls = edges["t_ns"][edges["level"] == -1][1:]  # the first one is of power-up
        for mark, rise, fall in zip(marks, rises, falls, strict=False):
            due = ((mark.device_time_us - HALF_US) * 1000 - LEAD_NS) / (1 + clock_error) + ECHO_NS
            assert 0 <= rise - due <= 125
            assert fall - rise == pytest.approx(2 * 16_000 / (1 + clock_error), abs=125)
        assert len(rises) in (len(marks), len(marks) + 1)


def test_a_new_stream_has_its_own_pulses(specimen: Specimen) -> None:
    with EmulatedSkin([specimen("capture")]) as skin:
        host = Host(skin)
        host.say(Configure(LAYOUT))
        for i in range(5):
            host.say(Start())
            host.run((i + 1) * 12 * MS + i * 300_000)
        marks = [packet for packet in host.all(Samples) if packet.sync]
        due = [(mark.device_time_us - HALF_US) * 1000 - LEAD_NS + ECHO_NS for mark in marks]
        edges = skin.edges(0)
        rises = set(edges["t_ns"][edges["level"] == 1].tolist())
        assert len(due) == 5 * 2
        assert rises > set(due)
        assert len(rises) == len(due) + 5  # a frame of each stream was cut off


def test_a_slow_link_drops_whole_packets_and_counts_them(specimen: Specimen) -> None:
    rate = 50_000.0  # bytes per second; 80,000 samples take 160,000
    with EmulatedSkin([specimen("capture")], link_rate=rate) as skin:
        host = Host(skin)
        host.run(900 * MS)  # an idle link saves nothing up
        idle = host.parser.counters.bytes
        host.say(Configure(LAYOUT), Start())
        for ms in range(100, 4001, 100):
            host.run((900 + ms) * MS)
            assert host.parser.counters.bytes - idle <= rate * ms / 1000 + 1
        assert host.parser.counters.bytes > 0.99 * rate * 4
        counters = host.parser.counters
        assert counters.crc_errors == counters.framing_errors == 0
        dropped = host.all(Status)[-1].packets_dropped
        assert 0 < dropped <= counters.lost_packets
        host.say(Stop())
        host.run(7000 * MS)  # the ring has emptied
        assert host.all(Status)[-1].packets_dropped == host.parser.counters.lost_packets
        # what is there is whole: a jump of the index is a lost packet
        sent = 2 * sum(packet.counts.size for packet in host.all(Samples))
        assert 0.9 < sent / (rate * 4 + 65_536) < 1  # all the link's and the ring's


def test_what_changes_nothing_in_the_stream(specimen: Specimen) -> None:
    """Running in pieces, and a short history; a link that is fast enough only delays it."""

    def heard(step_ns: int = 200 * MS, **options: float) -> list[Samples]:
        with EmulatedSkin([specimen("capture")], clock_error=0.002, **options) as skin:
            host = Host(skin)
            host.say(Configure(LAYOUT), Start())
            for t_ns in range(step_ns, 200 * MS + 1, step_ns):
                host.run(t_ns)
            return host.all(Samples)

    usual, late = heard(), heard(link_rate=250_000)
    assert heard(step_ns=100_000) == heard(history_s=0) == usual
    assert len(usual) - 2 <= len(late) and late == usual[: len(late)]


def test_the_converter_clips_where_the_amplifier_does(specimen: Specimen) -> None:
    loud = replace(specimen("capture"), gain=1.2)
    with EmulatedSkin([loud], Amplifier(low_v=-1, high_v=4)) as skin:
        host = Host(skin)
        counts = np.concatenate([packet.counts for packet in host.stream(20 * MS)])
        info = host.all(Info)[-1]
        assert (counts.min(), info.zero_count, counts.max()) == (0, 2048, 4095)
