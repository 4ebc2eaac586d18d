# SPDX-License-Identifier: Apache-2.0

"""Every reader of files × every odd file: each is read or refused, in bounded time and memory.

Each case runs in a process of its own, which is forked, so that what hangs in C, or is killed for
its memory, is found, too.
"""

from __future__ import annotations

import os
import random
import re
import signal
import socket
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

from tactile_cdma.base.errors import TactileError
from tactile_cdma.base.interrupt import terminable
from test.support.bounds import HangError, bounded, room

from ..fuzz.target import MOST_TEXT
from ..outcome import Outcome, Plan
from .readers import READERS, Reader, placed

SPARSE_BYTES = 4 << 30
STREAMED, STREAMED_BYTES = ("capture.bin",), 64 << 20
"""Files that are decoded piece by piece, however long they are, and how long they are here."""
LONGEST_S, LONGEST_WAIT_S = 60.0, 200.0
"""For one file: of the processor's time, and on a busy computer's clock, s."""
END_S = 10.0
"""After a signal a reader's process is over within this time, s; chosen: on a busy computer."""
MOST_LARGE = {True: 1 << 20, False: 1 << 27}
"""Most bytes of a large file, where its reader takes more."""
MOST_SIGNAL_S = {True: 0.3, False: 3.0}
"""A signal comes at a random time after the beginning, at most so late, s."""
REFUSED, WRONG, SLOW, KILLED = 0, 1, 2, 3
"""How a reader's process ends: as it should, with a defect, late, by a signal as it should."""
SHRINKS = "a file that shrinks"


def run(plan: Plan) -> Iterator[Outcome]:
    """Give every reader every odd file, then one as large as it takes, whole and interrupted."""
    warm(READERS)
    for kind, make in ODD.items():
        yield tried(kind, READERS, make)
    yield tried("as many bytes as are taken", READERS, partial(large, MOST_LARGE[plan.quick]))
    for number in (signal.SIGINT, signal.SIGTERM):
        rng = random.Random(plan.seed + number)
        yield interrupted(number, READERS, MOST_LARGE[plan.quick], MOST_SIGNAL_S[plan.quick], rng)


def warm(readers: dict[str, Reader]) -> None:
    """Have all modules loaded and all contents made: what that takes is no reader's."""
    for reader in readers.values():
        with TemporaryDirectory() as folder, suppress(TactileError):
            reader.read(placed(reader, Path(folder), partial(_whole, reader=reader)))


def tried(kind: str, readers: dict[str, Reader], make: Make) -> Outcome:
    """Give each reader such a file."""
    ends = Counter[int]()
    for name, reader in readers.items():
        with TemporaryDirectory() as folder:
            path = placed(reader, Path(folder), partial(make, reader=reader))
            end = _ended(_forked(partial(_read, reader, path, kind)), LONGEST_WAIT_S)
            if end != REFUSED:
                print(f"{name}, {kind}: ended with {end}", file=sys.stderr)
            ends[end] += 1
    return _outcome(f"readers given {kind}", ends)


def interrupted(
    number: int, readers: dict[str, Reader], most_bytes: int, most_s: float, rng: random.Random
) -> Outcome:
    """Send a signal to each reader in the midst of a large file."""
    ends = Counter[int]()
    for name, reader in readers.items():
        with TemporaryDirectory() as folder:
            path = placed(reader, Path(folder), partial(large, most_bytes, reader=reader))
            process = _forked(partial(_read, reader, path, ""))
            time.sleep(rng.uniform(0.0, most_s))
            os.kill(process, number)
            if (end := _ended(process, END_S)) not in (REFUSED, KILLED):
                print(f"{name}, signal {number}: ended with {end}", file=sys.stderr)
            ends[end] += 1
    return _outcome(f"readers ended by {signal.Signals(number).name}", ends)


def _outcome(fault: str, ends: Counter[int]) -> Outcome:
    crashes = sum(count for end, count in ends.items() if end not in (REFUSED, KILLED, SLOW))
    return Outcome(fault, ends.total(), crashes=crashes, hangs=ends[SLOW])


# ---- odd files


class Make(Protocol):
    """Puts a file where a reader looks for its own."""

    def __call__(self, path: Path, reader: Reader) -> object: ...


def _whole(path: Path, reader: Reader) -> None:
    path.write_bytes(reader.content())


def _socket(path: Path, reader: Reader) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        before = Path.cwd()
        os.chdir(path.parent)  # a socket's path is short
        try:
            listener.bind(path.name)
        finally:
            os.chdir(before)


def _sparse(path: Path, reader: Reader) -> None:
    path.write_bytes(reader.content()[:64])
    os.truncate(path, SPARSE_BYTES if path.name not in STREAMED else STREAMED_BYTES)


def _other_kind(path: Path, reader: Reader) -> None:
    other = next(one for one in READERS.values() if Path(one.name).suffix != path.suffix)
    path.write_bytes(other.content())


ODD: dict[str, Make] = {
    "their own file": _whole,
    "a pipe": lambda path, reader: os.mkfifo(path),
    "/dev/zero": lambda path, reader: path.symlink_to("/dev/zero"),
    "/dev/tty": lambda path, reader: path.symlink_to("/dev/tty"),
    "a socket": _socket,
    "a folder": lambda path, reader: path.mkdir(),
    "nothing": lambda path, reader: None,
    "a link to itself": lambda path, reader: path.symlink_to(path.name),
    "an empty file": lambda path, reader: path.touch(),
    "4 GiB": _sparse,
    "half of a file": lambda path, reader: path.write_bytes(
        reader.content()[: len(reader.content()) // 2]
    ),
    "another kind of file": _other_kind,
    "noise": lambda path, reader: path.write_bytes(random.Random(1).randbytes(4096)),
    "UTF-16": lambda path, reader: path.write_bytes(
        reader.content().decode("latin-1").encode("utf-16")
    ),
    SHRINKS: lambda path, reader: path.write_bytes(reader.content() * 2),
}


def large(most_bytes: int, path: Path, reader: Reader) -> None:
    """Repeat what a reader reads, up to the most bytes that it says to take."""
    _sparse(path, reader)
    limit = most_bytes
    try:
        reader.read(path)
    except TactileError as error:
        if told := re.search(r"such files at most (\d+)", str(error)):
            limit = min(int(told[1]), most_bytes)
    content = reader.content()
    path.write_bytes((content * (limit // len(content) + 1))[:limit])


# ---- a process for each


def _read(reader: Reader, path: Path, kind: str) -> int:
    """Read a file, in bounds; returns how that ends."""
    if kind == SHRINKS:
        cut_when_looked_at(path)
    try:
        with terminable(), bounded(room(path), LONGEST_S, LONGEST_WAIT_S):
            reader.read(path)
    except TactileError as error:
        said = str(error)
        return REFUSED if said.isprintable() and 0 < len(said) <= MOST_TEXT else WRONG
    except HangError:
        traceback.print_exc()
        return SLOW
    return REFUSED


def cut_when_looked_at(path: Path) -> None:
    """Cut a file in half whenever a program has asked for its size."""
    look = os.fstat

    def cut(descriptor: int) -> os.stat_result:
        status = look(descriptor)
        if os.readlink(f"/proc/self/fd/{descriptor}") == str(path):
            os.truncate(path, status.st_size // 2)
        return status

    system: Any = os
    system.fstat = cut


def _forked(run: Callable[[], int]) -> int:
    """Run a function in a process of its own, which ends with what it returns; its number."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # until the child can hear it
    if process := os.fork():
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        return process
    end = WRONG
    signal.signal(signal.SIGINT, signal.default_int_handler)  # whatever the parent has made of it
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        end = run()
    except KeyboardInterrupt:
        end = KILLED
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(end)


def _ended(process: int, wait_s: float) -> int:
    """Wait for a process to end, and return how; SLOW if it does not."""
    end_s = time.monotonic() + wait_s
    while time.monotonic() < end_s:
        ended, status = os.waitpid(process, os.WNOHANG)
        if ended:
            code = os.waitstatus_to_exitcode(status)
            return KILLED if code == -signal.SIGTERM else code
        time.sleep(0.005)
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return SLOW
