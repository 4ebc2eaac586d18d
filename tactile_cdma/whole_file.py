"""Text files that are replaced as a whole: readers find the old content or the new one."""

from __future__ import annotations

import errno
import os
import tempfile
from contextlib import suppress
from pathlib import Path


def replace_file(path: Path, text: str) -> None:
    """Write a file in UTF-8 that all may read, in a folder that is there.

    Raises OSError; whatever was at the path, or at where a link there points, is then untouched.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():  # root could put a file where /dev/null was
        raise OSError(errno.EINVAL, "not a file")
    # mkstemp's file is for its owner only; this one is for whoever may read the folder.
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
            os.fchmod(file.fileno(), 0o644)
            file.flush()
            os.fsync(file.fileno())  # else a power cut may leave the new name on nothing
        os.replace(name, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(name)
        raise
