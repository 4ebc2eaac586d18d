# SPDX-License-Identifier: Apache-2.0

"""The recording container: from a damaged file, intact data is read and losses are counted."""

import errno
import json
import os
import struct
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_cdma.base.errors import CaptureError
from tactile_cdma.recording.recording_file import (
    HEAD_BYTES,
    MAGIC,
    MOST_BYTES,
    SUFFIX,
    Chunk,
    Description,
    Recorder,
    RecordingEncoder,
    RecordingParser,
    describe,
    is_recording,
    is_text,
    length_ns,
    read_chunks,
    seek,
    survey,
)

ABOUT = Description(1_700_000_000_000_000_000, 5_000_000_000, "sim://", 9600, {"nodes": 4}, "0")
# Payloads that look like records, too: a recording of a recording is one like any other.
PAYLOADS = st.lists(
    st.binary(min_size=1, max_size=40) | st.sampled_from([b"\xf1SKD" * 9, b"\xf1SK", MAGIC]),
    min_size=1,
    max_size=6,
)


def encoded(payloads: list[bytes], identity: int = 77) -> bytes:
    encoder = RecordingEncoder(ABOUT, identity)
    raw = encoder.begin()
    for i, payload in enumerate(payloads):
        raw += encoder.chunk(payload, 5.0 + i)
    return raw + encoder.end(5.0 + len(payloads))


def parsed(raw: bytes, sizes: list[int] | None = None) -> tuple[RecordingParser, list[Chunk]]:
    """Parse in pieces of these sizes, taken in turn."""
    parser, chunks, place, turn = RecordingParser(), list[Chunk](), 0, 0
    while place < len(raw):
        size = sizes[turn % len(sizes)] if sizes else len(raw)
        chunks += parser.feed(raw[place : place + size])
        place, turn = place + size, turn + 1
    return parser, chunks + parser.finish()


def state(parser: RecordingParser) -> tuple[object, ...]:
    counts = parser.damaged, parser.lost_bytes, parser.chunks, parser.bytes
    return parser.description, parser.end_ns, counts


def is_part(some: list[Chunk], whole: list[Chunk]) -> bool:
    """Whether some of the whole are there, in order."""
    left = iter(whole)
    return all(chunk in left for chunk in some)


@settings(max_examples=60, deadline=None)
@given(PAYLOADS, st.lists(st.integers(1, 50), min_size=1, max_size=5))
def test_what_was_written_is_read_in_any_pieces(payloads: list[bytes], sizes: list[int]) -> None:
    raw = encoded(payloads)
    parser, chunks = parsed(raw, sizes)
    assert chunks == [Chunk(i * 10**9, payload) for i, payload in enumerate(payloads)]
    assert parser.description == ABOUT
    assert parser.end_ns == len(payloads) * 10**9
    assert (parser.damaged, parser.lost_bytes) == (0, 0)
    assert state(parser) == state(parsed(raw)[0])


@settings(max_examples=60, deadline=None)
@given(PAYLOADS, st.data())
def test_a_cut_file_gives_what_is_before_the_cut(
    payloads: list[bytes], data: st.DataObject
) -> None:
    raw = encoded(payloads)
    _, whole = parsed(raw)
    cut = data.draw(st.integers(0, len(raw) - 1))
    parser, chunks = parsed(raw[:cut])
    assert chunks == whole[: len(chunks)]
    assert parser.end_ns is None and parser.lost_bytes == parser.damaged == 0
    written = [place + len(payload) <= cut for place, payload in _places(payloads)]
    assert len(chunks) == sum(written)


def _places(payloads: list[bytes]) -> list[tuple[int, bytes]]:
    """Where each payload begins in the file."""
    places, end = [], len(RecordingEncoder(ABOUT, 77).begin())
    for payload in payloads:
        places.append((end + HEAD_BYTES, payload))
        end += HEAD_BYTES + len(payload)
    return places


@settings(max_examples=60, deadline=None)
@given(PAYLOADS, st.data())
def test_a_flipped_byte_costs_one_record_and_is_counted(
    payloads: list[bytes], data: st.DataObject
) -> None:
    raw = bytearray(encoded(payloads))
    _, whole = parsed(bytes(raw))
    raw[data.draw(st.integers(0, len(raw) - 1))] ^= data.draw(st.integers(1, 255))
    sizes = data.draw(st.lists(st.integers(1, 99), min_size=1, max_size=3))
    parser, chunks = parsed(bytes(raw), sizes)
    assert is_part(chunks, whole)
    assert len(chunks) >= len(whole) - 1
    assert parser.damaged == (parser.end_ns is not None)  # a lost end looks like a cut
    assert parser.description == ABOUT  # it is there twice
    if parser.end_ns is not None:
        assert parser.lost_bytes == sum(map(len, payloads)) - parser.bytes
    assert state(parser) == state(parsed(bytes(raw))[0])


@settings(max_examples=60, deadline=None)
@given(PAYLOADS, st.data())
def test_missing_and_foreign_bytes_never_make_data(
    payloads: list[bytes], data: st.DataObject
) -> None:
    raw, other = encoded(payloads), encoded([b"not of this one"] * 3, identity=78)
    _, whole = parsed(raw)
    begin, end = sorted(data.draw(st.tuples(*[st.integers(0, len(raw))] * 2)))
    insert = data.draw(st.binary(max_size=60) | st.just(other))
    first_ours = begin > len(RecordingEncoder(ABOUT, 77).begin())
    parser, chunks = parsed(raw[:begin] + insert + raw[end:])
    if first_ours:  # else the inserted recording is what the file is one of
        assert is_part(chunks, whole)
        if parser.end_ns is not None:
            assert parser.lost_bytes == sum(map(len, payloads)) - parser.bytes
            assert parser.damaged or parser.lost_bytes or (begin == end and not insert)


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=300))
def test_any_bytes_are_parsed_without_a_crash(raw: bytes) -> None:
    assert parsed(raw)[1] == []


def test_large_pieces_are_divided_and_come_back_whole() -> None:
    payload = bytes(range(256)) * (MOST_BYTES // 100)
    parser, chunks = parsed(encoded([payload]), [99_991])
    assert b"".join(chunk.data for chunk in chunks) == payload
    assert parser.damaged == 0


@pytest.mark.parametrize("cut", [0, 300_000])
def test_reading_begins_anywhere(tmp_path: Path, cut: int) -> None:
    path, encoder, seconds = tmp_path / "some.skin", RecordingEncoder(ABOUT, 5), 60
    piece = encoded([b"of another"], identity=6) * 400  # whose records are not taken for ours
    raw = encoder.begin()
    for second in range(seconds):
        raw += encoder.chunk(piece, 5.0 + second)
    raw += encoder.end(5.0 + seconds)
    assert len(raw) > 5 * MOST_BYTES
    path.write_bytes(raw[: len(raw) - cut])
    whole = list(read_chunks(path, RecordingParser()))
    assert len(whole) == seconds - (2 if cut else 0)
    for time_ns in (-1, 0, 1, 17_000_000_000, 17_500_000_000, 10**12):
        parser, position = seek(path, time_ns)
        found = list(read_chunks(path, parser, position))
        before = [chunk for chunk in found if chunk.time_ns < time_ns]
        assert found[len(before) :] == [chunk for chunk in whole if chunk.time_ns >= time_ns]
        assert sum(len(chunk.data) for chunk in before) < 2 * MOST_BYTES
        assert parser.lost_bytes == parser.damaged == 0
        assert (parser.end_ns is None) == bool(cut)


@pytest.mark.parametrize(("version", "whose"), [(1, "an older"), (3, "another"), ("x", "another")])
def test_another_version_is_refused(version: object, whose: str) -> None:
    raw, encoder = encoded([b"x"]), RecordingEncoder(ABOUT, 77)
    head = encoder.begin()
    text = head[len(MAGIC) + HEAD_BYTES :].replace(
        b'"version": 2', json.dumps({"version": version}).encode()[1:-1]
    )
    with pytest.raises(CaptureError, match=f"version {version}, made by {whose} version"):
        parsed(MAGIC + encoder._record(b"H", text) + raw[len(head) :])


@pytest.mark.parametrize(
    "content",
    [
        *(b"{", b"\xff\xfe", b"[1]", b"[" * 99_999),
        *(b'{"version": 2}', b'{"wall_ns": "x"}', b'{"parameters": [1]}'),
    ],
)
def test_a_description_that_makes_no_sense_is_damage(content: bytes) -> None:
    encoder, good = RecordingEncoder(ABOUT, 77), RecordingEncoder(ABOUT, 77).begin()
    if b'"' in content and b"version" not in content:  # a whole one but for this
        content = json.dumps(json.loads(good[8 + HEAD_BYTES :]) | json.loads(content)).encode()
    raw = MAGIC + encoder._record(b"H", content) + encoded([b"x"])[len(good) :]
    parser, chunks = parsed(raw)
    assert chunks == [Chunk(0, b"x")]
    assert parser.description == ABOUT  # it is there twice
    assert parser.damaged == 1


@pytest.mark.parametrize("change", [{"wall_ns": -1}, {"baud": 1.5}, {"monotonic_ns": 2**70}])
def test_an_end_that_makes_no_sense_is_none(change: dict[str, object]) -> None:
    encoder = RecordingEncoder(ABOUT, 77)
    head = encoder.begin()
    begin, said = head + encoder.chunk(b"x", 5.0), json.loads(head[len(MAGIC) + HEAD_BYTES :])
    for content, is_sound in ((said, True), (said | change, False)):
        parser, chunks = parsed(begin + encoder._record(b"F", json.dumps(content).encode()))
        assert chunks == [Chunk(0, b"x")]
        assert (parser.end_ns is not None) == is_sound


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "some.skin"
    with Recorder(path, "sim://", 9600, {"nodes": 4}) as recorder:
        began = describe(path).monotonic_ns * 1e-9
        for i in range(50):
            recorder.write(bytes([i]) * 100, began + 0.1 * i)
    return path


def test_a_file_says_what_it_is(file: Path) -> None:
    found = survey(file)
    assert (found.chunks, found.bytes, found.lost_bytes, found.losses) == (50, 5000, 0, ())
    assert found.time_ns * 1e-9 == pytest.approx(4.9, abs=1e-6)
    about = describe(file)
    assert (about.port, about.baud, about.parameters) == ("sim://", 9600, {"nodes": 4})
    times = [c.time_ns * 1e-9 for c in read_chunks(file, RecordingParser())]
    assert times == pytest.approx([0.1 * i for i in range(50)], abs=1e-6)


def test_damage_anywhere_is_told(file: Path) -> None:
    raw = file.read_bytes()
    for place in range(0, len(raw), 61):
        file.write_bytes(raw[:place] + bytes([raw[place] ^ 1]) + raw[place + 1 :])
        found = survey(file)
        assert found.losses
        assert found.bytes >= 4900
        assert describe(file).port == "sim://"


def test_a_file_that_was_cut_is_read_and_said_to_be(file: Path) -> None:
    raw = file.read_bytes()
    file.write_bytes(raw[: len(raw) // 2])
    found = survey(file)
    assert "cut short" in found.losses[0]
    assert 1500 < found.bytes < 2600 and found.bytes % 100 == 0
    assert length_ns(file) is None


def test_what_is_written_is_there_before_the_end(tmp_path: Path) -> None:
    path = tmp_path / "some.skin"
    with Recorder(path, "sim://", 9600, {}) as recorder:
        recorder.write(b"said", 1e9)
        assert [c.data for c in read_chunks(path, RecordingParser())] == [b"said"]


def test_a_full_disk_is_an_error_of_the_system() -> None:
    full = os.strerror(errno.ENOSPC)
    with pytest.raises(OSError, match=full), Recorder(Path("/dev/full"), "sim://", 9600, {}) as it:
        it.write(b"x", 0.0)


def test_other_files_are_no_recordings(tmp_path: Path) -> None:
    other, empty = tmp_path / "other", tmp_path / f"empty{SUFFIX}"
    other.write_bytes(b"some bytes\0" * 100)
    empty.write_bytes(b"")
    assert not is_recording(other)
    for path in (other, empty):
        with pytest.raises(CaptureError, match="not a recording"):
            survey(path)
    with pytest.raises(CaptureError, match="No such file"):
        survey(tmp_path / "none.skin")


def test_a_pipe_is_refused_without_waiting_for_its_other_end(tmp_path: Path) -> None:
    pipe = tmp_path / f"pipe{SUFFIX}"
    os.mkfifo(pipe)
    for ask in (is_recording, is_text):
        with pytest.raises(CaptureError, match="not a file"):
            ask(pipe)


def test_heads_that_all_claim_a_megabyte_are_not_all_believed() -> None:
    head = struct.pack("<3scIIqQ", b"\xf1SK", b"D", 7, MOST_BYTES, 0, 0) + b"crc!"
    parser = RecordingParser()
    parser.feed(MAGIC + head * (4 * MOST_BYTES // len(head)))
    # Else each of them would be: 100,000 checksums of a megabyte.
    assert parser._vain < 128 * MOST_BYTES


def test_a_damaged_recording_is_searched_to_its_end_all_the_same() -> None:
    encoder = RecordingEncoder(ABOUT, 7)
    begin = encoder.begin()
    large = [encoder.chunk(bytes([i]) * (MOST_BYTES // 2), i * 1e-3) for i in range(12)]
    damaged = [part[:-1] + b"?" for part in large[:-1]] + large[-1:]
    parser, chunks = parsed(begin + b"".join(damaged))
    assert [chunk.data[:1] for chunk in chunks] == [bytes([11])]
    assert parser.lost_bytes == 11 * MOST_BYTES // 2
