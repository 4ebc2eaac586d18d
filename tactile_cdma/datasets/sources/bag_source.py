# SPDX-License-Identifier: Apache-2.0

"""Bags (rosbag2, MCAP or sqlite3) as a source, read without ROS and piece by piece."""

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias

from rosbags.interfaces import Connection

from ...base.errors import CaptureError
from ..samples import (
    NANO,
    PUBLISHER,
    Kind,
    RawImage,
    Sample,
    SampleStream,
    Value,
    feature_name,
    skin_stream,
)
from . import bag_messages as fields
from . import images
from .bag_file import CDR, FAR_NS, BagFile, encoding
from .opening import Wanted

GENERIC = (
    *("image", "image_raw", "image_color", "image_rect", "image_rect_color", "image_rect_raw"),
    *("compressed", "compressedDepth"),
)
"""Ends of cameras' topics that say nothing; features are called after what is before."""
STAMP_OFF_S = 10.0
"""The most that a believed stamp is from the time of recording, s; chosen: far above what messages
wait, and below any error of a clock that was never set."""

ASTRAY = (
    f"were recorded more than {FAR_NS / NANO / 3600:g} h before or after the others, by the bag "
    "(damaged, or was the clock set meanwhile?)"
)
UNREAD = "do not fit their definition (damaged?)"
"""Why messages are left out."""
_SPLIT = re.compile(r"_\d+(\.(?:mcap|db3))$")
"""Ends of the names of a split bag's files: NAME_0.mcap, NAME_1.mcap, …"""

_Take: TypeAlias = Callable[[Any, int], Value | None]
"""Makes a sample's value of a message and its stamp, ns; None where it is not of the stream."""


class BagSource:
    """A bag: a folder with metadata.yaml, or one MCAP or sqlite3 file; see samples.SampleSource.

    Cameras are read, but no pictures of a skin. counts: type and number of each topic's messages.
    Raises CaptureError for a bag that cannot be read, or holds none of what is asked for.
    """

    def __init__(self, path: Path, wanted: Wanted) -> None:
        self.path, self.problem = path, None
        self._notes: list[str] = []
        self._off: dict[str, tuple[int, int]] = {}  # stamps not believed: how many, first error, ns
        self._left_out: dict[str, Counter[str]] = {}  # messages by topic and reason
        self._takes: defaultdict[str, list[tuple[str, _Take]]] = defaultdict(list)  # by topic
        with BagFile(path) as bag:
            self.counts = {one.topic: (one.msgtype, one.msgcount) for one in bag.channels}
            if not sum(number for _, number in self.counts.values()):
                raise CaptureError(f"{path}: the bag is empty")
            self.begin_ns, self.end_ns = bag.span_ns
            with self._whole():
                self.streams: Mapping[str, SampleStream] = {
                    stream.key: stream for stream in self._find(bag, wanted)
                }

    @property
    def notes(self) -> tuple[str, ...]:
        off = (
            f"{topic}: {number} of {self.counts[topic][1]} stamps are more than "
            f"{STAMP_OFF_S:g} s from when the message was recorded, the first by "
            f"{first_ns / NANO:.3f} s (another clock, or simulated time?); the time of recording "
            "is taken for them"
            for topic, (number, first_ns) in sorted(self._off.items())
        )
        left_out = (
            f"{topic}: {number} of {self.counts[topic][1]} messages {reason}; they are left out"
            for topic, reasons in sorted(self._left_out.items())
            for reason, number in sorted(reasons.items())
        )
        return (*self._notes, *off, *left_out)

    def samples(self, begin_ns: int | None, end_ns: int | None) -> Iterator[Sample]:
        stop_ns = None if end_ns is None else end_ns + 1
        self._off = {}
        with BagFile(self.path) as bag, self._whole():
            wanted = [one for one in bag.channels if one.topic in self._takes]
            for topic, seen_ns, message in self._messages(bag, wanted, begin_ns, stop_ns):
                time_ns = fields.stamp_ns(message) or seen_ns
                if abs(off_ns := time_ns - seen_ns) > STAMP_OFF_S * NANO:
                    time_ns = seen_ns
                    number, first_ns = self._off.get(topic, (0, off_ns))
                    self._off[topic] = number + 1, first_ns
                for key, take in self._takes[topic]:
                    if (value := take(message, time_ns)) is not None:
                        yield Sample(key, time_ns, seen_ns, value)

    def marks(self, topic: str) -> list[tuple[int, Any]]:
        with BagFile(self.path) as bag:
            self._first(bag, topic, asked=True)
            found = self._messages(bag, bag.of(topic))
            return [(seen_ns, message) for _, seen_ns, message in found]

    @contextmanager
    def _whole(self) -> Iterator[None]:
        """Raises CaptureError where a message has not the fields that ours of its type have."""
        try:
            yield
        except AttributeError as error:
            if (kind := getattr(error.obj, "__msgtype__", None)) is None:
                raise  # no message's
            raise CaptureError(
                f"{self.path}: {kind} has no field {error.name} in the bag's own definition, of "
                "another version"
            ) from None

    def _find(self, bag: BagFile, wanted: Wanted) -> Iterator[SampleStream]:
        kinds = {c.topic: c.msgtype for c in bag.channels if c.msgcount and encoding(c) == CDR}
        foreign = {c.topic: encoding(c) for c in bag.channels if encoding(c) != CDR}
        self._notes += [f"{topic} is left out: encoded as {its}" for topic, its in foreign.items()]
        arrays = [topic for topic in sorted(kinds) if kinds[topic] == fields.ARRAY]
        yield from self._skins(bag, wanted, kinds, arrays)
        pictures = tuple(topic.rpartition("/")[0] + "/" for topic in arrays)
        others = (
            t for t in sorted(kinds) if kinds[t] in fields.IMAGES and not t.startswith(pictures)
        )
        for topic in others if wanted.cameras is None else wanted.cameras:
            stream = self._camera(bag, topic, asked=wanted.cameras is not None)
            if stream is not None:
                yield stream
        yield from self._joined(bag, Kind.STATE, wanted.state)
        yield from self._joined(bag, Kind.ACTION, wanted.action)

    def _skins(
        self, bag: BagFile, wanted: Wanted, kinds: Mapping[str, str], arrays: Sequence[str]
    ) -> Iterator[SampleStream]:
        """Yield the streams of patches, of their contacts and wrenches; kinds: types of topics."""
        for topic in wanted.topics:
            if topic not in arrays:
                there = ", ".join(arrays) or "none"
                raise CaptureError(f"{self.path}: no skin's frames in {topic} (but in {there})")
        names: set[str] = set()
        for topic in wanted.topics or arrays:
            stem = topic.rpartition("/")[0]
            if (first := self._first(bag, topic, asked=bool(wanted.topics))) is None:
                continue
            info, *later_ones = self._infos(bag, stem, wanted.info) or [None]
            patch = fields.patch(topic, self.path.name, first, info)
            for later in later_ones:
                patch, notes = fields.with_later(patch, info, later)
                self._notes += notes
            if patch.name in names:
                raise CaptureError(f"{self.path}: {patch.name} is there twice; choose by --topic")
            names.add(patch.name)
            self._takes[topic].append((topic, partial(fields.skin_frame, patch=patch)))
            yield skin_stream(topic, Kind.TACTILE, patch)
            for kind, type_, take in (
                (Kind.CONTACTS, fields.CONTACTS_TYPE, fields.contacts),
                (Kind.WRENCH, fields.WRENCH_TYPE, fields.wrench),
            ):
                beside = f"{stem}/{kind}"
                if wanted.derived and kinds.get(beside) == type_ and self._first(bag, beside):
                    self._takes[beside].append((beside, _without_time(take)))
                    yield skin_stream(beside, kind, patch)

    def _joined(self, bag: BagFile, kind: Kind, choices: Sequence[str]) -> Iterator[SampleStream]:
        taken: set[str] = set()
        for stream in chain.from_iterable(self._vectors(bag, kind, one) for one in choices):
            if twice := taken.intersection(stream.names):
                raise CaptureError(
                    f"{self.path}: {kind}: {stream.topic} has {', '.join(sorted(twice))}, as "
                    f"another topic does: choose by --{kind} {stream.topic}:NAME,…"
                )
            taken.update(stream.names)
            yield stream

    def _infos(self, bag: BagFile, stem: str, elsewhere: Path | None) -> list[Any]:
        """Find a patch's infos: in this bag, else in another or the first file of a split one.

        An info is recorded when it changes, so that later files of a split bag have none.
        """
        topic = f"{stem}/info"
        if found := self._infos_in(bag, topic):
            return found
        other = elsewhere or self.path.with_name(_SPLIT.sub(r"_0\1", self.path.name))
        if other != self.path and (elsewhere or other.exists()):
            with BagFile(other) as first:
                found = self._infos_in(first, topic)
            if found:
                self._notes.append(f"{topic} is that of {other}")
                return found
        self._notes.append(
            f"{stem}/tactile: no info, so places and calibration are unknown; --info BAG takes "
            "another bag's"
        )
        return []

    def _infos_in(self, bag: BagFile, topic: str) -> list[Any]:
        channels = [c for c in bag.channels if c.topic == topic and c.msgtype == fields.INFO]
        return [info for _, _, info in bag.messages(channels) if info is not None]

    def _camera(self, bag: BagFile, topic: str, asked: bool) -> SampleStream | None:
        """Return the stream of an image topic; None, with a note, for images that are not taken."""
        if (kind := bag.of(topic)[0].msgtype) not in fields.IMAGES:
            raise CaptureError(f"{self.path}: {topic} is {kind}, not an image")
        if (first := self._first(bag, topic, asked)) is None:
            return None
        if (reason := images.problem(first)) is not None:
            self._leave_out(topic, reason, asked)
            return None
        self._takes[topic].append((topic, _without_time(RawImage)))
        words = topic.strip("/").split("/")
        while len(words) > 1 and words[-1] in GENERIC:
            words.pop()
        name = feature_name("_".join(words))
        if images.is_depth(first):
            depth = images.depth(first, topic)
            dtype, unit = depth.dtype.name, images.DEPTHS[getattr(first, "encoding", "16UC1")][1]
            return SampleStream(topic, Kind.DEPTH, name, depth.shape, dtype=dtype, unit=unit)
        shape = images.decoded(images.encoded(first, topic), topic).shape
        return SampleStream(topic, Kind.IMAGE, name, shape)

    def _vectors(self, bag: BagFile, kind: Kind, text: str) -> Iterator[SampleStream]:
        """Yield a stream for every program that publishes on a topic, by its elements' names."""
        topic, _, asked = text.partition(":")
        chosen = tuple(filter(None, asked.split(",")))  # none: all
        if (said := bag.of(topic)[0].msgtype) not in fields.VECTORS:
            raise CaptureError(
                f"{self.path}: {topic} is {said}; {kind} takes {', '.join(fields.VECTORS)}"
            )
        self._first(bag, topic, asked=True)
        messages = self._messages(bag, bag.of(topic))
        each = (fields.vector_names(message) for _, _, message in messages)
        for number, names in enumerate(fields.publishers(topic, each, chosen)):
            key = f"{kind}:{topic}{PUBLISHER}{number}"
            self._takes[topic].append((key, _without_time(partial(fields.vector, names=names))))
            yield SampleStream(key, kind, kind, (len(names),), names)

    def _first(self, bag: BagFile, topic: str, asked: bool = False) -> Any:
        """Return the first message of a topic; None, with a note, where none can be read.

        asked: by name; then that raises CaptureError.
        """
        channels = bag.of(topic)
        reason = bag.obstacle(channels[0])
        if reason is None:
            for _, _, message in self._messages(bag, channels):
                return message
            number, why = self.counts[topic][1], self._left_out.pop(topic)
            said = f"none of its {number} messages can be read: they {' or '.join(why)}"
            reason = said if number else "nothing recorded"
        self._leave_out(topic, reason, asked)
        return None

    def _leave_out(self, topic: str, reason: str, asked: bool) -> None:
        if asked:
            raise CaptureError(f"{self.path}: {topic}: {reason}")
        self._notes.append(f"{topic} is left out: {reason}")

    def _messages(
        self,
        bag: BagFile,
        channels: Sequence[Connection],
        begin_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[tuple[str, int, Any]]:
        """Yield messages with their topic and when they were recorded, ns.

        Without those that cannot be read, or that were not recorded when the bag says: these are
        counted.
        """
        self._left_out |= {channel.topic: Counter() for channel in channels}  # counted anew
        for topic, seen_ns, message in bag.messages(channels, begin_ns, stop_ns):
            if not self.begin_ns - FAR_NS <= seen_ns <= self.end_ns + FAR_NS:
                self._left_out[topic][ASTRAY] += 1
            elif message is None:
                self._left_out[topic][UNREAD] += 1
            else:
                yield topic, seen_ns, message


def _without_time(take: Callable[[Any], Value | None]) -> _Take:
    return lambda message, time_ns: take(message)
