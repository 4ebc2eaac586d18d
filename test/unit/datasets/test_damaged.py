# SPDX-License-Identifier: Apache-2.0

"""Damaged bags: one clear error, whatever the library makes of them."""

import json
import os
import random
import re
import signal
import sqlite3
import struct
import tempfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import pytest
import yaml
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2 import storage_mcap
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tactile_cdma.base.errors import CaptureError
from tactile_cdma.datasets.sources.bag_file import MOST_CHUNK_BYTES, BagFile, _fields, _types
from tactile_cdma.datasets.sources.opening import Wanted, open_source
from test.support.bags import ARRAY, INFO, BagMaker
from test.support.bounds import bounded
from test.support.command_line import Refused

pytestmark = pytest.mark.xdist_group("datasets")
_mcap: Any = storage_mcap
RULE = "=" * 80 + "\n"
MCAP, SQLITE, METADATA = "session.mcap", "session.db3", "metadata.yaml"


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    """Files of a bag of either kind, by the name of the one with messages."""
    maker = BagMaker().skin("/skin", 1.0)
    folder = tmp_path_factory.mktemp("damaged")
    return {
        name: {file.name: file.read_bytes() for file in path.iterdir()}
        for name, path in (
            (MCAP, maker.write(folder / "mcap" / "session")),
            (SQLITE, maker.write(folder / "sqlite" / "session", sqlite=True)),
        )
    }


@pytest.mark.parametrize(
    ("kind", "damaged", "damage"),
    [
        (MCAP, MCAP, lambda raw: raw[: len(raw) // 2]),
        (MCAP, MCAP, lambda raw: raw.replace(b"/skin/tactile", b"\xff" * 13)),
        (MCAP, METADATA, lambda raw: raw.replace(b"nanoseconds:", b"nanoseconds: x")),
        (SQLITE, SQLITE, lambda raw: raw[: len(raw) // 2]),
        (SQLITE, SQLITE, lambda raw: raw[:8192] + bytes(len(raw) - 8192)),
        (SQLITE, SQLITE, lambda raw: raw.replace(b"/skin/tactile", b"\xff" * 13)),
    ],
)
def test_a_damaged_bag(
    bags: dict[str, dict[str, bytes]],
    tmp_path: Path,
    refused: Refused,
    kind: str,
    damaged: str,
    damage: Callable[[bytes], bytes],
) -> None:
    path = tmp_path / "session"
    path.mkdir()
    for name, content in bags[kind].items():
        (path / name).write_bytes(damage(content) if name == damaged else content)
        assert name != damaged or damage(content) != content
    for words in (["info", path], ["export", path, "-o", tmp_path / "out.npz"]):
        said = refused(*words)
        assert f"{path}: not a bag, or a damaged or truncated one: " in said
        assert ("`mcap recover`" in said) == (kind == MCAP)
    assert not (tmp_path / "out.npz").exists()


class Foreign(BagMaker):
    """Of another version, in which the messages of a kind lack a field."""

    def __init__(self, kind: str, field: str) -> None:
        super().__init__()
        kinds = dict(self.types.fielddefs)
        kinds[kind] = kinds[kind][0], [its for its in kinds[kind][1] if its[0] != field]
        self.types = get_typestore(Stores.EMPTY)
        self.types.register(kinds)

    def make(self, kind: str, /, **fields: Any) -> Any:
        its = [name for name, _ in self.types.fielddefs[kind][1]]
        return super().make(kind, **{name: fields[name] for name in its})


@pytest.mark.parametrize(
    ("kind", "field"),
    [
        (ARRAY, "status"),
        (ARRAY, "height"),
        (INFO, "area"),
        ("tactile_cdma/msg/TactileContacts", "untouched"),
        ("std_msgs/msg/Header", "stamp"),
        ("sensor_msgs/msg/JointState", "position"),
    ],
)
def test_a_bag_of_another_version(kind: str, field: str, tmp_path: Path) -> None:
    maker = Foreign(kind, field)
    maker.skin("/skin", 0.2)
    maker.contacts("/skin", 0.2, 0.2)
    maker.joints("/joints", 0.2)
    path = maker.write(tmp_path / "bag")
    with pytest.raises(CaptureError, match=f"{kind} has no field "):
        list(open_source(path, Wanted(derived=True, state=["/joints"])).samples(None, None))


@pytest.mark.parametrize("name", [MCAP, SQLITE, METADATA])
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (os.mkfifo, "is a pipe, not a file"),
        (lambda path: path.symlink_to("/dev/zero"), "is a device, not a file"),
    ],
)
def test_what_is_no_file_is_named_as_such(
    tmp_path: Path, refused: Refused, name: str, make: Callable[[Path], object], words: str
) -> None:
    make(tmp_path / name)
    assert words in refused("info", tmp_path if name == METADATA else tmp_path / name)


@pytest.mark.parametrize("sqlite", [False, True])
@pytest.mark.parametrize("packed", ["none", "file"])
def test_a_pipe_among_a_bags_files(
    tmp_path: Path, refused: Refused, sqlite: bool, packed: str
) -> None:
    path = BagMaker().skin("/skin", 0.1).write(tmp_path / "session", sqlite, packed)
    [file] = path.glob("session.*")
    file.unlink()
    os.mkfifo(file)
    assert "is a pipe, not a file" in refused("info", path)


def test_metadata_of_4_gib_are_refused_unread(tmp_path: Path, refused: Refused) -> None:
    (tmp_path / METADATA).touch()
    os.truncate(tmp_path / METADATA, 4 << 30)
    assert f"has {4 << 30} bytes; files of this kind have" in refused("info", tmp_path)


def test_metadata_that_multiply_are_refused(tmp_path: Path, refused: Refused) -> None:
    """Merged keys double with each line: 1.5 kB would take for ever."""
    merged = "".join(f"a{i}: &a{i}\n  <<: [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 60))
    (tmp_path / METADATA).write_text("a0: &a0 {k: 1}\n" + merged)
    assert "anchors and aliases" in refused("info", tmp_path)


def test_a_quality_of_service_that_multiplies_is_not_read(tmp_path: Path) -> None:
    merged = "".join(f"a{i}: &a{i}\n  <<: [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 60))
    path = BagMaker().skin("/skin", 0.1).write(tmp_path / "session", sqlite=True) / SQLITE
    with closing(sqlite3.connect(path)) as changed, changed:
        changed.execute("UPDATE topics SET offered_qos_profiles = ?", ("a0: &a0 {}\n" + merged,))
    assert open_source(path, Wanted()).streams


def test_metadata_whose_files_are_no_list(tmp_path: Path) -> None:
    """Found by fuzzing: rosbags opened such a bag, and failed to close it."""
    path = BagMaker().skin("/skin", 0.1).write(tmp_path / "session")
    content = yaml.safe_load((path / METADATA).read_text())
    content["rosbag2_bagfile_information"]["files"] = "many"
    (path / METADATA).write_text(json.dumps(content))
    assert open_source(path, Wanted()).streams


@pytest.mark.parametrize("value", ["[1]", "~", "1.5", "many"])
@pytest.mark.parametrize(
    "key", ["name", "type", "message_count", "nanoseconds_since_epoch", "nanoseconds"]
)
def test_metadata_of_wrong_types(tmp_path: Path, refused: Refused, key: str, value: str) -> None:
    path = BagMaker().skin("/skin", 0.1).write(tmp_path / "session")
    text = (path / METADATA).read_text()
    changed = re.sub(rf"(?<=\b{key}: ).+", value, text)
    assert changed != text
    (path / METADATA).write_text(changed)
    if value != "many" or key not in {"name", "type"}:  # a text is right there
        assert "not a bag, or a damaged" in refused("info", path)


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE topics SET name = x'ff00'",
        "UPDATE topics SET type = x'ff00'",
        "UPDATE messages SET timestamp = 'noon' WHERE id = 5",
        "DROP TABLE messages; CREATE TABLE messages(id, topic_id, timestamp, data AS "
        "(zeroblob(1000000000))); INSERT INTO messages SELECT id, id, 5 FROM topics",
    ],
)
def test_sqlite_of_wrong_types(tmp_path: Path, refused: Refused, change: str) -> None:
    path = BagMaker().skin("/skin", 0.1).write(tmp_path / "session", sqlite=True) / SQLITE
    with closing(sqlite3.connect(path)) as changed:
        changed.executescript(change)
    assert "not a bag, or a damaged" in refused("info", path)


ENDLESS = (
    "DROP TABLE schema; CREATE VIEW schema AS WITH RECURSIVE endless(schema_version) AS "
    "(SELECT 1 UNION ALL SELECT schema_version + 1 FROM endless) "
    "SELECT max(schema_version) AS schema_version FROM endless"
)


@pytest.mark.parametrize("packed", [False, True])
def test_a_view_without_an_end_is_refused(tmp_path: Path, refused: Refused, packed: bool) -> None:
    maker, packing = BagMaker().skin("/skin", 0.1), "file" if packed else "none"
    maker.write(tmp_path / "plain", sqlite=True)
    path = maker.write(tmp_path / "session", True, packing) / SQLITE
    (tmp_path / "plain" / "plain.db3").replace(path)
    with closing(sqlite3.connect(path)) as changed:
        changed.executescript(ENDLESS)
    if packed:
        path.with_suffix(".db3.zstd").write_bytes(_mcap.zstd.compress(path.read_bytes()))
    else:
        assert "schema is a view" in refused("info", path)
    assert "schema is a view" in refused("info", path.parent)


def test_ctrl_c_ends_a_query(tmp_path: Path) -> None:
    """A query without an end, in the time of sqlite alone: a join of all messages."""
    path = BagMaker().skin("/skin", 0.1).write(tmp_path / "session", sqlite=True) / SQLITE
    with closing(sqlite3.connect(path)) as changed:
        changed.executescript(
            "DROP TABLE topics; CREATE TABLE topics(id, name, type, serialization_format, "
            "offered_qos_profiles, type_description_hash); DELETE FROM messages;"
            "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 100000) "
            "INSERT INTO topics SELECT 1, '/x', 'a/msg/B', 'cdr', '', '' FROM n;"
            "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < 100000) "
            "INSERT INTO messages(topic_id, timestamp, data) SELECT 1, i, '' FROM n"
        )
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        signal.setitimer(signal.ITIMER_REAL, 1.0)
        with pytest.raises(KeyboardInterrupt):
            open_source(path, Wanted())
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("kind", ["zstd", "lz4"])
def test_what_unpacks_to_too_much_is_not_unpacked(kind: str) -> None:
    """By what the bag says of a chunk, and by what it has, which may be another size."""
    pack = _mcap.zstd.compress if kind == "zstd" else lz4.frame.compress
    unpack = _mcap.DECOMPRESSORS[kind]
    assert unpack(pack(b"frames"), 6) == b"frames"
    bomb = pack(bytes(2 * MOST_CHUNK_BYTES))
    assert len(unpack(bomb, 100)) == 101  # of another size than it says: rosbags refuses it
    with pytest.raises(ValueError, match="made to fill the memory"):
        unpack(bomb, 2 * MOST_CHUNK_BYTES)
    noise = random.Random(1).randbytes(2 * MOST_CHUNK_BYTES)  # one message may be large
    assert unpack(pack(noise), len(noise)) == noise


def test_a_chunk_of_4_gib_in_a_small_bag_is_refused(tmp_path: Path, refused: Refused) -> None:
    """Within the memory that a reader may take beside a file of 140 kB."""
    path = BagMaker().skin("/skin", 0.1).write(tmp_path / "session") / MCAP
    packer = _mcap.zstd.ZstdCompressor()
    packed = b"".join(packer.compress(bytes(1 << 24)) for _ in range(256)) + packer.flush()
    chunk = struct.pack("<QQQI", 1, 2, 4 << 30, 0) + struct.pack("<I4sQ", 4, b"zstd", len(packed))
    whole = path.read_bytes()
    begin = whole.index(b"\x06", 8 + 9)  # the first chunk, after the header
    record = b"\x06" + struct.pack("<Q", len(chunk) + len(packed)) + chunk + packed
    footer = b"\x02" + struct.pack("<QQQI", 20, 0, 0, 0) + b"\x89MCAP0\r\n"
    path.write_bytes(whole[:begin] + record + footer)
    with bounded(most_bytes=10 * path.stat().st_size + (64 << 20)):
        assert "made to fill the memory" in refused("info", path)


@pytest.mark.parametrize("sqlite", [False, True])
def test_a_compressed_file_does_not_fill_the_disk(
    tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch, sqlite: bool
) -> None:
    path = BagMaker().skin("/skin", 0.1).write(tmp_path / "session", sqlite, "file")
    (file,) = path.glob("session.*")
    file.write_bytes(_mcap.zstd.compress(bytes(1 << 28)))
    (tmp_path / "room").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "room"))
    assert "made to fill the disk" in refused("info", path)
    assert not list((tmp_path / "room").iterdir())


def test_chunks_of_the_same_time_are_not_unpacked_at_once(tmp_path: Path) -> None:
    """As the index lists them: rosbags would hold all of them, to put their messages in order."""

    def chunks(first: int, step: int, number: int) -> list[SimpleNamespace]:
        starts = range(first, first + step * number, step or 1) if step else [first] * number
        return [
            SimpleNamespace(message_start_time=t, message_end_time=t + 9, uncompressed_size=1 << 24)
            for t in starts
        ]

    bag = BagFile(BagMaker().skin("/skin", 0.1).write(tmp_path / "session") / MCAP)
    storage: Any = bag._reader.storage
    with bag:
        storage.chunks = [*chunks(0, 0, 16), *chunks(10, 10, 100), *chunks(2000, 1, 50)]
        bag._check()
        storage.chunks += chunks(5, 0, 1)
        with pytest.raises(ValueError, match="17 chunks of the same time unpack to"):
            bag._check()


@pytest.mark.parametrize(
    ("format_", "text", "words"),
    [
        (MessageDefinitionFormat.MSG, "string[300000000] a", "300000001 fields, more than"),
        (MessageDefinitionFormat.MSG, "string a\n" * 15_000, "15000 fields, more than"),
        (MessageDefinitionFormat.MSG, "string a\n" * 100_000, "900000 characters, more than"),
        (
            MessageDefinitionFormat.MSG,
            f"C[2000] a\n{RULE}MSG: a/msg/C\nD[2000] a\n{RULE}MSG: a/msg/D\n",
            "4006002 fields, more than",
        ),
        (MessageDefinitionFormat.IDL, "const long X = ((1));", "computes its constants"),
        (MessageDefinitionFormat.IDL, "const long X = 1 << 99999999999;", "computes its constants"),
        (MessageDefinitionFormat.IDL, "/* " * 80_000, "Could not parse"),
    ],
)
def test_definitions_that_make_endless_code_are_refused(
    format_: MessageDefinitionFormat, text: str, words: str
) -> None:
    ext = ConnectionExtRosbag2("cdr", [])
    definition = MessageDefinition(format_, text)
    nobody: Any = None
    try:
        said = str(_types(Connection(1, "/x", "a/msg/B", definition, "", 1, ext, nobody)))
    except Exception as error:  # as BagFile takes it
        said = str(error)
    assert words in said


def test_an_array_of_numbers_is_one_field_however_long() -> None:
    fields = _fields(get_types_from_msg("float32[100000] a\nuint8 b\n", "a/msg/B"))
    assert fields == 2


@pytest.mark.parametrize("sqlite", [False, True])
def test_one_file_of_compressed_messages_says_so(
    tmp_path: Path, refused: Refused, sqlite: bool
) -> None:
    path = BagMaker().skin("/skin", 0.1).write(tmp_path / "session", sqlite, "message")
    assert "messages are compressed" in refused("info", path / (SQLITE if sqlite else MCAP))
    assert open_source(path, Wanted()).streams
