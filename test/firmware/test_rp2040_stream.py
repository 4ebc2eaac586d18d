# SPDX-License-Identifier: Apache-2.0

"""The RP2040's firmware, run instruction by instruction: conversation, samples and sync pulses."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.code.frame import FrameSpec
from tactile_cdma.wire._protocol import (
    SYNC_FRAME,
    SYNC_RESTART,
    SYNC_UNIT_US,
    Result,
    SyncMode,
)
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
from tactile_cdma.wire.packets import wrap
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

PLAIN = FrameLayout.of(FrameSpec(), 4)  # 80 kS/s
UNIT_NS = SYNC_UNIT_US * 1000


def test_usb_host_configures_the_device(rp2040_image: Path) -> None:
    with Bench(rp2040_image, USB) as bench:
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


def test_usb_answers_of_any_length_come_at_once(rp2040_image: Path) -> None:
    """A transfer ends with a packet that is not full; after a full one, with an empty one."""
    with Bench(rp2040_image, USB) as bench:
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
def test_pulses_and_marks_are_where_they_should_be(rp2040_image: Path, name: str) -> None:
    """To the tick of the ADC's clock; and the first sample of a frame is half a period later."""
    frame = SETUPS[name]
    with Bench(rp2040_image, USB) as bench:
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


def test_stop_and_start_again(rp2040_image: Path) -> None:
    """Even in the middle of a pulse and of a conversion: a new stream knows nothing of the last."""
    with Bench(rp2040_image, USB) as bench:
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


def test_usb_offers_nothing_in_the_last_fifth_of_a_frame(rp2040_image: Path) -> None:
    """RP2040-E15; what the host may not take then waits, and 680 kB/s get through."""
    with Bench(rp2040_image, USB, ramp) as bench:
        bench.stream(replace(PLAIN, samples_per_chip=17), 0.3)
        assert bench.check(bench.line) > 0.27 * 340_000
        assert bench.parser.counters.lost_packets == 0
        assert bench.board.late_packets == 0
