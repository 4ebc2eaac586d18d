# SPDX-License-Identifier: Apache-2.0

"""What arrives over a port, in either direction, as targets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache

import numpy as np

from tactile_cdma.base.errors import SpecError, TactileError
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.session import Session
from tactile_cdma.recording.offline import parameters_of
from tactile_cdma.sim.digitizer import VirtualDigitizer
from tactile_cdma.sim.options import SimOptions
from tactile_cdma.wire._protocol import MAX_SAMPLES, PacketType
from tactile_cdma.wire.messages import (
    WIRE,
    Ack,
    Configure,
    FrameLayout,
    GetInfo,
    Info,
    Pack,
    Packed,
    Packet,
    Quiet,
    Received,
    Samples,
    Start,
    Status,
    Stop,
)
from tactile_cdma.wire.packets import MAX_PACKET, PacketParser, PacketWriter, cobs_decode, wrap
from test.support.same_frames import assert_same

from .target import MiscountError, Target

CONFIG = SkinConfig.of({"nodes": 3, "bits": 8, "chip_us": 50.0, "frame_period_ms": 4.0})
"""A small skin, for speed."""
FRAMES = 5
"""True frames of an input."""
CRC_BYTES = 4
TICK_S = 1e-6
"""Tick of the digitizer's clock, s, from one of whose packets a frame has its time."""


def read_packets(data: bytes) -> None:
    """The parser, fed at once and in pieces whose lengths the data decide."""
    _parsed(data)


def read_bodies(data: bytes) -> None:
    """The parser again, with bodies whose checksums are right: each has its length before it."""
    writer = PacketWriter()
    for packet in _parsed(b"".join(wrap(body) for body in _bodies(data))):
        if isinstance(packet, Packet):
            assert PacketParser().feed(writer.encode(packet)) == [packet], "comes back otherwise"


def _parsed(data: bytes) -> list[Received]:
    whole, pieces = PacketParser(), PacketParser()
    at_once = whole.feed(data)
    one_by_one = []
    begin = 0
    while begin < len(data):
        end = begin + 1 + data[begin] % 64
        one_by_one += pieces.feed(data[begin:end])
        begin = end
    assert at_once == one_by_one, "other packets when split otherwise"
    assert whole.counters == pieces.counters, "other counts when split otherwise"
    assert whole.held <= MAX_PACKET, "more than a packet is held"
    return at_once


def _bodies(data: bytes) -> Iterator[bytes]:
    while data:
        size = data[0]
        yield data[1 : 1 + size]
        data = data[1 + size :]


@cache
def _true_stream() -> list[bytes]:
    """INFO and the packets of the first frames of a skin that always talks."""
    now_s = 0.0
    digitizer = VirtualDigitizer(SimOptions(scene="moving", threshold=0, noise=0.0), lambda: now_s)
    digitizer.receive(Session(CONFIG).open())
    for _ in range(FRAMES * 4):
        now_s += CONFIG.spec.frame_period_s / 4
        digitizer.advance()
    runs = digitizer.take(1 << 20).split(b"\0")
    packets = [run + b"\0" for run in runs if run]
    kinds = [type(PacketParser().feed(packet)[0]) for packet in packets]
    return packets[kinds.index(Info) :]


@cache
def _true_frames() -> dict[int, TactileFrame]:
    """By number on the wire, what these packets hold."""
    pipeline = Pipeline(CONFIG)
    frames = [frame for packet in _true_stream() for frame in pipeline.feed(packet, 0.0)]
    assert len(frames) >= FRAMES - 1 and all(frame.words.active.all() for frame in frames)
    return {_number(frame): frame for frame in frames}


def _number(frame: TactileFrame) -> int:
    return round(frame.t_start / CONFIG.spec.frame_period_s)


def read_line(data: bytes) -> None:
    """A true stream with hostile bytes between its packets: only true frames may come of it.

    The data are pieces: how many packets pass (and whether the next is left out), how many hostile
    bytes follow, and these.
    """
    stream = _true_stream()
    pipeline = Pipeline(CONFIG)
    frames, place = pipeline.feed(stream[0], 0.0), 1
    left = len(stream) - 2  # the last two come in any case: what is lost shows by them
    while len(data) >= 2 and place < left:
        passed, size = data[0] & 0x0F, data[1]
        for packet in stream[place : min(place + passed, left)]:
            frames += pipeline.feed(packet, 0.0)
        place = min(place + passed, left) + (data[0] >> 7)
        frames += pipeline.feed(data[2 : 2 + size], 0.0)
        data = data[2 + size :]
    frames += pipeline.feed(b"\0", 0.0)
    for packet in stream[place:]:
        frames += pipeline.feed(packet, 0.0)
    _check_line(pipeline, frames)


def _check_line(pipeline: Pipeline, frames: list[TactileFrame]) -> None:
    counters = pipeline.parser.counters
    if counters.packets + counters.lost_packets != len(_true_stream()):
        raise MiscountError(f"{counters} of {len(_true_stream())} packets")
    for frame in frames:
        true = _true_frames().get(_number(frame))
        assert true is not None, "a frame that was never sent"
        assert abs(frame.t_start - true.t_start) < 2 * TICK_S, "a frame at a wrong time"
        assert np.array_equal(frame.words.active, true.words.active), "others spoke"
        assert np.array_equal(frame.words.codes, true.words.codes), "other words"
        passed = frame.sequence - frames[0].sequence
        if passed != _number(frame) - _number(frames[0]):
            raise MiscountError(f"{passed} frames")


def read_both_ways(data: bytes) -> None:
    """A true stream, of which packets are changed and have the right checksum all the same.

    However it is split, the same must come of it. The data are pieces: how many packets pass (and
    whether the next comes twice), where its change begins, the length of the change, the change.
    """
    ways = {97: Pipeline(CONFIG), 4096: Pipeline(CONFIG)}
    sent, place, stream = bytearray(_true_stream()[0]), 1, _true_stream()
    while len(data) >= 3 and place < len(stream):
        passed, begin, size = data[0] & 0x07, data[1], data[2] & 0x1F
        sent += b"".join(stream[place : place + passed])
        place += passed
        for packet in stream[place : place + 1] * (1 + (data[0] >> 7)):
            body = bytearray(cobs_decode(packet[:-1])[:-CRC_BYTES])
            for index, change in zip(range(begin, len(body)), data[3 : 3 + size], strict=False):
                body[index] ^= change
            sent += wrap(bytes(body))
        place += 1
        data = data[3 + size :]
    sent += b"".join(stream[place:])
    found = []
    for size, pipeline in ways.items():
        frames: list[TactileFrame] = []
        for begin in range(0, len(sent), size):
            frames += pipeline.feed(bytes(sent[begin : begin + size]), 0.0)
        found.append(frames + pipeline.flush())
    assert_same(*found)
    counted = [
        (way.counters, way.packet_counts, way.rejections, way.digitizer) for way in ways.values()
    ]
    assert counted[0] == counted[1], "other counts"


def read_digitizer(data: bytes) -> None:
    """Intact packets of a digitizer that says anything; the pipeline takes each with its next.

    The data are pieces: a type, then what is changed in a packet of it that makes sense.
    """
    pipeline = Pipeline(CONFIG)
    pipeline.feed(wrap(_body(Info.TYPE, _templates()[Info.TYPE])), 0.0)
    t_host = 0.0
    for kind, payload in _changed(data, tuple(_templates())):
        t_host += 1e-3
        for frame in pipeline.feed(wrap(_body(kind, payload)), t_host):
            assert frame.words.codes.max() < 2**CONFIG.spec.bits, "no such word"
            assert np.isfinite(frame.t_host), "at no time"
            pressure_pa = frame.readings.pressure_pa
            assert not np.isinf(pressure_pa).any(), "an infinite pressure"


def read_offline(data: bytes) -> None:
    """A capture in which a digitizer describes any skin, as the command line decodes it."""
    for kind, payload in _changed(data, (Info.TYPE,)):
        for info in PacketParser().feed(wrap(_body(kind, payload))):
            if isinstance(info, Info) and info.frame.nodes <= 256 and info.frame.order <= 512:
                pipeline = Pipeline(SkinConfig.of(parameters_of(info)))
                pipeline.feed(PacketWriter().encode(info), 0.0)
                for packet in _true_stream()[1:]:
                    pipeline.feed(packet, 0.0)
                pipeline.flush()


def read_commands(data: bytes) -> None:
    """Commands to the virtual digitizer that make sense or not: each has one answer."""
    digitizer = VirtualDigitizer(SimOptions(scene="moving"), lambda: 0.0)
    kinds = (Configure.TYPE, GetInfo.TYPE, Start.TYPE, Stop.TYPE, Pack.TYPE)
    for kind, payload in _changed(data, kinds):
        if kind == Configure.TYPE and int.from_bytes(payload[:2], "little") > 256:
            continue  # such skins are simulated, but not quickly
        digitizer.receive(wrap(_body(kind, payload)))
        answers = PacketParser().feed(digitizer.take(1 << 20))
        assert sum(isinstance(answer, Ack) for answer in answers) == 1, "not one answer"


def _body(kind: int, payload: bytes) -> bytes:
    return WIRE["Header"].pack(kind, 0) + payload


@cache
def _templates() -> Mapping[int, bytes]:
    """Payloads that make sense, by type."""
    (info,) = PacketParser().feed(_true_stream()[0])
    assert isinstance(info, Info)
    layout = FrameLayout.of(CONFIG.spec, CONFIG.samples_per_chip)
    samples = int(CONFIG.spec.span_chips * CONFIG.samples_per_chip)
    counts = np.resize(np.array([-300, 300, 300, -300], np.int16), samples)
    packets: list[Packet] = [
        info,
        Samples(0, 0, counts, sync=True),
        Packed(0, 0, counts, sync=True, base=-2048),
        Quiet(0, 0, samples, 0, 0, sync=True),
        Status(0),
        Ack(PacketType.START, 0),
        GetInfo(),
        Start(),
        Stop(),
        Pack(),
        Configure(layout),
    ]
    return {packet.TYPE: packet.pack() for packet in packets}


def _changed(data: bytes, kinds: tuple[int, ...]) -> Iterator[tuple[int, bytes]]:
    """Packets, each from a piece of the data: a type, the length of the change, the change.

    It is XORed to the beginning of what makes sense; with the top bit of its length set the
    packet is cut off there.
    """
    templates = _templates()
    while len(data) >= 2:
        kind, size = kinds[data[0] % len(kinds)], data[1] & 0x7F
        change, template = data[2 : 2 + size], templates[kind]
        rest = b"" if data[1] & 0x80 else template[len(change) :]
        yield kind, bytes(a ^ b for a, b in zip(change, template, strict=False)) + rest
        data = data[2 + size :]


def _seeds_of_packets() -> Mapping[str, bytes]:
    stream = _true_stream()
    writer = PacketWriter()
    kinds = [Status(0), Ack(PacketType.START, 0), GetInfo(), Start(), Stop(), Pack()]
    return {
        "info": stream[0],
        "stream": b"".join(stream[:4]),
        "small": b"".join(writer.encode(packet) for packet in kinds),
        "text": b"ready\r\nreading 1.25 V\r\n",
        "zeros": bytes(8),
        "long": bytes([1]) * (MAX_PACKET + 2) + b"\0",
        "most": writer.encode(Samples(0, 0, np.zeros(MAX_SAMPLES, np.int16))),
    }


def _seeds_of_bodies() -> Mapping[str, bytes]:
    bodies = {str(kind): _body(kind, payload) for kind, payload in _templates().items()}
    short = {name: body for name, body in bodies.items() if len(body) < 256}
    return {name: bytes([len(body)]) + body for name, body in short.items()}


def _seeds_of_changes() -> Mapping[str, bytes]:
    several = bytes(part for kind in (0, 1, 1, 2, 1, 3, 4, 1) for part in (kind, 0))
    moved = bytes([1, 17, *range(17)])
    return {"nothing": bytes(8), "several": several, "moved": moved * 3, "cut": bytes([0, 0x84, 1])}


def _seeds_of_line() -> Mapping[str, bytes]:
    return {
        "nothing": b"",
        "noise": bytes([2, 4, 1, 2, 3, 4, 0x81, 3, 0, 5, 0, 1, 0]),
        "unended": bytes([3, 2, 9, 9, 2, 1, 0]),
    }


TARGETS = (
    Target("packets", read_packets, _seeds_of_packets, most_bytes=96),
    Target("bodies", read_bodies, _seeds_of_bodies, most_bytes=128),
    Target("line", read_line, _seeds_of_line, most_bytes=256),
    Target("both ways", read_both_ways, _seeds_of_line, most_bytes=256),
    Target("digitizer", read_digitizer, _seeds_of_changes, most_bytes=256),
    Target("offline", read_offline, _seeds_of_changes, (TactileError,), most_bytes=256),
    Target("commands", read_commands, _seeds_of_changes, (SpecError,), most_bytes=256),
)
