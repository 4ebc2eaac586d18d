# SPDX-License-Identifier: Apache-2.0

"""Files: only regular ones of bounded size are read, and files are replaced as a whole."""

import os
import shutil
from pathlib import Path

import pytest

from tactile_cdma.base.errors import ParameterError
from tactile_cdma.base.named_file import existing, expanded, open_named, read_named
from tactile_cdma.base.whole_file import replace_file, replacing, whole_folder
from test.support.programs import run_python


def test_a_file_is_read_up_to_its_limit(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"x" * (1 << 20))
    assert len(read_named(path, 1 << 20)) == 1 << 20
    with path.open("ab") as file:
        file.write(b"x")
    with pytest.raises(OSError, match="has 1048577 bytes; files of this kind have 1048576 at most"):
        read_named(path, 1 << 20)


def test_pipes_devices_and_folders_are_refused_without_waiting(tmp_path: Path) -> None:
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    os.mkfifo(pipe)
    link.symlink_to("/dev/zero")
    for path in (pipe, link):
        with pytest.raises(OSError, match="not a file"):
            open_named(path)
    with pytest.raises(OSError, match="is a folder, not a file"):
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
    for text, reason in (("~nobody-of-this-name/a", "the user after"), ("~\0", "no file can have")):
        with pytest.raises(ValueError, match=reason):
            expanded(text)


def test_paths_may_be_the_urls_of_robot_descriptions(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "install" / "share" / "my_hand").mkdir(parents=True)
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/opt/ros/none{os.pathsep}{tmp_path / 'install'}")
    share = tmp_path / "install" / "share" / "my_hand"
    assert expanded("package://my_hand/layouts/palm.yaml") == share / "layouts" / "palm.yaml"
    assert expanded(f"file://{tmp_path}/palm.yaml") == tmp_path / "palm.yaml"
    with pytest.raises(ValueError, match="no package 'my_arm' in AMENT_PREFIX_PATH: is it built"):
        expanded("package://my_arm/palm.yaml")
    with pytest.raises(ValueError, match="package:// or file://, but not with https://"):
        expanded("https://host/palm.yaml")


def test_a_missing_file_is_told_with_the_one_that_was_meant(tmp_path: Path) -> None:
    (tmp_path / "my_skin.yaml").write_text("")
    for path, meant in (
        (tmp_path / "my_skn.yaml", "; did you mean .*my_skin.yaml"),
        (tmp_path / "wired_skin.yaml", "; did you mean .*/config/wired_skin.yaml"),
        (tmp_path / "skn_my.yaml", "skn_my.yaml$"),  # only its ending is like the other's
        (tmp_path / "void" / "x.yaml", "x.yaml$"),
    ):
        with pytest.raises(ParameterError, match=meant):
            existing(path)


def test_a_file_is_made_and_replaced(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    for text in ("first, of two lines\nµ\n", "second\n"):
        replace_file(path, text)
        assert path.read_text(encoding="utf-8") == text
        assert path.stat().st_mode & 0o777 == 0o644
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_a_new_file_has_the_permissions_of_the_umask(tmp_path: Path, umask: int, mode: int) -> None:
    path, before = tmp_path / "file.txt", os.umask(umask)
    try:
        replace_file(path, "text")
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == mode


def test_a_private_file_stays_private_from_the_first_byte(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")
    path.chmod(0o600)
    with replacing(path) as file:
        file.write(b"new")
        assert all(each.stat().st_mode & 0o777 == 0o600 for each in tmp_path.iterdir())
    assert path.read_text() == "new"
    assert path.stat().st_mode & 0o777 == 0o600


def test_a_link_keeps_pointing_to_the_replaced_file(tmp_path: Path) -> None:
    target, link = tmp_path / "palm.yaml", tmp_path / "current.yaml"
    target.write_text("old")
    link.symlink_to(target)
    replace_file(link, "new")
    assert link.is_symlink() and target.read_text() == "new"


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failed_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")

    def fail(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(OSError, match="No space left"):
        replace_file(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_write_beyond_the_size_limit_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")
    program = (
        "import resource, sys; from pathlib import Path;"
        "from tactile_cdma.base.whole_file import replace_file;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100));"
        "replace_file(Path(sys.argv[1]), 'x' * 200)"
    )
    done = run_python("-c", program, path)
    assert "OSError: [Errno 27] File too large" in done.stderr
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_into_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    link = tmp_path / "table.csv"
    link.symlink_to(tmp_path / "gone" / "table.csv")
    with pytest.raises(
        OSError, match=r"it links to .*/gone/table\.csv, whose folder does not exist"
    ):
        replace_file(link, "text")
    with pytest.raises(OSError, match="whose folder does not exist"), whole_folder(link):
        pass


def test_what_killed_writers_leave_goes_with_the_next_write(tmp_path: Path) -> None:
    """But not what another one is writing now, nor what only looks alike."""
    pytest.importorskip("fcntl", reason="Windows itself keeps what is open")
    path = tmp_path / "skin[1].yaml"
    replace_file(path, "first")
    program = (
        "import os, sys; from pathlib import Path;"
        "from tactile_cdma.base.whole_file import replacing\n"
        "with replacing(Path(sys.argv[1])) as file:\n"
        "    file.write(b'half'); file.flush(); os.kill(os.getpid(), 9)"
    )
    for _ in range(2):
        run_python("-c", program, path)
    (tmp_path / ".skin[1].yaml.backup").write_text("precious")
    [left] = tmp_path.glob(".skin*.????????")
    assert path.read_text() == "first"
    with replacing(path) as file:
        file.write(b"second")
        assert not left.exists()
        replace_file(path, "meanwhile")
    assert path.read_text() == "second"
    assert {each.name for each in tmp_path.iterdir()} == {path.name, ".skin[1].yaml.backup"}


@pytest.mark.parametrize("write", ["file", "folder"])
def test_names_are_on_the_disk_before_a_write_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: str
) -> None:
    synced, fsync = [], os.fsync

    def note(descriptor: int) -> None:
        synced.append(Path(os.readlink(f"/proc/self/fd/{descriptor}")))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", note)
    if write == "file":
        replace_file(tmp_path / "file.txt", "text")
    else:
        with whole_folder(tmp_path / "folder"):
            pass
    assert synced[-1] == tmp_path


def test_a_missing_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        replace_file(tmp_path / "none" / "file.txt", "new")


def test_what_is_not_a_regular_file_is_not_replaced(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, tmp_path):
        with pytest.raises(OSError, match="not a file"):
            replace_file(path, "text")
    assert pipe.is_fifo()


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    with whole_folder(folder) as unfinished:
        (unfinished / "one").write_text("1")
        assert not folder.exists()
    with pytest.raises(KeyboardInterrupt), whole_folder(folder) as unfinished:
        (unfinished / "two").write_text("2")
        raise KeyboardInterrupt
    assert [path.name for path in tmp_path.rglob("*")] == ["data", "one"]
    with whole_folder(folder) as unfinished:
        (unfinished / "two").write_text("2")
    assert [path.name for path in tmp_path.rglob("*")] == ["data", "two"]
    with pytest.raises(FileNotFoundError), whole_folder(folder) as unfinished:
        shutil.rmtree(unfinished)  # by somebody else: what was there has been moved away by then
    assert [path.name for path in tmp_path.rglob("*")] == ["data", "two"]


def test_a_link_keeps_pointing_to_the_replaced_folder(tmp_path: Path) -> None:
    real, link = tmp_path / "real" / "set", tmp_path / "link"
    real.mkdir(parents=True)
    (real / "old").touch()
    link.symlink_to(real)
    with whole_folder(link) as unfinished:
        (unfinished / "new").touch()
    assert link.is_symlink() and sorted(tmp_path.iterdir()) == [link, real.parent]
    assert list(real.parent.iterdir()) == [real] and list(real.iterdir()) == [real / "new"]
