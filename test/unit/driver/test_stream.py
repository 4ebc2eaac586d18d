# SPDX-License-Identifier: Apache-2.0

"""The digitizer's bytes → frames: what was sent, whatever happens to it, in any pieces."""

import math
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_cdma.base import kernel
from tactile_cdma.config.skin_config import SkinConfig
from tactile_cdma.driver.pipeline import Pipeline, TactileFrame
from tactile_cdma.driver.stream import Decisions, Description, Stream
from tactile_cdma.driver.timeline import Answer
from tactile_cdma.framing.frames import Clause, Rejections
from tactile_cdma.wire._protocol import Result
from tactile_cdma.wire.messages import WIRE, Ack, Info, Packed, Quiet, Samples, Status
from tactile_cdma.wire.packets import PacketParser, PacketWriter
from test.support.examples import examples
from test.support.same_frames import assert_same
from test.support.simulated import stream, truth_of

SMALL: dict[str, object] = {}
LARGE = {"nodes": 256, "chip_us": 8.0, "frame_period_ms": 40.0}
CHIPS: dict[str, object] = {"samples_per_chip": 1}
FULL = {"nodes": 16, "order": 16, "first_row": 0}
FRAMES = 150


@cache
def sent(parameters: tuple[tuple[str, object], ...], url: str, frames: int = FRAMES) -> bytes:
    return stream(SkinConfig.of(dict(parameters)), url, frames)


@cache
def truths(
    parameters: tuple[tuple[str, object], ...], url: str, frames: int = FRAMES
) -> np.ndarray:
    """What every node sent in so many frames, (f, n): its word, or SILENT."""
    truth = truth_of(SkinConfig.of(dict(parameters)), url)
    return np.array([said(truth[i].active, truth[i].codes) for i in range(frames + 9)])


SILENT = -1


def said(active: np.ndarray, codes: np.ndarray) -> np.ndarray:
    return np.where(active, codes, SILENT)


def differences(frame: TactileFrame, truth: np.ndarray) -> np.ndarray:
    """Nodes of which something is certain that is not so, in frames (f, n): how many, (f)."""
    words = frame.words
    return np.count_nonzero((said(words.active, words.codes) != truth) & ~words.doubtful, axis=-1)


def outcome(pipeline: Pipeline, data: bytes, chunk: int) -> tuple[list[TactileFrame], object]:
    """The frames of a stream, and what was counted and learnt."""
    frames: list[TactileFrame] = []
    for begin in range(0, len(data), chunk):
        # Bytes are stamped by their place, so that the clock does not depend on the chunks.
        for part in range(begin, min(begin + chunk, len(data)), 997):
            stop = min(part + 997, begin + chunk)
            frames += pipeline.feed(data[part:stop], part * 2e-7, part % 3 == 0)
    frames += pipeline.flush()
    return frames, counted(pipeline)


def counted(pipeline: Pipeline) -> object:
    learnt = pipeline.health.invalid.tolist(), str(pipeline.health.swing_v)
    counts = pipeline.counters, pipeline.packet_counts, pipeline.rejections, pipeline.decisions
    return counts, pipeline.digitizer, learnt


TIGHT = {"frame_period_ms": 10.1}  # the next mark comes before it is seen how a frame ends
GAP = {"timing": "gap"}
PAUSES = {"resync_chips": 20, "guard_chips": 1, "frame_period_ms": 15.0}
SCRAMBLED = {"scramble": True}
SPARSE = {"codes": "sparse", "nodes": 120, "order": 32, "frame_period_ms": 20.0, **CHIPS}
RESTARTED = {"order": 96, "bits": 9, "parity": True, "resync_chips": 96, "guard_chips": 20}
RESTARTED |= {"nodes": 400, "chip_us": 5.0, "frame_period_ms": 8.0}
PAPER = FULL | {"sign_seed": -1, "polarity": -1}
MIDDLE = {"nodes": 64, "chip_us": 10.0, "rows": 8, "columns": 8}
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
    (SPARSE | RESTARTED, "scene=moving&noise=0.05"),
    ({"samples_per_chip": 8}, "scene=moving"),
    ({"samples_per_chip": 8, "polarity": -1}, "scene=presses&threshold=0"),
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
    (SCRAMBLED | {"parity": True}, "scene=all&threshold=0&offset=0.2"),
    (SCRAMBLED | CHIPS, "scene=moving&offset=0.2"),
    (SCRAMBLED | LARGE, "scene=hand"),
    (TIGHT, "scene=moving"),
    (TIGHT | FULL, "scene=all&threshold=0"),
    (PAPER, "scene=presses&threshold=0"),
    (MIDDLE, "scene=presses&threshold=0"),
    (GAP | {"samples_per_chip": 8}, "scene=presses&threshold=0&stretch=0.11"),
    (GAP | PAPER | {"samples_per_chip": 6}, "scene=presses&threshold=0&stretch=0.11"),
    (GAP | {"drive": "unipolar", "samples_per_chip": 8}, "scene=presses&threshold=0&stretch=0.11"),
    (GAP, "scene=moving&stretch=0.1"),
]


def is_sound(parameters: dict[str, object], options: str) -> bool:
    return not any(name in options for name in ("noise", "rail", "jitter", "paper"))


@pytest.mark.parametrize("parameters, options", CASES, ids=lambda case: str(case))
def test_what_is_certain_was_sent(parameters: dict[str, object], options: str) -> None:
    config, url = SkinConfig.of(parameters), f"sim://?seed=1&{options}"
    number = FRAMES // 2 if parameters.keys() >= LARGE.keys() else FRAMES
    pipeline = Pipeline(config)
    frames, _ = outcome(pipeline, sent((*parameters.items(),), url, number), 997)
    truth = truths((*parameters.items(),), url, number)
    for frame in frames:
        assert not differences(frame, truth[round(frame.t_start / config.spec.frame_period_s)])
    if is_sound(parameters, options):
        assert len(frames) >= number - 5
        assert [frame.sequence for frame in frames] == list(range(len(frames)))
        longest_s = max(frame.chip_s for frame in frames)
        assert (longest_s > 1.08 * config.spec.chip_s) == ("stretch" in options)
        doubtful, most = pipeline.decisions.doubts.total(), 0.01 if config.spec.scramble else 0.03
        crowded = config.spec.sparse and "threshold" in options
        assert doubtful == len(frames) if crowded else doubtful <= max(1, most * len(frames))
        assert "stretch" in options or not pipeline.decisions.searches, "its timing was known"
    assert pipeline.decisions.frames == pipeline.counters.frames == len(frames)


def test_why_frames_are_in_doubt_is_told() -> None:
    pipeline = Pipeline(SkinConfig.of(SMALL))
    outcome(pipeline, sent((), "sim://?seed=1&scene=all&threshold=0&rail=1.0", 60), 997)
    doubts = pipeline.decisions.doubts
    assert doubts.total() > 10
    [(clause, count)] = doubts.most_common(1)
    assert pipeline.decisions.reasons.startswith(f"{Clause(clause).doubt}: {count}")


def test_decisions_are_counted_from_any_moment() -> None:
    config, data = SkinConfig.of(SMALL), sent((), "sim://?seed=1&scene=moving")
    pipeline = Pipeline(config)
    pipeline.feed(data[: len(data) // 3], 1.0)
    before = pipeline.decisions.since(Decisions())
    copied = before.frames, before.reasons
    frames = pipeline.feed(data[len(data) // 3 :], 1.0)
    assert before.frames and (before.frames, before.reasons) == copied
    assert pipeline.decisions.since(before).frames == len(frames)
    assert pipeline.decisions.frames == pipeline.counters.frames == before.frames + len(frames)
    assert not pipeline.decisions.since(pipeline.decisions).frames


SPLIT = [CASES[0], CASES[2], CASES[5], CASES[7], CASES[12], (CHIPS, "scene=moving"), CASES[-1]]


@examples(40)
@given(
    case=st.sampled_from(SPLIT),
    sizes=st.lists(st.sampled_from([1, 2, 7, 61, 500, 997, 1 << 14]), min_size=1, max_size=6),
)
def test_any_split_gives_the_same(case: tuple[dict[str, object], str], sizes: list[int]) -> None:
    parameters, options = case
    config = SkinConfig.of(parameters)
    data = sent((*parameters.items(),), f"sim://?seed=1&{options}", 30)
    whole, parts = Pipeline(config), Pipeline(config)
    expected = whole.feed(data, 1.0) + whole.flush()
    frames, begin, number = [], 0, 0
    while begin < len(data):
        size = sizes[number % len(sizes)]
        if size == 1:  # a few single bytes are as good as many
            size = 1 if number % 40 < 20 else 997
        frames += parts.feed(data[begin : begin + size], 1.0)
        begin, number = begin + size, number + 1
    assert_same(frames + parts.flush(), expected)
    assert counted(parts) == counted(whole)


DAMAGES: dict[str, Callable[[bytes, int], tuple[int, bytes]]] = {
    "flip": lambda part, size: (1, bytes([part[0] ^ 1 << size % 8])),
    "cut": lambda part, size: (size, b""),
    "repeat": lambda part, size: (0, part),
    "zero": lambda part, size: (size % 40, bytes(size % 40)),
    "insert": lambda part, size: (0, np.random.default_rng(size).bytes(size % 300)),
}
"""How many bytes go from a place on, and what is put there."""


@examples(60)
@given(
    case=st.sampled_from([CASES[i] for i in (0, 2, 18, 26, 32, 34, -1)]),
    damages=st.lists(
        st.tuples(st.sampled_from([*DAMAGES]), st.floats(0.02, 1), st.integers(1, 4000)), max_size=6
    ),
    chunk=st.sampled_from([61, 997, 20_000]),
)
def test_damaged_bytes_make_no_false_word(
    case: tuple[dict[str, object], str], damages: list[tuple[str, float, int]], chunk: int
) -> None:
    parameters, options = case
    url, config = f"sim://?seed=1&{options}", SkinConfig.of(parameters)
    data = bytearray(sent((*parameters.items(),), url, 60))
    for kind, share, size in damages:
        at = int(share * (len(data) - 1))
        gone, put = DAMAGES[kind](data[at : at + size], size)
        data[at : at + gone] = put
    truth = truths((*parameters.items(),), url, 60)
    frames, _ = outcome(Pipeline(config), bytes(data), chunk)
    for frame in frames:
        assert not differences(frame, truth[round(frame.t_start / config.spec.frame_period_s)])
    assert len(frames) > 20 or len(damages) > 1 or not damages


def edited(data: bytes, edit: object) -> bytes:
    """The packets of a stream, each as `edit` makes it: None, one or a list."""
    writer, made = PacketWriter(), b""
    for number, packet in enumerate(PacketParser().feed(data)):
        result = edit(number, packet)  # type: ignore[operator]
        for one in result if isinstance(result, list) else [result]:
            if one is not None:
                made += writer.encode(one)
    return made


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


def spoilt(numbers: Sequence[int], **change: Callable[[Any], object]) -> Callable[..., Any]:
    """An edit of the samples among these packets, whose fields are made of the packet."""

    def edit(number: int, packet: Any) -> Any:
        if number not in numbers or not is_samples(packet):
            return packet
        return replace(packet, **{name: value(packet) for name, value in change.items()})

    return edit


LATER = range(101, 1 << 20)
SPOILT = {
    "a mark is missing": spoilt([100], sync=lambda p: False),
    "a mark too many": spoilt([101], sync=lambda p: True),
    "samples were lost": spoilt([100], overrun=lambda p: True),
    "a packet is missing": lambda n, p: None if n == 100 else p,
    "time stands still": spoilt(LATER, device_time_us=lambda p: 1000),
    "time leaps": spoilt(LATER, device_time_us=lambda p: p.device_time_us + 200_000),
    "indices leap": spoilt(LATER, first_index=lambda p: p.first_index + 12_345),
    "beyond any clock": spoilt([100], device_time_us=lambda p: 1 << 60),
    "a status between": lambda n, p: [p, Status(5)] if n % 50 == 0 else p,
    "an answer between": lambda n, p: [p, Ack(0x81, 7, Result.OK)] if n % 50 == 0 else p,
    "a loud sample": lambda n, p: (
        replace(p, counts=np.full_like(p.counts, 2047))
        if isinstance(p, Samples) and n == 100
        else p
    ),
    "silence after a frame": lambda n, p: (
        Quiet.of(p.device_time_us, p.first_index, np.full_like(p.counts, n % 5), sync=p.sync)
        if isinstance(p, Samples) and not p.sync and n % 3 == 0
        else p
    ),
    "silence that lasts too long": lambda n, p: (
        Quiet(p.device_time_us, p.first_index, 1 << 27, 0, 1 << 28) if n == 100 else p
    ),
    "silence that cannot be": lambda n, p: Impossible(p) if n == 100 else p,
    "another digitizer": lambda n, p: [p, replace(INFO, quiet_uv=3)] if n == 100 else p,
}
[INFO] = [
    packet
    for packet in PacketParser().feed(sent((), "sim://?seed=1&scene=moving"))
    if isinstance(packet, Info)
][:1]


@pytest.mark.parametrize("what", SPOILT)
@pytest.mark.parametrize("options", ["scene=moving", "scene=idle&heartbeat=20"])
def test_packets_that_do_not_go_on_make_no_false_word(what: str, options: str) -> None:
    """Where time leaps frames are not numbered as they were sent: each has to be one of these."""
    url = f"sim://?seed=1&{options}"
    pipeline, truth = Pipeline(SkinConfig.of(SMALL)), truths((), url)
    frames, _ = outcome(pipeline, edited(sent((), url), SPOILT[what]), 997)
    for frame in frames:
        assert not differences(frame, truth).min()
    assert len(frames) > 40


@pytest.mark.parametrize("parameters", [SMALL, CHIPS])
def test_a_frame_without_its_mark_costs_only_itself(parameters: dict[str, object]) -> None:
    """Its chips are no gap, from which to learn what noise is."""
    key, url = (*parameters.items(),), "sim://?scene=all&threshold=0"
    packets = PacketParser().feed(sent(key, url, 40))
    lost = [n for n, packet in enumerate(packets) if is_samples(packet) and packet.sync][20]
    data = edited(sent(key, url, 40), lambda n, p: replace(p, sync=False) if n == lost else p)
    frames, _ = outcome(Pipeline(SkinConfig.of(parameters)), data, 997)
    assert [f.sequence for f in frames] == [n for n in range(len(frames) + 1) if n != 20]
    for frame in frames:
        said_words = said(frame.words.active, frame.words.codes)
        assert np.array_equal(said_words, truths(key, url, 40)[frame.sequence])


def in_pieces(number: int, packet: object) -> object:
    """Packets of 100 samples at most, as of a digitizer with little memory."""
    if not isinstance(packet, Samples):
        return packet
    rate = 1e-6 * INFO.sample_rate_uhz
    return [
        replace(
            packet,
            device_time_us=packet.device_time_us + round(1e6 * begin / rate),
            first_index=packet.first_index + begin,
            counts=packet.counts[begin : begin + 100],
            sync=packet.sync and not begin,
        )
        for begin in range(0, packet.counts.size, 100)
    ]


@pytest.mark.parametrize("what", ["a packet is missing", "a mark too many"])
def test_a_frame_that_is_interrupted_is_incomplete_and_counted(what: str) -> None:
    whole = edited(sent((), "sim://?seed=1&scene=all&threshold=0"), in_pieces)
    marks = [n for n, p in enumerate(PacketParser().feed(whole)) if is_samples(p) and p.sync]
    within = marks[40] + 4
    edits = {
        "a packet is missing": lambda n, p: None if n == within else p,
        "a mark too many": lambda n, p: replace(p, sync=True) if n == within else p,
    }
    expected, _ = outcome(Pipeline(SkinConfig.of(SMALL)), whole, 997)
    pipeline = Pipeline(SkinConfig.of(SMALL))
    frames, _ = outcome(pipeline, edited(whole, edits[what]), 997)
    parts = 1 if what == "a packet is missing" else 2
    assert pipeline.rejections == Rejections(incomplete=parts)
    assert len(frames) == len(expected) - 1
    assert pipeline.counters.lost_frames == 1
    [lost] = {f.sequence for f in expected} - {f.sequence for f in frames}
    assert lost == 40


@pytest.mark.parametrize("parameters", [SMALL, CHIPS])
def test_packed_samples_are_followed_like_others(parameters: dict[str, object]) -> None:
    config = SkinConfig.of(parameters)
    data = sent((*parameters.items(),), "sim://?seed=1&scene=all&threshold=0", 200)

    def pack(number: int, packet: object) -> object:
        if not isinstance(packet, Samples) or number % 7 == 0:
            return packet
        values = {item.name: getattr(packet, item.name) for item in fields(packet)}
        return Packed(**values, base=-2048)

    packed = edited(data, pack)
    assert len(packed) < 0.85 * len(data)
    plain, frames = (Pipeline(config).feed(each, 1.0) for each in (data, packed))
    assert_same(frames, plain)
    assert len(frames) > 190


def at_the_rail(number: int, packet: object) -> object:
    """The amplifier is stuck at a rail from a certain packet on, whatever the nodes say."""
    if number <= 100 or not is_samples(packet):
        return packet
    top = INFO.max_count
    if isinstance(packet, Samples):
        return replace(packet, counts=np.full_like(packet.counts, top))
    count = packet.count
    return replace(packet, sum=count * top, sum_of_squares=count * top * top)


@pytest.mark.parametrize("options", ["scene=all&threshold=0", "scene=idle&heartbeat=0"])
def test_a_line_that_is_stuck_at_a_rail_is_not_called_silent(options: str) -> None:
    pipeline = Pipeline(SkinConfig.of(SMALL))
    outcome(pipeline, edited(sent((), f"sim://?seed=1&{options}"), at_the_rail), 997)
    assert 10 < pipeline.counters.frames < FRAMES - 10
    assert pipeline.rejections.at_rail > 10


def test_frames_that_are_kept_stay_what_they_were() -> None:
    """Frames share no memory, though the kernel writes all words to one place."""
    pipeline = Pipeline(SkinConfig.of(SMALL))
    data = sent((), "sim://?seed=1&scene=all&threshold=0", 20)
    kept, copies = [], []
    for begin in range(0, len(data), 100):
        for frame in pipeline.feed(data[begin : begin + 100], 1.0):
            words, readings = frame.words, frame.readings
            kept.append((words.codes, words.amplitude_v, readings.pressure_pa, readings.voltage_v))
            copies.append([array.copy() for array in kept[-1]])
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
    assert_same(frames, expected, at_host=False)
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
    assert_same(frames, expected[: len(frames)], at_host=False)


def test_rules_that_do_not_fit_are_refused() -> None:
    made = Stream(PacketParser(), Decisions())
    description = Description(INFO, SkinConfig.of(SMALL), 0.3)
    held = description.rules(frames=True)
    rules, reader = held.at, description.reader.at
    memory = kernel.ffi.new("uint8_t[]", kernel.lib.WORDS_BYTES * description.spec.nodes)
    for name, wrong in (
        ("marked", False),
        ("rate_hz", -1.0),
        ("rate_hz", math.nan),
        ("gap_size", 0),
        ("gap_size", 1 << 40),
        ("sure_gap", 1 << 20),
        ("least_rest", 1),
    ):
        right = getattr(rules, name)
        setattr(rules, name, wrong)
        with pytest.raises(ValueError, match=r"stream_describe: .* does not fit the frames"):
            made._answer("stream_describe", rules, reader, memory)
        setattr(rules, name, right)
    made._answer("stream_describe", rules, reader, memory)


def test_a_stream_that_ends_before_it_is_described_has_no_frame() -> None:
    pipeline = Pipeline(SkinConfig.of(SMALL))
    assert pipeline.flush() == []
    pipeline.feed(b"no packets\0", 0.0)
    assert pipeline.flush() == []


def test_answers_that_nobody_asked_for_are_refused() -> None:
    made = Stream(PacketParser(), Decisions())
    made.give(b"\1\2", 0.0, False)
    with pytest.raises(RuntimeError, match="not used up"):
        made.give(b"\3", 0.0, False)
    for answer, arguments in (
        ("stream_propose", (-0.5, 4.0)),
        ("stream_gather", (1,)),
        ("stream_place", (Answer.TAKE, 0, False, 0.0, 0.0)),
    ):
        with pytest.raises(ValueError, match=f"{answer}: not asked for"):
            made._answer(answer, *arguments)
