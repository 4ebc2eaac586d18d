# SPDX-License-Identifier: Apache-2.0

"""Files that a user names, and those that come with the package: found, and read to a limit."""

import codecs
import errno
import logging
import math
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from .errors import ParameterError, TactileError
from .text import closest

_log = logging.getLogger(__name__)

_KINDS = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFDIR: "a folder"}
_UTF_16 = codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE
_AT_ONCE = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
"""Flags to open a file with: without waiting, where there are pipes and terminals among files."""
CHECKOUT = Path(__file__).resolve().parents[2]
"""Folder of the package; only in a checkout the files lie there as well."""


def shipped(name: str) -> Path | None:
    """Find a file in the checkout, a workspace's share folder, or a wheel; None: not installed."""
    folders = _share_folders("tactile_cdma")
    if (CHECKOUT / "package.xml").is_file():
        folders.insert(0, CHECKOUT)
    folders.append(CHECKOUT / "tactile_cdma" / "share")  # setup.py copies them there
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


def existing(path: Path, kind: str = "parameter file") -> Path:
    """Return the path of a file; raises ParameterError, with a likely one, if there is none."""
    if path.is_file():
        return path
    path = path.absolute()
    if path.exists():
        raise ParameterError(f"{path}: not a file, so no {kind}")
    beside = {file.stem: file for file in path.parent.glob(f"*{path.suffix}")}
    near = closest(path.stem, beside)
    meant = shipped(f"config/{path.name}") or (beside[near] if near else None)
    raise ParameterError(f"no {kind} {path}" + (f"; did you mean {meant}?" if meant else ""))


def open_named(path: Path, most_bytes: float = math.inf) -> BinaryIO:
    """Open a regular file of at most so many bytes for reading, without waiting for anything.

    Raises OSError for pipes, devices, sockets and folders, too: reading them may never end.
    """
    try:
        _check(os.stat(path), most_bytes)  # before it is opened: that resets a port's board
        descriptor = os.open(path, _AT_ONCE)
    except ValueError:  # NUL or a lone surrogate
        raise OSError(errno.EINVAL, "no file can have this name") from None
    try:
        _check(os.fstat(descriptor), most_bytes)  # it may be another one by now
    except OSError:
        os.close(descriptor)
        raise
    _log.debug("reading %s", path)
    return open(descriptor, "rb")


def read_named(path: Path, most_bytes: int) -> bytes:
    """Read a whole file. Raises OSError as open_named, and if its length changes meanwhile."""
    with open_named(path, most_bytes) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(size + 1)
    if len(data) != size:
        raise OSError(errno.EIO, f"its {size} bytes changed while they were read")
    return data


def read_text(path: Path, most_bytes: int) -> str:
    """Read a whole text. Raises OSError as read_named, and for another encoding than UTF-8."""
    data = read_named(path, most_bytes)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        other = "UTF-16" if data[:2] in _UTF_16 else "Latin-1, or no text at all"
        raise OSError(
            errno.EILSEQ, f"not a text file in UTF-8, but in {other}: save it as UTF-8"
        ) from None


def _check(status: os.stat_result, most_bytes: float) -> None:
    if not stat.S_ISREG(status.st_mode):
        kind = _KINDS.get(stat.S_IFMT(status.st_mode), "a device")
        raise OSError(errno.EINVAL, f"is {kind}, not a file")
    if status.st_size > most_bytes:
        raise OSError(
            errno.EFBIG, f"has {status.st_size} bytes; files of this kind have {most_bytes} at most"
        )


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
        if folder := next(filter(Path.is_dir, _share_folders(name)), None):
            return folder / tail
        raise ValueError(
            f"no package {name!r} in AMENT_PREFIX_PATH: is it built, and its workspace sourced?"
        )
    if place and kind == "file":
        text = place
    elif place:
        raise ValueError(f"paths may begin with package:// or file://, but not with {kind}://")
    try:
        return Path(text).expanduser()
    except RuntimeError:
        raise ValueError("the user after ~ has no home folder") from None


def _share_folders(package: str) -> list[Path]:
    """List where an installed ROS package may have its share folder."""
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return [Path(prefix) / "share" / package for prefix in filter(None, prefixes)]


@contextmanager
def naming(path: Path, kind: type[TactileError], failure: str = "") -> Iterator[None]:
    """Turn an OSError into `kind`: the file's name, what has failed, the reason."""
    try:
        yield
    except TactileError:  # a PortError is an OSError as well
        raise
    except OSError as error:
        raise kind(": ".join(filter(None, (str(path), failure, error.strerror)))) from None
