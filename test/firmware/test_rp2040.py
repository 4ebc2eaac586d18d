# SPDX-License-Identifier: Apache-2.0

"""The RP2040's firmware, instruction by instruction: its image, conversation, line and faults."""

import struct
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from rp2040 import EmulatorError
from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.driver.timeline import end_index
from tactile_cdma.wire._protocol import SYNC_FRAME, SYNC_RESTART, SYNC_UNIT_US, Result, SyncMode
from tactile_cdma.wire.messages import (
    Ack,
    Bootsel,
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
from test.support.firmware import FIRMWARE, need, run
from test.support.programs import run_program
from test.support.rp2040_bench import (
    FLASH_ID,
    LEAD_NS,
    TICK_NS,
    TIME_NS,
    UART,
    USB,
    Bench,
    ramp,
    sine,
)

FLASH, RAM, RAM_SIZE = 0x10000000, 0x20000000, 0x42000
BOOT_SIZE = 256


@pytest.fixture(scope="module")
def built_rp2040(built: Callable[[str], Path]) -> Path:
    need("arm-none-eabi-gcc")
    return built("rp2040") / "rp2040"


def mpeg_crc(data: bytes) -> int:
    """CRC-32/MPEG-2 by the definition, bit by bit; its check value is 0x0376E6E7."""
    register = 0xFFFFFFFF
    for byte in data:
        for bit in range(7, -1, -1):
            top = register >> 31 ^ byte >> bit & 1
            register = register << 1 & 0xFFFFFFFF ^ 0x04C11DB7 * top
    return register


def test_the_boot_rom_accepts_the_second_stage(built_rp2040: Path) -> None:
    assert mpeg_crc(b"123456789") == 0x0376E6E7
    image = (built_rp2040 / "digitizer.bin").read_bytes()
    assert mpeg_crc(image[: BOOT_SIZE - 4]) == struct.unpack_from("<I", image, BOOT_SIZE - 4)[0]
    stack, reset = struct.unpack_from("<2I", image, BOOT_SIZE)
    assert stack == RAM + RAM_SIZE
    assert reset & 1 and FLASH < reset < FLASH + len(image), "starts in flash, in Thumb state"


def test_a_second_stage_that_is_too_long_is_refused(tmp_path: Path) -> None:
    (tmp_path / "linked.bin").write_bytes(b"\1" * 300)
    command = ("python3", FIRMWARE / "digitizer/rp2040/image.py", "linked.bin", "a.bin", "a.uf2")
    done = run_program(*command, cwd=tmp_path)
    assert done.returncode and "boot stage is longer than 252 bytes" in done.stderr
    assert not (tmp_path / "a.uf2").exists()


def test_uf2_holds_the_image(built_rp2040: Path) -> None:
    image = (built_rp2040 / "digitizer.bin").read_bytes()
    packed = (built_rp2040 / "digitizer.uf2").read_bytes()
    assert len(packed) % 512 == 0
    blocks = [packed[i : i + 512] for i in range(0, len(packed), 512)]
    content = b""
    for number, block in enumerate(blocks):
        first, second, flags, address, size, place, count, family = struct.unpack_from("<8I", block)
        assert (first, second) == (0x0A324655, 0x9E5D5157)
        assert block[-4:] == struct.pack("<I", 0x0AB16F30)
        assert (flags, family) == (0x2000, 0xE48BFF56), "for an RP2040, and to its flash"
        assert (place, count, size) == (number, len(blocks), 256)
        assert address == FLASH + number * 256
        content += block[32 : 32 + size]
    assert content.rstrip(b"\0") == image.rstrip(b"\0")
    assert len(content) - len(image) < 256


def test_all_code_but_the_start_runs_from_ram(built_rp2040: Path) -> None:
    """Waits for flash would make times depend on its cache."""
    listing = run(need("arm-none-eabi-nm"), "-S", built_rp2040 / "digitizer.elf")
    rows = [line.split() for line in listing.splitlines()]
    functions = {row[3]: int(row[0], 16) for row in rows if len(row) == 4 and row[2] in "tT"}
    in_flash = {name for name, address in functions.items() if address < RAM}
    assert in_flash <= {"flash_vectors", "reset", "__main_veneer"}
    assert {"main", "sync_interrupt", "stream_samples"} <= functions.keys() - in_flash


PLAIN = FrameLayout.of(FrameSpec(), 4)  # 80 kS/s
UNIT_NS = SYNC_UNIT_US * 1000


def test_usb_host_configures_the_device(bench: Bench) -> None:
    told = bench.board.usb_device
    assert told is not None
    assert told.strings[1:] == (
        "tactile_cdma",
        "Tactile skin digitizer",
        FLASH_ID.hex().upper(),
        None,
    )
    size = int.from_bytes(told.configuration[2:4], "little")
    assert len(told.configuration) == size > 64, "needs two packets"
    assert told.device[4:7] == bytes([0xEF, 2, 1]), "functions are told by association"


def test_usb_answers_of_any_length_come_at_once(bench: Bench) -> None:
    """A transfer ends with a packet that is not full; after a full one, with an empty one."""
    for number in range(40, 104):  # 13 bytes each: one of these makes whole packets
        bench.board.plug_usb(reading=False)
        bench.send(*number * [Stop()])
        bench.board.run(bench.board.now + 0.004)
        bench.board.plug_usb()
        acks = [packet for packet in bench.run(0.003) if isinstance(packet, Ack)]
        assert len(acks) == number


@pytest.mark.parametrize("link", [UART, USB])
def test_conversation(rp2040_image: Path, link: str) -> None:
    with Bench(rp2040_image, link) as bench:
        if link == UART:
            assert [type(packet) for packet in bench.packets] == [Info, Status]
        assert not bench.board.led
        bench.send(Configure(PLAIN, quiet_uv=100), GetInfo(), Start())
        bench.run(1.1)
        acks = bench.of(Ack)
        assert [(ack.command_sequence, ack.result) for ack in acks] == [(0, 0), (1, 0), (2, 0)]
        info = bench.of(Info)[-1]
        assert info.digitizer_id == FLASH_ID
        assert (info.sample_rate_uhz, info.sync_mode) == (80_000 * 10**6, SyncMode.DRIVE)
        assert (info.zero_count, info.min_count, info.max_count) == (2048, 0, 4095)
        assert info.volts_per_count == np.float32(3.3 / 4096)
        assert (info.frame, info.quiet_uv) == (PLAIN, 100)
        assert bench.board.led and bench.status.streaming
        assert bench.status.uptime_us < bench.board.now * 1e6 < bench.status.uptime_us + 200_000
        bench.send(Stop())
        bench.run(0.01)
        silent = bench.run(1.1)
        assert [type(packet) for packet in silent] == [Info, Status]
        assert not bench.board.led and not bench.status.streaming
        assert bench.status == Status(bench.status.uptime_us)
        assert bench.parser.counters.lost_packets == bench.parser.counters.jumps == 0


@pytest.mark.parametrize(("link", "shape"), [(UART, sine), (USB, ramp)])
def test_samples_are_the_lines(rp2040_image: Path, link: str, shape: Callable) -> None:  # type: ignore[type-arg]
    """One second: none is missing, each is in its place, and that is where it was taken."""
    with Bench(rp2040_image, link, shape) as bench:
        bench.stream(PLAIN, 1.05)
        total = bench.check(bench.line)
        assert total >= 80_000
        assert bench.line[-1].first_index + bench.line[-1].counts.size == total  # type: ignore[union-attr]
        expected = bench.times_ns[0] + 12_500 * np.arange(bench.times_ns.size)
        assert np.abs(bench.times_ns - expected).max() < 1e-3, (
            "a period is 12.5 µs, in the long run"
        )
        assert bench.parser.counters.lost_packets == 0


def restarts_ns(frame: FrameLayout) -> list[float]:
    """When the nodes start anew within a frame, from its first chip on."""
    if not frame.resync_chips:
        return []
    chips = (frame.bits + frame.parity) * frame.order
    slot = frame.resync_chips + frame.guard_chips
    return [i * slot * frame.chip_ns for i in range(1, -(-chips // frame.resync_chips))]


RESYNC = replace(PLAIN, resync_chips=32, guard_chips=1, frame_period_us=16_000)
SETUPS = {
    "plain": PLAIN,
    "restarts": RESYNC,
    "restarts, odd chip": replace(RESYNC, chip_ns=33_333, parity=True, frame_period_us=9_777),
    "short slots": replace(RESYNC, resync_chips=2, guard_chips=1, frame_period_us=20_000),
    "3 samples of a 47 µs chip": replace(PLAIN, chip_ns=47_000, samples_per_chip=3),
    "1 µs more than 3 whole periods of the PWM": replace(
        PLAIN, chip_ns=20_000, samples_per_chip=2, frame_period_us=4097
    ),
    "slow": replace(PLAIN, chip_ns=500_000, frame_period_us=200_000, samples_per_chip=1),
}


@pytest.mark.parametrize("name", SETUPS)
def test_pulses_and_marks_are_where_they_should_be(bench: Bench, name: str) -> None:
    """To the tick of the ADC's clock; and the first sample of a frame is half a period later."""
    frame = SETUPS[name]
    bench.stream(frame, 0.1 + 3 * frame.frame_period_us * 1e-6)
    rises = np.array([rise for rise, _ in bench.pulses])
    offsets = np.array([0.0, *restarts_ns(frame)])
    frames = -(-rises.size // offsets.size)
    starts = frame.frame_period_us * 1e3 * np.arange(frames)[:, np.newaxis]
    expected = rises[0] + (starts + offsets).ravel()[: rises.size]
    assert frames >= 3
    assert np.abs(rises - expected).max() <= TICK_NS / 2 + 1e-3
    for number, (_, length) in enumerate(bench.pulses):
        units = SYNC_RESTART if number % offsets.size else SYNC_FRAME
        assert length == pytest.approx(units * UNIT_NS, abs=1e-3)

    marks = rises[:: offsets.size] + LEAD_NS
    marked = [packet for packet in bench.line if packet.sync]
    assert len(marked) >= 3
    period_ns = bench.times_ns[1] - bench.times_ns[0]
    for mark, packet in zip(marks, marked, strict=False):
        place = np.searchsorted(bench.times_ns, mark)
        assert packet.first_index == place, "the first sample at or after the mark"
        assert abs(packet.device_time_us * 1e3 - bench.times_ns[place]) <= TIME_NS
    first = bench.times_ns[marked[0].first_index] - marks[0]
    assert first == pytest.approx(period_ns / 2, abs=TICK_NS), "no constant offset"
    bench.check(bench.line)


def test_a_step_at_a_mark_is_seen_at_the_mark(rp2040_image: Path) -> None:
    """The line rises with every pulse's lead over, and falls 1 ms later."""
    edges: list[tuple[float, bool]] = []

    def steps(times_ns: np.ndarray) -> np.ndarray:
        rises = np.array([-1e9] + [t_ns for t_ns, high in edges if high]) + LEAD_NS
        since = times_ns - rises[np.searchsorted(rises, times_ns, side="right") - 1]
        return np.where(since < 1e6, 3000, 1000)

    with Bench(rp2040_image, UART, steps) as bench:
        edges = bench.edges
        bench.stream(PLAIN, 0.1)
        counts = np.concatenate([packet.counts for packet in bench.of(Samples)])
        steps_up = np.flatnonzero(np.diff(counts) > 0) + 1
        marked = [packet.first_index for packet in bench.of(Samples) if packet.sync]
        assert len(marked) >= 6
        assert marked == steps_up[: len(marked)].tolist()
        assert np.all(counts[marked[0] :][:80] == 3000) and counts[marked[0] + 80] == 1000


def test_without_marks_the_sync_line_rests(rp2040_image: Path) -> None:
    with Bench(rp2040_image, UART) as bench:
        bench.stream(Configure(PLAIN, SyncMode.NONE), 0.1)
        assert not bench.edges and not any(packet.sync for packet in bench.line)
        assert bench.check(bench.line) > 7000


def test_stop_and_start_again(bench: Bench) -> None:
    """Even in the middle of a pulse and of a conversion: a new stream knows nothing of the last."""
    bench.stream(PLAIN, 0.03)
    for part in (0.0123, 0.0007, 0.0301, 0.0107):
        bench.send(Stop())
        bench.run(part)
        bench.send(Configure(replace(PLAIN, samples_per_chip=7)), Start())
        before = len(bench.line)
        bench.edges.clear()
        bench.run(0.03)
        starts = [packet.first_index for packet in bench.line[before:]].index(0) + before
        assert bench.check(bench.line[starts:]) > 3000
        rise = bench.pulses[0][0]
        marked = next(packet for packet in bench.line[starts:] if packet.sync)
        assert marked.first_index == np.searchsorted(bench.times_ns, rise + LEAD_NS)


def test_quiet_and_means(rp2040_image: Path) -> None:
    """The core's other ways of sending, with the board's samples in them."""
    with Bench(rp2040_image, UART, lambda t_ns: 2000 + t_ns // 1e6 % 7) as bench:
        bench.stream(Configure(PLAIN, quiet_uv=8000), 0.1)
        assert any(isinstance(packet, Quiet) and packet.sync for packet in bench.line)
        assert bench.check(bench.line) > 6000
    with Bench(rp2040_image, UART, lambda t_ns: np.full(t_ns.shape, 1234)) as bench:
        bench.stream(Configure(PLAIN, integrated=True), 0.1)
        counts = np.concatenate([packet.counts for packet in bench.of(Samples)])
        assert counts.size >= 7 * 200 and set(counts.tolist()) == {1234 * 8}
        assert bench.board.cycles / 96e6 < 0.1, "keeps up with the fastest rate of its converter"


@pytest.mark.parametrize("flash_id", [bytes(8), b"\xff" * 8])
def test_a_flash_without_a_number(rp2040_image: Path, flash_id: bytes) -> None:
    with Bench(rp2040_image, UART, flash_id=flash_id) as bench:
        assert bench.of(Info)[0].digitizer_id == bytes(8)


@pytest.mark.parametrize("image", ["digitizer.bin", "demo.bin"])
def test_a_command_or_1200_baud_restarts_it_as_a_drive(rp2040_image: Path, image: str) -> None:
    """Not before the command is answered; other speeds and lengths do nothing."""
    for ask in (lambda bench: bench.send(Bootsel()), lambda bench: bench.board.set_usb_baud(1200)):
        with Bench(rp2040_image.with_name(image)) as bench:
            bench.write(b"\0" + wrap(b"\x88\x00\x00\x01"))
            bench.board.set_usb_baud(115200)
            bench.run(0.2)
            assert bench.of(Ack)[-1].result == Result.BAD_LENGTH and not bench.board.is_drive
            bench.send(Start())
            ask(bench)
            bench.run(0.02)
            assert bench.of(Ack)[-1].result == Result.OK and not bench.board.is_drive
            bench.run(0.2)
            assert bench.board.is_drive


def test_usb_offers_nothing_in_the_last_fifth_of_a_frame(bench: Bench) -> None:
    """RP2040-E15; what the host may not take then waits, and 680 kB/s get through."""
    bench.stream(replace(PLAIN, samples_per_chip=17), 0.3)
    assert bench.check(bench.line) > 0.27 * 340_000
    assert bench.parser.counters.lost_packets == 0
    assert bench.board.late_packets == 0


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


def test_usb_commands_wait_until_there_is_time_for_them(bench: Bench) -> None:
    """At the highest rate a packet of a frame keeps main() from reading for 3 ms."""
    bench.stream(FAST, 0.02)
    bench.write(3000 * b"\5\1\2\3\4\0")
    bench.run(0.05)
    bench.send(Stop())
    bench.run(1.1)
    assert bench.status.command_errors == 3000


def test_the_link_that_commands_is_answered(bench: Bench) -> None:
    """Two hosts: a packet of one that the other interrupts is broken, and neither gets stuck."""
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


def test_a_usb_host_that_never_reads_leaves_the_uart_alone(bench: Bench) -> None:
    """As a PC that is only the power supply: it configures the device, nobody opens its port."""
    bench.board.plug_usb(reading=False)
    bench.run_deaf(1.2)
    bench.board.read_uart()
    other = PacketWriter()
    for _ in range(2):
        bench.board.write_uart(b"\0" + other.encode(GetInfo()))
        bench.board.run(bench.board.now + 0.1)
        heard = PacketParser().feed(bench.board.read_uart())
        assert [packet.command for packet in heard if isinstance(packet, Ack)][-1:] == [0x81]
        bench.send(GetInfo())  # and doesn't read the answer
        bench.board.run(bench.board.now + 0.01)
    assert not bench.read()
    bench.board.plug_usb()
    bench.send(GetInfo())
    bench.listen_again(0.1)
    assert [ack.command for ack in bench.of(Ack)][-1:] == [0x81]


def test_a_new_usb_host_gets_nothing_of_the_last_one(bench: Bench) -> None:
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
def test_a_port_that_is_closed_ends_the_stream(bench: Bench, by_dtr: bool) -> None:
    """Nothing of before awaits the next program, which may raise DTR or just send a command."""
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
def test_a_halt_that_is_cleared_takes_nothing_away(bench: Bench, reading: bool) -> None:
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


def test_a_cpu_that_was_away(bench: Bench) -> None:
    """Longer than the ring of samples lasts: all are either there or counted, none is doubled."""
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


def test_a_cpu_that_was_away_amid_packing(bench: Bench) -> None:
    """What the next lap overwrites while a packet is made of it is lost, and counted as such."""
    away, most_kept = 16_384 + 200, 16_384 - 16_384 // 4
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


def test_an_adc_whose_samples_were_not_fetched(bench: Bench) -> None:
    """Its FIFO overflows: how many results that cost is known to the sample."""
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


def test_a_sync_pulse_that_comes_too_late(bench: Bench) -> None:
    """Is counted; a new stream begins, and nothing that was sampled before is missing."""
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
    assert first_times.size and np.all(first_counts[: before[0].counts.size] == before[0].counts)  # type: ignore[union-attr]
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
