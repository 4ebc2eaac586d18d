# SPDX-License-Identifier: Apache-2.0

"""Records a skin's topics in a bag (rosbag2, MCAP), for machines without `ros2 bag`."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, get_type_hints

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.utilities import remove_ros_args
from rclpy.validate_full_topic_name import validate_full_topic_name
from rosbags.interfaces import Connection, Qos, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

from ..base.errors import ParameterError, TactileError
from ..config.arguments import positive
from ..messages.types import message_types
from .common.process import running

DATA = ("tactile", "info", "contacts", "wrench")
"""Topics of a skin's node that are recorded by default."""
PICTURES = ("heatmap", "pressure_image", "points", "markers")
SHARED = ("/diagnostics", "/tf_static")
OFFERED = QoSProfile(
    depth=1000,
    reliability=ReliabilityPolicy.BEST_AVAILABLE,
    durability=DurabilityPolicy.BEST_AVAILABLE,
)
"""The best QoS that all publishers of a topic offer. Depth: messages that may wait while the disk
is busy; chosen: some 12 s of frames."""
LOOK_S = 0.1
"""Interval of looks for topics that nobody published so far, and at the room on the disk, s."""
RESERVED_BYTES = 64 << 20
"""Room on the disk at which a bag ends. Its index is written last, and few programs read a bag
without; chosen far above the size of an index."""


class BagRecorder(Node):
    """Writes every message of some topics into a bag.

    Subscribes to a topic once somebody publishes it. counts: messages by topic. missing: topics
    that nobody has published so far.
    """

    def __init__(self, writer: Writer, topics: Iterable[str]) -> None:
        super().__init__("skin_bag")
        self.counts: Counter[str] = Counter()
        self._writer, self.missing = writer, list(dict.fromkeys(topics))
        self._types = message_types()
        self.create_timer(LOOK_S, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._look()

    def _look(self) -> None:
        for topic in tuple(self.missing):
            if offers := self.get_publishers_info_by_topic(topic):
                self.missing.remove(topic)
                self._record(topic, offers)

    def _record(self, topic: str, offers: Sequence[Any]) -> None:
        kind = offers[0].topic_type
        if kind not in self._types.types:
            self.get_logger().error(f"{topic} is left out: the definition of {kind} is not known")
            return
        connection = self._writer.add_connection(
            topic,
            kind,
            typestore=self._types,
            offered_qos_profiles=[_noted(offer.qos_profile) for offer in offers],
        )
        package, _, name = kind.split("/")
        message_type = getattr(import_module(f"{package}.msg"), name)
        keep: Callable[[bytes], None] = partial(self._keep, connection)
        self.create_subscription(message_type, topic, keep, OFFERED, raw=True)

    def _keep(self, connection: Connection, message: bytes) -> None:
        self._writer.write(connection, time.time_ns(), message)
        self.counts[connection.topic] += 1


def _noted(profile: QoSProfile) -> Qos:
    """A publisher's profile as bags have it; rclpy and rosbags name and number policies alike."""
    fields: dict[str, Any] = {}
    for name, kind in get_type_hints(Qos).items():
        value = getattr(profile, name)
        if isinstance(value, Duration):
            fields[name] = QosTime(*divmod(value.nanoseconds, 1_000_000_000))
        else:
            fields[name] = kind(value)
    return Qos(**fields)


def topics_of(arguments: argparse.Namespace) -> list[str]:
    """Full names of what to record; raises ParameterError for an invalid one."""
    names = DATA + (PICTURES if arguments.all else ())
    topics = ["/" + topic.lstrip("/") for topic in arguments.topics]
    if arguments.node or arguments.all or not topics:
        nodes = ["/" + node.strip("/") for node in arguments.node or ["skin"]]
        topics += [f"{node}/{name}" for node in nodes for name in names] + list(SHARED)
    for topic in topics:
        try:
            validate_full_topic_name(topic)
        except InvalidTopicNameException:
            raise ParameterError(f"{topic!r} is not a valid topic name") from None
    return topics


def arguments_of(command: Sequence[str]) -> argparse.Namespace:
    """What a command line says, without the program's name."""
    parser = argparse.ArgumentParser(prog="skin_bag", description=__doc__)
    parser.add_argument("folder", type=Path, help="the bag, a folder that is not there yet")
    parser.add_argument(
        "--node",
        action="append",
        metavar="NAME",
        help="skin to record, /skin unless given; several: --node /left/skin --node /right/skin",
    )
    parser.add_argument("--all", action="store_true", help="pictures, points and markers, too")
    parser.add_argument(
        "--topics",
        nargs="+",
        default=[],
        metavar="TOPIC",
        help="these, and no others unless --node or --all is given, too",
    )
    parser.add_argument("--seconds", type=positive, help="end after so long; else on Ctrl-C")
    return parser.parse_args(remove_ros_args(command))


def main() -> int:
    """Record until interrupted; returns the exit code, 1 if nothing came or writing failed."""
    arguments = arguments_of(sys.argv[1:])
    full = False
    try:
        topics = topics_of(arguments)
        with (
            Writer(arguments.folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
            running(
                lambda: BagRecorder(writer, topics), arguments.seconds, (OSError, WriterError)
            ) as program,
        ):
            print(f"recording into {arguments.folder}, Ctrl-C ends", flush=True)
            while not full and program.spin(LOOK_S):
                full = shutil.disk_usage(arguments.folder).free < RESERVED_BYTES
    except OSError as error:  # a quota, perhaps
        reason = f"{error.strerror}; `mcap recover` gives what it holds so far"
        print(f"skin_bag: {arguments.folder}: {reason}", file=sys.stderr)
        return 1
    except (WriterError, TactileError) as error:
        print(f"skin_bag: {error}", file=sys.stderr)
        return 1
    recorder = program.node
    for topic, count in sorted(recorder.counts.items()):
        print(f"{topic}: {count}")
    if recorder.missing:
        print(f"skin_bag: nobody published {', '.join(recorder.missing)}", file=sys.stderr)
    if full:
        room = f"less than {RESERVED_BYTES >> 20} MB are left on the disk"
        print(f"skin_bag: {arguments.folder}: ended here, whole: {room}", file=sys.stderr)
    return 0 if recorder.counts and not full else 1


if __name__ == "__main__":
    sys.exit(main())
