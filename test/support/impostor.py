# SPDX-License-Identifier: Apache-2.0

"""A node that publishes what it likes as a driver's."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from geometry_msgs.msg import Point32, WrenchStamped
from rclpy.duration import Duration
from rclpy.node import Node

from tactile_cdma.msg import TactileArray, TactileContacts, TactileSkinInfo
from tactile_cdma.ros.client import SkinClient
from tactile_cdma.ros.common.qos import LATCHED

from .spinning import spinning
from .waiting import wait_for


class Impostor:
    """Publishes contacts of an untouched skin as the driver /other; a client, which hears them."""

    def __init__(self, node: Node, **how: Any) -> None:
        self.node, self.skin = node, SkinClient(node, "/other", frames=True, **how)
        self.contacts = node.create_publisher(TactileContacts, "/other/contacts", 10)
        self.arrays = node.create_publisher(TactileArray, "/other/tactile", 10)
        self.wrenches = node.create_publisher(WrenchStamped, "/other/wrench", 10)
        infos = node.create_publisher(TactileSkinInfo, "/other/info", LATCHED)
        point, up = Point32(), Point32(z=1.0)
        place = {"positions": [point], "normals": [up], "area": [1e-4], "node": [1]}
        infos.publish(TactileSkinInfo(info_id=7, height=1, width=1, **place))
        wait_for(lambda: self.contacts.get_subscription_count() and self.skin.info)

    def send(self, sequence: int, age_s: float = 0.0, uncertainty_s: float = 0.0) -> None:
        about = {"sequence": sequence, "info_id": 7, "stamp_uncertainty": uncertainty_s}
        found = TactileContacts(untouched=True, taxels_in_service=1, taxels_valid=1, **about)
        array = TactileArray(height=1, width=1, pressure=[1.0 * sequence], status=b"\0", **about)
        stamp = self.node.get_clock().now() - Duration(nanoseconds=round(age_s * 1e9))
        sent = (found, self.contacts), (array, self.arrays), (WrenchStamped(), self.wrenches)
        for message, publisher in sent:
            message.header.stamp = stamp.to_msg()
            publisher.publish(message)

    def is_sure_while(self, send: Callable[[int], object]) -> bool:
        """Whether the touch was ever sure in 1 s of frames, 20 ms apart, from the third on."""
        found = []
        for number in range(100, 150):
            send(number)
            time.sleep(0.02)
            sure, seen = self.skin.touch.is_sure, self.skin.frame is not None
            found.append((sure, seen, self.skin.touch.is_sure))
        # What is sure may end while it is looked at.
        assert all(sure == seen for sure, seen, still in found[3:] if sure == still)
        return any(sure for sure, *_ in found[3:])


@contextmanager
def impostor(**how: Any) -> Iterator[Impostor]:
    """An impostor whose node is served."""
    node = Node("impostor")
    with spinning([node]):
        yield Impostor(node, **how)
