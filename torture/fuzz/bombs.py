# SPDX-License-Identifier: Apache-2.0

"""Files made to fill the memory, or to keep a reader busy or waiting for ever."""

from __future__ import annotations

import os
import signal
import struct
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from tactile_cdma.base.errors import TactileError
from tactile_cdma.base.marked_yaml import MOST_BYTES, MOST_TEXT
from tactile_cdma.config.body_file import read_body
from tactile_cdma.config.parameters import read_file
from tactile_cdma.hardware.programmer import read_memory
from tactile_cdma.places.layout_file import read_layout
from tactile_cdma.places.layout_nodes import Wiring
from tactile_cdma.readings.calibration import AdcScale, PressureCurve
from tactile_cdma.readings.calibration_file import read_calibration
from tactile_cdma.recording.recording_file import (
    MAGIC,
    RecordingParser,
    describe,
    is_text,
    length_ns,
    read_bytes,
    survey,
)
from tactile_cdma.recording.recording_file import MOST_BYTES as MOST_RECORD
from tactile_cdma.recording.scope_csv import MOST_CSV_BYTES, read_scope_csv
from tactile_cdma.rest.rest_file import read_rest

HANG_S = 60.0
"""Time after which a reader hangs, on however busy a machine, s."""
MOST_HELD = 1 << 30
"""Most memory that a reader may use for a file it refuses, bytes."""
YAML: dict[str, Callable[[Path], object]] = {
    "layout": lambda path: read_layout(path, Wiring()),
    "calibration": lambda path: read_calibration(path, 3, AdcScale(), PressureCurve.two_stage()),
    "body": read_body,
    "rest": lambda path: _read_rest(path),
    "parameters": read_file,
}
OTHERS: dict[str, Callable[[Path], object]] = {
    "capture": is_text,
    "bytes": lambda path: list(read_bytes(path)),
    "scope": read_scope_csv,
    "recording": describe,
    "whole recording": survey,
    "end of recording": length_ns,
    "node memory": read_memory,
}
"""The readers of users' files."""
YAML_BOMBS: dict[str, Callable[[], bytes]] = {
    "aliases that multiply": lambda: _multiplying(30),
    "lists in lists": lambda: b"a: " + b"[" * 1_000_000,
    "keys in keys": lambda: b"{a: " * 500_000,
    "millions of values": lambda: b"a: [" + b"1," * (MOST_BYTES // 2 - 10) + b"1]",
    "a text without end": lambda: b"a: " + b"x" * (4 * MOST_TEXT),
    "a number without end": lambda: b"/**: {ros__parameters: {nodes: " + b"9" * 60_000 + b"}}",
    "a key without end": lambda: b"/**: {ros__parameters: {" + b"n" * 60_000 + b": 1}}",
    "more than is read": lambda: b"#" * (MOST_BYTES + 1),
    "tags": lambda: b"!!python/object/apply:os.abort []\n",
    "a merge of keys": lambda: b"a: &a {b: 1}\nc: {<<: *a}\n",
    "not a number": lambda: b"/**: {ros__parameters: {chip_us: .nan, baud: .inf}}",
    "controls of a terminal": lambda: b'"\\e]0;owned\\a\\u202E\\0": "\\e[2J"\n',
}


def _read_rest(path: Path) -> None:
    if read_rest(path) is None:  # a missing file is no error to it
        raise FileNotFoundError(path)


def _multiplying(times: int) -> bytes:
    """Lists that each hold the one before nine times."""
    lists = [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, times)]
    return "\n".join(["a0: &a0 [x]", *lists]).encode()


def crafted_recording(size: int) -> bytes:
    """A recording of headers alone, each of which claims a record of a megabyte."""
    head = struct.pack("<3scIIqQ", b"\xf1SK", b"D", 7, MOST_RECORD, 0, 0)
    return MAGIC + head * (size // len(head))


def parse_crafted(size: int) -> None:
    """Parse a crafted recording in chunks, as a file."""
    parser, data = RecordingParser(), crafted_recording(size)
    for begin in range(0, len(data), 1 << 16):
        parser.feed(data[begin : begin + (1 << 16)])
    parser.finish()


def oversized_csv(path: Path) -> None:
    """Write a sparse file above the limit of CSV files."""
    with path.open("wb") as file:
        file.write(b"0,1\n")
        file.truncate(MOST_CSV_BYTES + 1)


def never_ending(folder: Path) -> Iterator[Path]:
    """Yield paths that block, never end, or are no files."""
    fifo = folder / "fifo.bin"
    if not fifo.exists():
        os.mkfifo(fifo)
    link = folder / "link.bin"
    link.unlink(missing_ok=True)
    link.symlink_to("/dev/zero")
    yield from (fifo, link, folder, Path("/dev/tty"), folder / "a\0b.bin", folder / "a\ud800.bin")


class _LateError(BaseException):
    """No Exception, so that no reader catches it."""


@contextmanager
def in_time() -> Iterator[None]:
    """Raise TimeoutError in code that hangs, busy or waiting."""

    def late(signum: int, frame: FrameType | None) -> None:
        raise _LateError

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, HANG_S)
    try:
        yield
    except _LateError:
        raise TimeoutError("it hangs") from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def refuse(read: Callable[[Path], object], path: Path, measured: bool = True) -> int:
    """Check that a reader refuses a file; returns its peak memory, bytes, or 0 if not measured.

    Raises AssertionError if the file is accepted, TimeoutError if the reader hangs.
    """
    if measured:
        tracemalloc.start()
    try:
        with in_time():
            read(path)
    except TimeoutError:
        raise
    except (TactileError, OSError) as refusal:
        assert str(refusal).isprintable() or not isinstance(refusal, TactileError)
        return tracemalloc.get_traced_memory()[1] if measured else 0
    finally:
        tracemalloc.stop()
    raise AssertionError(f"{path} was taken")
