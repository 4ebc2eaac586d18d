# SPDX-License-Identifier: Apache-2.0

"""Files that are replaced as a whole: readers find the old content or the new one."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO


def replace_file(path: Path, text: str) -> None:
    """Write a text file in UTF-8; see replacing."""
    with replacing(path) as file:
        file.write(text.encode())


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A file to write, in a folder that is there; in place once it is whole.

    A new file is for whom the umask says, one that was there stays for whom it was. Raises OSError.
    If anything is raised within, too, whatever was at the path, or at where a link there points,
    stays untouched.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():  # root could put a file where /dev/null was
        raise OSError(errno.EINVAL, "not a file")
    # "x", and a name that nobody guesses: in a shared folder a link could wait there.
    unfinished = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    file = unfinished.open("x+b")
    try:
        with file:
            with suppress(FileNotFoundError):
                os.fchmod(file.fileno(), stat.S_IMODE(path.stat().st_mode))
            yield file
            file.flush()
            os.fsync(file.fileno())  # else a power cut may leave the new name on nothing
        os.replace(unfinished, path)
    except BaseException:
        with suppress(OSError):
            unfinished.unlink()
        raise
