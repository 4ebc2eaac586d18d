# SPDX-License-Identifier: Apache-2.0

"""Gives a policy what it was trained on from topics, where drivers have the ports."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from functools import partial
from os import PathLike
from typing import Any, Self

import numpy as np
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32MultiArray, Float64MultiArray

from tactile_cdma.msg import TactileArray, TactileContacts, TactileSkinInfo

from ..base.errors import MessageError, ObservationError, ParameterError, PortError, TactileError
from ..config.parameters import unknown
from ..config.python_arguments import argument, instance, path_of, seconds
from ..datasets.alignment import HOLD, LAST, stale_s
from ..datasets.lerobot.meta import STATE, DatasetMeta
from ..datasets.samples import NANO, PatchInfo, Sample, SkinFrame, Value
from ..datasets.sources import bag_messages as fields
from ..live_observation import LAG_S, ROWS_HZ, Observation, skin_keys
from .client import node_name
from .common.background import Background
from .common.convert import places_of, readings_of
from .common.newest import AHEAD_S, Newest, Rivals
from .common.nodes import STEADY
from .common.process import PATIENCE_S, WAKE_S
from .common.qos import LATCHED, QUEUE

MOST_WAITING = 1024
"""Samples of a topic that wait for the program, the newest ones. Chosen: more than a row holds."""
LOOK_S = 0.2
"""Interval of looks for publishers of states, s; chosen, as a body's for subscribers."""
NODE = "tactile_observation"
STATES = dict(zip(fields.VECTORS, (JointState, Float32MultiArray, Float64MultiArray), strict=True))


class TopicObservation(Observation):
    """The observation of a dataset, as LiveObservation, by the topics that were recorded for it.

        with TopicObservation("grasps") as observation:
            while True:
                action = policy(observation.read())

    dataset: a folder that `tactile-cdma export --lerobot` wrote, or what is to be known of one.
    drivers: node of a patch's driver, such as /left_palm/skin, by the patch's name in the dataset;
        needed where the dataset is of no bag, or the driver has another name now.
    features, elements, others: see Observation.

    From open() to close() it has a node, a ROS context and a thread of its own. What the dataset's
    state was recorded from is subscribed to; state() is for any other.

    CaptureError: raised for a folder that is no such dataset. ParameterError: for a driver of no
    patch, and a patch without a driver.
    """

    def __init__(
        self, dataset: str | PathLike[str] | DatasetMeta, drivers: Mapping[str, str] | None = None
    ) -> None:
        if not isinstance(dataset, DatasetMeta):
            dataset = DatasetMeta.read(path_of("dataset", dataset))
        topics = {name: about.get("topic", "") for name, about in dataset.about.items()}
        recorded = {name: topic.rpartition("/")[0] for name, topic in topics.items() if topic}
        self._drivers = recorded | _named(drivers or {})
        for name in self._drivers.keys() - dataset.slots.keys():
            raise ParameterError(unknown(name, dataset.slots, "patch"))
        for name in dataset.slots.keys() - self._drivers.keys():
            raise ParameterError(f"drivers has no {name}, and {dataset.path} does not name it")
        self._background: Background | None = None
        self._patches: dict[str, _Patch] = {}
        self._inboxes: dict[str, _Inbox] = {}
        streams = {k: one for k, one in dataset.streams.items() if k != STATE or not dataset.states}
        super().__init__(dataset, streams | dataset.states)

    @classmethod
    def of(
        cls, drivers: Mapping[str, str], contacts: bool = False, wait_s: float = PATIENCE_S
    ) -> TopicObservation:
        """Take what `tactile-cdma export --samples last` would write of these drivers' topics.

        drivers: nodes by the names of their patches. contacts: with contacts and wrench. Raises
        PortError for a driver that does not describe its skin within wait_s.
        """
        argument("contacts", contacts, False)
        patches = _described(_named(drivers), seconds("wait_s", wait_s))
        return cls(DatasetMeta.of(patches, contacts, ROWS_HZ, LAST, HOLD), drivers)

    def open(self) -> None:
        """Subscribe, and forget what was known; nothing happens where it is open."""
        if self._background is not None:
            return
        background, stale = Background(NODE), stale_s(self.meta.fps)
        try:
            node, own = background.node, self._streams.keys() - {STATE}
            self._inboxes = {key: _Inbox(node, key, stale) for key in own}
            self._patches = {
                name: _Patch(node, name, driver, self._inboxes, self._check_taxels)
                for name, driver in self._drivers.items()
            }
            node.create_timer(LOOK_S, partial(self._look_for_states, node), clock=STEADY)
            background.start()
        except BaseException:
            background.close()
            raise
        self._background = background
        self._begin()

    def close(self) -> None:
        """End node, thread and context; nothing happens where it is closed."""
        background, self._background = self._background, None
        if background is not None:
            background.close()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def abouts(self) -> dict[str, Mapping[str, Any]]:
        """Return what drivers have told of their skins, by name."""
        return {name: one.info.about for name, one in self._patches.items() if one.info is not None}

    def at(self, time_ns: int) -> dict[str, NDArray[Any]]:
        """Observe a moment, Unix time, not before the last one; raises as read()."""
        self._take_waiting()
        return super().at(time_ns)

    def _now_ns(self) -> int:
        background = self._background
        return time.time_ns() if background is None else _now_ns(background.node)

    def _take_waiting(self) -> None:
        if self._background is None:
            raise PortError("the observation is closed")
        if not self._background.is_served:
            raise PortError("the observation is over: ROS was shut down, perhaps by a signal")
        if self._now_ns() < self._present.done_ns - AHEAD_S * NANO:
            self._begin()  # a simulated clock was set back
        for patch in self._patches.values():
            if patch.rivals.problem:
                raise ObservationError(patch.rivals.problem)
            if patch.info is not None and patch.info.frame_period_s > LAG_S / 2:
                self._lag_ns = max(self._lag_ns, round(2 * patch.info.frame_period_s * NANO))
        for inbox in self._inboxes.values():
            while inbox.waiting:
                self._add(inbox.waiting.popleft())

    def _problems(self) -> Iterator[str]:
        return (inbox.problem for inbox in self._inboxes.values() if inbox.problem)

    def _look_for_states(self, node: Node) -> None:
        """Subscribe to the states' topics once a publisher tells of what type they are."""
        for key, stream in self.meta.states.items():
            kinds = (one.topic_type for one in node.get_publishers_info_by_topic(stream.topic))
            kind = next(filter(STATES.get, kinds), None)
            if kind is not None and not (inbox := self._inboxes[key]).topic:
                inbox.follow(STATES[kind], stream.topic, partial(_vector, stream.names))


class _Inbox:
    """Samples of a stream that were of now when they came, and wait for the program.

    topic: its full name; empty before follow().
    """

    def __init__(self, node: Node, key: str, stale_after_s: float) -> None:
        self._node, self._key, self.topic = node, key, ""
        self._newest, self._refused = Newest(node.get_clock(), stale_after_s), ""
        self.waiting: deque[Sample] = deque(maxlen=MOST_WAITING)

    def follow(
        self,
        kind: type,
        topic: str,
        read: Callable[[Any], Value | None],
        hear: Callable[[dict[str, Any]], object] = bool,
    ) -> None:
        """Take messages of a topic.

        read: returns the value of one; None: of no sample of this stream.
        """

        def take(message: Any, about: dict[str, Any]) -> None:
            hear(about)
            try:
                if (value := read(message)) is not None:
                    self._take(message, value)
            except TactileError as error:
                self._refused = str(error)

        self.topic = self._node.create_subscription(kind, topic, take, QUEUE).topic_name

    @property
    def problem(self) -> str:
        """Tell why there is nothing of now; empty if there is."""
        if self._newest.is_of_now:
            return ""
        return f"{self.topic or self._key}: {self._refused or 'nothing comes'}"

    def _take(self, message: Any, value: Value) -> None:
        now_ns = _now_ns(self._node)
        stamp_ns = fields.stamp_ns(message) or now_ns
        frame = getattr(message, "info_id", 0), getattr(message, "sequence", stamp_ns)
        if not self._newest.take(stamp_ns, frame, getattr(message, "stamp_uncertainty", 0.0)):
            raise MessageError(self._newest.refused)
        self._refused = ""
        self.waiting.append(Sample(self._key, stamp_ns, now_ns, value))


class _Patch:
    """What a driver publishes of its skin.

    info: as it describes it; None before that, and for another skin than is wanted.
    """

    def __init__(
        self,
        node: Node,
        name: str,
        driver: str,
        inboxes: Mapping[str, _Inbox],
        check: Callable[[PatchInfo], object],
    ) -> None:
        """inboxes: of what is wanted, by key. check: raises CaptureError for another skin."""
        self.info: PatchInfo | None = None
        self.driver, self._name, self._check = driver, name, check
        self._reason, self._info_id = "no ~/info has come yet", 0
        self.rivals = Rivals(node, node.resolve_topic_name(f"{driver}/tactile"))
        node.create_subscription(TactileSkinInfo, f"{driver}/info", self._take_info, LATCHED)
        hows: tuple[tuple[Any, ...], ...] = (
            (TactileArray, f"{driver}/tactile", self._frame, self.rivals.hear),
            (TactileContacts, f"{driver}/contacts", fields.contacts),
            (WrenchStamped, f"{driver}/wrench", fields.wrench),
        )
        for key, how in zip(skin_keys(name), hows, strict=True):
            if key in inboxes:
                inboxes[key].follow(*how)

    def _take_info(self, message: TactileSkinInfo) -> None:
        self.info = None
        try:
            places_of(message)
            array = TactileArray(height=message.height, width=message.width, pressure=message.area)
            found = fields.patch(f"{self.driver}/tactile", "", array, message)
            self._check(found := replace(found, name=self._name))
        except TactileError as error:
            self._reason = str(error)
        else:
            self.info, self._info_id = found, message.info_id

    def _frame(self, message: TactileArray) -> SkinFrame:
        pressure_pa, status = readings_of(message)
        if self.info is None:
            raise MessageError(self._reason)
        if message.info_id != self._info_id:
            raise MessageError(f"frames of info {message.info_id}; the last was {self._info_id}")
        frame = fields.skin_frame(message, fields.stamp_ns(message), self.info)
        return replace(frame, pressure_pa=pressure_pa, status=status)


def _named(drivers: Mapping[str, str]) -> dict[str, str]:
    return {
        argument("a patch's name", name, ""): node_name(driver)
        for name, driver in instance("drivers", drivers, Mapping).items()
    }


def _described(drivers: Mapping[str, str], wait_s: float) -> list[PatchInfo]:
    """Wait for what drivers say of their skins; raises PortError."""
    with closing(Background(NODE)) as background:
        patches = [_Patch(background.node, *each, {}, bool) for each in drivers.items()]
        background.start()
        end_s = time.monotonic() + wait_s
        while missing := [one.driver for one in patches if one.info is None]:
            if time.monotonic() > end_s or not background.is_served:
                raise PortError(f"no ~/info of {', '.join(missing)}: do these drivers run?")
            time.sleep(WAKE_S)
        return [one.info for one in patches if one.info is not None]


def _vector(names: tuple[str, ...], message: Any) -> Value | None:
    """Read a state; None for another program's. A number that is none was not measured."""
    values = fields.vector(message, names)
    if values is not None and not np.isfinite(values).all():
        raise MessageError("its values are not finite")
    return values


def _now_ns(node: Node) -> int:
    return int(node.get_clock().now().nanoseconds)
