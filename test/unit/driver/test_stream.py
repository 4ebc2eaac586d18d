# SPDX-License-Identifier: Apache-2.0

"""The stream gives the same frames, to the bit, however its bytes are split, whatever happens."""

import math
import os
import threading
from contextlib import suppress
from dataclasses import fields
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base import kernel
from tactile_cdma.code.transform import Transform
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.compiled_stream import CompiledStream, _rules
from tactile_cdma.driver.description import Description
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.stream import Decisions
from tactile_cdma.driver.timeline import Answer
from tactile_cdma.framing.line_timing import CARRIED_FRAMES
from tactile_cdma.readings import taxels
from tactile_cdma.wire._protocol import Result
from tactile_cdma.wire.messages import WIRE, Ack, Info, Packed, Quiet, Samples, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.examples import examples
from test.support.same_frames import assert_same
from test.support.simulated import stream

SMALL: dict[str, object] = {}
LARGE = {"nodes": 256, "chip_us": 8.0, "frame_period_ms": 40.0}
CHIPS: dict[str, object] = {"samples_per_chip": 1}
FULL = {"nodes": 16, "order": 16, "first_row": 0}
FRAMES = 150  # more than twice what one timing is used for


@cache
def sent(parameters: tuple[tuple[str, object], ...], url: str, frames: int = FRAMES) -> bytes:
    return stream(SkinConfig.of(dict(parameters)), url, frames)


def outcome(
    pipeline: Pipeline, data: bytes, chunk: int, pieces: int = 1
) -> tuple[list[TactileFrame], object]:
    """The frames of a stream, and what was counted and learnt.

    chunk: bytes that are read at once. pieces: in how many these are given.
    """
    frames: list[TactileFrame] = []
    for begin in range(0, len(data), chunk):
        read, size = data[begin : begin + chunk], -(-chunk // pieces)
        for part in range(0, len(read), size):
            # The clock depends on when bytes were read, and not on the pieces.
            frames += pipeline.feed(read[part : part + size], begin * 2e-7, begin % 3 == 0)
    frames += pipeline.flush()
    health = pipeline.health
    learnt = health.invalid.tolist(), health.suspect.tolist(), str(health.swing_v)
    counted = pipeline.counters, pipeline.packet_counts, pipeline.rejections
    return frames, (*counted, pipeline.digitizer, learnt)


def compare(config: SkinConfig, data: bytes, chunk: int = 997) -> Pipeline:
    """Decode a stream as it is read, and in small pieces; returns the first pipeline."""
    pipeline, other = Pipeline(config), Pipeline(config)
    frames, told = outcome(pipeline, data, chunk)
    expected, expected_told = outcome(other, data, chunk, pieces=7)
    assert_same(frames, expected)
    assert told == expected_told
    assert pipeline.decisions.total >= len(frames)
    return pipeline


TIGHT = {"frame_period_ms": 10.1}  # the next mark comes before it is seen how a frame ends
GAP = {"timing": "gap"}
PAUSES = {"resync_chips": 20, "guard_chips": 1, "frame_period_ms": 15.0}
SCRAMBLED = {"scramble": True}
SPARSE = {"codes": "sparse", "nodes": 120, "order": 32, "frame_period_ms": 20.0, **CHIPS}
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
    (SPARSE, "scene=moving"),
    (SPARSE, "scene=hand&noise=0.05&offset=0.3"),
    (SPARSE, "scene=all&threshold=0"),
    ({"samples_per_chip": 8}, "scene=moving"),
    ({"parity": True}, "scene=all&threshold=0&noise=0.2"),
    ({"drive": "unipolar"}, "scene=moving"),
    ({"polarity": -1}, "scene=moving"),
    ({"amplitude_mv": 0.0}, "scene=moving"),
    (FULL, "scene=all&threshold=0"),
    (FULL, "scene=moving&offset=0.3"),
    (PAUSES, "scene=moving"),
    (PAUSES | CHIPS, "scene=moving"),
    (CHIPS, "scene=moving&offset=0.2"),
    (CHIPS, "scene=all&threshold=0&noise=0.3"),
    (CHIPS, "scene=idle"),
    (CHIPS | FULL, "scene=moving"),
    (CHIPS | {"drive": "unipolar"}, "scene=moving"),
    (LARGE | CHIPS, "scene=hand"),
    (LARGE, "scene=hand"),
    (LARGE, "scene=all&threshold=0"),
    (SCRAMBLED, "scene=moving&offset=0.2"),
    (SCRAMBLED, "scene=idle&heartbeat=0&noise=0.1"),
    (SCRAMBLED | CHIPS, "scene=all&threshold=0"),
    (SCRAMBLED | CHIPS, "scene=moving&offset=0.2"),
    (SCRAMBLED | LARGE, "scene=hand"),
    (TIGHT, "scene=moving"),
    (TIGHT | FULL, "scene=all&threshold=0"),
    (GAP, "scene=moving&stretch=0.1"),
]


@pytest.mark.parametrize("parameters, options", CASES, ids=lambda case: str(case))
def test_frames_do_not_depend_on_the_split(parameters: dict[str, object], options: str) -> None:
    in_python = "noise" in options or "rail" in options or "stretch" in options
    frames = FRAMES // 2 if in_python or parameters.keys() >= LARGE.keys() else FRAMES
    data = sent(tuple(parameters.items()), f"sim://?seed=1&{options}", frames)
    compare(SkinConfig.of(parameters), data)


@pytest.mark.parametrize(
    "parameters", [SMALL, CHIPS, TIGHT, PAUSES | CHIPS, SCRAMBLED, SCRAMBLED | CHIPS, FULL]
)
@pytest.mark.parametrize("options", ["scene=all&threshold=0", "scene=idle", "scene=moving"])
def test_nearly_all_frames_of_a_sound_skin_are_decided_by_the_kernel(
    parameters: dict[str, object], options: str
) -> None:
    pipeline = Pipeline(SkinConfig.of(parameters))
    outcome(pipeline, sent(tuple(parameters.items()), f"sim://?seed=1&{options}", 200), 997)
    assert pipeline.decisions.compiled > 195 - (200 // CARRIED_FRAMES + 1)
    assert pipeline.decisions.python_share < 0.05


@pytest.mark.parametrize("options", ["scene=moving", "scene=idle&heartbeat=8"])  # all, two nodes
@pytest.mark.parametrize("parameters", [SMALL, {"drive": "unipolar"}, SCRAMBLED, FULL])
def test_words_of_a_sound_skin_are_read_in_one_call(
    parameters: dict[str, object], options: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of few words Python is asked where they leave energy over; those of sound nodes do not."""
    looked: list[object] = []
    for name in ("few_differ", "out_of_place"):
        monkeypatch.setattr(taxels, name, lambda *arguments: looked.append(arguments))
    config = SkinConfig.of(parameters)
    pipeline = Pipeline(config)
    frames = pipeline.feed(sent(tuple(parameters.items()), f"sim://?seed=1&{options}"), 0.0)
    assert sum(frame.words.active.any() for frame in frames) > 20
    assert not looked and not pipeline.decisions.words_in_python


@pytest.mark.parametrize(
    ("parameters", "options", "reason"),
    [
        (SMALL, "scene=all&threshold=0&stretch=0.1", "unexplained"),
        (SMALL, "scene=all&threshold=0&rail=1.0", "clipped"),
        (SMALL, "scene=idle&heartbeat=0&noise=0.4", "no timing yet"),
        (GAP, "scene=moving", "gap timing"),
    ],
)
def test_why_frames_are_decided_in_python_is_told(
    parameters: dict[str, object], options: str, reason: str
) -> None:
    pipeline = Pipeline(SkinConfig.of(parameters))
    outcome(pipeline, sent(tuple(parameters.items()), f"sim://?seed=1&{options}", 60), 997)
    assert pipeline.decisions.in_python.most_common(1)[0][0] == reason
    assert pipeline.decisions.python_share > 0.9
    assert (pipeline.decisions.words_in_python > 50) == (reason == "clipped")


def test_decisions_are_counted_from_any_moment() -> None:
    config, data = SkinConfig.of(SMALL), sent((), "sim://?seed=1&scene=moving")
    pipeline = Pipeline(config)
    pipeline.feed(data[: len(data) // 3], 1.0)
    before = pipeline.decisions.since(Decisions())
    copied = before.compiled, before.reasons
    frames = pipeline.feed(data[len(data) // 3 :], 1.0)
    assert before.total and (before.compiled, before.reasons) == copied
    assert pipeline.decisions.since(before).total == len(frames)
    assert pipeline.decisions.total == pipeline.counters.frames == before.total + len(frames)
    assert not pipeline.decisions.since(pipeline.decisions).total


@pytest.mark.parametrize(
    ("parameters", "chunk"),
    [*((SMALL, chunk) for chunk in (1, 7, 500, 1 << 14)), (GAP, 7), (GAP, 1500)],
)
def test_any_split_gives_the_same(parameters: dict[str, object], chunk: int) -> None:
    config = SkinConfig.of(parameters)
    data = sent(tuple(parameters.items()), "sim://?seed=1&scene=moving", 40)
    whole, parts = Pipeline(config), Pipeline(config)
    expected = whole.feed(data, 1.0) + whole.flush()
    frames = [
        frame
        for begin in range(0, len(data), chunk)
        for frame in parts.feed(data[begin : begin + chunk], 1.0)
    ]
    assert_same(frames + parts.flush(), expected)
    assert parts.packet_counts == whole.packet_counts
    assert parts.counters == whole.counters


@examples(60)
@given(
    case=st.sampled_from([CASES[0], CASES[2], CASES[17], CASES[28], CASES[32], CASES[34]]),
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


class Impossible:
    """Samples whose squares are too few for their sum, which Quiet refuses."""

    TYPE = Quiet.TYPE

    def __init__(self, packet: Samples | Quiet) -> None:
        self._place = packet.device_time_us, packet.first_index

    def pack(self) -> bytes:
        data: bytes = WIRE["Quiet"].pack(*self._place, 0, 100, 1000, 1)
        return data


SPOILT = {
    "a mark is missing": lambda n, p: other(p, sync=False) if is_samples(p) and n == 100 else p,
    "a mark too many": lambda n, p: other(p, sync=True) if is_samples(p) and n == 101 else p,
    "samples were lost": lambda n, p: other(p, overrun=True) if is_samples(p) and n == 100 else p,
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
    "silence within a frame": lambda n, p: (
        Quiet.of(p.device_time_us, p.first_index, np.full_like(p.counts, n % 5), sync=p.sync)
        if isinstance(p, Samples) and n % 3 == 0
        else p
    ),
    "silence that lasts too long": lambda n, p: (
        Quiet(p.device_time_us, p.first_index, 1 << 27, 0, 1 << 28) if n == 100 else p
    ),
    "silence that cannot be": lambda n, p: Impossible(p) if n == 100 else p,
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
def test_packets_that_do_not_go_on_cost_the_same(what: str, options: str) -> None:
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
    pipeline = compare(config, packed)
    assert pipeline.decisions.python_share < 0.05
    plain, _ = outcome(Pipeline(config), data, 997)
    frames, _ = outcome(Pipeline(config), packed, 997)  # at other times
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
    pipeline = compare(SkinConfig.of(SMALL), data)
    assert 10 < pipeline.counters.frames < FRAMES - 10
    assert pipeline.rejections.at_rail > 10


def test_frames_that_are_kept_stay_what_they_were() -> None:
    """Frames share no memory, though the kernel writes all correlations to one place."""
    config, data = SkinConfig.of(SMALL), sent((), "sim://?seed=1&scene=all&threshold=0", 20)
    pipeline = Pipeline(config)
    pipeline.stream.give(data, 1.0, False)
    kept, copies = [], []
    needs_bytes = False
    while not needs_bytes:
        event = pipeline.stream.next()
        if frame := pipeline.take(event):
            words, readings = frame.words, frame.readings
            kept.append((words.codes, words.amplitude_v, readings.pressure_pa, readings.voltage_v))
            copies.append([array.copy() for array in kept[-1]])
        needs_bytes = event.needs_bytes
    assert pipeline.decisions.compiled >= 15
    assert len(kept) >= 19
    np.testing.assert_array_equal(kept, copies)


def wait_for_frames(pipeline: Pipeline, reader: int, count: int) -> list[TactileFrame]:
    """So many frames, from a file that has them."""
    frames: list[TactileFrame] = []
    while len(frames) < count:
        event = pipeline.stream.next(reader, 1000)
        frame = pipeline.take(event)
        frames += [] if frame is None else [frame]
    return frames


def test_reading_a_file_gives_what_giving_bytes_gives() -> None:
    config, data = SkinConfig.of(SMALL), sent((), "sim://?seed=1&scene=moving")
    expected = Pipeline(config).feed(data, 1.0)
    pipeline = Pipeline(config)
    reader, writer = os.pipe()

    def write() -> None:
        for begin in range(0, len(data), 333):
            os.write(writer, data[begin : begin + 333])

    thread = threading.Thread(target=write)
    thread.start()
    frames = wait_for_frames(pipeline, reader, len(expected))
    thread.join()
    for one, other_one in zip(frames, expected, strict=True):
        np.testing.assert_array_equal(one.readings.pressure_pa, other_one.readings.pressure_pa)
        assert one.t_start == other_one.t_start
    while not pipeline.stream.next(reader, 1).needs_bytes:
        pass
    os.close(writer)
    with pytest.raises(OSError, match="end of file"):
        pipeline.stream.next(reader, 1000)
    os.close(reader)


def test_bytes_that_are_no_packets_do_not_hold_up_who_reads_them() -> None:
    pipeline = Pipeline(SkinConfig.of(SMALL))
    reader, writer = os.pipe()
    stop = threading.Event()

    def babble() -> None:
        with suppress(OSError):
            while not stop.is_set():
                os.write(writer, b"no packet\0")

    thread = threading.Thread(target=babble)
    thread.start()
    for _ in range(3):
        event = pipeline.stream.next(reader, 20)
        assert event.needs_bytes and not event.packet
    stop.set()
    os.close(reader)
    thread.join()
    os.close(writer)
    assert pipeline.packet_counts.framing_errors + pipeline.packet_counts.crc_errors > 2


def test_counts_may_be_read_while_another_thread_waits() -> None:
    config, data = SkinConfig.of(SMALL), sent((), "sim://?seed=1&scene=moving")
    pipeline = Pipeline(config)
    pipeline.feed(data[: len(data) // 4], 1.0)
    before = pipeline.packet_counts
    reader, writer = os.pipe()

    def wait() -> None:
        with suppress(OSError):  # end of file
            pipeline.stream.next(reader, 2000)

    thread = threading.Thread(target=wait)
    thread.start()
    while not threading.active_count() > 1:
        pass
    assert pipeline.packet_counts == before
    with pytest.raises(RuntimeError, match="another thread"):
        while thread.is_alive():
            pipeline.stream.next(reader, 0)
        raise RuntimeError("another thread was quicker")
    os.close(writer)
    thread.join()
    os.close(reader)


def test_bytes_that_were_read_are_decoded_before_others_are_left_out() -> None:
    config, data = SkinConfig.of(SMALL), sent((), "sim://?seed=1&scene=moving")
    expected = Pipeline(config).feed(data, 1.0)
    pipeline = Pipeline(config)
    half = len(data) // 2
    frames = pipeline.feed(data[:half], 1.0)
    reader, writer = os.pipe()
    os.write(writer, data[half : half + 30_000])
    frames += wait_for_frames(pipeline, reader, 1)
    left = pipeline.drain()
    assert left, "more than a frame was read"
    frames += left
    pipeline.skipped(5000)
    assert pipeline.counters.skipped_bytes == 5000
    os.close(reader), os.close(writer)
    for one, other_one in zip(frames, expected, strict=False):
        np.testing.assert_array_equal(one.readings.pressure_pa, other_one.readings.pressure_pa)


def test_settings_that_do_not_fit_are_refused() -> None:
    made = CompiledStream(PacketParser(), Decisions())
    rules = _rules(Description(INFO, SkinConfig.of(SMALL)), frames=True).at
    transform = Transform(SkinConfig.of(SMALL).spec.book.plan, spreading=False)
    code = kernel.ffi.new("struct frame_code *", {"transform": transform.at})
    rows = kernel.pointer(np.empty((10, 20), np.float32), 10, 20)
    nodes = rules.frame.frame.nodes
    for struct, name, wrong in (
        (rules.frame.frame, "nodes", 0),
        (rules.frame.frame, "first", 5),
        (rules.frame.frame, "order", 16),
        (rules.frame, "chip", math.nan),
        (rules, "rate_hz", -1),
        (rules, "gap_size", 0),
    ):
        right = getattr(struct, name)
        setattr(struct, name, wrong)
        with pytest.raises(ValueError, match=r"stream_describe: .* does not fit the frames"):
            made._answer("stream_describe", rules, code, rows)
        setattr(struct, name, right)
    assert rules.frame.frame.nodes == nodes
    made._answer("stream_describe", rules, code, rows)
    timing = {"due": 1000, "over": 900, "uses": 1, "has_frame": True, "chip": 4.0}
    timing |= {"until": 950.0, "heard": 800, "tail": 900, "tail_end": 910}
    edges = kernel.ffi.new("struct frame_edges *")
    made._answer("stream_carry", kernel.struct("stream_timing", **timing).at, edges)
    for change in ({"due": 0}, {"over": 1 << 40}, {"tail": 700}, {"until": np.nan}, {"heard": 0}):
        spoilt = kernel.struct("stream_timing", **timing | change).at
        with pytest.raises(ValueError, match=r"stream_carry: .* does not fit the frames"):
            made._answer("stream_carry", spoilt, edges)


def test_answers_that_nobody_asked_for_are_refused() -> None:
    made = CompiledStream(PacketParser(), Decisions())
    made.give(b"\1\2", 0.0, False)
    with pytest.raises(RuntimeError, match="not used up"):
        made.give(b"\3", 0.0, False)
    for answer, arguments in (
        ("stream_decide", (1, 2, 0.0, 0.0)),
        ("stream_look", (1,)),
        ("stream_place", (Answer.TAKE, 0, False, 0.0, 0.0, made._cut_short)),
    ):
        with pytest.raises(ValueError, match=f"{answer}: not asked for"):
            made._answer(answer, *arguments)


def test_bytes_are_kept_that_a_digitizers_description_is_amid() -> None:
    """The kernel reads where they are: if nobody else holds them, the stream does."""
    data = sent((), "sim://?scene=all&threshold=0", 40)
    pipeline = Pipeline(SkinConfig.of({}))
    pipeline.stream.give(bytes(bytearray(data)), 0.0, False)
    frames, others = [], []
    while not (event := pipeline.stream.next()).needs_bytes:
        frame = pipeline.take(event)
        frames += [frame] if frame else []
        others.append(bytes(len(data)))  # takes the place of what was given back
    assert len(frames) > 30
    assert pipeline.packet_counts.crc_errors == pipeline.packet_counts.framing_errors == 0
