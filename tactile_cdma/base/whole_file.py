# SPDX-License-Identifier: Apache-2.0

"""Atomic replacement of files and folders: readers find the old content or the new one."""

import errno
import glob
import logging
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from .named_file import open_named

fcntl: Any
try:
    import fcntl
except ImportError:  # Windows, where nobody can remove a file that is open
    fcntl = None

_log = logging.getLogger(__name__)

MOST_ASIDE = 99
"""Files of one name that are kept aside. Chosen: more than anybody exchanges skins unnoticed."""


def replace_file(path: Path, text: str, follow: bool = True) -> None:
    """Replace a file by text in UTF-8; see replacing."""
    with replacing(path, follow) as file:
        file.write(text.encode())


@contextmanager
def replacing(path: Path, follow: bool = True) -> Iterator[BinaryIO]:
    """Yield a file to write, in an existing folder; it takes its place when the context ends.

    A new file has the permissions of the umask, a replaced one keeps its own; a link keeps
    pointing to the file that is replaced, unless `follow` is False. Raises OSError. After that, or
    any exception in the context, the old file is untouched. What programs that were killed left
    unfinished is removed.
    """
    path = _real(path) if follow else path
    if path.exists() and not path.is_file():  # root could replace /dev/null
        raise OSError(errno.EINVAL, "not a file")
    unfinished = _unfinished(path)
    file = unfinished.open("x+b")
    try:
        with _kept(file):  # beyond its closing: Windows renames no file that is open
            with file:
                with suppress(FileNotFoundError):
                    os.chmod(unfinished, stat.S_IMODE(path.stat().st_mode))
                yield file
                file.flush()
                os.fsync(file.fileno())  # or the new name may be an empty file after a power cut
            os.replace(unfinished, path)
        _sync(path.parent)
        _log.debug("wrote %s", path)
    except BaseException:
        with suppress(OSError):
            unfinished.unlink()
        raise


def keep_aside(path: Path) -> Path | None:
    """Give what is to be replaced another name, too, of its own: NAME.old, NAME.old2 and so on.

    Returns that name; None if there is no such file. Raises OSError.
    """
    for number in range(1, MOST_ASIDE + 1):
        aside = path.with_name(f"{path.name}.old{number if number > 1 else ''}")
        if os.path.lexists(aside):
            continue
        try:
            os.link(path, aside, follow_symlinks=False)  # so that it is never away
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError:  # a folder, or a file system without links
            os.rename(path, aside)
        _sync(path.parent)
        return aside
    raise OSError(errno.EEXIST, f"remove some of {path.name}.old…: there are {MOST_ASIDE}")


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder beside `path` to write in; it gets that name when the context ends.

    What was there is replaced; a link keeps pointing to the folder that is replaced. Raises
    OSError. After that, or any exception in the context, nothing has changed.
    """
    path = _real(path)
    unfinished = _unfinished(path)
    replaced = path.with_name(f"{unfinished.name}.old")
    unfinished.mkdir()
    try:
        yield unfinished
        with suppress(FileNotFoundError):
            os.rename(path, replaced)
        os.rename(unfinished, path)
    except BaseException:
        shutil.rmtree(unfinished, ignore_errors=True)
        if replaced.exists() and not path.exists():
            os.rename(replaced, path)
        raise
    _sync(path.parent)
    _log.debug("wrote the folder %s", path)
    shutil.rmtree(replaced, ignore_errors=True)


def _real(path: Path) -> Path:
    """Return what a path leads to; raises OSError for a link into a folder that is not there."""
    real = Path(os.path.realpath(path))
    if path.is_symlink() and not real.parent.is_dir():
        raise OSError(errno.ENOENT, f"it links to {real}, whose folder does not exist")
    return real


@contextmanager
def _kept(file: BinaryIO) -> Iterator[None]:
    """Tell other writers, see _unfinished, that a file has one until the context ends."""
    if fcntl is None:
        yield
        return
    with os.fdopen(os.dup(file.fileno())) as same:  # closing `file` does not end its lock
        fcntl.flock(same, fcntl.LOCK_EX)
        yield


def _unfinished(path: Path) -> Path:
    """Return a name beside a path to write at first; names of killed writers' files are removed.

    They are those that nobody has locked, or on Windows open. Random: in a shared folder somebody
    could have left a link there.
    """
    for left in path.parent.glob(f".{glob.escape(path.name)}.{'[0-9a-f]' * 8}"):
        with suppress(OSError), open_named(left) as file:
            if fcntl is None:
                file.close()
            else:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            left.unlink()
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}")


def _sync(folder: Path) -> None:
    """Have the names in a folder outlast a power cut, where the file system can."""
    with suppress(OSError):  # Windows opens no folders
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
