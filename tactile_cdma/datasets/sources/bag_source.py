# SPDX-License-Identifier: Apache-2.0

"""Bags (rosbag2, MCAP or sqlite3) as a source, read without ROS and piece by piece."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from ...base.errors import CaptureError
from ...messages.types import message_types
from ..lerobot import INFO
from ..samples import (
    CONTACT_NAMES,
    NANO,
    WRENCH_NAMES,
    Kind,
    RawImage,
    Sample,
    SampleStream,
    Value,
    feature_name,
)
from . import bag_messages as fields
from . import images
from .bag_times import FAR_NS, believed_span
from .opening import Wanted

GENERIC = ("image", "image_raw", "image_color", "image_rect", "image_rect_color", "compressed")
"""Ends of cameras' topics that say nothing; features are called after what is before."""
STAMP_OFF_S = 10.0
"""The most that a believed stamp is from the time of recording, s; chosen: far above what messages
wait, and below any error of a clock that was never set."""

_Take: TypeAlias = Callable[[Any, int], Value]
"""Makes a sample's value of a message and its stamp, ns."""


class BagSource:
    """A bag: a folder with metadata.yaml, or one MCAP or sqlite3 file; see samples.SampleSource.

    Of all cameras, those are read that are no picture of a skin. counts: type and number of the
    messages of every topic. Raises CaptureError for a bag that cannot be read, or that holds none
    of what is asked for.
    """

    def __init__(self, path: Path, wanted: Wanted) -> None:
        self.path, self.problem = path, None
        self._notes: list[str] = []
        self._off: dict[str, tuple[int, int]] = {}  # stamps not believed: how many, first error, ns
        self._astray: Counter[str] = Counter()  # messages whose time of recording is not believed
        self._takes: defaultdict[str, list[tuple[str, _Take]]] = defaultdict(list)  # by topic
        self.streams: Mapping[str, SampleStream] = {}
        with self._opened() as bag:
            self.counts = {c.topic: (c.msgtype, c.msgcount) for c in bag.connections}
            if not bag.message_count:
                raise CaptureError(f"{path}: the bag is empty")
            self.begin_ns, self.end_ns = self._span(bag)
            found = {stream.key: stream for stream in self._find(bag, wanted)}
            for kind, topic in ((Kind.STATE, wanted.state), (Kind.ACTION, wanted.action)):
                if topic is not None:
                    found[f"{kind}:{topic}"] = self._vector(bag, kind, topic)
            self.streams = found

    @property
    def notes(self) -> tuple[str, ...]:
        off = (
            f"{topic}: {number} of {self.counts[topic][1]} stamps are more than "
            f"{STAMP_OFF_S:g} s from when the message was recorded, the first by "
            f"{first_ns / NANO:.3f} s (another clock, or simulated time?); the time of recording "
            "is taken for them"
            for topic, (number, first_ns) in sorted(self._off.items())
        )
        astray = (
            f"{topic}: {number} of {self.counts[topic][1]} messages were recorded more than "
            f"{FAR_NS / NANO / 3600:g} h before or after the others, by the bag (damaged, or was "
            "the clock set meanwhile?); they are left out"
            for topic, number in sorted(self._astray.items())
        )
        return (*self._notes, *off, *astray)

    def samples(self, begin_ns: int | None, end_ns: int | None) -> Iterator[Sample]:
        stop_ns = None if end_ns is None else end_ns + 1
        self._off = {}
        with self._opened() as bag:
            wanted = [c for c in bag.connections if c.topic in self._takes]
            for topic, seen_ns, message in self._messages(bag, wanted, begin_ns, stop_ns):
                time_ns = fields.stamp_ns(message) or seen_ns
                if abs(off_ns := time_ns - seen_ns) > STAMP_OFF_S * NANO:
                    time_ns = seen_ns
                    number, first_ns = self._off.get(topic, (0, off_ns))
                    self._off[topic] = number + 1, first_ns
                for key, take in self._takes[topic]:
                    yield Sample(key, time_ns, seen_ns, take(message, time_ns))

    def marks(self, topic: str) -> list[tuple[int, Any]]:
        with self._opened() as bag:
            found = self._messages(bag, self._connections(bag, topic))
            return [(seen_ns, message) for _, seen_ns, message in found]

    def _span(self, bag: AnyReader) -> tuple[int, int]:
        """When the first and the last message were recorded, by what most of them say."""
        begin_ns, end_ns = bag.start_time, bag.end_time
        if 0 <= end_ns - begin_ns <= FAR_NS:
            return begin_ns, end_ns
        with self._intact():  # reads all of the bag, as seldom as that is needed
            return believed_span(seen_ns for _, seen_ns, _ in bag.messages())

    def _find(self, bag: AnyReader, wanted: Wanted) -> Iterator[SampleStream]:
        """The streams of skins and cameras."""
        kinds = {c.topic: c.msgtype for c in bag.connections if c.msgcount}
        arrays = [topic for topic in sorted(kinds) if kinds[topic] == fields.ARRAY]
        for topic in wanted.topics:
            if topic not in arrays:
                there = ", ".join(arrays) or "none"
                raise CaptureError(f"{self.path}: no skin's frames in {topic} (but in {there})")
        names: set[str] = set()
        for topic in wanted.topics or arrays:
            stem = topic.rpartition("/")[0]
            has_info = kinds.get(f"{stem}/info") == fields.INFO
            infos = self._all(bag, f"{stem}/info") if has_info else iter(())
            if (info := next(infos, None)) is None:
                self._notes.append(f"{topic}: no info, so places and calibration are unknown")
            patch = fields.patch(topic, self.path.name, self._first(bag, topic), info)
            for later in infos:
                patch, notes = fields.with_later(patch, info, later)
                self._notes += notes
            if patch.name in names:
                raise CaptureError(f"{self.path}: two patches are {patch.name}; choose by --topic")
            names.add(patch.name)
            self._takes[topic].append((topic, partial(fields.skin_frame, patch=patch)))
            yield SampleStream(topic, Kind.TACTILE, patch.name, (len(patch),), patch=patch)
            for name, kind, type_, elements, take in (
                ("contacts", Kind.CONTACTS, fields.CONTACTS_TYPE, CONTACT_NAMES, fields.contacts),
                ("wrench", Kind.WRENCH, fields.WRENCH_TYPE, WRENCH_NAMES, fields.wrench),
            ):
                beside = f"{stem}/{name}"
                if wanted.derived and kinds.get(beside) == type_:
                    self._takes[beside].append((beside, _without_time(take)))
                    yield SampleStream(beside, kind, patch.name, (len(elements),), elements)
        pictures = tuple(topic.rpartition("/")[0] + "/" for topic in arrays)
        others = (
            t for t in sorted(kinds) if kinds[t] in fields.IMAGES and not t.startswith(pictures)
        )
        for topic in others if wanted.cameras is None else wanted.cameras:
            stream = self._camera(bag, topic, asked=wanted.cameras is not None)
            if stream is not None:
                yield stream

    def _camera(self, bag: AnyReader, topic: str, asked: bool) -> SampleStream | None:
        """The stream of an image topic; None, with a note, for images that are not taken."""
        if (kind := self._connections(bag, topic)[0].msgtype) not in fields.IMAGES:
            raise CaptureError(f"{self.path}: {topic} is {kind}, not an image")
        first = self._first(bag, topic)
        if (reason := images.problem(first)) is not None:
            if asked:
                raise CaptureError(f"{self.path}: {topic}: {reason}")
            self._notes.append(f"{topic} is left out: {reason}")
            return None
        shape = images.decoded(images.encoded(first, topic), topic).shape
        self._takes[topic].append((topic, _without_time(RawImage)))
        words = topic.strip("/").split("/")
        while len(words) > 1 and words[-1] in GENERIC:
            words.pop()
        return SampleStream(topic, Kind.IMAGE, feature_name("_".join(words)), shape)

    def _vector(self, bag: AnyReader, kind: Kind, topic: str) -> SampleStream:
        if (said := self._connections(bag, topic)[0].msgtype) not in fields.VECTORS:
            raise CaptureError(
                f"{self.path}: {topic} is {said}; {kind} takes {', '.join(fields.VECTORS)}"
            )
        names = fields.vector_names(self._first(bag, topic))
        take = partial(fields.vector, topic=topic, names=names)
        self._takes[topic].append((f"{kind}:{topic}", _without_time(take)))
        return SampleStream(f"{kind}:{topic}", kind, kind, (len(names),), names)

    def _first(self, bag: AnyReader, topic: str) -> Any:
        for message in self._all(bag, topic):
            return message
        raise CaptureError(f"{self.path}: nothing was recorded of {topic}")

    def _all(self, bag: AnyReader, topic: str) -> Iterator[Any]:
        for _, _, message in self._messages(bag, self._connections(bag, topic)):
            yield message

    def _connections(self, bag: AnyReader, topic: str) -> list[Connection]:
        found = [c for c in bag.connections if c.topic == topic]
        if not found:
            there = ", ".join(sorted({c.topic for c in bag.connections}))
            raise CaptureError(f"{self.path}: no topic {topic} (there are {there})")
        return found

    def _messages(
        self,
        bag: AnyReader,
        connections: Sequence[Connection],
        begin_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[tuple[str, int, Any]]:
        """Messages with their topic and when they were recorded, ns.

        Without those that were not recorded when the bag says: these are counted.
        """
        if not connections:  # to rosbags, none means all
            return
        for connection in connections:
            self._astray.pop(connection.topic, None)
        with self._intact():
            for connection, seen_ns, raw in bag.messages(connections, begin_ns, stop_ns):
                if self.begin_ns - FAR_NS <= seen_ns <= self.end_ns + FAR_NS:
                    yield connection.topic, seen_ns, bag.deserialize(raw, connection.msgtype)
                else:
                    self._astray[connection.topic] += 1

    @contextmanager
    def _opened(self) -> Iterator[AnyReader]:
        """The bag, open; raises CaptureError for whatever is wrong with it."""
        with self._intact():
            bag = AnyReader([self.path], default_typestore=_known_types())
            bag.open()
        with closing(bag):
            yield bag

    @contextmanager
    def _intact(self) -> Iterator[None]:
        """Turns what rosbags raises for a bag into CaptureError: for a damaged one, anything."""
        try:
            yield
        except FileNotFoundError:
            missing = f"neither a bag (metadata.yaml) nor a dataset ({INFO})"
            reason = missing if self.path.is_dir() else "no such file"
            raise CaptureError(f"{self.path}: {reason}") from None
        except KeyError as error:
            raise CaptureError(f"{self.path}: the definition of {error} is not known") from None
        except PermissionError as error:
            raise CaptureError(f"{self.path}: {error.strerror}") from None
        except Exception as error:
            reason = str(error) or type(error).__name__
            is_mcap = any(self.path.glob("*.mcap")) or self.path.suffix == ".mcap"
            remedy = "; `mcap recover` saves what is whole" if is_mcap else ""
            raise CaptureError(
                f"{self.path}: no bag, or damaged or cut short: {reason}{remedy}"
            ) from None


def _without_time(take: Callable[[Any], Value]) -> _Take:
    return lambda message, time_ns: take(message)


def _known_types() -> Typestore:
    """For bags without definitions, as rosbag2 wrote them before Iron."""
    try:
        return message_types()
    except CaptureError:  # ours are not installed
        return get_typestore(Stores.ROS2_JAZZY)
