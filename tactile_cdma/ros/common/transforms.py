# SPDX-License-Identifier: Apache-2.0

"""Listens to /tf and /tf_static without tf2, whose Python interface is not on PyPI."""

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

from ...base.errors import TransformError
from ...places.poses import Pose, TfTree
from .following import Following, Topic

QUEUE = 100
"""Depth of the subscriptions; the same as in tf2."""
STATIC = QoSProfile(depth=QUEUE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
COMPLAINT_S = 10.0
"""Least time between two warnings of the same cause, s; chosen."""


class TransformListener:
    """The tree of tf frames that a node receives while it follows them."""

    def __init__(self, node: Node) -> None:
        self.tree = TfTree()
        self._node = node
        self.follow = Following(
            node,
            Topic(TFMessage, "/tf_static", self._take, STATIC),
            Topic(TFMessage, "/tf", self._take, QoSProfile(depth=QUEUE)),
        ).follow

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
