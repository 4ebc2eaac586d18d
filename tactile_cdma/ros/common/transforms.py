# SPDX-License-Identifier: Apache-2.0

"""Hears /tf and /tf_static: tf2's Python interface is not on PyPI, its messages are enough."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.subscription import Subscription
from tf2_msgs.msg import TFMessage

from ...base.errors import TransformError
from ...places.poses import Pose
from ...places.tf_tree import TfTree

QUEUE = 100
"""Messages, as tf2 has it."""
STATIC = QoSProfile(depth=QUEUE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
COMPLAINT_S = 10.0


class TransformListener:
    """A tree of tf frames as a node hears of them, while it follows."""

    def __init__(self, node: Node) -> None:
        self.tree = TfTree()
        self._node = node
        self._subscriptions: list[Subscription] = []

    def follow(self, asked: bool) -> None:
        """Subscribe while the tree is needed."""
        if asked and not self._subscriptions:
            self._subscriptions = [
                self._node.create_subscription(TFMessage, topic, self._take, qos)
                for topic, qos in (("/tf_static", STATIC), ("/tf", QoSProfile(depth=QUEUE)))
            ]
        elif not asked:
            for subscription in self._subscriptions:
                self._node.destroy_subscription(subscription)
            self._subscriptions = []

    def _take(self, message: TFMessage) -> None:
        for stamped in message.transforms:
            place, turn = stamped.transform.translation, stamped.transform.rotation
            try:
                pose = Pose.of_quaternion(
                    (place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w)
                )
                self.tree.put(stamped.header.frame_id, stamped.child_frame_id, pose)
            except (ValueError, TransformError) as error:
                self._node.get_logger().warning(
                    f"transform of {stamped.child_frame_id!r} not taken: {error}",
                    throttle_duration_sec=COMPLAINT_S,
                )
