# SPDX-License-Identifier: Apache-2.0

"""Where coordinate frames are to each other: the latest of what /tf and /tf_static say.

tf2 keeps a history and interpolates between the moments on either side of a stamp. Here the latest
counts, whatever the stamp: a patch on a moving arm is taken to be where the arm was last reported,
which is off by its speed times the age of that report (10 ms at 1 m/s: 10 mm).
"""

from __future__ import annotations

import numpy as np

from ..base.errors import TransformError
from .poses import Pose

MOST_FRAMES = 10_000
"""More than any robot has: a sender that makes up names must not fill the memory."""


_HERE = Pose(np.eye(3), np.zeros(3))


class TfTree:
    """Every frame's pose in its parent; a frame that is told again is moved."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}

    def put(self, parent: str, child: str, pose: Pose) -> None:
        """Learn the pose of child in parent.

        Raises TransformError for a frame that would be its own parent, and where there are too
        many frames.
        """
        parent, child = _plain(parent), _plain(child)
        if parent == child:
            raise TransformError(f"frame {child!r} is said to be its own parent")
        if child not in self._parents and len(self._parents) >= MOST_FRAMES:
            raise TransformError(
                f"more than {MOST_FRAMES} tf frames: does a node make up names without end?"
            )
        self._parents[child] = (parent, pose)

    def pose(self, target: str, source: str) -> Pose:
        """The pose of source in target: target.point = pose.apply(source.point).

        Raises TransformError, naming the frames, where they are not connected.
        """
        target, source = _plain(target), _plain(source)
        down, up = self._to_root(target), self._to_root(source)
        for frame, pose in up.items():
            if frame in down:
                return down[frame].inverse @ pose
        raise TransformError(
            f"no transform from {source!r} to {target!r}: {source!r} hangs from {list(up)[-1]!r}, "
            f"{target!r} from {list(down)[-1]!r}; set parent_frame and mount_xyz_m of the patch, "
            "or start what publishes the robot's frames"
        )

    def root(self, frame: str) -> tuple[str, Pose]:
        """The frame that a frame hangs from in the end, maybe itself, and its pose there.

        Raises TransformError where frames go round in a circle.
        """
        return list(self._to_root(_plain(frame)).items())[-1]

    def _to_root(self, frame: str) -> dict[str, Pose]:
        """The pose of a frame in itself, in its parent, and so on to the root."""
        pose = _HERE
        poses = {frame: pose}
        while frame in self._parents:
            frame, step = self._parents[frame]
            if frame in poses:
                raise TransformError(f"tf frames go round in a circle: {' → '.join(poses)}")
            pose = step @ pose
            poses[frame] = pose
        return poses


def _plain(frame: str) -> str:
    """Older nodes write frames with a slash before them."""
    return frame.removeprefix("/")
