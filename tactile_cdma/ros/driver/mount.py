# SPDX-License-Identifier: Apache-2.0

"""Publishes to tf where the skin is mounted, or, if the parameters do not say it, its middle."""

import numpy as np
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from ...base.errors import SpecError
from ...config.parameters import Values
from ...places.layout import Layout
from ...places.layout_shapes import tangents
from ...places.poses import Pose

TF_STATIC = "/tf_static"
MIDDLE = "_middle"
"""Ending, after the skin's frame_id, of the name of the frame in its middle."""


class Mount:
    """A node's transform on /tf_static, offered from configure to cleanup."""

    def __init__(self, node: Node, profile: QoSProfile) -> None:
        self._node, self._profile = node, profile
        self._publisher: Publisher | None = None

    def show(self, values: Values, layout: Layout) -> None:
        """Publish where the skin is, by all parameters' values; raises SpecError as transform_of.

        A skin that is not mounted by parameters gets a frame in its middle: its own frame, which a
        robot's description may hold as well, is then known to tf, and rviz does not miss it.
        """
        transform = transform_of(values)
        if transform is None and values["frame_id"]:
            transform = middle_of(values, layout)
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
    """Place the skin by all parameters' values, without a stamp; None without a parent_frame.

    Raises SpecError for names that tf does not take.
    """
    parent, child = values["parent_frame"], values["frame_id"]
    if not parent:
        return None
    if parent == child:
        raise SpecError(f"parent_frame and frame_id are both {parent!r}: they must be two frames")
    if not child:
        raise SpecError(f"frame_id is empty: tf wants a name for what is mounted on {parent!r}")
    return _stamped(parent, child, Pose.of_rpy(values["mount_xyz_m"], values["mount_rpy_rad"]))


def middle_of(values: Values, layout: Layout) -> TransformStamped:
    """Place the skin's middle, the middle taxel, in its own frame, z out of it; without a stamp."""
    taxel = layout.middle
    right, up = tangents(layout.normals[taxel : taxel + 1])
    axes = np.stack([right[0], up[0], layout.normals[taxel]], axis=1)
    pose = Pose(axes, layout.positions_m[taxel].astype(np.float64))
    return _stamped(values["frame_id"], values["frame_id"] + MIDDLE, pose)


def _stamped(parent: str, child: str, pose: Pose) -> TransformStamped:
    translation = Vector3(**dict(zip("xyz", pose.translation_m.tolist(), strict=True)))
    rotation = Quaternion(**dict(zip("xyzw", pose.quaternion.tolist(), strict=True)))
    return TransformStamped(
        header=Header(frame_id=parent),
        child_frame_id=child,
        transform=Transform(translation=translation, rotation=rotation),
    )
