# SPDX-License-Identifier: Apache-2.0

"""The digitizer's core on its virtual board, with emulated nodes on its lines.

The nodes here copy the sync line to the analog one, 201 of their cycles of 125 ns later.
"""

from dataclasses import replace

import numpy as np
import pytest

from emulated import EmulatedSkin
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.wire.messages import (
    Configure,
    FrameLayout,
    Packet,
    Samples,
    Start,
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
