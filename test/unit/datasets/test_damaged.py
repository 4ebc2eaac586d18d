# SPDX-License-Identifier: Apache-2.0

"""Damaged bags: one clear error, whatever the library makes of them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rosbags.typesys import Stores, get_typestore

from tactile_cdma.base.errors import CaptureError
from tactile_cdma.datasets.sources.opening import Wanted, open_source
from test.support.bags import ARRAY, INFO, BagMaker
from test.support.command_line import Refused

pytestmark = pytest.mark.xdist_group("datasets")
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
