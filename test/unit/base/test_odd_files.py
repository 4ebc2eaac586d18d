# SPDX-License-Identifier: Apache-2.0

"""Every reader of files that users name, given what is no file, too large, empty, or shrinking."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tactile_cdma.base.errors import ParameterError, TactileError
from tactile_cdma.base.named_file import existing
from tactile_cdma.base.whole_file import replace_file
from tactile_cdma.calibrating.load_points import read_table
from tactile_cdma.config.parameters import read_file
from tactile_cdma.recording.recording_file import is_text, read_pieces
from test.support.bounds import bounded
from torture.files.campaign import ODD, SPARSE_BYTES, cut_when_looked_at
from torture.files.readers import READERS, placed, session

BAGS = {"mcap", "sqlite", "metadata"}
"""What another library reads, in words of its own where it is damaged."""
OURS = [reader for reader in READERS if reader not in BAGS]


def refused(reader: str, folder: Path, make: Callable[[Path], object]) -> str:
    """Return how a reader refuses what make puts in its file's place."""
    path = placed(READERS[reader], folder, make)
    with bounded(), pytest.raises(TactileError) as caught:
        READERS[reader].read(path)
    assert path.name in str(caught.value) or path.parent.name in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("reader", OURS)
@pytest.mark.parametrize("odd", ["a pipe", "/dev/zero", "a socket", "a folder"])
def test_what_is_no_file_is_named_as_such(tmp_path: Path, reader: str, odd: str) -> None:
    make = partial(ODD[odd], reader=READERS[reader])
    kind = odd.replace("/dev/zero", "a device")
    assert f"is {kind}, not a file" in refused(reader, tmp_path, make)


@pytest.mark.parametrize("reader", [each for each in OURS if each not in {"session"}])
def test_an_empty_file_is_refused(tmp_path: Path, reader: str) -> None:
    refused(reader, tmp_path, Path.touch)


@pytest.mark.parametrize("reader", [each for each in OURS if each not in {"capture"}])
def test_4_gib_are_refused_in_bounded_time_and_memory(tmp_path: Path, reader: str) -> None:
    said = refused(reader, tmp_path, lambda path: (path.touch(), os.truncate(path, SPARSE_BYTES)))
    streamed = "not a recording" in said
    assert streamed or f"has {SPARSE_BYTES} bytes; files of this kind have" in said


def test_what_is_read_piece_by_piece_has_no_limit(tmp_path: Path) -> None:
    path = tmp_path / "capture.bin"
    path.touch()
    os.truncate(path, SPARSE_BYTES)
    with bounded():
        assert is_text(path) is False
        assert next(read_pieces(path)).count(0) == 1 << 16


@pytest.mark.parametrize(
    "reader", [each for each in OURS if each not in {"recording", "description", "capture"}]
)
def test_a_file_that_shrinks_while_it_is_read_is_not_taken_for_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str
) -> None:
    monkeypatch.setattr(os, "fstat", os.fstat)  # which is replaced for this test
    cut_when_looked_at(tmp_path / READERS[reader].name)
    said = refused(reader, tmp_path, lambda path: path.write_text("node,pressure\n" * 64))
    assert "changed while they were read" in said


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
