# SPDX-License-Identifier: Apache-2.0

"""Files named by a user: those that could block a reader or fill its memory are refused."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tactile_cdma.base.named_file import expanded, open_named, read_named


def test_a_file_is_read_up_to_its_limit(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"x" * (1 << 20))
    assert len(read_named(path, 1 << 20)) == 1 << 20
    with path.open("ab") as file:
        file.write(b"x")
    with pytest.raises(OSError, match="larger than 1 MB"):
        read_named(path, 1 << 20)


def test_pipes_devices_and_folders_are_refused_without_waiting(tmp_path: Path) -> None:
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    os.mkfifo(pipe)
    link.symlink_to("/dev/zero")
    for path in (pipe, link):
        with pytest.raises(OSError, match="not a file"):
            open_named(path)
    with pytest.raises(OSError, match="Is a directory"):
        open_named(tmp_path)
    with pytest.raises(OSError, match="No such file"):
        open_named(tmp_path / "none")


@pytest.mark.parametrize("name", ["a\0b", "a\ud800"])
def test_names_that_no_file_can_have_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(OSError, match="no file can have this name"):
        open_named(tmp_path / name)


def test_paths_of_users_begin_in_the_home_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/somebody")
    assert expanded("~/skin.yaml") == Path("/home/somebody/skin.yaml")
    assert expanded("skin.yaml") == Path("skin.yaml")
    for text, reason in (("~nobody-of-this-name/a", "no such user"), ("~\0", "no file can have")):
        with pytest.raises(ValueError, match=reason):
            expanded(text)
