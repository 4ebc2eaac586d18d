# SPDX-License-Identifier: Apache-2.0

"""Publishes to tf where the skin is mounted, if the parameters say it."""

from __future__ import annotations

from geometry_msgs.msg import Quaternion, Transform, TransformStamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from ...base.errors import SpecError
from ...config.parameters import Values
from ...places.poses import Pose
from ..common.convert import vector

TF_STATIC = "/tf_static"


class Mount:
    """A node's transform on /tf_static, offered from configure to cleanup."""

    def __init__(self, node: Node, profile: QoSProfile) -> None:
        self._node, self._profile = node, profile
        self._publisher: Publisher | None = None

    def show(self, transform: TransformStamped | None) -> None:
        """Publish where the skin is; None: it is not mounted on another frame."""
        if transform is None:
            return
        if self._publisher is None:
            self._publisher = self._node.create_publisher(TFMessage, TF_STATIC, self._profile)
        transform.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(TFMessage(transforms=[transform]))

    def release(self) -> None:
        """Offer the transform no longer; those who received it keep it, as usual in tf."""
        if self._publisher is not None:
            self._node.destroy_publisher(self._publisher)
            self._publisher = None


def transform_of(values: Values) -> TransformStamped | None:
    """The skin's place by all parameters' values, without a stamp; None without a parent_frame.

    Raises SpecError for names that tf does not take.
    """
    parent, child = values["parent_frame"], values["frame_id"]
    if not parent:
        return None
    if parent == child:
        raise SpecError(f"parent_frame and frame_id are both {parent!r}: they must be two frames")
    for name in ("parent_frame", "frame_id"):
        if not values[name] or values[name].startswith("/"):
            raise SpecError(f"{name} is {values[name]!r}: tf wants a name, without a leading slash")
    pose = Pose.of_rpy(values["mount_xyz_m"], values["mount_rpy_rad"])
    translation = vector(pose.translation_m)
    rotation = Quaternion(**dict(zip("xyzw", pose.quaternion.tolist(), strict=True)))
    return TransformStamped(
        header=Header(frame_id=parent),
        child_frame_id=child,
        transform=Transform(translation=translation, rotation=rotation),
    )
