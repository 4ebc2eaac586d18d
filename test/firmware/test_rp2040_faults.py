# SPDX-License-Identifier: Apache-2.0

"""The RP2040's firmware under faults of its links, its samples and its CPU."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from rp2040 import EmulatorError
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.driver.timeline import end_index, sample_count
from tactile_cdma.wire._protocol import Result, SyncMode
from tactile_cdma.wire.messages import (
    Ack,
    Configure,
    FrameLayout,
    GetInfo,
    Info,
    Quiet,
    Samples,
    Start,
    Status,
    Stop,
)
from tactile_cdma.wire.packets import PacketParser, PacketWriter, wrap
from test.support.rp2040_bench import UART, USB, Bench, ramp

PLAIN = FrameLayout.of(FrameSpec(), 4)  # 80 kS/s
UNMARKED = Configure(PLAIN, SyncMode.NONE)
FAST = FrameLayout.of(FrameSpec(), 25)  # 500 kS/s, the ADC's limit
TURN = 2**18  # samples that a DMA channel writes before it hands over


def missing(packets: list[Samples | Quiet]) -> list[int]:
    """Sizes of the gaps between packets, by first_index."""
    steps = [after.first_index - end_index(before) for before, after in pairwise(packets)]
    return [step for step in steps if step]


@pytest.mark.parametrize("link", [UART, USB])
def test_what_is_no_command(rp2040_image: Path, link: str) -> None:
    """Each broken packet counts once, whatever it is; good ones among them are obeyed."""
    with Bench(rp2040_image, link) as bench:
        rng = np.random.default_rng(1)
        good = bench.writer.encode(GetInfo())
        unknown = wrap(b"\x99\x05\x00")
        long = wrap(b"\x81\x06\x00" + bytes(rng.integers(1, 256, 3000, np.uint8)))
        bench.write(b"\0" + rng.bytes(500).replace(b"\0", b"\1") + b"\0")  # 1: garbage
        bench.write(good[:-3] + b"\0")  # 2: truncated
        bench.write(bytes([good[0], good[1] ^ 1, *good[2:]]))  # 3: a bit is wrong
        bench.write(good + good)  # intact, and again
        bench.write(unknown + long)
        bench.write(b"\x02" * 20_000 + b"\0")  # 4: no end
        bench.send(GetInfo())
        bench.run(0.3)
        acks = [(ack.command, ack.command_sequence, ack.result) for ack in bench.of(Ack)]
        assert acks == [
            (0x81, 0, Result.OK),
            (0x81, 0, Result.OK),
            (0x99, 5, Result.UNKNOWN_COMMAND),
            (0x81, 6, Result.BAD_LENGTH),
            (0x81, 1, Result.OK),
        ]
        bench.run(1.0)
        assert (bench.status.command_errors, bench.status.commands_refused) == (4, 2)
        assert len(bench.of(Info)) >= 3


def test_usb_commands_wait_until_there_is_time_for_them(rp2040_image: Path) -> None:
    """At the highest rate a packet of a frame keeps main() from reading for 3 ms."""
    with Bench(rp2040_image, USB) as bench:
        bench.stream(FAST, 0.02)
        bench.write(3000 * b"\5\1\2\3\4\0")
        bench.run(0.05)
        bench.send(Stop())
        bench.run(1.1)
        assert bench.status.command_errors == 3000


def test_the_link_that_commands_is_answered(rp2040_image: Path) -> None:
    """Two hosts: a packet of one that the other interrupts is broken, and neither gets stuck."""
    with Bench(rp2040_image, USB) as bench:
        bench.board.read_uart()
        bench.stream(PLAIN, 0.05)
        assert not bench.board.read_uart(), "USB is first where a host has configured it"
        other = PacketWriter()
        bench.board.write_uart(other.encode(GetInfo())[:5])
        bench.run(0.02)
        assert bench.check(bench.line) > 4000, "noise takes nothing away"
        bench.board.write_uart(b"\0" + other.encode(GetInfo()))
        bench.run_deaf(0.03)
        bench.board.run(bench.board.now + 0.05)
        assert not bench.read() and len(bench.board.read_uart()) > 8000
        bench.board.write_uart(other.encode(GetInfo())[:5])
        bench.run_deaf(0.01)
        bench.write(bench.writer.encode(GetInfo()))
        bench.listen_again(0.05)
        assert [ack.command for ack in bench.of(Ack)] == [0x81]
        assert bench.check(bench.line) > 2000


def test_a_uart_that_is_too_slow(rp2040_image: Path) -> None:
    """What doesn't fit is dropped in whole packets, each counted; what comes is right."""
    with Bench(rp2040_image, UART, ramp) as bench:
        bench.stream(FrameLayout.of(FrameSpec(), 8), 1.2)  # 320 kB/s onto 200 kB/s
        bench.send(Stop())
        bench.run(1.5)
        passed = bench.check(bench.line)
        assert bench.status.packets_dropped > 10
        assert bench.parser.counters.lost_packets == bench.status.packets_dropped
        assert sum(missing(bench.line)) + passed == end_index(bench.line[-1])
        assert bench.status.samples_lost == bench.status.sync_faults == 0
        assert 170_000 * 1.2 < 2 * passed < 200_000 * 1.8, "the UART was busy all the time"


def test_a_usb_host_that_stops_reading(rp2040_image: Path) -> None:
    """It may read on after any time: what is left of before is 5 kB, the rest is new."""
    with Bench(rp2040_image, USB, ramp) as bench:
        bench.stream(PLAIN, 0.1)
        bench.board.plug_usb(reading=False)
        bench.run(1.5)
        before = end_index(bench.line[-1])
        bench.board.plug_usb()
        heard, again_us = len(bench.line), bench.board.now * 1e6
        bench.run(1.2)
        passed = bench.check(bench.line)
        gaps = missing(bench.line)
        old = [p for p in bench.line[heard:] if p.device_time_us < again_us - 15_000]
        assert 0 < 2 * sum(map(sample_count, old)) < 4096 + 1300
        assert len(gaps) == 1 and gaps[0] > 100_000, "and nothing is missing from then on"
        assert bench.status.packets_dropped == bench.parser.counters.lost_packets > 50
        assert sum(gaps) + passed == end_index(bench.line[-1]) > before + 100_000
        assert bench.status.samples_lost == bench.status.sync_faults == 0
        assert all(np.diff([p.device_time_us for p in bench.line]) > 0)


def test_usb_comes_back_after_it_was_unplugged(rp2040_image: Path) -> None:
    with Bench(rp2040_image, USB) as bench:
        bench.stream(PLAIN, 0.1)
        bench.board.unplug_usb()
        bench.run_deaf(0.3)
        bench.board.plug_usb()
        bench.listen_again(0.1)
        bench.send(Start())
        bench.run(0.1)
        assert bench.of(Ack)[-1].result == Result.OK
        restart = [packet.first_index for packet in bench.line].index(0)
        assert bench.check(bench.line[restart:]) > 7000


def test_a_usb_host_that_never_reads_leaves_the_uart_alone(rp2040_image: Path) -> None:
    """As a PC that is only the power supply: it configures the device, nobody opens its port."""
    with Bench(rp2040_image, USB, ramp) as usb:
        usb.board.plug_usb(reading=False)
        usb.run_deaf(1.2)
        usb.board.read_uart()
        other = PacketWriter()
        for _ in range(2):
            usb.board.write_uart(b"\0" + other.encode(GetInfo()))
            usb.board.run(usb.board.now + 0.1)
            heard = PacketParser().feed(usb.board.read_uart())
            assert [packet.command for packet in heard if isinstance(packet, Ack)][-1:] == [0x81]
            usb.send(GetInfo())  # and doesn't read the answer
            usb.board.run(usb.board.now + 0.01)
        assert not usb.read()
        usb.board.plug_usb()
        usb.send(GetInfo())
        usb.listen_again(0.1)
        assert [ack.command for ack in usb.of(Ack)][-1:] == [0x81]


def test_a_new_usb_host_gets_nothing_of_the_last_one(rp2040_image: Path) -> None:
    with Bench(rp2040_image, USB) as bench:
        bench.board.plug_usb(reading=False)
        bench.run_deaf(2.2)  # two reports: more than the controller holds
        bench.board.unplug_usb()
        bench.run_deaf(0.1)
        bench.board.plug_usb()
        bench.board.run(bench.board.now + 0.1)
        assert not bench.read().strip(b"\0")
        bench.run(1.0)
        assert bench.of(Info)


@pytest.mark.parametrize("by_dtr", [True, False])
def test_a_port_that_is_closed_ends_the_stream(rp2040_image: Path, by_dtr: bool) -> None:
    """Nothing of before awaits the next program, which may raise DTR or just send a command."""
    with Bench(rp2040_image, USB, ramp) as bench:
        bench.stream(PLAIN, 0.1)
        bench.board.plug_usb(reading=False)
        bench.run(0.002)
        bench.board.set_usb_dtr(False)
        bench.run(0.02)
        assert not bench.board.led
        bench.edges.clear()
        bench.run_deaf(1.3)
        assert not bench.edges
        bench.board.plug_usb()
        bench.board.run(bench.board.now + 0.02)
        assert bench.read().strip(b"\0") == b"", "the controller's two packets are delimiters"
        if by_dtr:
            bench.board.set_usb_dtr(True)
            assert [type(packet) for packet in bench.run(1.1)] == [Info, Status]
            assert not bench.status.streaming
        bench.send(Start())
        bench.run(0.1)
        assert bench.line[0].first_index == 0 and bench.check(bench.line) > 7000


def test_a_host_that_sleeps(rp2040_image: Path) -> None:
    """Its stream ends, so that the nodes are silent; a stream commanded over the UART goes on."""
    with Bench(rp2040_image, USB, ramp) as bench:
        bench.stream(PLAIN, 0.1)
        bench.board.suspend_usb(True)
        bench.run(0.02)
        bench.edges.clear()
        before = bench.board.cycles
        bench.run(1.0)
        assert not bench.edges and not bench.board.led
        assert (bench.board.cycles - before) / 96e6 < 0.002
        bench.board.suspend_usb(False)
        bench.listen_again(1.1)
        assert not bench.status.streaming
        bench.send(Start())
        bench.run(0.1)
        assert [p.first_index for p in bench.line].count(0) == 2
    with Bench(rp2040_image, UART, ramp) as bench:
        bench.board.plug_usb()
        bench.stream(PLAIN, 0.1)
        bench.board.suspend_usb(True)
        bench.run(0.1)
        assert not missing(bench.line) and bench.check(bench.line) > 14_000


@pytest.mark.parametrize("reading", [False, True])
def test_a_halt_that_is_cleared_takes_nothing_away(rp2040_image: Path, reading: bool) -> None:
    with Bench(rp2040_image, USB, ramp) as bench:
        bench.stream(PLAIN, 0.1)
        bench.board.plug_usb(reading)
        bench.run(0.01)
        bench.board.clear_usb_halt()
        bench.run(0.01)
        bench.board.plug_usb()
        bench.run(0.1)
        assert not missing(bench.line)
        assert bench.check(bench.line) > 16_000
        assert bench.parser.counters.lost_packets == 0


def test_a_cpu_that_was_away(rp2040_image: Path) -> None:
    """Longer than the ring of samples lasts: all are either there or counted, none is doubled."""
    with Bench(rp2040_image, USB, ramp) as bench:
        bench.stream(UNMARKED, 0.1001)  # it is between two packets then
        bench.board.stall(0.4)  # 32,000 samples
        bench.run(0.7)
        bench.send(Stop())
        bench.run(1.1)
        (gap,) = missing(bench.line)
        assert 32_000 - 16_384 <= gap <= 32_000 - 8_192
        assert bench.status.samples_lost == gap
        assert bench.check(bench.line) + gap == end_index(bench.line[-1])
        assert [p.overrun for p in bench.line].count(True) == 1
        assert bench.parser.counters.lost_packets == 0


def test_a_cpu_that_was_away_amid_packing(rp2040_image: Path) -> None:
    """What the next lap overwrites while a packet is made of it is lost, and counted as such."""
    away, most_kept = 16_384 + 200, 16_384 - 16_384 // 4
    with Bench(rp2040_image, USB, ramp) as bench:
        bench.stream(Configure(FrameLayout.of(FrameSpec(), 12), SyncMode.NONE), 0.02)  # 240 kS/s
        for moment in range(24):
            bench.run(away / 240_000 + 0.15 + moment * 43e-6)
            bench.board.stall(away / 240_000)
        bench.run(0.5)
        bench.send(Stop())
        bench.run(1.1)
        gaps = missing(bench.line)
        assert bench.check(bench.line) + sum(gaps) == end_index(bench.line[-1])
        assert len(gaps) == [p.overrun for p in bench.line].count(True) == 24
        assert away - most_kept - 300 < min(gaps) and max(gaps) < away - most_kept + 900
        assert bench.status.samples_lost == sum(gaps)
        assert bench.status.packets_dropped == bench.parser.counters.lost_packets == 0


def test_an_adc_whose_samples_were_not_fetched(rp2040_image: Path) -> None:
    """Its FIFO overflows: how many results that cost is known to the sample."""
    with Bench(rp2040_image, USB, ramp) as bench:
        bench.stream(FAST, 0.02)
        for hold_s in (30e-6, 101e-6, 1.5e-3):
            bench.board.hold_samples(hold_s)
            bench.run(0.02)
        bench.send(Stop())
        bench.run(1.1)
        gaps = missing(bench.line)
        assert len(gaps) == 3
        assert gaps[2] > 700
        assert bench.status.samples_lost == sum(gaps)
        assert bench.check(bench.line) + sum(gaps) == end_index(bench.line[-1])
        marks = [packet.device_time_us for packet in bench.line if packet.sync]
        assert set(np.diff(marks) % 12_800) == {0}
        assert bench.status.sync_faults == 0


def test_a_sync_pulse_that_comes_too_late(rp2040_image: Path) -> None:
    """Is counted; a new stream begins, and nothing that was sampled before is missing."""
    with Bench(rp2040_image, USB) as bench:
        bench.stream(PLAIN, 0.05)
        first_times, first_counts = bench.times_ns, bench.counts
        away = bench.board.now
        bench.board.stall(5e-3)  # a period of the PWM lasts at most 1.4 ms
        bench.run(0.1)
        bench.send(Stop())
        bench.run(1.1)
        assert bench.status.sync_faults == 1
        assert bench.status.samples_lost == bench.status.packets_dropped == 0
        (again,) = [i for i, packet in enumerate(bench.line) if packet.first_index == 0 and i]
        before, after = bench.line[:again], bench.line[again:]
        assert not missing(before) and not missing(after)
        last_us = before[-1].device_time_us + 12.5 * before[-1].counts.size  # type: ignore[union-attr]
        assert last_us > (away + 4.9e-3) * 1e6, "samples that came meanwhile are sent"
        assert after[0].device_time_us - last_us < 1000
        assert bench.check(after) > 6000
        assert first_times.size and np.all(
            first_counts[: before[0].counts.size] == before[0].counts
        )  # type: ignore[union-attr]
        marks = [packet.device_time_us for packet in after if packet.sync]
        assert len(marks) >= 5 and set(np.diff(marks)) == {12_800}
        pulses = [(rise, length) for rise, length in bench.pulses if rise > marks[0] * 1e3 - 70e3]
        assert {round(length) for _, length in pulses} == {32_000}


def test_dma_hands_over_for_ever(rp2040_image: Path) -> None:
    """Both ways, at the ADC's highest rate; QUIET keeps the emulation short."""
    with Bench(rp2040_image, USB, lambda t_ns: 2000 + t_ns // 1e5 % 3) as bench:
        bench.stream(Configure(FAST, quiet_uv=10_000), 2.3 * TURN / 500_000)
        assert isinstance(bench.line[-1], Quiet)
        assert not missing(bench.line)
        assert bench.check(bench.line) > 2.2 * TURN


def test_a_cpu_that_hangs_is_reset(rp2040_image: Path) -> None:
    with Bench(rp2040_image, UART) as bench:
        bench.stream(PLAIN, 0.02)
        bench.board.stall(1.0)
        with pytest.raises(EmulatorError, match="watchdog has reset"):
            bench.run(1.0)


def test_what_is_missing_is_named(rp2040_image: Path, tmp_path: Path) -> None:
    with pytest.raises(EmulatorError, match="make rp2040"):
        Bench(tmp_path / "digitizer.bin")
    (tmp_path / "short.bin").write_bytes(b"\0" * 256)
    with pytest.raises(EmulatorError, match="rp2040_chip"):
        Bench(tmp_path / "short.bin")
