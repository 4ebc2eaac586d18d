# SPDX-License-Identifier: Apache-2.0

"""Publishes a body's contacts and wrench, taxels, points, and the names of its patches."""

import time
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
from geometry_msgs.msg import WrenchStamped
from numpy.typing import NDArray
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from tactile_cdma.msg import TactileArray, TactileBody, TactileContacts, TactileSkinInfo

from ...messages.cdr import TaxelArray, read_array
from ...messages.rounds import Rounds
from ...readings.status import is_certain
from ...views.cloud import BODY_POINT, Cloud
from ..common.convert import point_cloud, publish_wrench
from ..common.following import Following, Topic
from ..common.newest import Newest, Rivals
from ..common.nodes import STEADY
from ..common.qos import FRESH, LATCHED, PICTURE, RELIABLE
from ..common.touches import Touches
from .messages import Part, Places, body_contacts, body_names, body_tactile
from .patches import MessageInfo, Patches

FIRST_S = 2.0
"""Longest wait for all patches before the first message, s, unless stale_after_s is longer. A patch
that was not heard yet is not absent. Chosen: on a busy computer discovery takes a second."""
LATEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""QoS of arrays: points are drawn less often than arrays arrive."""
Offer = Callable[[Any, str, QoSProfile], Publisher]
"""Creates a publisher of the node: type, topic, QoS."""
Message = TypeVar("Message", bound=Touches | TaxelArray)


class Output(Generic[Message]):
    """Publishes something that it makes of the patches' messages, while somebody subscribes to it.

    latest: each patch's newest message since somebody subscribes. places: of its taxels, by its
    latest info, where topics have infos.
    """

    def __init__(
        self,
        patches: Patches,
        publishers: list[Publisher],
        read: Callable[[bytes], Message],
        *topics: Topic,
        is_polled: bool = False,
    ) -> None:
        """read: takes a message apart. topics: of every patch, names and callbacks without it."""
        self.patches, self._publishers = patches, publishers
        self._read: Callable[[bytes], Message] = read
        self.latest: dict[str, Message] = {}
        self.places: dict[str, Places] = {}
        values, clock = patches.values, patches.node.get_clock()
        ages = values["stale_after_s"], values["clocks_apart_s"]
        self.newest = {patch: Newest(clock, *ages) for patch in patches.arrivals}
        name, node = topics[-1].name, patches.node
        self._rivals = {patch: Rivals(node, f"{patch}/{name}") for patch in patches.arrivals}
        own = [
            topic._replace(name=f"{patch}/{topic.name}", callback=partial(topic.callback, patch))
            for patch in patches.arrivals
            for topic in topics
        ]
        self.following = Following(node, *own, is_polled=is_polled)

    def tick(self) -> bool:
        """Follow the patches if somebody subscribes; returns whether somebody does."""
        asked = any(publisher.get_subscription_count() for publisher in self._publishers)
        self.following.follow(asked)
        if not asked:
            self.latest.clear()
            self.places.clear()
        return asked

    def take_info(self, name: str, message: TactileSkinInfo) -> None:
        self.places.pop(name, None)  # those of before may be of another skin
        self.places[name] = Places(message)

    def places_of(self, name: str, array: TaxelArray) -> Places | None:
        """Return where the taxels of a patch's array are; None if unknown."""
        places = self.places.get(name)
        # A restarted driver counts from 1 again: the same id may mean another skin.
        if places and (places.info_id, len(places)) != (array.info_id, len(array.status)):
            return None
        return places

    def hear(self, name: str, data: bytes, info: MessageInfo) -> Message | None:
        """Take apart what a patch has sent, and note that it came.

        None if it is not of now, or may be of another driver than the last: which of them knows
        what touches the patch, nobody can tell.
        """
        message, newest, rivals = self._read(data), self.newest[name], self._rivals[name]
        stamp_ns, frame = message.heading.stamp_ns, (message.info_id, message.sequence)
        is_taken = newest.take(stamp_ns, frame, message.stamp_uncertainty_s)
        rivals.hear(info)
        if problem := rivals.problem:
            newest.forget()
        self.patches.arrivals[name].add(message, info, problem or newest.refused)
        return message if is_taken and not problem else None


class RoundOutput(Output[Message]):
    """Publishes what the patches sent in one round, and what is absent where nothing comes."""

    def __init__(self, patches: Patches, *about: Any) -> None:
        """about: what follows patches in Output."""
        super().__init__(patches, *about)
        self.rounds = Rounds(patches.values["stale_after_s"])
        self.published_s = time.monotonic()  # when it was, or would have been, published
        self.sequence = 0

    def tick(self) -> bool:
        asked, now_s = super().tick(), time.monotonic()
        if not asked:
            self.rounds.forget()
            self.published_s = now_s
        elif now_s - self.published_s > self.rounds.silent_after_s:
            self._end_round(now_s)
        return asked

    @abstractmethod
    def publish(self, present: set[str], now_s: float) -> bool:
        """Publish the latest messages of the patches that are present; returns whether it did."""

    def take(self, name: str, data: bytes, info: MessageInfo) -> None:
        """Add a patch's message to the round that it belongs to."""
        message, now_s = self.hear(name, data, info), time.monotonic()
        if message is None:
            return
        if self.rounds.is_due_before(name):
            self._end_round(now_s)
        self.latest[name] = message
        if self.rounds.add(name, now_s):
            self._end_round(now_s)

    def _end_round(self, now_s: float) -> None:
        self.rounds.end()
        heard = self.rounds.present(self.patches.arrivals, now_s)
        if self.publish({name for name in heard if self.newest[name].is_of_now}, now_s):
            self.published_s = now_s
            self.sequence += 1


class ContactsOutput(RoundOutput[Touches]):
    """Publishes ~/contacts and ~/wrench."""

    def __init__(self, patches: Patches, offer: Offer) -> None:
        self._contacts = offer(TactileContacts, "~/contacts", RELIABLE)
        self._wrench = offer(WrenchStamped, "~/wrench", RELIABLE)
        topic = Topic(TactileContacts, "contacts", self.take, FRESH, raw=True)
        super().__init__(patches, [self._contacts, self._wrench], Touches.read, topic)
        self._is_first = True  # nobody has had a message yet

    def tick(self) -> bool:
        asked = super().tick()
        self._is_first |= not asked
        return asked

    def publish(self, present: set[str], now_s: float) -> bool:
        parts, absent = [], []
        for name in self.patches.arrivals:
            message = self.latest.get(name) if name in present else None
            pose = self.patches.pose(name, message)
            if message and message.taxels_valid and pose:
                parts.append((pose, message))
            else:
                absent.append(name)
        patience_s = max(FIRST_S, self.rounds.silent_after_s)
        if absent and self._is_first and now_s - self.published_s <= patience_s:
            return False
        self._is_first = False
        heading = self.patches.heading(message for _, message in parts)
        found = body_contacts(parts, absent, heading, self.sequence)
        self._contacts.publish(found.message)
        if self._wrench.get_subscription_count():
            values, sums = self.patches.values, (found.force_n, found.torque_nm)
            publish_wrench(self._wrench, values, heading, *sums)
        return True


class TaxelsOutput(RoundOutput[TaxelArray]):
    """Publishes ~/tactile."""

    def __init__(self, patches: Patches, offer: Offer) -> None:
        self._tactile = offer(TactileBody, "~/tactile", qos_profile_sensor_data)
        infos = Topic(TactileSkinInfo, "info", self.take_info, LATCHED)
        arrays = Topic(TactileArray, "tactile", self.take, FRESH, raw=True)
        super().__init__(patches, [self._tactile], read_array, infos, arrays)

    def publish(self, present: set[str], now_s: float) -> bool:
        parts, absent, there = [], [], []
        for name in self.patches.arrivals:
            array, places = self.latest.get(name), self.places.get(name)
            is_absent = name not in present or not array or not self.places_of(name, array)
            pose = self.patches.pose(name, array)
            if array and places:
                parts.append(Part(name, array, places, pose, is_absent))
            if is_absent:
                absent.append(name)
            elif array:
                there.append(array)
        heading = self.patches.heading(there)
        self._tactile.publish(body_tactile(parts, absent, heading, self.sequence))
        return True


class PointsOutput(Output[TaxelArray]):
    """Publishes ~/points, at most visual_rate_hz times a second, and ~/names.

    Both are made of each patch's latest array, taken from the middleware only when needed: arrays
    come more often than points are drawn.
    """

    def __init__(self, patches: Patches, offer: Offer) -> None:
        self._points = offer(PointCloud2, "~/points", PICTURE)
        self._names = offer(MarkerArray, "~/names", PICTURE)
        infos = Topic(TactileSkinInfo, "info", self.take_info, LATCHED)
        arrays = Topic(TactileArray, "tactile", self._take, LATEST, raw=True)
        publishers = [self._points, self._names]
        super().__init__(patches, publishers, read_array, infos, arrays, is_polled=True)
        self._new: set[str] = set()  # patches whose arrays have not been drawn
        self._drawn: list[str] = []  # patches that the last points are of
        self._message, self._is_due = b"", False
        period_s = 1.0 / patches.values["visual_rate_hz"]
        self._timer = patches.node.create_timer(period_s, self._become_due, clock=STEADY)
        self._timer.cancel()  # until somebody asks

    def tick(self) -> bool:
        if not (asked := super().tick()):
            self._new.clear()
        if not self._points.get_subscription_count():
            self._timer.cancel()
        else:
            if self._timer.is_canceled():
                self._timer.reset()
            self._draw()  # notices silent patches, however seldom points are drawn
        if self._names.get_subscription_count():
            self._publish_names()
        return asked

    def _publish_names(self) -> None:  # also of a patch that has fallen silent
        self.following.poll()
        places_m = {
            name: pose.apply(places.positions_m)
            for name, array in self.latest.items()
            if (places := self.places.get(name)) and (pose := self.patches.pose(name, array))
        }
        if places_m:
            self._names.publish(body_names(places_m, self.patches.values["frame_id"]))

    def _take(self, name: str, data: bytes, info: MessageInfo) -> None:
        if message := self.hear(name, data, info):
            self.latest[name] = message
            self._new.add(name)

    def _become_due(self) -> None:
        self._is_due = True
        self._draw()

    def _draw(self) -> None:
        """Publish the latest of every patch, if due and any is new, or a patch has come or gone."""
        self.following.poll()
        present = [name for name, newest in self.newest.items() if newest.is_of_now]
        is_new = not self._new.isdisjoint(present) or present != self._drawn
        if not self._is_due or not is_new:
            return
        self._is_due, self._drawn = False, present
        self._new.difference_update(present)
        found = {name: cloud for name in present if (cloud := self._cloud(name)) is not None}
        heading = self.patches.heading(self.latest[name] for name in found)
        # Kept until the next one, as by the driver's Pictures.
        self._message = point_cloud(BODY_POINT, list(found.values()), heading)
        self._points.publish(self._message)

    def _cloud(self, name: str) -> NDArray[np.void] | None:
        """Return (m,) BODY_POINT of a patch; None while its info or its place is missing."""
        array, values = self.latest.get(name), self.patches.values
        pose = self.patches.pose(name, array)
        if not array or not pose or not (places := self.places_of(name, array)):
            return None
        certain_pa = np.where(is_certain(array.status), array.pressure_pa, np.float32(np.nan))
        cloud = Cloud(*places.placed(pose), list(self.patches.arrivals).index(name))
        return cloud.points(certain_pa, values["colour_max_kpa"] * 1e3, values["colour_gamma"])
