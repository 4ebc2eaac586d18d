# SPDX-License-Identifier: Apache-2.0

"""A bag as a file: its channels, and their messages as far as they can be read."""

import io
import math
import re
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self, cast

import lz4.frame  # type: ignore[import-untyped]
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2 import Reader, reader, storage_mcap
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ...base.errors import CaptureError
from ...base.named_file import naming, open_named
from ...messages.types import message_types
from ..lerobot import INFO
from ..samples import NANO

CDR = "cdr"
"""The encoding of ROS 2's messages."""
FAR_NS = 86_400 * NANO
"""Messages farther than this, ns, from most others were not recorded when they say. Chosen: a day,
since hardly a recorder is paused for so long, and damage or a clock that is set makes years."""
_IDL_RULE = "=" * 80 + "\nIDL: "
"""Before each file of a definition in IDL."""

MOST_METADATA_BYTES = 1 << 21
"""Largest metadata.yaml; chosen: of some 8,000 files, in 10 s."""
MOST_CHUNK_BYTES = 1 << 28
"""Most that a chunk or message of a bag unpacks to; chosen, hundreds of times what is usual."""
MOST_FIELDS = 10_000
"""Lines of a definition, and elements of its arrays of a fixed length, that rosbags makes code of,
in 1 ms each. Chosen: a hundred times what messages have."""
_ARRAY = re.compile(r"([\w/]+)(?:<=\d+)?\[(\d+)\]")
_AT_ONCE = re.compile(r"bool|byte|char|octet|u?int\d+|float\d+")
"""Types of which an array takes one line of code, however long it is."""
_NESTED = re.compile(r"\([^()]*\(")
_IDL_TEXT = re.compile(r'"(\\.|[^"\\])*"|//.*|/\*(?s:.)*?\*/')
_SQLITE = b"SQLite format 3\0"

_defined = storage_mcap.get_msgdef


def _defined_or_foreign(schema: storage_mcap.Schema | None) -> MessageDefinition:
    """Return no definition for a schema of another system (protobuf, JSON), where rosbags raises.

    One such channel would make all of the bag unreadable.
    """
    try:
        return _defined(schema)
    except KeyError:
        return MessageDefinition(MessageDefinitionFormat.NONE, "")


storage_mcap.get_msgdef = _defined_or_foreign


class _Checked(type(Path())):  # type: ignore[misc]
    """A path at which rosbags, which looks first whether it exists, finds nothing without an end.

    Raises CaptureError for pipes, devices, and sqlite's views, which can be queries without an end.
    """

    def exists(self, **options: bool) -> bool:
        if super().exists(**options) and not self.is_dir():
            is_metadata = self.name == "metadata.yaml"
            with naming(self, CaptureError):
                file = open_named(self, MOST_METADATA_BYTES if is_metadata else math.inf)
            with file:
                if file.read(len(_SQLITE)) == _SQLITE and _has_views(self):
                    raise CaptureError(f"{self}: has other views than a bag's tables")
        return bool(super().exists(**options))


def _has_views(path: Path) -> bool:
    found = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
    with closing(found):
        return bool(found.execute("SELECT 1 FROM sqlite_master WHERE type = 'view'").fetchone())


def _unpacked(kind: Any) -> Callable[[bytes, int], bytes]:
    """Return a decompressor of a chunk, which makes no more of it than the bag says, and MOST."""

    def decompress(data: bytes, size: int = MOST_CHUNK_BYTES) -> bytes:
        with kind.open(io.BytesIO(data)) as file:
            unpacked = file.read(min(size, MOST_CHUNK_BYTES) + 1)
        if len(unpacked) > MOST_CHUNK_BYTES:
            raise ValueError(
                f"a chunk or message unpacks to more than {MOST_CHUNK_BYTES} bytes; recorders "
                "write some 1 MB at once: was it made to fill the memory?"
            )
        return bytes(unpacked)

    return decompress


_reader: Any = reader
_zstd = _reader.zstd
storage_mcap.DECOMPRESSORS |= {"zstd": _unpacked(_zstd), "lz4": _unpacked(lz4.frame)}
_reader.zstd = SimpleNamespace(open=_zstd.open, decompress=_unpacked(_zstd))


class BagFile:
    """A folder with metadata.yaml, or one MCAP or sqlite3 file; a context manager.

    Types are made for the channels that are read, and for no other: what nobody asks for need not
    be readable. Raises CaptureError for whatever is wrong with the bag.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._types: dict[tuple[object, ...], Typestore | str] = {}
        with self._intact():
            self._reader = Reader(_Checked(path))

    def __enter__(self) -> Self:
        with self._intact():
            self._reader.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    @property
    def channels(self) -> Sequence[Connection]:
        """Return what was recorded: topic, type, number of messages."""
        return self._reader.connections

    @property
    def span_ns(self) -> tuple[int, int]:
        """Tell when the first and the last message were recorded, ns, by what most of them say.

        Damaged times may be centuries off.
        """
        begin_ns, end_ns = self._reader.start_time, self._reader.end_time
        if 0 <= end_ns - begin_ns <= FAR_NS:
            return begin_ns, end_ns
        with self._intact():  # reads all of the bag, as seldom as that is needed
            return believed_span(seen_ns for _, seen_ns, _ in self._reader.messages())

    def of(self, topic: str) -> list[Connection]:
        """Return the channels of a topic. Raises CaptureError for one that is not there."""
        if found := [channel for channel in self.channels if channel.topic == topic]:
            return found
        there = ", ".join(sorted({channel.topic for channel in self.channels}))
        raise CaptureError(f"{self.path}: no topic {topic} (there are {there})")

    def obstacle(self, channel: Connection) -> str | None:
        """Say why the messages of a channel cannot be read; None if they can."""
        found = self._types_of(channel)
        return found if isinstance(found, str) else None

    def messages(
        self,
        channels: Sequence[Connection],
        begin_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[tuple[str, int, Any]]:
        """Yield topic, time of recording, ns, and message; None: it does not fit its definition.

        stop_ns: messages are earlier than this.
        """
        if not channels:  # to rosbags, none means all
            return
        with self._intact():
            for channel, seen_ns, raw in self._reader.messages(channels, begin_ns, stop_ns):
                yield channel.topic, seen_ns, self._message(channel, raw)

    def _message(self, channel: Connection, raw: bytes) -> Any:
        types = self._types_of(channel)
        if isinstance(types, str):
            return None
        try:
            return types.deserialize_cdr(raw, channel.msgtype)
        except Exception:  # whatever damaged bytes make of the code that rosbags generates
            return None

    def _types_of(self, channel: Connection) -> Typestore | str:
        key = channel.msgtype, channel.msgdef, encoding(channel)
        if key not in self._types:
            try:
                self._types[key] = _types(channel)
            except Exception as error:  # of grammars, hashes, code that is generated
                reason = str(error) or type(error).__name__
                self._types[key] = f"the definition of {channel.msgtype}: {reason}"
        return self._types[key]

    @contextmanager
    def _intact(self) -> Iterator[None]:
        """Turns what rosbags raises for a bag into CaptureError: for a damaged one, anything."""
        try:
            yield
        except CaptureError:
            raise
        except FileNotFoundError:
            missing = f"neither a bag (metadata.yaml) nor a dataset ({INFO})"
            reason = missing if self.path.is_dir() else "no such file"
            raise CaptureError(f"{self.path}: {reason}") from None
        except PermissionError as error:
            raise CaptureError(f"{self.path}: {error.strerror}") from None
        except Exception as error:
            reason = str(error) or type(error).__name__
            is_mcap = any(self.path.glob("*.mcap")) or self.path.suffix == ".mcap"
            remedy = "; `mcap recover` saves what is whole" if is_mcap else ""
            raise CaptureError(
                f"{self.path}: no bag, or damaged or cut short: {reason}{remedy}"
            ) from None


def believed_span(times_ns: Iterable[int]) -> tuple[int, int]:
    """Return the first and last time of the largest run that has no gap of more than FAR_NS.

    Memory grows with the days that they lie in, not with their number.
    """
    days: dict[int, tuple[int, int, int]] = {}  # first, last, number
    for time_ns in times_ns:
        first, last, number = days.get(time_ns // FAR_NS, (time_ns, time_ns, 0))
        days[time_ns // FAR_NS] = min(first, time_ns), max(last, time_ns), number + 1
    runs: list[tuple[int, int, int]] = []
    for first, last, number in sorted(days.values()):
        if runs and first - runs[-1][1] <= FAR_NS:
            before = runs.pop()
            first, number = before[0], before[2] + number
        runs.append((first, last, number))
    first, last, _ = max(runs, key=lambda run: run[2])
    return first, last


def encoding(channel: Connection) -> str:
    """Tell how the messages of a channel are encoded: as ROS 2's if that is CDR."""
    return cast(ConnectionExtRosbag2, channel.ext).serialization_format


def _types(channel: Connection) -> Typestore | str:
    """Return the types that the messages of a channel are made of, or why there are none."""
    if (its := encoding(channel)) != CDR:
        return f"its messages are encoded as {its or 'nothing known'}, not as ROS 2's ({CDR})"
    definition = channel.msgdef
    if definition.format == MessageDefinitionFormat.NONE:  # as rosbag2 wrote before Iron
        known = _known_types()
        unknown = f"the definition of {channel.msgtype} is not known"
        return known if channel.msgtype in known.fielddefs else unknown
    arrays = _ARRAY.findall(definition.data)
    fields = definition.data.count("\n") + sum(
        int(count) for kind, count in arrays if not _AT_ONCE.fullmatch(kind)
    )
    if fields > MOST_FIELDS:
        return f"the definition of {channel.msgtype} has {fields} fields, more than {MOST_FIELDS}"
    types = get_typestore(Stores.EMPTY)
    if definition.format == MessageDefinitionFormat.MSG:
        types.register(get_types_from_msg(definition.data, channel.msgtype))
    elif _NESTED.search(_IDL_TEXT.sub("", definition.data)):  # they would take minutes
        return f"the definition of {channel.msgtype} has parentheses in parentheses"
    else:
        for part in definition.data.split(_IDL_RULE):
            text = part.partition("\n")[2] if _IDL_RULE in definition.data else part
            if text:
                types.register(get_types_from_idl(text))
    if channel.digest and (found := types.hash_rihs01(channel.msgtype)) != channel.digest:
        return f"the definition of {channel.msgtype} has hash {found}, not {channel.digest}"
    return types


def _known_types() -> Typestore:
    try:
        return message_types()
    except CaptureError:  # ours are not installed
        return get_typestore(Stores.ROS2_JAZZY)
