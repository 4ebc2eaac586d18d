# SPDX-License-Identifier: Apache-2.0

"""A bag as a file: its channels, and their messages as far as they can be read."""

import heapq
import io
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self, cast

import apsw
import lz4.frame  # type: ignore[import-untyped]
import rosbags.interfaces as bags
from rosbags.rosbag2 import Reader, reader, storage_mcap, storage_sqlite3
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ...base.errors import CaptureError
from ...base.marked_yaml import read_marked
from ...base.named_file import naming, open_named
from ...messages.types import message_types
from ..lerobot import INFO
from ..samples import NANO
from .bag_messages import JOINTS

CDR = "cdr"
"""The encoding of ROS 2's messages."""
FAR_NS = 86_400 * NANO
"""Messages farther than this, ns, from most others were not recorded when they say. Chosen: a day,
since hardly a recorder is paused for so long, and damage or a clock that is set makes years."""
SURPLUS = {JOINTS: 8}
"""Bytes that may follow a message: `rclpy.serialization` reserves 4 for each empty list of float64,
a JointState has three, and rosbags bears the 3 that may be left over. Of others any is damage."""
_IDL_RULE = "=" * 80 + "\nIDL: "
"""Before each file of a definition in IDL."""

MOST_METADATA_BYTES = 1 << 21
"""Largest metadata.yaml; chosen: of some 8,000 files, in 10 s."""
MOST_CHUNK_BYTES, MOST_RATIO = 1 << 25, 8
"""A chunk or message unpacks to no more than this, and so many times its size. Chosen: recorders
write chunks of 1 to 4 MB, and a black picture of 8 million pixels has 25 MB."""
MOST_FILE_RATIO = 1000
"""Times its size that a compressed file unpacks to. Chosen: records of skins at rest have 20."""
MOST_AT_ONCE_BYTES = 1 << 28
"""Chunks whose times overlap, and one value of sqlite; chosen: a recorder's clock may be set."""
MOST_FIELDS = 10_000
"""Fields of a definition, with all elements of its arrays of a fixed length, that rosbags makes
code of, in 2 ms each. Chosen: a hundred times what messages have."""
MOST_TEXT = 1 << 18
"""Characters of a definition, and of a quality of service. Chosen: ten times the longest's."""
_COMPUTED = re.compile(r"\([^()]*\(|<<|\*")
"""What the constants of IDL could take minutes or a memory by; rosidl writes plain numbers."""
_IDL_TEXT = re.compile(r'"(\\.|[^"\\])*"|//.*|/\*(?s:.)*?(\*/|\Z)')
_ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of what zstd has compressed (RFC 8878), and of no message in CDR."""
_PIECE_BYTES = 1 << 18
"""Bytes to unpack at once: longer pieces would take twice the memory."""
_STEPS = 100_000
"""Steps of sqlite's machine, some 1 ms, between two looks for Ctrl-C."""

_defined = storage_mcap.get_msgdef


def _defined_or_foreign(schema: storage_mcap.Schema | None) -> bags.MessageDefinition:
    """Return no definition for a schema of another system (protobuf, JSON), where rosbags raises.

    One such channel would make all of the bag unreadable.
    """
    try:
        return _defined(schema)
    except KeyError:
        return bags.MessageDefinition(bags.MessageDefinitionFormat.NONE, "")


storage_mcap.get_msgdef = _defined_or_foreign


class _Checked(type(Path())):  # type: ignore[misc]
    """A path at which rosbags, which looks first whether it exists, finds nothing without an end.

    Raises CaptureError for pipes and devices, and for metadata.yaml of aliases.
    """

    def exists(self, **options: bool) -> bool:
        if super().exists(**options) and not self.is_dir():
            is_metadata = self.name == "metadata.yaml"
            with naming(self, CaptureError):
                open_named(self, MOST_METADATA_BYTES if is_metadata else math.inf).close()
            if is_metadata:
                read_marked(self, CaptureError)
        return bool(super().exists(**options))


def _guard(database: apsw.Connection) -> None:
    """Let Ctrl-C end every query, and refuse views, whose queries may have no end."""
    database.set_progress_handler(lambda: False, _STEPS)
    database.limit(apsw.SQLITE_LIMIT_LENGTH, MOST_AT_ONCE_BYTES)
    odd = "SELECT name FROM sqlite_master WHERE type = 'view' OR sql LIKE 'CREATE VIRTUAL%'"
    for (name,) in database.execute(odd):
        raise ValueError(f"{name} is a view or a virtual table, which no recorder makes")


def _unpacked(kind: Any) -> Callable[[bytes, int], bytes]:
    """Return a decompressor, which makes no more of data than the bag says, nor than allowed."""

    def decompress(data: bytes, size: int = MOST_AT_ONCE_BYTES) -> bytes:
        most = MOST_CHUNK_BYTES + MOST_RATIO * len(data)
        left, pieces = min(size, most) + 1, list[bytes]()
        with kind.open(io.BytesIO(data)) as file:
            while left and (piece := file.read(min(left, _PIECE_BYTES))):
                pieces.append(piece)
                left -= len(piece)
        if not left and size > most:
            raise ValueError(
                f"{len(data)} bytes unpack to more than {most}; recorders write some 1 MB at once: "
                "was it made to fill the memory?"
            )
        return b"".join(pieces)

    return decompress


_reader: Any = reader
_zstd = _reader.zstd


def _qos(given: Any) -> Any:
    """Return a channel's quality of service; none of a text that YAML could make endless."""
    is_odd = isinstance(given, str) and ("&" in given or len(given) > MOST_TEXT)
    return [] if is_odd else parse_qos(given)


class _Unpacked(_zstd.ZstdFile):  # type: ignore[misc, name-defined]
    """A compressed file of a bag, which rosbags unpacks to a folder for temporary files."""

    def read(self, size: int | None = -1) -> bytes:
        data: bytes = super().read(size)
        packed = os.fstat(self.fileno()).st_size
        if self.tell() > MOST_FILE_RATIO * packed:
            raise ValueError(
                f"a file of {packed} bytes unpacks to {MOST_FILE_RATIO} times its size and more: "
                "was it made to fill the disk?"
            )
        return data


storage_mcap.DECOMPRESSORS |= {"zstd": _unpacked(_zstd), "lz4": _unpacked(lz4.frame)}
_reader.zstd = SimpleNamespace(open=_Unpacked, decompress=_unpacked(_zstd))
for _module in (_reader, storage_mcap, storage_sqlite3):
    setattr(_module, parse_qos.__name__, _qos)


class BagFile:
    """A folder with metadata.yaml, or one MCAP or sqlite3 file; a context manager.

    Types are made only for the channels that are read: the others need not be readable.
    Raises CaptureError for whatever is wrong with the bag.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._types: dict[tuple[object, ...], Typestore | str] = {}
        with self._intact():
            self._reader = Reader(_Checked(path))

    def __enter__(self) -> Self:
        with self._intact():
            apsw.connection_hooks.append(_guard)
            try:
                self._reader.open()
            finally:
                apsw.connection_hooks.remove(_guard)
            try:
                self._check()
            except ValueError:
                self._reader.close()
                raise
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def _check(self) -> None:
        """Refuse metadata of wrong types, and chunks that would be unpacked all at once."""
        storage: Any = self._reader.storage
        storage.files = []  # those of metadata are of any type: rosbags would fail to clear them
        whole = [self._reader.start_time, self._reader.end_time]
        for one in self.channels:
            whole.append(one.msgcount)
            if not isinstance(one.topic, str) or not isinstance(one.msgtype, str):
                raise ValueError(f"topic {one.topic!r:.40} of type {one.msgtype!r:.40}: not text")
        if odd := [value for value in whole if not isinstance(value, int)]:
            raise ValueError(f"a number of messages, or a time, is {odd[0]!r:.40}")
        for one in getattr(storage, "storages", [storage]):
            held, ends = 0, list[tuple[int, int]]()
            for chunk in sorted(getattr(one, "chunks", ()), key=lambda c: c.message_start_time):
                held += chunk.uncompressed_size
                heapq.heappush(ends, (chunk.message_end_time, chunk.uncompressed_size))
                while ends and ends[0][0] < chunk.message_start_time:
                    held -= heapq.heappop(ends)[1]
                if held > MOST_AT_ONCE_BYTES and len(ends) > 1:
                    raise ValueError(f"{len(ends)} chunks of the same time unpack to {held} bytes")

    @property
    def channels(self) -> Sequence[bags.Connection]:
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
            return believed_span(int(seen_ns) for _, seen_ns, _ in self._reader.messages())

    def of(self, topic: str) -> list[bags.Connection]:
        """Return the channels of a topic. Raises CaptureError for one that is not there."""
        if found := [channel for channel in self.channels if channel.topic == topic]:
            return found
        there = ", ".join(sorted({channel.topic for channel in self.channels}))
        raise CaptureError(f"{self.path}: no topic {topic} (there are {there})")

    def obstacle(self, channel: bags.Connection) -> str | None:
        """Say why the messages of a channel cannot be read; None if they can."""
        found = self._types_of(channel)
        return found if isinstance(found, str) else None

    def messages(
        self,
        channels: Sequence[bags.Connection],
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
                yield channel.topic, int(seen_ns), self._message(channel, raw)

    def _message(self, channel: bags.Connection, raw: bytes) -> Any:
        types = self._types_of(channel)
        if isinstance(types, str):
            return None
        if raw[:4] == _ZSTD:
            raise CaptureError(
                f"{self.path}: its messages are compressed, but this file does not say how: give "
                "the bag's folder, with metadata.yaml"
            )
        for surplus in range(0, SURPLUS.get(channel.msgtype, 0) + 1, 4):
            with suppress(Exception):  # whatever damaged bytes make of the code rosbags generates
                return types.deserialize_cdr(raw[: len(raw) - surplus], channel.msgtype)
        return None

    def _types_of(self, channel: bags.Connection) -> Typestore | str:
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
                f"{self.path}: not a bag, or a damaged or truncated one: {reason}{remedy}"
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


def encoding(channel: bags.Connection) -> str:
    """Tell how the messages of a channel are encoded: as ROS 2's if that is CDR."""
    return cast(bags.ConnectionExtRosbag2, channel.ext).serialization_format


def _types(channel: bags.Connection) -> Typestore | str:
    """Return the types that the messages of a channel are made of, or why there are none."""
    if (its := encoding(channel)) != CDR:
        return f"its messages are encoded as {its or 'nothing known'}, not as ROS 2's ({CDR})"
    definition = channel.msgdef
    if definition.format == bags.MessageDefinitionFormat.NONE:  # as rosbag2 wrote before Iron
        known = _known_types()
        unknown = f"the definition of {channel.msgtype} is not known"
        return known if channel.msgtype in known.fielddefs else unknown
    if (length := len(definition.data)) > MOST_TEXT:
        return f"the definition of {channel.msgtype} has {length} characters, more than {MOST_TEXT}"
    types = get_typestore(Stores.EMPTY)
    if definition.format == bags.MessageDefinitionFormat.MSG:
        parsed = get_types_from_msg(definition.data, channel.msgtype)
    elif _COMPUTED.search(_IDL_TEXT.sub("", definition.data)):
        return f"the definition of {channel.msgtype} computes its constants: write them as numbers"
    else:
        parsed = {}
        for part in definition.data.split(_IDL_RULE):
            text = part.partition("\n")[2] if _IDL_RULE in definition.data else part
            if text:
                parsed |= get_types_from_idl(text)
    if (fields := _fields(parsed)) > MOST_FIELDS:
        return f"the definition of {channel.msgtype} has {fields} fields, more than {MOST_FIELDS}"
    types.register(parsed)
    if channel.digest and (found := types.hash_rihs01(channel.msgtype)) != channel.digest:
        return f"the definition of {channel.msgtype} has hash {found}, not {channel.digest}"
    return types


def _fields(types: Mapping[str, Any]) -> int:
    """Count the fields of all types, arrays of a fixed length with all that their elements have."""
    known = dict[str, int]()

    def of(name: str) -> int:
        if name not in known:
            known[name] = 0  # of itself, which ROS 2 has not
            known[name] = sum(1 + elements(*kind) for _, kind in types.get(name, ((), ()))[1])
        return known[name]

    def elements(node: bags.Nodetype, kind: Any) -> int:
        if node == bags.Nodetype.NAME:
            return of(kind)
        if node != bags.Nodetype.ARRAY:
            return 0
        (inner, its), number = kind
        if inner == bags.Nodetype.BASE and its[0] != "string":  # numpy reads it at once
            return 0
        return int(number) * (1 + elements(inner, its))

    return sum(of(name) for name in types)


def _known_types() -> Typestore:
    try:
        return message_types()
    except CaptureError:  # ours are not installed
        return get_typestore(Stores.ROS2_JAZZY)
