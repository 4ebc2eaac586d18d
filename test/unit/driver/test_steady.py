# SPDX-License-Identifier: Apache-2.0

"""A stream that the kernel follows gives the same as the stages, to the bit, whatever happens."""

import gc
import os
import threading
from contextlib import suppress
from dataclasses import fields
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_cdma.base import kernel
from tactile_cdma.code.transform import compiled_transform
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.levels import LevelDecoder
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.steady import Event
from tactile_cdma.framing.line_timing import CARRIED_FRAMES
from tactile_cdma.wire._protocol import Result
from tactile_cdma.wire.messages import Ack, Info, Packed, Quiet, Samples, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.simulated import stream

pytestmark = pytest.mark.skipif(kernel.compiled is None, reason="the kernel is not used")

SMALL: dict[str, object] = {}
LARGE = {"nodes": 256, "chip_us": 8.0, "frame_period_ms": 40.0}
CHIPS: dict[str, object] = {"samples_per_chip": 1}
FULL = {"nodes": 16, "order": 16, "first_row": 0}
FRAMES = 150  # more than twice what one timing is used for


@cache
def sent(parameters: tuple[tuple[str, object], ...], url: str, frames: int = FRAMES) -> bytes:
    return stream(SkinConfig.of(dict(parameters)), url, frames)


class Followed:
    """A pipeline, and how much of the stream it left to the kernel."""

    def __init__(self, config: SkinConfig, in_stages: bool = False) -> None:
        self.pipeline = Pipeline(config, background=False)
        self.in_stages = in_stages
        self.steady_frames = 0

    def feed(self, data: bytes, t_host: float, backlog: bool = False) -> list[TactileFrame]:
        if self.in_stages:  # whatever could be left to the kernel is decided here
            self.pipeline._steady = None
            return [
                frame
                for begin in range(0, len(data), 64)
                for frame in self._feed_in_stages(data[begin : begin + 64], t_host, backlog)
            ]
        was_steady = self.pipeline.is_steady
        frames = self.pipeline.feed(data, t_host, backlog)
        self.steady_frames += len(frames) * was_steady
        return frames

    def _feed_in_stages(self, data: bytes, t_host: float, backlog: bool) -> list[TactileFrame]:
        frames = self.pipeline.feed(data, t_host, backlog)
        assert not self.pipeline.is_steady, "64 bytes introduce no digitizer and end a frame"
        self.pipeline._steady = None
        return frames


def outcome(followed: Followed, data: bytes, chunk: int) -> tuple[list[TactileFrame], object]:
    frames: list[TactileFrame] = []
    for begin in range(0, len(data), chunk):
        # Bytes are stamped by their place, so that the clock does not depend on the chunks.
        for part in range(begin, min(begin + chunk, len(data)), 997):
            stop = min(part + 997, begin + chunk)
            frames += followed.feed(data[part:stop], part * 2e-7, part % 3 == 0)
    frames += followed.pipeline.flush()
    pipeline = followed.pipeline
    told = pipeline.counters, pipeline.packet_counts, pipeline.rejections, pipeline.digitizer
    return frames, told


def assert_same(some: list[TactileFrame], others: list[TactileFrame]) -> None:
    assert len(some) == len(others)
    for one, other in zip(some, others, strict=True):
        for name in ("sequence", "t_start", "t_middle", "t_host", "chip_s", "clipped"):
            assert getattr(one, name) == getattr(other, name), name
        for part in ("words", "readings"):
            mine, theirs = getattr(one, part), getattr(other, part)
            for item in fields(mine):
                values = getattr(mine, item.name), getattr(theirs, item.name)
                np.testing.assert_array_equal(*values, err_msg=f"{part}.{item.name}")


def compare(config: SkinConfig, data: bytes, chunk: int = 997) -> Followed:
    followed = Followed(config)
    frames, told = outcome(followed, data, chunk)
    expected, expected_told = outcome(Followed(config, in_stages=True), data, chunk)
    assert_same(frames, expected)
    assert told == expected_told
    return followed


CASES = [
    (SMALL, "scene=moving"),
    (SMALL, "scene=all&threshold=0"),
    (SMALL, "scene=idle"),
    (SMALL, "scene=idle&heartbeat=0"),
    (SMALL, "scene=hand&noise=0.05"),
    (SMALL, "scene=all&threshold=0&noise=0.3"),
    (SMALL, "scene=idle&heartbeat=0&noise=0.4"),
    (SMALL, "scene=all&threshold=0&stretch=0.1"),
    (SMALL, "scene=moving&jitter=0.1"),
    (SMALL, "scene=all&threshold=0&rail=1.0"),
    (SMALL, "scene=moving&offset=0.7&clock_spread=1e-4"),
    (SMALL, "scene=presses&dead=3,5&sensor=paper"),
    ({"samples_per_chip": 8}, "scene=moving"),
    ({"parity": True}, "scene=all&threshold=0&noise=0.2"),
    ({"drive": "unipolar"}, "scene=moving"),
    ({"polarity": -1}, "scene=moving"),
    ({"amplitude_mv": 0.0}, "scene=moving"),
    (FULL, "scene=all&threshold=0"),
    (FULL, "scene=moving&offset=0.3"),
    ({"resync_chips": 20, "guard_chips": 1, "frame_period_ms": 15.0}, "scene=moving"),
    (CHIPS, "scene=moving&offset=0.2"),
    (CHIPS, "scene=all&threshold=0&noise=0.3"),
    (CHIPS, "scene=idle"),
    (CHIPS | FULL, "scene=moving"),
    (CHIPS | {"drive": "unipolar"}, "scene=moving"),
    (LARGE | CHIPS, "scene=hand"),
    (LARGE, "scene=hand"),
    (LARGE, "scene=all&threshold=0"),
]


@pytest.mark.parametrize("parameters, options", CASES, ids=lambda case: str(case))
def test_frames_are_those_of_the_stages(parameters: dict[str, object], options: str) -> None:
    data = sent(tuple(parameters.items()), f"sim://?seed=1&{options}")
    compare(SkinConfig.of(parameters), data)


@pytest.mark.parametrize("parameters", [SMALL, CHIPS])
@pytest.mark.parametrize("options", ["scene=all&threshold=0", "scene=idle", "scene=moving"])
def test_most_frames_of_a_sound_skin_are_left_to_the_kernel(
    parameters: dict[str, object], options: str
) -> None:
    config = SkinConfig.of(parameters)
    followed = compare(config, sent(tuple(parameters.items()), f"sim://?seed=1&{options}", 200))
    assert followed.steady_frames > 190 - 4 * (200 // CARRIED_FRAMES)


@pytest.mark.parametrize("chunk", [1, 7, 64, 500, 1 << 14, 1 << 22])
def test_any_split_gives_the_same(chunk: int) -> None:
    config, data = SkinConfig.of(SMALL), sent((), "sim://?seed=1&scene=moving")
    whole, parts = Pipeline(config, background=False), Pipeline(config, background=False)
    expected = whole.feed(data, 1.0) + whole.flush()
    frames = [
        frame
        for begin in range(0, len(data), chunk)
        for frame in parts.feed(data[begin : begin + chunk], 1.0)
    ]
    assert_same(frames + parts.flush(), expected)
    assert parts.packet_counts == whole.packet_counts
    assert parts.counters == whole.counters


@settings(max_examples=60, deadline=None)
@given(
    case=st.sampled_from([CASES[0], CASES[2], CASES[17]]),
    damages=st.lists(
        st.tuples(
            st.sampled_from(["flip", "cut", "repeat", "zero", "insert"]),
            st.floats(0.02, 1),
            st.integers(1, 4000),
        ),
        max_size=6,
    ),
    chunk=st.sampled_from([61, 997, 20_000]),
)
def test_damage_gives_the_same(
    case: tuple[dict[str, object], str], damages: list[tuple[str, float, int]], chunk: int
) -> None:
    parameters, options = case
    data = bytearray(sent(tuple(parameters.items()), f"sim://?seed=1&{options}", 60))
    for kind, share, size in damages:
        at = int(share * (len(data) - 1))
        if kind == "flip":
            data[at] ^= 1 << size % 8
        elif kind == "cut":
            del data[at : at + size]
        elif kind == "repeat":
            data[at:at] = data[at : at + size]
        elif kind == "zero":
            data[at : at + size % 40] = bytes(size % 40)
        else:
            data[at:at] = np.random.default_rng(size).bytes(size % 300)
    compare(SkinConfig.of(parameters), bytes(data), chunk)


def edited(data: bytes, edit: object) -> bytes:
    """The packets of a stream, each as `edit` makes it: None, one or a list."""
    writer, made = PacketWriter(), b""
    for number, packet in enumerate(PacketParser().feed(data)):
        result = edit(number, packet)  # type: ignore[operator]
        for one in result if isinstance(result, list) else [result]:
            if one is not None:
                made += writer.encode(one)
    return made


def other(packet: Samples | Quiet, **changes: int | bool) -> Samples | Quiet:
    return type(packet)(
        **{item.name: changes.get(item.name, getattr(packet, item.name)) for item in fields(packet)}
    )


def is_samples(packet: object) -> bool:
    return isinstance(packet, (Samples, Quiet))


SPOILT = {
    "a mark is missing": lambda n, p: other(p, sync=False) if is_samples(p) and n == 100 else p,
    "a mark too many": lambda n, p: other(p, sync=True) if is_samples(p) and n == 101 else p,
    "samples were lost": lambda n, p: other(p, overrun=True) if is_samples(p) and n == 100 else p,
    "a roll call": lambda n, p: other(p, called=True) if is_samples(p) and n > 100 else p,
    "a packet is missing": lambda n, p: None if n == 100 else p,
    "time stands still": lambda n, p: (
        other(p, device_time_us=1000) if is_samples(p) and n > 100 else p
    ),
    "time leaps": lambda n, p: (
        other(p, device_time_us=p.device_time_us + 200_000) if is_samples(p) and n > 100 else p
    ),
    "indices leap": lambda n, p: (
        other(p, first_index=p.first_index + 12_345) if is_samples(p) and n > 100 else p
    ),
    "beyond any clock": lambda n, p: (
        other(p, device_time_us=1 << 60) if is_samples(p) and n == 100 else p
    ),
    "a status between": lambda n, p: [p, Status(5)] if n % 50 == 0 else p,
    "an answer between": lambda n, p: [p, Ack(0x81, 7, Result.OK)] if n % 50 == 0 else p,
    "a loud sample": lambda n, p: (
        other(p, counts=np.full_like(p.counts, 2047)) if isinstance(p, Samples) and n == 100 else p
    ),
    "another digitizer": lambda n, p: (
        [p, Info(**{f.name: getattr(INFO, f.name) for f in fields(Info)} | {"quiet_uv": 3})]
        if n == 100
        else p
    ),
}
[INFO] = [
    packet
    for packet in PacketParser().feed(sent((), "sim://?seed=1&scene=moving"))
    if isinstance(packet, Info)
][:1]


@pytest.mark.parametrize("what", SPOILT)
@pytest.mark.parametrize("options", ["scene=moving", "scene=idle&heartbeat=20"])
def test_packets_that_do_not_go_on_are_left_to_the_stages(what: str, options: str) -> None:
    data = edited(sent((), f"sim://?seed=1&{options}"), SPOILT[what])
    compare(SkinConfig.of(SMALL), data)


@pytest.mark.parametrize("parameters", [SMALL, CHIPS])
def test_packed_samples_are_followed_like_others(parameters: dict[str, object]) -> None:
    """Frame for frame the same, and by the kernel, though packets come in either form."""
    config = SkinConfig.of(parameters)
    data = sent(tuple(parameters.items()), "sim://?seed=1&scene=all&threshold=0", 200)

    def pack(number: int, packet: object) -> object:
        if not isinstance(packet, Samples) or number % 7 == 0:
            return packet
        values = {item.name: getattr(packet, item.name) for item in fields(packet)}
        return Packed(**values, base=-2048)

    packed = edited(data, pack)
    assert len(packed) < 0.85 * len(data)
    followed = compare(config, packed)
    assert followed.steady_frames > 190 - 4 * (200 // CARRIED_FRAMES)
    plain, _ = outcome(Followed(config), data, 997)
    frames, _ = outcome(Followed(config), packed, 997)  # at other times: of fewer bytes
    assert len(frames) == len(plain)
    for one, other in zip(frames, plain, strict=True):
        np.testing.assert_array_equal(one.words.codes, other.words.codes)
        np.testing.assert_array_equal(one.words.rho, other.words.rho)


def at_the_rail(number: int, packet: object) -> object:
    """The amplifier is stuck at a rail from a certain packet on, whatever the nodes say."""
    if number <= 100 or not is_samples(packet):
        return packet
    top = INFO.max_count
    if isinstance(packet, Samples):
        return other(packet, counts=np.full_like(packet.counts, top))
    count = packet.count
    return other(packet, sum=count * top, sum_of_squares=count * top * top)


@pytest.mark.parametrize("options", ["scene=all&threshold=0", "scene=idle&heartbeat=0"])
def test_a_line_that_is_stuck_at_a_rail_is_not_called_silent(options: str) -> None:
    data = edited(sent((), f"sim://?seed=1&{options}"), at_the_rail)
    followed = compare(SkinConfig.of(SMALL), data)
    whole = Followed(SkinConfig.of(SMALL))
    frames, _ = outcome(whole, data, 997)
    assert followed.steady_frames > 10, "it was followed before"
    assert len(frames) < FRAMES - 10
    assert whole.pipeline.rejections.at_rail > 10


def test_waiting_at_a_file_gives_what_giving_bytes_gives() -> None:
    config, data = SkinConfig.of(SMALL), sent((), "sim://?seed=1&scene=moving")
    expected = Pipeline(config, background=False).feed(data, 1.0)
    pipeline = Pipeline(config, background=False)
    reader, writer = os.pipe()
    frames: list[TactileFrame] = []
    first = len(data) // 4
    frames += pipeline.feed(data[:first], 1.0)
    assert pipeline.is_steady

    def write() -> None:
        for begin in range(first, len(data), 333):
            os.write(writer, data[begin : begin + 333])

    thread = threading.Thread(target=write)
    thread.start()
    while len(frames) < len(expected):
        if pipeline.is_steady:
            waited = pipeline.wait(reader, 1000)
            assert waited.event is not Event.MORE, "bytes are missing"
            frames += pipeline.take(waited)
        else:
            frames += pipeline.feed(os.read(reader, 4096), 1.0)
    thread.join()
    for one, other_one in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(one.readings.pressure_pa, other_one.readings.pressure_pa)
        assert one.t_start == other_one.t_start
    if pipeline.is_steady:
        assert pipeline.wait(reader, 1).event is Event.MORE
        os.close(writer)
        with pytest.raises(OSError, match="end of file"):
            pipeline.wait(reader, 1000)
    else:
        os.close(writer)
    os.close(reader)


def test_counts_may_be_read_while_another_thread_waits() -> None:
    config, data = SkinConfig.of(SMALL), sent((), "sim://?seed=1&scene=moving")
    pipeline = Pipeline(config, background=False)
    pipeline.feed(data[: len(data) // 4], 1.0)
    assert pipeline.is_steady
    before = pipeline.packet_counts
    reader, writer = os.pipe()

    def wait() -> None:
        with suppress(OSError):  # end of file
            pipeline.wait(reader, 2000)

    thread = threading.Thread(target=wait)
    thread.start()
    while not threading.active_count() > 1:
        pass
    assert pipeline.packet_counts == before
    os.close(writer)
    with pytest.raises(RuntimeError, match="another thread"):
        while thread.is_alive():
            pipeline.wait(reader, 0)
        raise RuntimeError("another thread was quicker")
    thread.join()
    os.close(reader)


def test_bytes_that_were_read_are_decoded_before_others_are_left_out() -> None:
    config, data = SkinConfig.of(SMALL), sent((), "sim://?seed=1&scene=moving")
    expected = Pipeline(config, background=False).feed(data, 1.0)
    pipeline = Pipeline(config, background=False)
    half = len(data) // 2
    frames = pipeline.feed(data[:half], 1.0)
    assert pipeline.is_steady
    reader, writer = os.pipe()
    os.write(writer, data[half : half + 30_000])
    while len(frames) <= len(expected) // 2:
        frames += pipeline.take(pipeline.wait(reader, 0))
    frames += pipeline.settle()
    pipeline.skipped(5000)
    assert not pipeline.is_steady
    assert pipeline.counters.skipped_bytes == 5000
    os.close(reader), os.close(writer)
    for one, other_one in zip(frames, expected, strict=False):
        np.testing.assert_array_equal(one.readings.pressure_pa, other_one.readings.pressure_pa)


def test_arguments_that_do_not_fit_are_refused() -> None:
    assert kernel.compiled is not None
    config = SkinConfig.of(SMALL)
    pipeline = Pipeline(config, background=False)
    pipeline.feed(sent((), "sim://?seed=1&scene=moving"), 1.0)
    levels = pipeline._levels
    assert isinstance(levels, LevelDecoder) and pipeline._steady is not None
    steady, parser = pipeline._steady._kernel, PacketParser()
    rows, setting = np.empty((10, 20), np.float32), np.zeros(43)
    with pytest.raises(TypeError, match="not a Scanner"):
        kernel.compiled.Steady(3, 3, setting, rows)
    with pytest.raises(TypeError, match="not a Transform"):
        kernel.compiled.Steady(parser.scanner, parser.scanner, setting, rows)
    transform = compiled_transform((2, 2), True)
    with pytest.raises(ValueError, match="no frame of this code"):
        kernel.compiled.Steady(parser.scanner, transform, setting, rows)
    with pytest.raises(ValueError, match="43"):
        kernel.compiled.Steady(parser.scanner, transform, setting[1:], rows)
    steady.leave()
    place = (0, 0, 0, 0, 0, 1, 0.0, 0.0, (0.0, 0.0, 0.0), np.empty(0))
    with pytest.raises(ValueError, match="fewer samples"):
        steady.enter(*place, 3, 0, 1, None)
    edges = np.arange(3, dtype=np.int32), np.zeros(3), np.ones(2), np.zeros(200, np.int32)
    with pytest.raises(ValueError, match="does not fit"):
        steady.enter(*place, 1000, 0, 1, (4.0, 2000, 900, 10, *edges))
    with pytest.raises(ValueError, match="does not fit"):
        steady.enter(*place, 1000, 0, 1, (4.0, 800, 995, 10, *edges))
    with pytest.raises(ValueError, match="values"):
        steady.enter(*place, 1000, 0, 1, (4.0, 800, 900, 10, *edges[:3], edges[0]))
    steady.enter(*place, 1000, 0, 1, None)
    steady.give(b"\1\2", 0.0, False)
    with pytest.raises(RuntimeError, match="not used up"):
        steady.give(b"\3", 0.0, False)
    del steady, pipeline
    gc.collect()
