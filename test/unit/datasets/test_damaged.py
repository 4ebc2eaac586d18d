# SPDX-License-Identifier: Apache-2.0

"""Damaged bags, tables and datasets: one clear error, whatever the libraries make of them."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.commands.cli import main
from test.support.bags import BagMaker

pytestmark = pytest.mark.xdist_group("datasets")
MCAP, SQLITE, METADATA = "session.mcap", "session.db3", "metadata.yaml"


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    """Files of a bag of either kind, by the name of the one with messages."""
    maker = BagMaker()
    maker.skin("/skin", 1.0)
    folder = tmp_path_factory.mktemp("damaged")
    return {
        name: {file.name: file.read_bytes() for file in path.iterdir()}
        for name, path in (
            (MCAP, maker.write(folder / "mcap" / "session")),
            (SQLITE, maker.write(folder / "sqlite" / "session", sqlite=True)),
        )
    }


def told(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert main(words) == 1
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    return said


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
    capsys: pytest.CaptureFixture[str],
    kind: str,
    damaged: str,
    damage: Callable[[bytes], bytes],
) -> None:
    path = tmp_path / "session"
    path.mkdir()
    for name, content in bags[kind].items():
        (path / name).write_bytes(damage(content) if name == damaged else content)
        assert name != damaged or damage(content) != content
    for words in (["info", str(path)], ["export", str(path), "-o", str(tmp_path / "out.npz")]):
        said = told(words, capsys)
        assert f"{path}: no bag, or damaged or cut short: " in said
        assert ("`mcap recover`" in said) == (kind == MCAP)
    assert not (tmp_path / "out.npz").exists()


def with_method(raw: bytes) -> bytes:
    """An NPZ file whose members say that they are compressed in a way that nobody knows."""
    found = bytearray(raw)
    for mark, place in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        at = raw.find(mark)
        while at >= 0:
            found[at + place] = 99
            at = raw.find(mark, at + 1)
    return bytes(found)


def with_garbage(raw: bytes) -> bytes:
    """The same with other bytes in the compressed data of pressure_pa."""
    with zipfile.ZipFile(io.BytesIO(raw)) as archive:
        at = archive.getinfo("pressure_pa.npy").header_offset + 200
    return raw[:at] + b"\xff" * 300 + raw[at + 300 :]


def with_header(raw: bytes) -> bytes:
    """The same with a header of pressure_pa that Python cannot parse."""
    written = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(raw)) as archive, zipfile.ZipFile(written, "w") as copy:
        for name in archive.namelist():
            content = archive.read(name)
            if name == "pressure_pa.npy":
                content = content.replace(b"{'descr': ", b"('descr': ")
            copy.writestr(name, content)
    return written.getvalue()


@pytest.mark.parametrize("damage", [with_method, with_garbage, with_header, lambda raw: raw[:-50]])
def test_a_damaged_npz(
    bags: dict[str, dict[str, bytes]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    damage: Callable[[bytes], bytes],
) -> None:
    (tmp_path / MCAP).write_bytes(bags[MCAP][MCAP])
    path = tmp_path / "out.npz"
    assert main(["export", str(tmp_path / MCAP), "-o", str(path)]) == 0
    with np.load(path) as table:
        assert len(table["sequence"]) == 78
    path.write_bytes(damage(path.read_bytes()))
    assert f"{path}: not a table of tactile-cdma, or damaged: " in told(["info", str(path)], capsys)


@pytest.mark.parametrize(
    ("value", "damaged"), [('"fps": 30', '"fps": 0'), ('"total_frames": 2', '"total_frames": "2')]
)
def test_a_dataset_with_damaged_metadata(
    bags: dict[str, dict[str, bytes]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    value: str,
    damaged: str,
) -> None:
    pytest.importorskip("pyarrow")
    (tmp_path / MCAP).write_bytes(bags[MCAP][MCAP])
    out = tmp_path / "out"
    assert main(["export", str(tmp_path / MCAP), "--lerobot", str(out), "--fps", "30"]) == 0
    capsys.readouterr()
    info = out / "meta/info.json"
    text = info.read_text()
    assert value in text
    info.write_text(text.replace(value, damaged))
    assert f"{out}: not a dataset of LeRobot v3, or damaged: " in told(["info", str(out)], capsys)


def test_a_dataset_without_its_data(
    bags: dict[str, dict[str, bytes]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pyarrow")
    (tmp_path / MCAP).write_bytes(bags[MCAP][MCAP])
    out = tmp_path / "out"
    assert main(["export", str(tmp_path / MCAP), "--lerobot", str(out), "--fps", "30"]) == 0
    capsys.readouterr()
    assert main(["info", str(out)]) == 0
    assert "problem" not in capsys.readouterr().out
    [file] = (out / "data").glob("*/*.parquet")
    file.write_bytes(file.read_bytes()[:-100])
    assert f"{out}: not a dataset of LeRobot v3, or damaged" in told(["info", str(out)], capsys)
    shutil.rmtree(out / "data")
    assert main(["info", str(out)]) == 0
    said = capsys.readouterr().out
    assert "problem: data/ holds 0 rows of the 2" in said
    assert "gaps" not in said and "invalid" not in said, "nothing was read"
