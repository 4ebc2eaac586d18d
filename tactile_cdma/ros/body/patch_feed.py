# SPDX-License-Identifier: Apache-2.0

"""Receives what one patch of a body publishes, while it is needed."""

import math
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from tactile_cdma.msg import TactileArray, TactileContacts, TactileSkinInfo

from ...base.arrays import Floats
from ...messages.cdr import TaxelArray, read_array
from ...places.poses import Pose
from ...readings.status import is_certain
from ...readings.taxels import Coverage
from ...views.cloud import Cloud
from ..common.convert import places_of
from ..common.following import Following, Topic
from ..common.qos import FRESH, LATCHED
from ..common.touches import Touches
from .tactile import Places

LATEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""QoS of arrays: points are drawn less often than arrays arrive."""
MessageInfo = dict[str, int]
"""What the middleware knows of a message: source_timestamp, received_timestamp, ns."""


class PatchFeed:
    """The latest messages of one patch.

    node_name: fully qualified name of the patch's driver. contacts, taxels: the latest messages;
    array: the latest that was polled; None: none since they are followed. is_new: the array has not
    been drawn. places: of the taxels, by the latest info.
    """

    def __init__(
        self,
        node: Node,
        node_name: str,
        index: int,
        on_contacts: Callable[["PatchFeed", Touches], None],
        on_taxels: Callable[["PatchFeed", TaxelArray], None],
    ) -> None:
        self.node_name = node_name
        self.contacts: Touches | None = None
        self.taxels: TaxelArray | None = None
        self.places: Places | None = None
        self.array: TaxelArray | None = None
        self.is_new = False
        self._heard_s, self._stamp_ns = -math.inf, 0
        self._late_s = self._underway_s = math.inf
        self._settles = False  # ROS time has just stepped back
        self._counted, self._reported_s = 0, -math.inf
        self._node, self._index = node, index
        self._on_contacts, self._on_taxels = on_contacts, on_taxels
        self._cloud: tuple[int, Cloud] | None = None  # and the info_id that it is of
        contacts, info, array = (f"{node_name}/{name}" for name in ("contacts", "info", "tactile"))
        self._for_contacts = Following(
            node, Topic(TactileContacts, contacts, self._take_contacts, FRESH, raw=True)
        )
        self._for_taxels = Following(
            node,
            Topic(TactileSkinInfo, info, self._take_places, LATCHED),
            Topic(TactileArray, array, self._take_taxels, FRESH, raw=True),
        )
        self._for_points = Following(
            node,
            Topic(TactileSkinInfo, info, self._take_info, LATCHED),
            Topic(TactileArray, array, self._take_array, LATEST, raw=True),
            is_polled=True,
        )

    @property
    def is_followed(self) -> bool:
        return bool(self._for_contacts or self._for_points or self._for_taxels)

    def silent_s(self, now_s: float) -> float:
        """Time since the last message, s; infinite if there was none."""
        return now_s - self._heard_s

    def late_s(self) -> float:
        """Least age of a message on arrival since the last call, s; 0 if none arrived.

        The least, because a busy computer takes some messages late, but not all.
        """
        late_s, self._late_s = self._late_s, math.nan if self._settles else math.inf
        self._settles = False
        return late_s if late_s < math.inf else 0.0

    def step_back(self) -> None:
        """ROS time has stepped back, as where a bag begins anew: no stamp counts as off for now.

        Until late_s was asked twice: messages of before may still come after the first time.
        """
        self._late_s, self._stamp_ns, self._settles = math.nan, 0, True

    def underway_s(self) -> float:
        """Least time that a message took since the last call, s; NaN if that is not known.

        From its sending, by the clock of its driver's computer, to its arrival, by the clock of
        this one: delay of the network plus offset of the clocks. The least, because the network
        delays some messages more than others.
        """
        underway_s, self._underway_s = self._underway_s, math.inf
        return underway_s if underway_s < math.inf else math.nan

    def rate_hz(self, now_s: float) -> float:
        """Rate of the frames received since the last call."""
        rate_hz = self._counted / (now_s - self._reported_s)
        self._counted, self._reported_s = 0, now_s
        return rate_hz

    @property
    def coverage(self) -> Coverage | None:
        """How much of the patch its latest message is of; None without any."""
        if self.contacts:
            return Coverage(self.contacts.taxels_valid, self.contacts.taxels_in_service)
        latest = self.taxels or self.array
        return Coverage.of(latest.pressure_pa, latest.status) if latest else None

    @property
    def has_driver(self) -> bool:
        """Whether anybody publishes its topics.

        With a discovery server, only topics that are subscribed to are known.
        """
        return any(
            self._node.count_publishers(f"{self.node_name}/{topic}")
            for topic in ("contacts", "tactile")
        )

    def follow(self, contacts: bool, points: bool, taxels: bool) -> None:
        """Subscribe to what the body's contacts, points and taxels need, and to nothing else.

        Names need what points do: the places of patches that are there.
        """
        self._for_contacts.follow(contacts)
        self._for_points.follow(points)
        self._for_taxels.follow(taxels)
        if not taxels:
            self.taxels = None
        if not contacts:
            self.contacts = None
        if not points:
            self.array = self._cloud = None
            self.is_new = False

    def poll_points(self) -> None:
        """Take the latest array, and info, if there are new ones."""
        self._for_points.poll()

    @property
    def taxels_m(self) -> Floats | None:
        """(t, 3) places of taxels in the patch's frame, m; None if not known."""
        return None if self._cloud is None else self._cloud[1].positions_m

    def points(self, max_pa: float, pose: Pose, gamma: float) -> NDArray[np.void] | None:
        """(m,) BODY_POINT of the latest array; None while the info that goes with it is missing.

        max_pa, pose, gamma: see Cloud.points.
        """
        if self.array is None or self._cloud is None:
            return None
        info_id, cloud = self._cloud
        pressure_pa = self.array.pressure_pa
        # A restarted driver counts from 1 again: the same id may mean another skin.
        if self.array.info_id != info_id or len(pressure_pa) != len(cloud):
            return None
        certain_pa = np.where(is_certain(self.array.status), pressure_pa, np.float32(np.nan))
        return cloud.points(certain_pa, max_pa, pose, gamma)

    def _hear(self, stamp_ns: int, info: MessageInfo) -> None:
        self._counted += stamp_ns > self._stamp_ns  # once per frame, not per topic
        self._heard_s, self._stamp_ns = time.monotonic(), stamp_ns
        age_ns = self._node.get_clock().now().nanoseconds - stamp_ns
        self._late_s = min(self._late_s, age_ns * 1e-9)
        sent_ns, received_ns = info["source_timestamp"], info["received_timestamp"]
        if sent_ns and received_ns:  # 0 where the middleware does not tell
            self._underway_s = min(self._underway_s, (received_ns - sent_ns) * 1e-9)

    def _take_contacts(self, message: bytes, info: MessageInfo) -> None:
        contacts = Touches.read(message)
        self._hear(contacts.heading.stamp_ns, info)
        self._on_contacts(self, contacts)

    def _take_taxels(self, message: bytes, info: MessageInfo) -> None:
        taxels = read_array(message)
        self._hear(taxels.heading.stamp_ns, info)
        self._on_taxels(self, taxels)

    def _take_places(self, message: TactileSkinInfo) -> None:
        self.places = None  # those of before may be of another skin
        self.places = Places(message)

    def _take_array(self, message: bytes, info: MessageInfo) -> None:
        self.array = read_array(message)
        self._hear(self.array.heading.stamp_ns, info)
        self.is_new = True

    def _take_info(self, message: TactileSkinInfo) -> None:
        self._cloud = None
        positions_m, normals, _ = (place.astype(np.float32) for place in places_of(message))
        self._cloud = message.info_id, Cloud(positions_m, normals, self._index)
