# SPDX-License-Identifier: Apache-2.0

"""Every reader of files that users name, given what is no file, too large, empty, or shrinking."""

import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactile_cdma.base.errors import ParameterError, TactileError
from tactile_cdma.base.named_file import existing
from tactile_cdma.base.whole_file import replace_file
from tactile_cdma.calibrating.load_session import LoadSession
from tactile_cdma.calibrating.load_table import read_table
from tactile_cdma.config.body_file import read_body
from tactile_cdma.config.parameters import read_file
from tactile_cdma.datasets.lerobot.meta import DatasetMeta
from tactile_cdma.hardware.programmer import node_image, read_memory
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from tactile_cdma.places.surface_file import read_link, read_triangles
from tactile_cdma.readings.calibration_file import read_any, seal_calibration
from tactile_cdma.recording.recording_file import describe, is_text, read_pieces, survey
from tactile_cdma.recording.scope_csv import read_scope_csv
from tactile_cdma.rest.rest_file import read_rest
from test.support.bounds import bounded

SPARSE_BYTES = 4 << 30


def session(path: Path) -> None:
    """Add points to a table, up to the first one: there is no driver."""
    nothing: Any = None
    LoadSession(nothing, nothing, 0.01, [1], 1.0).run(path, [], append=True)


READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "parameters": ("skin.yaml", read_file),
    "layout": ("layout.yaml", lambda path: read_layout(path, Wiring())),
    "body": ("body.yaml", read_body),
    "calibration": ("calibration.yaml", read_any),
    "sealed": ("calibration.yaml", seal_calibration),
    "loads": ("loads.csv", read_table),
    "session": ("loads.csv", session),
    "state": ("skin.rest.yaml", read_rest),
    "recording": ("touch.skin", survey),
    "description": ("touch.skin", describe),
    "capture": ("capture.bin", is_text),
    "scope": ("scope.csv", read_scope_csv),
    "stl": ("part.stl", read_triangles),
    "obj": ("part.obj", read_triangles),
    "urdf": ("robot.urdf", lambda path: read_link(path, "palm")),
    "dataset": ("meta/info.json", lambda path: DatasetMeta.read(path.parent.parent)),
    "node": ("node.hex", read_memory),
    "bytes": ("node.bin", read_memory),
    "program": ("node.hex", lambda path: node_image("atmega328p", [bytes(64)], 16, path)),
}
"""Readers by what they read: a file's name, and what reads it."""


def refused(reader: str, folder: Path, make: Callable[[Path], object]) -> str:
    """Return how a reader refuses what make puts in its file's place."""
    name, read = READERS[reader]
    path = folder / name
    path.parent.mkdir(exist_ok=True)
    make(path)
    with bounded(), pytest.raises((TactileError, ValueError)) as caught:
        read(path)
    assert path.name in str(caught.value) or folder.name in str(caught.value)
    return str(caught.value)


def socket_at(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        before = Path.cwd()
        os.chdir(path.parent)  # a socket's path is short
        try:
            listener.bind(path.name)
        finally:
            os.chdir(before)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    ("kind", "make"),
    [
        ("a pipe", os.mkfifo),
        ("a device", lambda path: path.symlink_to("/dev/zero")),
        ("a socket", socket_at),
        ("a folder", Path.mkdir),
    ],
)
def test_what_is_no_file_is_named_as_such(
    tmp_path: Path, reader: str, kind: str, make: Callable[[Path], object]
) -> None:
    assert f"is {kind}, not a file" in refused(reader, tmp_path, make)


@pytest.mark.parametrize("reader", [each for each in READERS if each not in {"session"}])
def test_an_empty_file_is_refused(tmp_path: Path, reader: str) -> None:
    refused(reader, tmp_path, Path.touch)


@pytest.mark.parametrize("reader", [each for each in READERS if each not in {"capture"}])
def test_4_gib_are_refused_in_bounded_time_and_memory(tmp_path: Path, reader: str) -> None:
    said = refused(reader, tmp_path, lambda path: (path.touch(), os.truncate(path, SPARSE_BYTES)))
    streamed = "not a recording" in said
    assert streamed or f"has {SPARSE_BYTES} bytes, such files at most" in said


def test_what_is_read_piece_by_piece_has_no_limit(tmp_path: Path) -> None:
    path = tmp_path / "capture.bin"
    path.touch()
    os.truncate(path, SPARSE_BYTES)
    with bounded():
        assert is_text(path) is False
        assert next(read_pieces(path)).count(0) == 1 << 16


@pytest.mark.parametrize(
    "reader", [each for each in READERS if each not in {"recording", "description", "capture"}]
)
def test_a_file_that_shrinks_while_it_is_read_is_not_taken_for_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str
) -> None:
    look, name = os.fstat, READERS[reader][0]

    def cut(descriptor: int) -> os.stat_result:
        status = look(descriptor)
        if Path(os.readlink(f"/proc/self/fd/{descriptor}")).name == Path(name).name:
            os.truncate(tmp_path / name, status.st_size // 2)
        return status

    monkeypatch.setattr(os, "fstat", cut)
    said = refused(reader, tmp_path, lambda path: path.write_text("node,pressure\n" * 64))
    assert "changed as they were read" in said


def test_parameter_files_of_ros_are_files(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=f"{tmp_path.name}: not a file"):
        existing(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ParameterError, match="pipe: not a file"):
        existing(tmp_path / "pipe")


def test_a_pipe_beside_a_file_hinders_nobody_who_writes_it(tmp_path: Path) -> None:
    """As a writer looks for what killed writers have left, some names could be anybody's."""
    pipe = tmp_path / ".table.csv.01234567"
    os.mkfifo(pipe)
    with bounded():
        replace_file(tmp_path / "table.csv", "text")
    assert (tmp_path / "table.csv").read_text() == "text" and pipe.is_fifo()


@pytest.mark.parametrize(
    ("encoding", "named"), [("utf-16", "in UTF-16"), ("latin-1", "in Latin-1")]
)
def test_another_encoding_is_named(tmp_path: Path, encoding: str, named: str) -> None:
    path = tmp_path / "file"
    path.write_bytes("node,pressure_kpa,voltage_v\n# 20 °C\n1,2,3\n".encode(encoding))
    for read in (read_table, read_file, session):
        with pytest.raises(TactileError, match=f"UTF-8, but {named}"):
            read(path)
    path.write_bytes("node,pressure_kpa,voltage_v\n1,2,3\n".encode("utf-8-sig"))
    assert np.allclose(read_table(path).columns["pressure"], 2000)
