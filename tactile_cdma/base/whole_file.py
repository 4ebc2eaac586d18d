# SPDX-License-Identifier: Apache-2.0

"""Atomic replacement of files and folders: readers find the old content or the new one."""

from __future__ import annotations

import errno
import logging
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

_log = logging.getLogger(__name__)


def replace_file(path: Path, text: str) -> None:
    """Replace a file by text in UTF-8; see replacing."""
    with replacing(path) as file:
        file.write(text.encode())


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A file to write, in an existing folder; it takes its place when the context ends.

    A new file has the permissions of the umask, a replaced one keeps its own; a link keeps
    pointing to the file that is replaced. Raises OSError. After that, or any exception in the
    context, the old file is untouched.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():  # root could replace /dev/null
        raise OSError(errno.EINVAL, "not a file")
    # "x" and a random name: in a shared folder somebody could have left a link there.
    unfinished = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    file = unfinished.open("x+b")
    try:
        with file:
            with suppress(FileNotFoundError):
                os.fchmod(file.fileno(), stat.S_IMODE(path.stat().st_mode))
            yield file
            file.flush()
            os.fsync(file.fileno())  # or the new name may be an empty file after a power cut
        os.replace(unfinished, path)
        _log.debug("wrote %s", path)
    except BaseException:
        with suppress(OSError):
            unfinished.unlink()
        raise


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """An empty folder beside `path` to write in; it gets that name when the context ends.

    What was there is replaced; a link keeps pointing to the folder that is replaced. Raises
    OSError. After that, or any exception in the context, nothing has changed.
    """
    path = Path(os.path.realpath(path))
    unfinished = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
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
    _log.debug("wrote the folder %s", path)
    shutil.rmtree(replaced, ignore_errors=True)
