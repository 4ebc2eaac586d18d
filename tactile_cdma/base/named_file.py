# SPDX-License-Identifier: Apache-2.0

"""Files named by a user: only regular ones are opened, and none is read beyond a size."""

import errno
import logging
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from .errors import ParameterError, TactileError
from .shipped import shipped
from .text import closest

_log = logging.getLogger(__name__)


def existing(path: Path, kind: str = "parameter file") -> Path:
    """Return the path of a file; raises ParameterError, with a likely one, if there is none."""
    if path.is_file():
        return path
    path = path.absolute()
    beside = {file.stem: file for file in path.parent.glob(f"*{path.suffix}")}
    near = closest(path.stem, beside)
    meant = shipped(f"config/{path.name}") or (beside[near] if near else None)
    raise ParameterError(f"no {kind} {path}" + (f"; did you mean {meant}?" if meant else ""))


def open_named(path: Path) -> BinaryIO:
    """Open a file for reading. Raises OSError for pipes and devices, too: reading may never end."""
    try:
        mode = os.stat(path).st_mode
    except ValueError:  # NUL or a lone surrogate
        raise OSError(errno.EINVAL, "no file can have this name") from None
    if stat.S_ISDIR(mode):
        raise OSError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "not a file")
    _log.debug("reading %s", path)
    return path.open("rb")


def read_named(path: Path, most_bytes: int) -> bytes:
    """Read a whole file. Raises OSError as open_named, and for a file of more than most_bytes."""
    with open_named(path) as file:
        if os.fstat(file.fileno()).st_size > most_bytes:
            raise OSError(
                errno.EFBIG, f"is larger than {most_bytes >> 20} MB; is it the right file?"
            )
        return file.read(most_bytes)  # even if it grows meanwhile


def expanded(text: str) -> Path:
    """Make a path of what users write, relative to the working folder or the home folder (~).

    As in robot descriptions, it may be a URL: file:///tmp/a.yaml, or package://my_robot/a.yaml, in
    the share folder of a package. Raises ValueError with the reason if there can be no such path.
    """
    if "\0" in text:
        raise ValueError("no file can have this name")
    kind, _, place = text.partition("://")
    if place and kind == "package":
        name, _, tail = place.partition("/")
        return package_share(name) / tail
    if place and kind == "file":
        text = place
    elif place:
        raise ValueError(f"paths may begin with package:// or file://, but not with {kind}://")
    try:
        return Path(text).expanduser()
    except RuntimeError:
        raise ValueError("no such user's home") from None


def package_share(name: str) -> Path:
    """Find the share folder of an installed ROS package; raises ValueError if there is none."""
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    for prefix in filter(None, prefixes):
        if (folder := Path(prefix) / "share" / name).is_dir():
            return folder
    raise ValueError(
        f"no package {name!r} in AMENT_PREFIX_PATH: is it built, and its workspace sourced?"
    )


@contextmanager
def naming(path: Path, kind: type[TactileError], failure: str = "") -> Iterator[None]:
    """Turn an OSError into `kind`: the file's name, what has failed, the reason."""
    try:
        yield
    except TactileError:  # a PortError is an OSError as well
        raise
    except OSError as error:
        raise kind(": ".join(filter(None, (str(path), failure, error.strerror)))) from None
