# SPDX-License-Identifier: Apache-2.0

"""Files to decode offline: recordings, raw bytes of a port, or text (oscilloscope captures)."""

from collections.abc import Iterator
from pathlib import Path

from ..base.errors import CaptureError
from ..base.named_file import naming, open_named
from .container import RecordingParser
from .recording_file import describe, is_recording, read_chunks, read_pieces, survey

_TABLES = {b"PK\x03\x04": "NPZ", b"PAR1": "Parquet", b"sequence,device_time_s,": "CSV"}
"""How tables of frames begin."""
_NO_TEXT = bytes(range(1, 32)).translate(None, b"\t\n\v\f\r\x1a\x1b")
"""Bytes that text does not hold, but raw packets do. Some scopes fill up their text with zeros."""


def is_text(path: Path) -> bool:
    """Whether a capture is text of a scope rather than raw packets, each of which ends with a zero.

    Raises CaptureError where it cannot be read, is empty, or is a table that was exported.
    """
    # open_named refuses pipes: a capture is read more than once
    with naming(path, CaptureError), open_named(path) as file:
        head = file.read(65_536)
    if not head:
        raise CaptureError(f"{path}: the file is empty")
    for beginning, kind in _TABLES.items():
        if head.startswith(beginning):
            raise CaptureError(
                f"{path}: {kind}, such as export writes: it holds no samples to decode"
            )
    if head[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" not in head:  # UTF-16 has zeros
        return True
    text = head.replace(b"\0", b"")
    return bool(text) and text.translate(None, _NO_TEXT) == text


def read_bytes(path: Path) -> Iterator[tuple[bytes, float]]:
    """Bytes of a port, and when they were read, s on the monotonic clock of the recording host.

    From a recording, or from a file of the bytes alone, which has no times: 0 then.
    Raises CaptureError where it cannot be read.
    """
    if is_recording(path):
        description = describe(path)
        for chunk in read_chunks(path, RecordingParser()):
            yield chunk.data, description.t_host(chunk.time_ns)
        return
    for data in read_pieces(path):
        yield data, 0.0


def capture_notes(path: Path) -> tuple[str, ...]:
    """What is wrong with a file that read_bytes reads, one sentence each."""
    return survey(path).notes if is_recording(path) else ()
