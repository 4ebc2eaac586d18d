# SPDX-License-Identifier: Apache-2.0

"""Damaged bags: one clear error, whatever the library makes of them."""

import os
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import pytest
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2 import storage_mcap
from rosbags.typesys import Stores, get_typestore

from tactile_cdma.base.errors import CaptureError
from tactile_cdma.datasets.sources.bag_file import MOST_CHUNK_BYTES, _types
from tactile_cdma.datasets.sources.opening import Wanted, open_source
from test.support.bags import ARRAY, INFO, BagMaker
from test.support.command_line import Refused

pytestmark = pytest.mark.xdist_group("datasets")
_mcap: Any = storage_mcap
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
        assert f"{path}: no bag, or damaged or cut short: " in said
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


def test_metadata_of_4_gib_are_refused_unread(tmp_path: Path, refused: Refused) -> None:
    (tmp_path / METADATA).touch()
    os.truncate(tmp_path / METADATA, 4 << 30)
    assert f"has {4 << 30} bytes, such files at most" in refused("info", tmp_path)


def test_a_view_without_an_end_is_refused(tmp_path: Path, refused: Refused) -> None:
    path = BagMaker().skin("/skin", 0.1).write(tmp_path / "session", sqlite=True) / SQLITE
    with closing(sqlite3.connect(path)) as changed:
        changed.executescript(
            "DROP TABLE schema; CREATE VIEW schema AS WITH RECURSIVE endless(schema_version) AS "
            "(SELECT 1 UNION ALL SELECT schema_version + 1 FROM endless) "
            "SELECT max(schema_version) AS schema_version FROM endless"
        )
    assert "views" in refused("info", path)
    assert "views" in refused("info", path.parent)


@pytest.mark.parametrize("kind", ["zstd", "lz4"])
def test_what_unpacks_to_too_much_is_not_unpacked(kind: str) -> None:
    """By what the bag says of a chunk, and by what it has, which may be another size."""
    pack = _mcap.zstd.compress if kind == "zstd" else lz4.frame.compress
    unpack = _mcap.DECOMPRESSORS[kind]
    assert unpack(pack(b"frames"), 6) == b"frames"
    bomb = pack(bytes(MOST_CHUNK_BYTES + 1))
    assert len(unpack(bomb, 100)) == 101  # of another size than it says: rosbags refuses it
    with pytest.raises(ValueError, match="made to fill the memory"):
        unpack(bomb, MOST_CHUNK_BYTES + 1)


@pytest.mark.parametrize(
    ("format_", "text", "words"),
    [
        (MessageDefinitionFormat.MSG, "string[300000000] a", "300000000 fields, more than"),
        (MessageDefinitionFormat.MSG, "string a\n" * 100_000, "100000 fields, more than"),
        (MessageDefinitionFormat.IDL, "const long X = ((1));", "parentheses in parentheses"),
    ],
)
def test_definitions_that_make_endless_code_are_refused(
    format_: MessageDefinitionFormat, text: str, words: str
) -> None:
    ext = ConnectionExtRosbag2("cdr", [])
    definition = MessageDefinition(format_, text)
    nobody: Any = None
    assert words in str(_types(Connection(1, "/x", "a/msg/B", definition, "", 1, ext, nobody)))
